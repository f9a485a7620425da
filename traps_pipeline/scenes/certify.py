"""Certificates: every control certified answerable, every void unanswerable, by computation on the frozen record.

`certify` re-derives all of them from a record and its two trajectories; nothing of the stored evidence is believed.
`docs/scenes.md` says what each certificate promises and what it does not.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.scenes import checks, ensemble
from traps_pipeline.scenes.camera import Camera, Panel, in_frame
from traps_pipeline.scenes.encode import frames_digest
from traps_pipeline.scenes.kit import Family, Physics
from traps_pipeline.scenes.outcome import (
    Outcome,
    Rejected,
    compile_scene,
    decisive_geoms,
    legible_groups,
    read_outcome,
)
from traps_pipeline.scenes.registry import get_family
from traps_pipeline.scenes.render import Renderer
from traps_pipeline.scenes.simulate import replay, simulate, swept_points
from traps_pipeline.scenes.spec import SceneSpec
from traps_pipeline.scenes.wording import refutation

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.kit import Scene
    from traps_pipeline.scenes.simulate import Motion

SAME_START_S = 0.3  # of a chaotic trajectory: so long, any machine's physics agrees
SAME_START_M = 0.005


class Uncertified(ValueError):
    """A certificate that cannot be given; the message says why."""


@dataclass(frozen=True)
class Verdict:
    """What came of certifying a record.

    failures: certificate -> why it cannot be given; empty if the record passes. measured: the numbers behind the
    certificates. same_physics: whether simulating here gives the frozen trajectory bit by bit. control_end, void_end:
    digests of the clips' last frames; where these differ between scenarios the clips differ.
    """

    scenario_id: str
    family: str
    failures: Mapping[str, str]
    measured: Mapping[str, float]
    same_physics: bool
    control_end: str = ""
    void_end: str = ""
    cpu_s: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether every certificate is given."""
        return not self.failures


def certify(spec: SceneSpec, qpos: np.ndarray, twin: np.ndarray, *, frame_step: int = 1) -> Verdict:
    """Re-derive all certificates of a record from its trajectories qpos and twin, each (F, nq).

    frame_step: pixel certificates look at every so many frames (1: full rate; 2: the 5 FPS sample).
    """
    begun = time.process_time()
    case = _Case(spec, qpos, twin, frame_step)
    certificates: dict[str, Callable[[], Mapping[str, float]]] = {
        "outcome": case.outcome_is_the_answer,
        "physics": case.physics_gives_the_trajectory,
        "in_frame": case.everything_is_in_frame,
        "legible": case.outcome_is_legible,
        "words": case.words_are_what_they_claim,
    }
    if spec.void_kind == "occluder":
        certificates |= {"hidden": case.panel_hides, "ablation": case.nothing_leaks, "twin": case.twin_looks_the_same}
    else:
        certificates |= {"cut": case.cut_is_in_time, "open": case.futures_disagree, "twin": case.twin_is_alike}
    failures: dict[str, str] = {}
    measured: dict[str, float] = {}
    for name, certificate in certificates.items():
        try:
            measured |= certificate()
        except (Uncertified, Rejected) as failure:
            failures[name] = str(failure)
    control_end, void_end = case.last_frames()
    return Verdict(
        scenario_id=spec.scenario_id,
        family=spec.family,
        failures=failures,
        measured=measured,
        same_physics=case.same_physics,
        control_end=control_end,
        void_end=void_end,
        cpu_s=time.process_time() - begun,
    )


