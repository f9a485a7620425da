"""Resolve parameters to a scenario: simulate, frame, choose void and twin.

Only `resolve` creates records; it raises `Rejected`, with the reason, for a draw without a valid pair.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from traps_pipeline.base.plugins import plugins
from traps_pipeline.scenes.certification import ensemble
from traps_pipeline.scenes.certification.certificates import (
    MIN_ACCEPTED,
    OPEN,
    certificates_for,
    futures_of,
    open_from_state,
    settled_answer,
)
from traps_pipeline.scenes.certification.ensemble import Cut, Futures, Rollout
from traps_pipeline.scenes.certification.evidence import Claim, Evidence, Pair, VoidKind, require_certificates
from traps_pipeline.scenes.draw.closing import close_control, record_of
from traps_pipeline.scenes.draw.trim import trim_candidates
from traps_pipeline.scenes.physics.kit import Family, Physics, Wording, params_to_dict
from traps_pipeline.scenes.picture.camera import fit_shot
from traps_pipeline.scenes.worlds.outcome import Rejected, compile_scene, simulated
from traps_pipeline.scenes.worlds.pace import lengths, shortened
from traps_pipeline.scenes.worlds.shot import shot_of, shown_points
from traps_pipeline.scenes.worlds.spec import SceneSpec, Twin, physics_record, trajectory_digest
from traps_pipeline.scenes.worlds.world import World

HOPELESS_SHARE = 0.9  # of the scouts; a scene whose true top share is 65 % looks like that less than once in 300 times


@dataclass(frozen=True)
class Resolved:
    """A record, the trajectory of its control and that of its twin: qpos at frame times (F, nq) float32."""

    spec: SceneSpec
    qpos: np.ndarray
    twin: np.ndarray

    @property
    def worlds(self) -> dict[str, np.ndarray]:
        """The trajectories of a drawn scenario: its own and those of other worlds, by name."""
        return {"qpos": self.qpos, "twin": self.twin}


def resolve(
    family: Family,
    params: Any,
    wording: Wording,
    ill_posed_question: str,
    *,
    scenario_id: str,
    seed: int,
    physics: Physics | None = None,
) -> Resolved:
    """Return the record and trajectories of drawn parameters. Raises Rejected if they make no valid pair."""
    physics = physics or family.physics
    full = _control(family, params, physics)
    answer = full.outcome.label
    if answer is not None and answer not in wording.labels:
        raise ValueError(f"{family.name}: reading {answer!r} is not one of the labels {list(wording.labels)}")
    void_kind: VoidKind = "truncation" if full.occluder is None else "occluder"
    pair, evidence = _certify_some_length(full, void_kind, wording, ill_posed_question, seed)
    control, physics = pair.control, pair.control.physics
    twin, frame = pair.other_world, pair.void_from
    occluder = None if control.occluder is None else asdict(control.occluder)
    spec = SceneSpec(
        scenario_id=scenario_id,
        taxonomy=family.taxonomy,
        category=family.category,
        sub_scenario=family.sub_scenario,
        family=family.name,
        seed=seed,
        params=json_values(params_to_dict(params)),
        physics=physics_record(physics),
        camera=json_values(asdict(control.camera)),
        void_kind=void_kind,
        void=json_values({"cut_frame": frame} if occluder is None else {"panel": occluder, "hidden_from_frame": frame}),
        control=json_values(record_of(pair)),
        question=wording.question,
        labels=list(wording.labels),
        aliases=dict(wording.aliases),
        answer_type=family.answer_type,
        ground_truth=control.outcome.answer,
        ill_posed_question=ill_posed_question,
        answerable_question=json_values(asdict(wording.answerable_question)),
        trajectory_sha256=trajectory_digest(control.qpos),
        twin=Twin(
            params=None if occluder is None else json_values(params_to_dict(twin.params)),
            rollout=pair.rollout,
            ground_truth=twin.outcome.answer,
            trajectory_sha256=trajectory_digest(twin.qpos),
        ),
        evidence=({"package": plugin.package} if (plugin := plugins("families").get(family.name)) else {})
        | {
            name: value
            for certificate in certificates_for(void_kind)
            for name, value in certificate.kept(evidence).items()
        },
    )
    return Resolved(spec, control.qpos, twin.qpos)


def _certify_some_length(
    uncut: World, void_kind: VoidKind, wording: Wording, ill_posed_question: str, seed: int
) -> tuple[Pair, Mapping[str, Any]]:
    """Return the first pair with all certificates, and its evidence. Raises Rejected."""
    rejection = Rejected("no other hidden element gives another outcome")
    for worlds in [(uncut,)] if void_kind == "truncation" else _with_other_worlds(uncut):
        for n_frames in lengths(worlds, seed):
            control, *other_worlds = (shortened(world, n_frames) for world in worlds)
            end_s = (n_frames - 1) / control.physics.fps
            answer = control.outcome.label
            claim = Claim(
                uncut.family, end_s, len(wording.labels), answer, None, wording.question, ill_posed_question, seed
            )
            try:
                pair = Pair(control, claim, futures_of(control, seed))
                evidence = require_certificates(certificates_for(void_kind, "control"), pair, {})
                candidates = (
                    trim_candidates(_with_twin(pair, None, other_worlds[0])) if other_worlds else _at_latest_cut(pair)
                )
                return _first_certified(candidates, void_kind, seed, evidence)
            except Rejected as failure:
                rejection = failure  # another length, or another world, may do
    raise rejection


def _control(family: Family, params: Any, physics: Physics) -> World:
    """Simulate the control of a draw, and fit camera and occluder to it."""
    model, scene = compile_scene(family, params, physics)
    qpos = simulated(model, scene, physics)
    camera, occluder = fit_shot(scene.view, shown_points(model, scene, qpos), scene.cover)
    return World(family, params, physics, qpos, camera, occluder, simulated=qpos)


def _first_certified(
    candidates: Iterable[Pair], void_kind: VoidKind, seed: int, evidence: Evidence
) -> tuple[Pair, Mapping[str, Any]]:
    """Return the first pair whose void, twin and closing certify. Raises Rejected."""
    rejection = Rejected("there is no twin")
    for pair in candidates:
        try:
            return close_control(
                pair, seed, require_certificates(certificates_for(void_kind, "void", "twin"), pair, evidence)
            )
        except Rejected as failure:
            rejection = failure  # the next one may hide more, or be alike
    raise rejection


# --- occlusion --------------------------------------------------------------------------------------------------------


def _with_twin(pair: Pair, frame: int | None, twin: World) -> Pair:
    claim = replace(pair.claim, twin_answer=twin.outcome.label)
    return replace(pair, claim=claim, void_frame=frame, twin=twin)


def _with_other_worlds(control: World) -> Iterator[tuple[World, World]]:
    """Yield the control with each world of another hidden element and another outcome."""
    family, physics = control.family, control.physics
    assert family.twins is not None, f"{family.name}: an occlusion family needs twins"
    for params in family.twins(control.params):
        try:
            qpos = simulated(*compile_scene(family, params, physics), physics)
        except Rejected:
            continue  # this other world diverges; the next one may not
        world = replace(control, params=params, qpos=qpos, simulated=qpos)
        if settled_answer(world) not in (None, control.outcome.label):
            camera, occluder = shot_of((control, world))
            yield replace(control, camera=camera, occluder=occluder), replace(world, camera=camera, occluder=occluder)


# --- chaotic ----------------------------------------------------------------------------------------------------------


def _at_latest_cut(pair: Pair) -> list[Pair]:
    """Return the pair at the latest open cut, with a future of that cut as its twin."""
    choice = choose_cut(pair.futures, pair.claim, pair.control.outcome.commit_frame)
    if choice is None:
        raise Rejected("no cut at 1.0 s or later leaves the outcome open")
    cut, twin = choice
    assert twin.qpos is not None
    cut_pair = _with_twin(pair, cut.frame, replace(pair.control, qpos=twin.qpos, simulated=None))
    return [replace(cut_pair, rollout=twin.number)]


def choose_cut(futures: Futures, claim: Claim, commit_frame: int) -> tuple[Cut, Rollout] | None:
    """Return the latest cut that leaves the outcome open, and a twin; or None."""
    if commit_frame < futures.first:
        return None
    for rollouts in futures.batches():
        if len(rollouts) == ensemble.BATCHES[0]:
            if _is_hopeless(rollouts, futures.first):
                return None
            continue
        for cut in open_cuts(rollouts, range(futures.first, commit_frame + 1), claim):
            if OPEN.failure({**cut.evidence(), **open_from_state(futures, cut.frame, claim)}, claim) is None:
                return cut, ensemble.twin_of(rollouts, cut.frame, claim.answer)
    return None


def open_cuts(rollouts: Sequence[Rollout], frames: range, claim: Claim) -> Iterator[Cut]:
    """Yield the cuts at which the futures leave the outcome open, latest first."""
    cuts = (ensemble.at_cut(rollouts, frame, claim.family.perturbation) for frame in reversed(frames))
    return (cut for cut in cuts if OPEN.failure(cut.evidence(), claim) is None)


def _is_hopeless(scouts: Sequence[Rollout], first: int) -> bool:
    """Return whether too few scouts pass the earliest cut, or nearly all end alike."""
    counts = Counter(r.label for r in scouts if r.parted >= first and r.label is not None)
    is_short = counts.total() < len(scouts) * MIN_ACCEPTED / ensemble.TRIED / 2
    return is_short or max(counts.values(), default=0) > HOPELESS_SHARE * counts.total()


def json_values(value: Any) -> Any:
    """Return a value as JSON would read it back: lists, and Python numbers."""
    if isinstance(value, dict):
        return {key: json_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_values(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value
