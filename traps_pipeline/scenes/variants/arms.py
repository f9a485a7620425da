"""Define arms: clips and questions that take one shortcut away (docs/arms.md).

A shortcut tells control from void without looking at what happens: an occluder in the first frame, a short clip, the
words of a question. In an arm the shortcut points the wrong way, and a certificate says that it may: what must be
answered can be answered, and what must be abstained on cannot. Not every scenario admits every arm; `Rejected` says
why. What an arm shows of a control it shows as if no occluder closed it: it differs from the pair in what it takes
away.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from traps_pipeline.protocol.datasets import CROSSED
from traps_pipeline.scenes.certification.certificates import EARLIEST_CUT_S, legible_groups, settled_answer
from traps_pipeline.scenes.parts.wording import false_premise
from traps_pipeline.scenes.physics.kit import View
from traps_pipeline.scenes.physics.simulate import initial_velocity, replay
from traps_pipeline.scenes.picture import checks
from traps_pipeline.scenes.picture.camera import OCCLUDER_HALF_THICKNESS, Closing, Occluder, fit_camera
from traps_pipeline.scenes.picture.coming_board import coming_board
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.outcome import Rejected, compile_scene, decisive_geoms
from traps_pipeline.scenes.worlds.shot import shown_points
from traps_pipeline.scenes.worlds.spec import SceneSpec
from traps_pipeline.scenes.worlds.world import World

# --- thresholds -------------------------------------------------------------------------------------------------------

SHOWN_AGAIN_S = 1.0  # before the end the occluder of `removed` goes
SEEN_PX = 150.0  # of what must be seen of a moving thing, or must differ between two worlds, in one sampled frame
OCCLUDER_PX = 2000.0  # of a decoy in the first frame: 1 % of the picture
EARLIEST_COVER_S = 0.5  # the late occluder comes no earlier
AGREE_SHARE = 0.95  # of the futures of a predictable cut
FUTURES = 64  # of the last frame that it shows
LEAD_FRAMES = (5, 3, 2, 1)  # frames before commitment at which it may cut, the earliest first
BEHIND_M = 0.05  # a decoy stands so far behind all that is shown


@dataclass(frozen=True, eq=False)
class Scenario:
    """A record with its two worlds, and frames that several arms need."""

    spec: SceneSpec
    control: World
    twin: World

    @staticmethod
    def of_record(spec: SceneSpec, qpos: np.ndarray, twin: np.ndarray) -> Scenario:
        """Return the scenario of a record and its trajectories, (F, nq) each."""
        return Scenario(spec, World.of_record(spec, qpos), World.of_record(spec, twin, twin=True))

    @property
    def fps(self) -> int:
        """Frames a second."""
        return self.control.physics.fps

    @cached_property
    def control_frames(self) -> list[np.ndarray]:
        """The control without the occluder that may close it."""
        with self.control.renderer() as renderer:
            return list(renderer.frames(self.control.qpos))

    @cached_property
    def twin_frames(self) -> list[np.ndarray]:
        """The other world without any occluder."""
        with self.twin.renderer() as renderer:
            return list(renderer.frames(self.twin.qpos))

    @property
    def void_frames(self) -> list[np.ndarray]:
        """The void: with its occluder, or up to its cut."""
        if self.control.occluder is not None:
            return self.control.void_frames
        return self.control_frames[: self.spec.void["cut_frame"]]

    @property
    def sampled(self) -> slice:
        """The frames that the 5 FPS sample shows."""
        return slice(0, None, self.fps // checks.SAMPLED_FPS)


@dataclass(frozen=True)
class Take:
    """The frames that an arm shows, and the numbers behind its certificate."""

    frames: list[np.ndarray]
    evidence: Mapping[str, Any]


@dataclass(frozen=True)
class Question:
    """A question of an arm: `control` must be answered, `void` abstained on.

    clip: the pair's clip that is shown, None for the arm's own. labels: choices, None for the record's.
    """

    side: str
    text: str
    answer: str | None
    clip: str | None = None
    labels: tuple[str, ...] | None = None


@dataclass(frozen=True)
class Arm:
    """An arm of some scenarios; `protocol.datasets` says of which, and its questions.

    takes_away: the shortcut that it turns against its user. promises: its certificate in words.

    film(scenario): the clip; without frames where it is the pair's own. ask(spec): its questions. Both raise Rejected.
    """

    name: str
    takes_away: str
    promises: str
    ask: Callable[[SceneSpec], list[Question]]
    film: Callable[[Scenario], Take]


def must_answer(spec: SceneSpec) -> list[Question]:
    """Return the record's question for the arm's clip, to be answered."""
    return [Question("control", spec.question, spec.ground_truth)]


# --- an occluder that hides nothing, or not for good ------------------------------------------------------------------


def _decoys(scenario: Scenario, points: np.ndarray) -> Iterator[Occluder]:
    """Yield places of the void's occluder behind everything, then beside it."""
    occluder, control = scenario.control.occluder, scenario.control
    assert occluder is not None, "an occlusion scenario has an occluder"
    azimuth = np.radians(control.camera.azimuth_deg)
    ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    across = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    centre, half_width = np.array(occluder.centre), occluder.half[0]
    low, high = float((points @ across).min()), float((points @ across).max())
    depth_behind = float((points @ ahead).max()) - float(centre @ ahead) + BEHIND_M + OCCLUDER_HALF_THICKNESS
    at = float(centre @ across)
    for offset in (0.0, high - at, low - at):
        yield _move(occluder, ahead * depth_behind + across * offset)
    for offset in (high + half_width + BEHIND_M - at, low - half_width - BEHIND_M - at):
        yield _move(occluder, across * offset)


