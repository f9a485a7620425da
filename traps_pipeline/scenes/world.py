"""One simulated world as the camera of its pair sees it; what several certificates need of it is computed once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.scenes.camera import Camera, Panel
from traps_pipeline.scenes.checks import PastPanel, void_frames
from traps_pipeline.scenes.kit import Family, Inventory, Motion, Physics, Scene
from traps_pipeline.scenes.outcome import Outcome, compile_scene, decisive_geoms, read_outcome, simulated
from traps_pipeline.scenes.registry import get_family
from traps_pipeline.scenes.render import Renderer
from traps_pipeline.scenes.simulate import replay
from traps_pipeline.scenes.spec import SceneSpec

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True, eq=False)
class World:
    """A scene with its trajectory and its shot.

    qpos: the trajectory (F, nq). panel: the cover panel of its void, None where the void is a cut. frame_step: pixel
    evidence looks at every so many frames. simulated: the trajectory that simulating gives here, where it is known.
    """

    family: Family
    params: Any
    physics: Physics
    qpos: np.ndarray
    camera: Camera
    panel: Panel | None
    frame_step: int = 1
    simulated: np.ndarray | None = None

    @staticmethod
    def of_record(spec: SceneSpec, qpos: np.ndarray, *, twin: bool = False, frame_step: int = 1) -> World:
        """The control of a record, or its twin, with its trajectory. Raises ValueError for unknown parameters."""
        family = get_family(spec.family)
        params = spec.twin.params if twin and spec.twin.params is not None else spec.params
        return World(
            family=family,
            params=family.params_from(params),
            physics=Physics(**spec.physics),
            qpos=qpos,
            camera=Camera.from_record(spec.camera),
            panel=Panel.from_record(spec.void["panel"]) if spec.void_kind == "occluder" else None,
            frame_step=frame_step,
        )

    @cached_property
    def _compiled(self) -> tuple[mujoco.MjModel, Scene]:
        return compile_scene(self.family, self.params, self.physics, self.panel)

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled model, panel included."""
        return self._compiled[0]

    @property
    def scene(self) -> Scene:
        """The built scene: the roles of its parts."""
        return self._compiled[1]

    @property
    def inventory(self) -> Inventory:
        """What a viewer can name; needs no trajectory and no compiled model."""
        return self.family.build(self.params, self.physics).inventory

    @cached_property
    def motion(self) -> Motion:
        """Poses of all bodies, replayed."""
        return replay(self.model, self.qpos, self.physics)

    @cached_property
    def outcome(self) -> Outcome:
        """What the trajectory comes to."""
        return read_outcome(self.family, self.motion, self.params)

    @cached_property
    def resimulated(self) -> np.ndarray:
        """The trajectory that simulating the scene gives here, (F, nq). Raises Rejected if the solver diverges."""
        if self.simulated is not None:
            return self.simulated
        return simulated(*compile_scene(self.family, self.params, self.physics), self.physics)

    @property
    def same_physics(self) -> bool:
        """Whether simulating here gives the trajectory bit by bit."""
        return np.array_equal(self.resimulated, self.qpos)

    @property
    def looked_at(self) -> np.ndarray:
        """The poses that pixel evidence looks at."""
        return self.qpos[:: self.frame_step]

    def renderer(self) -> Renderer:
        """A renderer of this world; close it before another one is opened."""
        return Renderer(self.model, self.camera)

    @property
    def concealed(self) -> tuple[str, ...]:
        """Names of all geoms that the void must not show: those of decisive bodies and of the hidden element."""
        return (*decisive_geoms(self.model, self.scene.decisive), *self.scene.hidden)

    @cached_property
    def geoms(self) -> tuple[str, ...]:
        """Names of all geoms, in the order of the model."""
        return tuple(self.model.geom(i).name for i in range(self.model.ngeom))

    @cached_property
    def void_pixels(self) -> np.ndarray:
        """How many pixels each of the `geoms` has in each frame of the void, (F, G), by segmentation."""
        with self.renderer() as renderer:
            return renderer.visible_pixels(self.looked_at, self.geoms, panel=True)

    def pixels_of(self, names: Sequence[str]) -> np.ndarray:
        """How many pixels some geoms have together in each frame of the void, (F,)."""
        return self.void_pixels[:, [self.geoms.index(name) for name in names]].sum(axis=1)

    @cached_property
    def past_panel(self) -> PastPanel:
        """What is seen past the panel."""
        decisive = decisive_geoms(self.model, self.scene.decisive)
        return PastPanel(self.pixels_of(decisive), self.pixels_of(self.scene.hidden))

    @cached_property
    def void_frames(self) -> list[np.ndarray]:
        """The world with its panel, as it is drawn."""
        with self.renderer() as renderer:
            return list(void_frames(renderer, self.looked_at))
