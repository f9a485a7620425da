"""Represent a simulated world in its pair's shot, with cached values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.physics.flexes import flexes
from traps_pipeline.scenes.physics.kit import Family, Inventory, Motion, Physics, Scene
from traps_pipeline.scenes.physics.simulate import replay
from traps_pipeline.scenes.picture.camera import Camera, Closing, Occluder
from traps_pipeline.scenes.picture.checks import PastOccluder, differing_pixels, occluded_frames
from traps_pipeline.scenes.picture.coming_board import Coming, coming_board
from traps_pipeline.scenes.picture.render import SUPERSAMPLE, Renderer
from traps_pipeline.scenes.worlds.outcome import (
    Outcome,
    compile_scene,
    decisive_geoms,
    moving_geoms,
    read_outcome,
    simulated,
)
from traps_pipeline.scenes.worlds.spec import SceneSpec

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True, eq=False)
class World:
    """A scene with its trajectory, and the camera and occluder of its pair (its shot).

    qpos: the trajectory (F, nq). occluder: the occluder of its void, None where the void is a cut. frame_step: pixel
    evidence looks at every so many frames. simulated: the trajectory that simulating gives here, where it is known.
    closing: how the control ends, None if no occluder comes.
    """

    family: Family
    params: Any
    physics: Physics
    qpos: np.ndarray
    camera: Camera
    occluder: Occluder | None
    frame_step: int = 1
    simulated: np.ndarray | None = None
    closing: Closing | None = None

    @staticmethod
    def of_record(spec: SceneSpec, qpos: np.ndarray, *, twin: bool = False, frame_step: int = 1) -> World:
        """Return the control or the twin of a record. Raises ValueError."""
        family = get_family(spec.family)
        params = spec.twin.params if twin and spec.twin.params is not None else spec.params
        return World(
            family=family,
            params=family.params_from(params),
            physics=Physics(**spec.physics),
            qpos=qpos,
            camera=Camera.from_record(spec.camera),
            occluder=Occluder.from_record(spec.void["panel"]) if spec.void_kind == "occluder" else None,
            frame_step=frame_step,
            closing=closing_of(spec),
        )

    @cached_property
    def _compiled(self) -> tuple[mujoco.MjModel, Scene]:
        return compile_scene(self.family, self.params, self.physics, self.occluder)

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled model, occluder included."""
        return self._compiled[0]

    @property
    def scene(self) -> Scene:
        """The built scene: the roles of its parts."""
        return self._compiled[1]

    @property
    def inventory(self) -> Inventory:
        """The things a viewer can name; needs no trajectory and no compiled model."""
        return self.family.build(self.params, self.physics).inventory

    @cached_property
    def closed_model(self) -> mujoco.MjModel:
        """The compiled model with the occluder that closes the control."""
        if self.closing is None or self.occluder is not None:
            return self.model
        return compile_scene(self.family, self.params, self.physics, self.closing.occluder)[0]

    @property
    def open_frames(self) -> int:
        """The number of frames of the control before an occluder comes; all if none does."""
        return len(self.qpos) if self.closing is None else self.closing.frame

    @cached_property
    def board(self) -> Coming:
        """The offset of the board that closes the control, by frame."""
        return coming_board(self.closing, self.camera, len(self.qpos), self.physics.fps)

    @cached_property
    def motion(self) -> Motion:
        """The poses of all bodies, replayed from the trajectory."""
        return replay(self.model, self.qpos, self.physics)

    @cached_property
    def outcome(self) -> Outcome:
        """The outcome of the trajectory."""
        return read_outcome(self.family, self.motion, self.params)

    @property
    def outcome_read(self) -> Outcome:
        """The outcome that the frames before the closing occluder show by themselves."""
        open_frames, motion = slice(0, self.open_frames), self.motion
        parts = (
            {k: v[open_frames] for k, v in poses.items()}
            for poses in (motion.positions, motion.rotations, motion.vertices)
        )
        return read_outcome(self.family, Motion(motion.times[open_frames], *parts), self.params)

    @cached_property
    def resimulated(self) -> np.ndarray:
        """The trajectory that simulating on this machine gives, (F, nq). Raises Rejected."""
        if self.simulated is not None:
            return self.simulated
        return simulated(*compile_scene(self.family, self.params, self.physics), self.physics)

    @property
    def same_physics(self) -> bool:
        """Whether simulating on this machine gives the trajectory bit by bit."""
        return np.array_equal(self.resimulated, self.qpos)

    @property
    def evidence_frames(self) -> range:
        """The indices of the frames that pixel evidence looks at."""
        return range(0, len(self.qpos), self.frame_step)

    def renderer(self, *, supersample: int = SUPERSAMPLE) -> Renderer:
        """Return a renderer of this world; close it before you open another one."""
        return Renderer(self.model, self.camera, supersample=supersample)

    @property
    def concealed_geoms(self) -> tuple[str, ...]:
        """The names of the geoms of decisive bodies and the hidden element, which the void must not show."""
        return (*decisive_geoms(self.model, self.scene.decisive), *self.scene.hidden)

    @property
    def closed_geoms(self) -> tuple[str, ...]:
        """The names of the geoms that closing must hide: concealed ones, or in a cut scene all that move."""
        return moving_geoms(self.model) if self.occluder is None else self.concealed_geoms

    @cached_property
    def geoms(self) -> tuple[str, ...]:
        """Names of all geoms and soft bodies, in the order of the model."""
        model = self.closed_model
        return (*(model.geom(i).name for i in range(model.ngeom)), *flexes(model))

    @property
    def closed_frames(self) -> list[int]:
        """The indices of the closed control's frames that pixel evidence looks at, the last included."""
        return sorted(range(len(self.qpos) - 1, self.open_frames - 1, -self.frame_step))

    # What is drawn behind the occluder, that of the void or the one that closes the control, is needed by several
    # certificates; each frame is drawn once.

    def behind_occluder(self, frames: Sequence[int]) -> list[np.ndarray]:
        """Return some frames of the world drawn with the void's occluder."""
        missing = [frame for frame in frames if frame not in self._behind]
        if missing:
            with self.closed_renderer() as renderer:
                self._behind.update(zip(missing, occluded_frames(renderer, self.qpos[missing]), strict=True))
        return [self._behind[frame] for frame in frames]

    @cached_property
    def _behind(self) -> dict[int, np.ndarray]:
        return {}

    def pixels_of(self, names: Sequence[str], frames: Sequence[int] | None = None) -> np.ndarray:
        """Return the number of pixels that geoms have together behind the occluder, by frame, (F,)."""
        frames = self.evidence_frames if frames is None else frames
        missing = [frame for frame in frames if frame not in self._segmented]
        if missing:
            with self.closed_renderer() as renderer:
                counts = renderer.visible_pixels(self.qpos[missing], self.geoms, occluder=True)
            self._segmented.update(zip(missing, counts, strict=True))
        columns = [self.geoms.index(name) for name in names]
        return np.array([self._segmented[frame][columns].sum() for frame in frames])

    @cached_property
    def _segmented(self) -> dict[int, np.ndarray]:
        return {}

    def ablation_px(self, frames: Sequence[int], geoms: tuple[str, ...]) -> int:
        """Return how many pixels of some frames change when geoms are not drawn."""
        missing = [frame for frame in frames if (frame, geoms) not in self._ablated]
        if missing:
            complete_frames = self.behind_occluder(missing)
            with self.closed_renderer() as renderer:
                ablated_frames = occluded_frames(renderer, self.qpos[missing], without=geoms)
                for frame, ablated, unablated in zip(missing, complete_frames, ablated_frames, strict=True):
                    self._ablated[frame, geoms] = differing_pixels([ablated], [unablated])[0]
        return sum(self._ablated[frame, geoms] for frame in frames)

    @cached_property
    def _ablated(self) -> dict[tuple[int, tuple[str, ...]], int]:
        return {}

    @cached_property
    def past_occluder(self) -> PastOccluder:
        """The numbers of pixels that decisive bodies and the hidden element show past the occluder."""
        decisive = decisive_geoms(self.model, self.scene.decisive)
        return PastOccluder(self.pixels_of(decisive), self.pixels_of(self.scene.hidden))

    @property
    def void_frames(self) -> list[np.ndarray]:
        """The frames, drawn with the void's occluder, that pixel evidence looks at."""
        return self.behind_occluder(self.evidence_frames)

    def closed_renderer(self) -> Renderer:
        """Return a renderer with the occluder that closes the control; close it first."""
        return Renderer(self.closed_model, self.camera)


def closing_of(spec: SceneSpec) -> Closing | None:
    """Return the closing of a record's control (from when an occluder stands); None if none comes."""
    if spec.control is None:
        return None
    occluder = (spec.void if spec.void_kind == "occluder" else spec.control)["panel"]
    return Closing(spec.control["closes_frame"], Occluder.from_record(occluder))
