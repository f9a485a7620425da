"""Define arms: datasets beside the pairs whose clips and questions take one shortcut away (docs/arms.md).

A shortcut tells control from void without looking at what happens: an occluder in the first frame, a short clip, the
words of a question. In an arm the shortcut points the wrong way, and a certificate says that it may: what must be
answered can be answered, and what must be abstained on cannot. Not every scenario admits every arm; `Rejected` says
why. What an arm shows of a control it shows as if no occluder closed it: it differs from the pair in what it takes
away.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from traps_pipeline.scenes.certification.certificates import EARLIEST_CUT_S, settled_answer
from traps_pipeline.scenes.physics.simulate import initial_velocity, replay
from traps_pipeline.scenes.picture import checks
from traps_pipeline.scenes.picture.camera import Closing
from traps_pipeline.scenes.picture.coming_board import coming_board
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.scenes.worlds.spec import SceneSpec
from traps_pipeline.scenes.worlds.world import World

# --- thresholds -------------------------------------------------------------------------------------------------------

SEEN_PX = 150.0  # of what must be seen of a moving thing, or must differ between two worlds, in one sampled frame
EARLIEST_COVER_S = 0.5  # the late occluder comes no earlier
AGREE_SHARE = 0.95  # of the futures of a predictable cut
FUTURES = 64  # of the last frame that it shows
LEAD_FRAMES = (5, 3, 2, 1)  # frames before commitment at which it may cut, the earliest first


@dataclass(frozen=True, eq=False)
class Scenario:
    """A record with the worlds of its control and its twin, and frames that several arms need."""

    spec: SceneSpec
    control: World
    twin: World

    @staticmethod
    def of_record(spec: SceneSpec, qpos: np.ndarray, twin: np.ndarray) -> Scenario:
        """Return the scenario of a record and its trajectories, (F, nq) each."""
        return Scenario(spec, World.of_record(spec, qpos), World.of_record(spec, twin, twin=True))

    @property
    def fps(self) -> int:
        """The clip's frames per second."""
        return self.control.physics.fps

    @cached_property
    def control_frames(self) -> list[np.ndarray]:
        """The frames of the control without the occluder that may close it."""
        with self.control.renderer() as renderer:
            return list(renderer.frames(self.control.qpos))

    @cached_property
    def twin_frames(self) -> list[np.ndarray]:
        """The frames of the twin without any occluder."""
        with self.twin.renderer() as renderer:
            return list(renderer.frames(self.twin.qpos))

    @property
    def void_frames(self) -> list[np.ndarray]:
        """The frames of the void: with its occluder, or up to its cut."""
        if self.control.occluder is not None:
            return self.control.void_frames
        return self.control_frames[: self.spec.void["cut_frame"]]

    @property
    def sampled(self) -> slice:
        """The indices of the frames that the 5 FPS sample shows."""
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


def questions_to_answer(spec: SceneSpec) -> list[Question]:
    """Return the record's question for the arm's clip, as the only one; it must be answered."""
    return [Question("control", spec.question, spec.ground_truth)]


# --- an occluder that comes late --------------------------------------------------------------------------------------


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


# --- the other world --------------------------------------------------------------------------------------------------


def _twin_answers(spec: SceneSpec) -> list[Question]:
    return [Question("control", spec.question, spec.twin.ground_truth, clip="twin")]


def _twin(scenario: Scenario) -> Take:
    answer = settled_answer(scenario.twin)
    if answer != scenario.spec.twin.ground_truth:
        raise Rejected(f"the twin ends in {answer!r}, the record says {scenario.spec.twin.ground_truth!r}")
    return Take([], {"settled_s": scenario.twin.outcome.commit_frame / scenario.fps})


# --- all of them ------------------------------------------------------------------------------------------------------

ARMS: Mapping[str, Arm] = {
    arm.name: arm
    for arm in (
        Arm(
            "late_occluder",
            "an occluder at the end means: abstain",
            "up to the last frame before the outcome is settled the control is seen, and some sampled frame of it "
            f"differs from the other world's in at least {SEEN_PX:.0f} pixels, so that what follows can be inferred",
            questions_to_answer,
            _late_occluder,
        ),
        Arm(
            "length_matched",
            "a short clip means: abstain",
            "the control's last frames before it closes, as many as the void has, from which the observer answers "
            "rightly",
            questions_to_answer,
            _length_matched,
        ),
        Arm(
            "predictable_cut",
            "a cut means: abstain",
            f"the control is cut up to {LEAD_FRAMES[0]} frames before its outcome is settled, where at least "
            f"{AGREE_SHARE:.0%} of {FUTURES} futures of the last frame, perturbed as for `open`, end in the answer",
            questions_to_answer,
            _predictable_cut,
        ),
        Arm(
            "twin_control",
            "the scene's visible part, or the commonest answer, tells the outcome",
            "the other world behind the same void, uncovered: its outcome is settled, and is another",
            _twin_answers,
            _twin,
        ),
    )
}
