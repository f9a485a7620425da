"""The camera of a pair and its occluder, fitted to the worlds that it shows: which of two is the control makes no
difference."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from traps_pipeline.scenes.physics.kit import Box, Scene
from traps_pipeline.scenes.physics.simulate import swept_points
from traps_pipeline.scenes.picture.camera import Camera, Occluder, fit_shot
from traps_pipeline.scenes.worlds.world import World

if TYPE_CHECKING:
    import mujoco


def shown_points(model: mujoco.MjModel, scene: Scene, qpos: np.ndarray) -> np.ndarray:
    """Return what a picture of a scene must hold: everything that moves over a trajectory, and the stage. Shape (N,
    3).
    """
    return np.concatenate([swept_points(model, qpos), *(box.corners() for box in scene.framed)])


def shot_of(worlds: Sequence[World]) -> tuple[Camera, Occluder | None]:
    """Return the nearest camera that has all worlds in its frame, and the smallest occluder that covers what any of
    them says; no occluder if some of them has nothing to cover."""
    points = np.concatenate([shown_points(world.model, world.scene, world.qpos) for world in worlds])
    covers = [world.scene.cover for world in worlds if world.scene.cover is not None]
    cover = box_around([box.corners() for box in covers]) if len(covers) == len(worlds) else None
    return fit_shot(worlds[0].scene.view, points, cover)


def box_around(points: Sequence[np.ndarray]) -> Box:
    """Return the smallest box with all points, each (N, 3)."""
    every = np.concatenate(points)
    return Box(_corner(every.min(axis=0)), _corner(every.max(axis=0)))


def _corner(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