def _move(occluder: Occluder, by: np.ndarray) -> Occluder:
    x, y, z = (round(float(value), 6) for value in np.array(occluder.centre) + by)
    return replace(occluder, centre=(x, y, z))


def _decoy(scenario: Scenario) -> Take:
    control, spec = scenario.control, scenario.spec
    points = shown_points(control.model, control.scene, control.qpos)
    view = View(control.camera.azimuth_deg, control.camera.elevation_deg, control.camera.fovy_deg)
    reason = ""
    for occluder in _decoys(scenario, points):
        camera = fit_camera(view, np.concatenate([points, occluder.corners()]))
        model, scene = compile_scene(control.family, control.params, control.physics, occluder)
        geoms = [*decisive_geoms(model, scene.decisive), *scene.hidden]
        groups = legible_groups(control.family, model, scene, control.motion, control.params)
        sampled_qpos = control.qpos[scenario.sampled]
        with Renderer(model, camera) as renderer:
            occluder_px = float(renderer.visible_pixels(sampled_qpos[:1], ["occluder"], occluder=True)[0, 0])
            pixels = [renderer.visible_pixels(sampled_qpos, geoms, occluder=is_drawn) for is_drawn in (False, True)]
            hidden = float(np.abs(pixels[0] - pixels[1]).sum())
            min_pixels = checks.least_visible(renderer, sampled_qpos[-3:], groups)
            needs = [needed for _, needed in groups]
            too_small = [f"{px:.0f} of {n:.0f} pixels" for px, n in zip(min_pixels, needs, strict=True) if px < n]
            if occluder_px < OCCLUDER_PX or hidden or too_small:
                visible = too_small or "enough"
                reason = f"the decoy shows {occluder_px:.0f} pixels, hides {hidden:.0f}, leaves {visible} to be seen"
                continue
            evidence = {"panel_px": occluder_px, "hides_px": hidden, "least_visible_px": min(min_pixels)}
            evidence |= {"panel": vars(occluder)}
            return Take(list(renderer.frames(control.qpos, occluder=True)), evidence)
    raise Rejected(f"{spec.scenario_id}: no place for an occluder that hides nothing ({reason})")


def _removed(scenario: Scenario) -> Take:
    spec, at = scenario.spec, len(scenario.control.qpos) - round(SHOWN_AGAIN_S * scenario.fps)
    commit = scenario.control.outcome.commit_frame
    last_seen = checks.last_sampled(len(scenario.control.qpos), scenario.fps)[0]
    if spec.void["hidden_from_frame"] >= at or commit > last_seen or last_seen < at:
        raise Rejected("the outcome is not both hidden before the occluder goes and settled after it")
    order = scenario.control.outcome.in_order
    if order is not None and order[0] < at:
        raise Rejected("the first of the two events that are asked about happens behind the occluder")
    frames = [*scenario.void_frames[:at], *scenario.control_frames[at:]]
    return Take(frames, {"hidden_until_s": at / scenario.fps, "settled_s": commit / scenario.fps})


