"""Simulate a built scene to a trajectory, and replay it to poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from traps_pipeline.scenes.physics.flexes import carriers, elements, flex_vertices, flexes
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene

if TYPE_CHECKING:
    import mujoco

SIGNS = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, 8).T  # of a box's corners


def initial_velocity(model: mujoco.MjModel, velocity: Mapping[str, Sequence[float]]) -> np.ndarray:
    """Return the initial qvel, (nv,), from velocities by body (3 numbers if soft)."""
    qvel, soft_bodies = np.zeros(model.nv), flexes(model)
    for body, values in velocity.items():
        if body in soft_bodies:
            for address in model.body_dofadr[carriers(model, soft_bodies[body])]:
                qvel[address : address + 3] = values[:3]
            continue
        address = model.body(body).dofadr[0]
        qvel[address : address + len(values)] = values
    return qvel


def simulate(model: mujoco.MjModel, scene: Scene, physics: Physics) -> np.ndarray:
    """Return qpos at every frame time, (F, nq) float32. Raises FloatingPointError."""
    import mujoco

    data = mujoco.MjData(model)
    data.qvel[:] = initial_velocity(model, scene.velocity)
    frames = np.empty((physics.n_frames, model.nq), np.float32)
    for i in range(physics.n_frames):
        frames[i] = data.qpos
        mujoco.mj_step(model, data, physics.substeps)
    n_warnings = int(data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number)
    if n_warnings or not np.isfinite(frames).all():
        raise FloatingPointError(f"simulation diverged ({n_warnings} bad accelerations)")
    return frames


def replay(model: mujoco.MjModel, qpos: np.ndarray, physics: Physics) -> Motion:
    """Return the poses of a trajectory's bodies, without dynamics."""
    import mujoco

    data, soft_bodies = mujoco.MjData(model), flexes(model)
    names = [model.body(i).name for i in range(1, model.nbody)]
    positions = np.empty((len(qpos), model.nbody, 3))
    rotations = np.empty((len(qpos), model.nbody, 9))
    soft_vertices = {name: np.empty((len(qpos), int(model.flex_vertnum[i]), 3)) for name, i in soft_bodies.items()}
    for i, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        positions[i], rotations[i] = data.xpos, data.xmat
        for name, places in soft_vertices.items():
            places[i] = flex_vertices(model, data, soft_bodies[name])
    return Motion(
        times=np.arange(len(qpos)) / physics.fps,
        positions={name: positions[:, i + 1] for i, name in enumerate(names)},
        rotations={name: rotations[:, i + 1].reshape(-1, 3, 3) for i, name in enumerate(names)},
        vertices=soft_vertices,
    )


def standing_points(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Return box corners of all that is drawn and stands still, without floors: (N, 3). qpos: any pose, (nq,)."""
    import mujoco

    is_drawn = (model.geom_rgba[:, 3] > 0) & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return _corners(model, data, np.flatnonzero(is_drawn & (model.body_dofnum[model.geom_bodyid] == 0))).reshape(-1, 3)


def _corners(model: mujoco.MjModel, data: mujoco.MjData, geoms: np.ndarray) -> np.ndarray:
    """Return the corners of geoms' boxes in a pose, (N, 8, 3)."""
    centre, half_size = model.geom_aabb[geoms, :3], model.geom_aabb[geoms, 3:]
    local = centre[:, None] + SIGNS[None] * half_size[:, None]
    rotation = data.geom_xmat[geoms].reshape(-1, 3, 3)
    return np.einsum("gij,gkj->gki", rotation, local) + data.geom_xpos[geoms][:, None]


def swept_points(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Return box corners of all that moves, over a trajectory: (N, 3), in eights."""
    import mujoco

    data = mujoco.MjData(model)
    moving_geoms = np.flatnonzero(model.body_dofnum[model.geom_bodyid] > 0)
    points, soft_bodies = [], flexes(model).values()
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        points.append(_corners(model, data, moving_geoms))
        for flex in soft_bodies:
            at, reach = flex_vertices(model, data, flex)[elements(model, flex)], float(model.flex_radius[flex])
            middle, half_extent = (at.max(axis=1) + at.min(axis=1)) / 2, np.ptp(at, axis=1) / 2 + reach
            points.append(middle[:, None] + SIGNS[None] * half_extent[:, None])
    return np.concatenate(points).reshape(-1, 3)
