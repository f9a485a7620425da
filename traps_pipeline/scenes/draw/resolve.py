"""From a family's parameters to a resolved scenario: simulate, read the outcome, fit the shot, choose void and twin.

`resolve` is the only way a record comes to be; it raises `Rejected` with the reason when the draw makes no good pair.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from traps_pipeline.scenes.certification import ensemble
from traps_pipeline.scenes.certification.certificates import (
    MIN_ACCEPTED,
    OPEN,
    certificates_for,
    futures_of,
    settled_answer,
    shown_points,
)
from traps_pipeline.scenes.certification.ensemble import Cut, Futures, Rollout
from traps_pipeline.scenes.certification.evidence import Claim, Evidence, Pair, VoidKind, required
from traps_pipeline.scenes.draw.closing import closed, record_of
from traps_pipeline.scenes.draw.trim import trimmed
from traps_pipeline.scenes.physics.kit import Family, Physics, Wording, params_to_dict
from traps_pipeline.scenes.picture.camera import fit_shot
from traps_pipeline.scenes.worlds.outcome import Rejected, compile_scene, simulated
from traps_pipeline.scenes.worlds.pace import cut_to, lengths
from traps_pipeline.scenes.worlds.spec import SceneSpec, Twin, trajectory_digest
from traps_pipeline.scenes.worlds.world import World

HOPELESS_SHARE = 0.9  # of the scouts; a scene whose true top share is 65 % looks like that less than once in 300 times


@dataclass(frozen=True)
class Resolved:
    """A record and its two trajectories, qpos at frame times (F, nq) float32."""

    spec: SceneSpec
    qpos: np.ndarray
    twin: np.ndarray


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
    """The record of a scenario with its trajectories. Raises Rejected when it makes no valid pair."""
    physics = physics or family.physics
    whole = _control(family, params, physics)
    answer = whole.outcome.label
    if answer is not None and answer not in wording.labels:
        raise ValueError(f"{family.name}: reading {answer!r} is not one of the labels {list(wording.labels)}")
    kind: VoidKind = "truncation" if whole.panel is None else "occluder"
    pair, evidence = _of_some_length(whole, kind, wording, ill_posed_question, seed)
    control, physics = pair.control, pair.control.physics
    twin, frame = pair.other_world, pair.void_from
    panel = None if control.panel is None else asdict(control.panel)
    spec = SceneSpec(
        scenario_id=scenario_id,
        taxonomy=family.taxonomy,
        category=family.category,
        sub_scenario=family.sub_scenario,
        family=family.name,
        seed=seed,
        params=plain(params_to_dict(params)),
        physics=asdict(physics),
        camera=plain(asdict(control.camera)),
        void_kind=kind,
        void=plain({"cut_frame": frame} if panel is None else {"panel": panel, "hidden_from_frame": frame}),
        control=plain(record_of(pair)),
        question=wording.question,
        labels=list(wording.labels),
        aliases=dict(wording.aliases),
        answer_type=family.answer_type,
        ground_truth=control.outcome.answer,
        ill_posed_question=ill_posed_question,
        answerable_question=plain(asdict(wording.answerable_question)),
        trajectory_sha256=trajectory_digest(control.qpos),
        twin=Twin(
            params=None if panel is None else plain(params_to_dict(twin.params)),
            rollout=pair.rollout,
            ground_truth=twin.outcome.answer,
            trajectory_sha256=trajectory_digest(twin.qpos),
        ),
        evidence={name: value for each in certificates_for(kind) for name, value in each.kept(evidence).items()},
    )
    return Resolved(spec, control.qpos, twin.qpos)


def _of_some_length(
    whole: World, kind: VoidKind, wording: Wording, ill_posed_question: str, seed: int
) -> tuple[Pair, Mapping[str, Any]]:
    """The pair of a simulated control, with all its evidence, of the first length for which it has all certificates.
    Raises Rejected if there is none."""
    rejected = Rejected("there is no length")
    for n_frames in lengths(whole, seed):
        control = cut_to(whole, n_frames)
        end_s = (n_frames - 1) / control.physics.fps
        answer = control.outcome.label
        claim = Claim(whole.family, end_s, len(wording.labels), answer, None, wording.question, ill_posed_question)
        try:
            pair = Pair(control, claim, futures_of(control, seed))
            evidence = required(certificates_for(kind, "control"), pair, {})
            candidates = _cut_short(pair) if control.panel is None else _covered(pair)
            pair, evidence = _with_certified_void(candidates, kind, evidence)
            return closed(pair, seed, evidence)
        except Rejected as failure:
            rejected = failure  # another length may do
    raise rejected


def _control(family: Family, params: Any, physics: Physics) -> World:
    """The control of a draw: simulated, and with its camera and panel fitted."""
    model, scene = compile_scene(family, params, physics)
    qpos = simulated(model, scene, physics)
    camera, panel = fit_shot(scene.view, shown_points(model, scene, qpos), scene.cover)
    return World(family, params, physics, qpos, camera, panel, simulated=qpos)


def _with_certified_void(
    candidates: Iterable[Pair], kind: VoidKind, so_far: Evidence
) -> tuple[Pair, Mapping[str, Any]]:
    """The first of some pairs, which differ in twin and panel, whose void and twin are certified. Raises Rejected if
    none is."""
    rejected = Rejected("there is no twin")
    for pair in candidates:
        try:
            return pair, required(certificates_for(kind, "void", "twin"), pair, so_far)
        except Rejected as failure:
            rejected = failure  # the next one may hide more, or be alike
    raise rejected


# --- occlusion --------------------------------------------------------------------------------------------------------


def _covered(pair: Pair) -> Iterator[Pair]:
    """The pair with its void, for each other world that may be its twin, behind the panels that this twin may do with.
    Raises Rejected if there is no other world."""
    worlds = _other_worlds(pair.control)
    if not worlds:
        raise Rejected("no other hidden element gives another outcome")
    return (shown for world in worlds for shown in trimmed(_with_twin(pair, None, world)))


def _with_twin(pair: Pair, frame: int | None, twin: World) -> Pair:
    claim = replace(pair.claim, twin_answer=twin.outcome.label)
    return replace(pair, claim=claim, void_frame=frame, twin=twin)


def _other_worlds(control: World) -> list[World]:
    """Worlds with another hidden element and another settled outcome."""
    family, physics = control.family, control.physics
    assert family.twins is not None, f"{family.name}: an occlusion family needs twins"
    worlds = []
    for params in family.twins(control.params):
        try:
            qpos = simulated(*compile_scene(family, params, physics), physics)
        except Rejected:
            continue  # this other world diverges; the next one may not
        world = replace(control, params=params, qpos=qpos, simulated=qpos)
        if settled_answer(world) not in (None, control.outcome.label):
            worlds.append(world)
    return worlds


# --- chaotic ----------------------------------------------------------------------------------------------------------


def _cut_short(pair: Pair) -> list[Pair]:
    """The pair with the latest cut that leaves its outcome open, and a future of that cut as its twin."""
    found = choose_cut(pair.futures, pair.claim, pair.control.outcome.commit_frame)
    if found is None:
        raise Rejected("no cut at 1.0 s or later leaves the outcome open")
    cut, twin = found
    assert twin.qpos is not None
    other = _with_twin(pair, cut.frame, replace(pair.control, qpos=twin.qpos, simulated=None))
    return [replace(other, rollout=twin.number)]


def choose_cut(futures: Futures, claim: Claim, commit_frame: int) -> tuple[Cut, Rollout] | None:
    """The latest cut, not too early and not after commitment, that leaves the outcome open, and a twin: the first
    rollout that looks like the control up to there and ends otherwise. None if there is no such cut."""
    if commit_frame < futures.first:
        return None
    for rollouts in futures.batches():
        if len(rollouts) == ensemble.BATCHES[0]:
            if _hopeless(rollouts, futures.first):
                return None
            continue
        cut = latest_open_cut(rollouts, range(futures.first, commit_frame + 1), claim)
        if cut is not None:
            return cut, ensemble.twin_of(rollouts, cut.frame, claim.answer)
    return None


def latest_open_cut(rollouts: Sequence[Rollout], frames: range, claim: Claim) -> Cut | None:
    """The last of the frames at which a cut is certified to leave the outcome open, or None."""
    cuts = (ensemble.at_cut(rollouts, frame, claim.family.perturbation) for frame in reversed(frames))
    return next((cut for cut in cuts if OPEN.failure(cut.evidence(), claim) is None), None)


def _hopeless(scouts: Sequence[Rollout], first: int) -> bool:
    """Whether hardly any scout looks like the control at the earliest cut, or nearly all of them end alike."""
    counts = Counter(r.label for r in scouts if r.parted >= first and r.label is not None)
    few = counts.total() < len(scouts) * MIN_ACCEPTED / ensemble.TRIED / 2
    return few or max(counts.values(), default=0) > HOPELESS_SHARE * counts.total()


def plain(value: Any) -> Any:
    """Tuples to lists, numpy numbers to Python's, so that a record equals itself after a round trip through JSON."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value
