"""Find walls that are not drawn, and the drawn edges that reveal them.

A thing that turns back where nothing is visible contradicts the physics that a viewer expects. So a wall that is not
drawn (a pane that would tint what is behind it) must have edges that are. A pane before the scene that lies
parallel to the picture needs none: it stops only what would come towards the eye.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from traps_pipeline.scenes.picture.camera import Camera

if TYPE_CHECKING:
    import mujoco

FACES_THE_EYE_DEG = 25.0  # a pane whose normal is no further off the line of sight lies parallel to the picture
TOUCHES_M = 0.01  # an edge is no further from its wall


def outlines(model: mujoco.MjModel, camera: Camera, qpos: np.ndarray) -> Mapping[str, tuple[str, ...]]:
    """Return undrawn solid geoms by name, with the drawn, contactless edges at each.

    Panes that face the eye are left out. qpos: any pose, (nq,).
    """
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    is_solid = (model.geom_contype | model.geom_conaffinity) != 0
    static = model.body_weldid[model.geom_bodyid] == 0
    visible = model.geom_rgba[:, 3] > 0
    edges = np.flatnonzero(static & visible & ~is_solid)
    names: dict[str, tuple[str, ...]] = {}
    for wall in np.flatnonzero(is_solid & ~visible):
        if _is_facing_eye(model, data, camera, int(wall)):
            continue
        nearby_edges = [
            int(edge)
            for edge in edges
            if mujoco.mj_geomDistance(model, data, int(wall), int(edge), 2 * TOUCHES_M, np.zeros(6)) < TOUCHES_M
        ]
        names[model.geom(int(wall)).name] = tuple(model.geom(edge).name for edge in nearby_edges)
    return names


def _is_facing_eye(model: mujoco.MjModel, data: mujoco.MjData, camera: Camera, geom: int) -> bool:
    """Return whether a geom is a pane before the scene, parallel to the picture."""
    normal = data.geom_xmat[geom].reshape(3, 3)[:, int(np.argmin(model.geom_size[geom]))]
    forward = camera.axes()[2]
    is_parallel = abs(normal @ forward) > np.cos(np.radians(FACES_THE_EYE_DEG))
    is_before = (data.geom_xpos[geom] - np.array(camera.lookat)) @ forward < 0
    return bool(is_parallel and is_before)