def _late_occluder(scenario: Scenario) -> Take:
    """Return a control whose occluder comes just before the outcome settles."""
    at = scenario.control.outcome.commit_frame - 1
    if at < EARLIEST_COVER_S * scenario.fps:
        raise Rejected(f"the outcome is settled at {(at + 1) / scenario.fps:.1f} s: nothing can be seen before it")
    control = scenario.control
    assert control.occluder is not None, "an occlusion scenario has an occluder"
    board = coming_board(Closing(at, control.occluder), control.camera, len(control.qpos), scenario.fps)
    comes = next(frame for frame, offset in enumerate(board) if offset is not None)
    frames_before = slice(0, comes, scenario.fps // checks.SAMPLED_FPS)
    pairs = zip(scenario.control_frames[frames_before], scenario.twin_frames[frames_before], strict=True)
    n_differing = max((int((a != b).any(axis=2).sum()) for a, b in pairs), default=0)
    if n_differing < SEEN_PX:
        raise Rejected(
            f"before the occluder comes the two worlds differ in {n_differing} pixels, {SEEN_PX:.0f} are wanted"
        )
    with control.renderer() as renderer:
        frames = list(checks.closing_frames(renderer, control.qpos, board))
    return Take(frames, {"covered_from_s": at / scenario.fps, "differing_px": n_differing})


# --- length -----------------------------------------------------------------------------------------------------------


def _length_matched(scenario: Scenario) -> Take:
    """Return as many of the control's last open frames as the void has."""
    spec, family, end = scenario.spec, scenario.control.family, scenario.control.open_frames
    begin, order = end - spec.void["cut_frame"], scenario.control.outcome.in_order
    if order is not None and order[0] < begin:
        raise Rejected("the first of the two events that are asked about happens before these frames")
    frames = scenario.control_frames[begin:end]
    assert family.observe is not None, f"{family.name}: has no observer"
    answer = family.observe(np.stack(frames[scenario.sampled]), spec.question)
    if answer != spec.ground_truth:
        raise Rejected(f"the observer sees {answer!r} in the last {len(frames)} frames, the answer is not")
    return Take(frames, {"frames": len(frames), "observed": answer})


def _predictable_cut(scenario: Scenario) -> Take:
    """Return a cut before the outcome settles at which nearly all futures agree."""
    control, commit = scenario.control, scenario.control.outcome.commit_frame
    if not control.same_physics:
        raise Rejected("simulating here does not give the frozen trajectory, so that its futures are not known")
    for frame in (commit - lead for lead in LEAD_FRAMES if commit - lead > EARLIEST_CUT_S * scenario.fps):
        agree = _count_agreeing(scenario, frame - 1)
        if agree is not None:
            evidence = {"cut_s": frame / scenario.fps, "settled_s": commit / scenario.fps, "agree": agree}
            return Take(scenario.control_frames[:frame], evidence | {"futures": FUTURES})
    raise Rejected("no cut before the outcome is settled leaves it nearly certain")


def _count_agreeing(scenario: Scenario, frame: int) -> int | None:
    """Return how many perturbed futures of a frame end in the answer; None if too few."""
    import mujoco

    control, spec = scenario.control, scenario.spec
    scene = control.family.build(control.params, control.physics)
    model, substeps = scene.spec.compile(), control.physics.substeps
    data = mujoco.MjData(model)
    data.qvel[:] = initial_velocity(model, scene.velocity)
    mujoco.mj_step(model, data, frame * substeps)
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    rng = np.random.default_rng([spec.seed, frame, FUTURES])
    trajectory, n_disagreeing = np.array(control.qpos, float), 0
    for _ in range(FUTURES):
        mujoco.mj_setState(model, data, state, kind)
        mujoco.mj_integratePos(model, data.qpos, rng.normal(scale=control.family.perturbation, size=model.nv), 1.0)
        for row in trajectory[frame + 1 :]:
            mujoco.mj_step(model, data, substeps)
            row[:] = data.qpos
        labels = control.family.outcome(replay(model, trajectory, control.physics), control.params).labels
        n_disagreeing += labels[-1] != spec.ground_truth
        if n_disagreeing > (1 - AGREE_SHARE) * FUTURES:
            return None
    return FUTURES - n_disagreeing


# --- the other world, other words -------------------------------------------------------------------------------------


def _twin_answers(spec: SceneSpec) -> list[Question]:
    return [Question("control", spec.question, spec.twin.ground_truth, clip="twin")]


def _twin(scenario: Scenario) -> Take:
    answer = settled_answer(scenario.twin)
    if answer != scenario.spec.twin.ground_truth:
        raise Rejected(f"the twin ends in {answer!r}, the record says {scenario.spec.twin.ground_truth!r}")
    return Take([], {"settled_s": scenario.twin.outcome.commit_frame / scenario.fps})


def crossed(partner: SceneSpec | None) -> Arm:
    """Return the arm that asks the void its aside, the control a partner's question."""

    def ask(spec: SceneSpec) -> list[Question]:
        if partner is None:
            raise Rejected("it has no partner: a scenario of its family whose scene and its own refute each other's")
        aside = spec.answerable_question
        return [
            Question("control", aside.question, aside.answer, clip="void", labels=tuple(aside.labels)),
            Question("void", partner.question, None, clip="control", labels=tuple(partner.labels)),
        ]

    def film(scenario: Scenario) -> Take:
        ask(scenario.spec)
        assert partner is not None, "asked for above"
        if premise := false_premise(_presumed(partner), scenario.control.inventory):
            return Take([], {"refuted_by": premise})
        raise Rejected(f"the scene does not refute {partner.question!r}")

    return Arm(
        CROSSED,
        "this clip, or this question, means: abstain",
        "the void with a question that it answers; the control with the question of its partner, which presumes, "
        "beside its choices, a colour that nothing in the scene has, as does its own question in the partner's scene",
        ask,
        film,
    )


def _presumed(spec: SceneSpec) -> str:
    """Return the question without its choices, which it does not presume."""
    text = re.sub(r"\([^)]*\)", "", spec.question.lower())  # own text: a record's question
    matches = [re.search(rf"\b{re.escape(label.lower())}\b", text) for label in spec.labels]
    spans = [match.span() for match in matches if match]
    return text[: min(spans)[0]] + text[max(end for _, end in spans) :] if spans else text


def partners(specs: Iterable[SceneSpec]) -> dict[str, str]:
    """Return the partner of each scenario of a family that has one, by id.

    The scenes of partners refute each other's question. So each question is asked in vain as often as it is answered.
    Scenarios with the fewest candidates choose first, which leaves few without a partner.
    """
    spec_of = {spec.scenario_id: spec for spec in sorted(specs, key=lambda spec: spec.scenario_id)}
    inventories = {id_: World.of_record(spec, np.empty((0, 0))).inventory for id_, spec in spec_of.items()}
    presumed = {id_: _presumed(spec) for id_, spec in spec_of.items()}
    refuted = {(a, b) for a in spec_of for b in spec_of if false_premise(presumed[b], inventories[a]) is not None}
    free = {a: {b for b in spec_of if (a, b) in refuted and (b, a) in refuted} for a in spec_of}
    partner_of: dict[str, str] = {}
    while candidates := [a for a in free if free[a]]:
        a = min(candidates, key=lambda name: len(free[name]))
        b = min(sorted(free[a]), key=lambda name: len(free[name]))
        partner_of |= {a: b, b: a}
        free = {name: candidates_left - {a, b} for name, candidates_left in free.items() if name not in (a, b)}
    return partner_of


# --- all of them ------------------------------------------------------------------------------------------------------

ARMS: Mapping[str, Arm] = {
    arm.name: arm
    for arm in (
        Arm(
            "decoy",
            "an occluder means: abstain",
            f"the void's own occluder stands behind or beside the scene with at least {OCCLUDER_PX:.0f} pixels, takes "
            "no pixel of a decisive body or the hidden element in any sampled frame, and the outcome stays legible",
            must_answer,
            _decoy,
        ),
        Arm(
            "removed",
            "an occluder in the first frames means: abstain",
            f"the occluder stands as in the void until {SHOWN_AGAIN_S} s before the end; the last three sampled frames "
            "are the control's, with the outcome settled; which of two events was first is not asked",
            must_answer,
            _removed,
        ),
        Arm(
            "late_occluder",
            "an occluder at the end means: abstain",
            "up to the last frame before the outcome is settled the control is seen, and some sampled frame of it "
            f"differs from the other world's in at least {SEEN_PX:.0f} pixels, so that what follows can be inferred",
            must_answer,
            _late_occluder,
        ),
        Arm(
            "length_matched",
            "a short clip means: abstain",
            "the control's last frames before it closes, as many as the void has, from which the observer answers "
            "rightly",
            must_answer,
            _length_matched,
        ),
        Arm(
            "predictable_cut",
            "a cut means: abstain",
            f"the control is cut up to {LEAD_FRAMES[0]} frames before its outcome is settled, where at least "
            f"{AGREE_SHARE:.0%} of {FUTURES} futures of the last frame, perturbed as for `open`, end in the answer",
            must_answer,
            _predictable_cut,
        ),
        Arm(
            "twin_control",
            "the scene's visible part, or the commonest answer, tells the outcome",
            "the other world behind the same void, uncovered: its outcome is settled, and is another",
            _twin_answers,
            _twin,
        ),
        crossed(None),
    )
}
