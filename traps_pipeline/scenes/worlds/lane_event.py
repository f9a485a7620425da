"""Simulate the event of one of two lanes by itself, as if there were no other lane."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.scenes.physics.kit import Box, Family, Motion, Physics, Scene
from traps_pipeline.scenes.physics.simulate import replay, swept_points
from traps_pipeline.scenes.worlds.outcome import Outcome, Rejected, compile_scene, read_outcome, simulated

if TYPE_CHECKING:
    import mujoco

DOUBLES = 3  # at most
DOUBLES_SHARE = 0.5  # of the width of what is hidden, that they take at most


@dataclass(frozen=True, eq=False)
class LaneEvent:
    """A family's scene with its trajectory, (F, nq), and outcome. Raises Rejected where there is none."""

    family: Family
    params: Any
    physics: Physics

    @cached_property
    def _compiled(self) -> tuple[mujoco.MjModel, Scene]:
        return compile_scene(self.family, self.params, self.physics)

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled MuJoCo model of the scene."""
        return self._compiled[0]

    @property
    def scene(self) -> Scene:
        """The built scene: the roles of its parts."""
        return self._compiled[1]

    @property
    def cover(self) -> Box:
        """The box that a board must hide so that the event's outcome is not seen."""
        if self.scene.cover is None:
            raise Rejected(f"{self.family.name}: its scenes have nothing that a board could hide")
        return self.scene.cover

    @cached_property
    def qpos(self) -> np.ndarray:
        """The event's trajectory: joint positions of each frame, (F, nq)."""
        return simulated(self.model, self.scene, self.physics)

    @cached_property
    def motion(self) -> Motion:
        """Poses of all bodies of the event, by frame."""
        return replay(self.model, self.qpos, self.physics)

    @cached_property
    def outcome(self) -> Outcome:
        """The event's outcome: the answer if it is seen."""
        return read_outcome(self.family, self.motion, self.params)

    @cached_property
    def points(self) -> np.ndarray:
        """Corners of all that is ever shown, (N, 3)."""
        framed = [box.corners() for box in self.scene.framed]
        return np.concatenate([swept_points(self.model, self.qpos), *geom_corners(self.model).values(), *framed])

    def copied_geoms(self, body: str) -> list[str]:
        """Return the geom names of a body's double: all but those of the hidden element, unless it has no other."""
        model, number = self.model, self.model.body(body).id
        names = [model.geom(int(i)).name for i in np.flatnonzero(model.geom_bodyid == number)]
        return [name for name in names if name not in self.scene.hidden] or names

    def doubles(self, size: float) -> dict[str, np.ndarray]:
        """Return box corners from their origin, (N, 3), of the bodies that have a double of a size, by body."""
        import mujoco

        data, corners = mujoco.MjData(self.model), geom_corners(self.model)
        mujoco.mj_kinematics(self.model, data)
        room, spans = DOUBLES_SHARE * float(np.ptp(self.cover.corners()[:, 0])), dict[str, np.ndarray]()
        for body in self.scene.decisive[:DOUBLES]:
            span = np.concatenate([corners[name] for name in self.copied_geoms(body)]) - data.body(body).xpos
            room -= float(np.ptp(span[:, 0]))
            if not spans or room > 0:
                spans[body] = size * span
        return spans


def geom_corners(model: mujoco.MjModel, qpos: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Return box corners (8, 3) of every geom but planes by name, at the start or in a pose."""
    import mujoco

    data, signs = mujoco.MjData(model), Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)).corners()
    data.qpos[:] = model.qpos0 if qpos is None else qpos
    mujoco.mj_kinematics(model, data)
    corners = {}
    for geom in np.flatnonzero(model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE):
        local = model.geom_aabb[geom, :3] + signs * model.geom_aabb[geom, 3:]
        corners[model.geom(geom).name] = local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
    return corners


def middle_of(values: np.ndarray) -> float:
    """Return the middle between the least and the greatest value."""
    return float(values.min() + values.max()) / 2
