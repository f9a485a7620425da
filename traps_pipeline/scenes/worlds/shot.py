"""Fit a pair's camera and occluder to both worlds, whichever is the control."""

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
    """Return the points that a picture must hold: what moves, and the stage, (N, 3)."""
    return np.concatenate([swept_points(model, qpos), *(box.corners() for box in scene.framed)])


def shot_of(worlds: Sequence[World]) -> tuple[Camera, Occluder | None]:
    """Return the nearest camera with all worlds in frame, and the smallest occluder that hides them.

    It covers what any world must hide; None if some world has nothing to cover.
    """
    points = np.concatenate([shown_points(world.model, world.scene, world.qpos) for world in worlds])
    cover_boxes = [world.scene.cover for world in worlds if world.scene.cover is not None]
    cover = box_around([box.corners() for box in cover_boxes]) if len(cover_boxes) == len(worlds) else None
    return fit_shot(worlds[0].scene.view, points, cover)


def box_around(points: Sequence[np.ndarray]) -> Box:
    """Return the smallest box with all points, each (N, 3)."""
    all_points = np.concatenate(points)
    return Box(_corner(all_points.min(axis=0)), _corner(all_points.max(axis=0)))


def _corner(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