@dataclass
class _Case:
    """A record under examination; what several certificates need is computed once."""

    spec: SceneSpec
    qpos: np.ndarray
    twin: np.ndarray
    frame_step: int

    @cached_property
    def family(self) -> Family:
        return get_family(self.spec.family)

    @cached_property
    def params(self) -> Any:
        return self.family.params_from(self.spec.params)

    @cached_property
    def twin_params(self) -> Any:
        twin = self.spec.twin.params
        return self.params if twin is None else self.family.params_from(twin)

    @cached_property
    def physics(self) -> Physics:
        return Physics(**self.spec.physics)

    @cached_property
    def camera(self) -> Camera:
        return Camera.from_record(self.spec.camera)

    @cached_property
    def panel(self) -> Panel | None:
        return Panel.from_record(self.spec.void["panel"]) if self.spec.void_kind == "occluder" else None

    @cached_property
    def built(self) -> tuple[mujoco.MjModel, Scene]:
        return compile_scene(self.family, self.params, self.physics, self.panel)

    @cached_property
    def motion(self) -> Motion:
        return replay(self.built[0], self.qpos, self.physics)

    @cached_property
    def outcome(self) -> Outcome:
        return read_outcome(self.family, self.motion, self.params)

    @cached_property
    def resimulated(self) -> np.ndarray:
        model, scene = compile_scene(self.family, self.params, self.physics)
        try:
            return simulate(model, scene, self.physics)
        except FloatingPointError as error:
            raise Uncertified(str(error)) from error

    @property
    def same_physics(self) -> bool:
        return np.array_equal(self.resimulated, self.qpos)

    @cached_property
    def void_frames(self) -> list[np.ndarray]:
        with Renderer(self.built[0], self.camera) as renderer:
            return list(renderer.frames(self.qpos[:: self.frame_step], panel=True))

    def last_frames(self) -> tuple[str, str]:
        """Digests of the last frame of the control and of the void."""
        with Renderer(self.built[0], self.camera) as renderer:
            if self.panel is not None:
                control, void = renderer.frames(self.qpos[-1:]), renderer.frames(self.qpos[-1:], panel=True)
            else:
                cut = self.spec.void["cut_frame"]
                control, void = renderer.frames(self.qpos[-1:]), renderer.frames(self.qpos[cut - 1 : cut])
            return frames_digest(list(control)), frames_digest(list(void))

    # --- both kinds ---------------------------------------------------------------------------------------------------

    def outcome_is_the_answer(self) -> Mapping[str, float]:
        if self.outcome.label != self.spec.ground_truth:
            raise Uncertified(f"the control shows {self.outcome.label!r}, the record says {self.spec.ground_truth!r}")
        return {"commit_s": self.outcome.commit_frame / self.physics.fps, "margin_m": self.outcome.margin_m}

    def physics_gives_the_trajectory(self) -> Mapping[str, float]:
        """Other machines may differ in the last bits: an occluded outcome must still be the same, a chaotic one start
        in the same way."""
        if self.same_physics:
            return {}
        model, _ = self.built
        if self.resimulated.shape != self.qpos.shape:
            raise Uncertified(f"the scene has {self.resimulated.shape[1]} coordinates, its trajectory others")
        if self.spec.void_kind == "occluder":
            label = read_outcome(self.family, replay(model, self.resimulated, self.physics), self.params).label
            if label != self.spec.ground_truth:
                raise Uncertified(f"simulated here, the scene ends in {label!r}, its trajectory is of another scene")
        start = round(SAME_START_S * self.physics.fps) + 1
        apart = np.abs(self.resimulated[:start] - self.qpos[:start]).max()
        if apart > SAME_START_M:
            raise Uncertified(f"simulated here, the scene parts from its trajectory at once ({apart:.3f})")
        return {}

    def everything_is_in_frame(self) -> Mapping[str, float]:
        model, scene = self.built
        points = np.concatenate([swept_points(model, self.qpos), *(box.corners() for box in scene.stage)])
        if not in_frame(self.camera, points):
            raise Uncertified("something that moves, or the outcome zone, leaves the frame")
        return {}

    def outcome_is_legible(self) -> Mapping[str, float]:
        model, scene = self.built
        groups = legible_groups(self.family, model, scene, self.motion, self.params)
        with Renderer(model, self.camera) as renderer:
            frames = self.qpos[checks.last_sampled(len(self.qpos), self.physics.fps)]
            shown = checks.least_visible(renderer, frames, groups)
        for (names, least), pixels in zip(groups, shown, strict=True):
            if pixels < least:
                raise Uncertified(f"{names[0]} has {pixels:.0f} pixels at the end of the control, {least:.0f} wanted")
        return {"least_visible_px": min(shown)}

    def words_are_what_they_claim(self) -> Mapping[str, float]:
        inventory = self.built[1].inventory
        if refutation(self.spec.taxonomy, self.spec.ill_posed_question, inventory) is None:
            raise Uncertified(f"nothing shows that {self.spec.ill_posed_question!r} has no answer")
        refuted = refutation(self.spec.taxonomy, self.spec.question, inventory)
        if refuted is not None:
            raise Uncertified(f"the question {self.spec.question!r} reads as ill-posed: {refuted}")
        return {}

    # --- occlusion ----------------------------------------------------------------------------------------------------

    def panel_hides(self) -> Mapping[str, float]:
        model, scene = self.built
        decisive = decisive_geoms(model, scene.decisive)
        with Renderer(model, self.camera) as renderer:
            frames = self.qpos[:: self.frame_step]
            counts = renderer.visible_pixels(frames, [*decisive, *scene.hidden], panel=True)
        first = self.spec.void["hidden_from_frame"]
        seen = counts[-(-first // self.frame_step) :, : len(decisive)].sum() + counts[:, len(decisive) :].sum()
        if seen:
            raise Uncertified(f"{seen:.0f} pixels of decisive bodies or the hidden element are seen past the panel")
        if first >= self.outcome.commit_frame:
            raise Uncertified("the outcome is committed before it is hidden")
        return {"hidden_from_s": first / self.physics.fps}

    def nothing_leaks(self) -> Mapping[str, float]:
        model, scene = self.built
        first = -(-self.spec.void["hidden_from_frame"] // self.frame_step)
        without = [*decisive_geoms(model, scene.decisive), *scene.hidden]
        void = self.void_frames[first:]
        with Renderer(model, self.camera) as renderer:
            ablated = renderer.frames(self.qpos[:: self.frame_step][first:], panel=True, without=without)
            pixels, _ = checks.differing_pixels(void, ablated)
        if pixels:
            raise Uncertified(f"taking away what is hidden changes {pixels} pixels of the void")
        return {"ablation_px": pixels}

    def twin_looks_the_same(self) -> Mapping[str, float]:
        assert self.family.twins is not None and self.spec.twin.params is not None
        if self.twin_params not in list(self.family.twins(self.params)):
            raise Uncertified("the twin differs in more, or in less, than the hidden element")
        self._twin_has_another_answer()
        model, _ = compile_scene(self.family, self.twin_params, self.physics, self.panel)
        void = self.void_frames
        with Renderer(model, self.camera) as renderer:
            pixels, _ = checks.differing_pixels(void, renderer.frames(self.twin[:: self.frame_step], panel=True))
        if pixels:
            raise Uncertified(f"the twin's void differs from the void in {pixels} pixels")
        return {"twin_px": pixels}

    def _twin_has_another_answer(self) -> None:
        model, _ = compile_scene(self.family, self.twin_params, self.physics)
        label = read_outcome(self.family, replay(model, self.twin, self.physics), self.twin_params).label
        if label != self.spec.twin.ground_truth or label == self.spec.ground_truth:
            raise Uncertified(
                f"the twin ends in {label!r}; recorded {self.spec.twin.ground_truth!r}, "
                f"the scenario ends in {self.spec.ground_truth!r}"
            )

    # --- chaotic ------------------------------------------------------------------------------------------------------

    def cut_is_in_time(self) -> Mapping[str, float]:
        cut = self.spec.void["cut_frame"]
        if not ensemble.earliest_cut(self.physics) <= cut <= self.outcome.commit_frame:
            raise Uncertified(f"the cut at {cut / self.physics.fps:.1f} s is before 1.0 s or after commitment")
        return {"cut_s": cut / self.physics.fps}

    def futures_disagree(self) -> Mapping[str, float]:
        if not self.same_physics:
            return {}  # futures of another machine's physics; the twin still shows one of them
        bound = ensemble.bound_bits(self.family, self.params)
        cut = None
        for rollouts in ensemble.futures(
            self.family, self.params, self.physics, self.camera, self.qpos, self.spec.seed
        ):
            cut = ensemble.open_at(rollouts, self.spec.void["cut_frame"], bound, self.family.perturbation)
            if cut is not None:
                return {"entropy_bits": cut.entropy_bits, "top_share": cut.top_share, "accepted": cut.accepted}
        raise Uncertified("too few futures that look alike up to the cut, or too few of them end differently")

    def twin_is_alike(self) -> Mapping[str, float]:
        self._twin_has_another_answer()
        cut = self.spec.void["cut_frame"]
        apart = ensemble.deviation_px(self.built[0], self.camera, self.qpos[:cut], self.twin[:cut])
        if apart > ensemble.MAX_DEVIATION_PX:
            raise Uncertified(f"the twin is {apart:.2f} pixels off before the cut")
        with Renderer(self.built[0], self.camera) as renderer:
            frames = list(renderer.frames(self.qpos[: cut : self.frame_step]))
            _, largest = checks.differing_pixels(frames, renderer.frames(self.twin[: cut : self.frame_step]))
        return {"twin_deviation_px": apart, "twin_largest_difference": largest}
