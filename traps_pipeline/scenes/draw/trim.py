"""Trim occluders to the area that the twin needs.

A family says what its occluder hides at the most, as a box (`Scene.cover`). How much of that must be hidden follows
from the pair: where control and twin differ in any frame, where anything of the hidden element shows, and where
decisive bodies, or their shadows, are from the last frame before the outcome settles. The occluder is cut to that,
upright on the floor as before, and the camera stays. What else the family's box held is then seen: it is the same in
both worlds.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from traps_pipeline.scenes.certification.evidence import Pair
from traps_pipeline.scenes.picture.camera import HEIGHT, Camera, Occluder
from traps_pipeline.scenes.worlds.outcome import decisive_geoms

MARGINS_PX = (3, 9)  # around what must be hidden, to be tried one after the other


def trim_candidates(pair: Pair) -> Iterator[Pair]:
    """Yield the pair with ever larger occluders, each of which may fail a certificate."""
    occluder = pair.control.occluder
    assert occluder is not None, "only an occluder can be trimmed"
    needed_mask = must_hide(pair)
    occluders = [cut_to(occluder, pair.control.camera, needed_mask, margin) for margin in MARGINS_PX]
    for smaller in dict.fromkeys((*occluders, occluder)):
        control, twin = (replace(world, occluder=smaller) for world in (pair.control, pair.other_world))
        yield replace(pair, control=control, twin=twin, void_frame=control.past_occluder.hidden_from())


def must_hide(pair: Pair) -> np.ndarray:
    """Return a mask of the pixels (H, W) that an occluder must cover to hide what differs."""
    needed_mask, videos = np.zeros((HEIGHT, pair.control.camera.width), bool), list[list[np.ndarray]]()
    for world in (pair.control, pair.other_world):
        settled_from = max(world.outcome.commit_frame - 1, 0)
        decisive = decisive_geoms(world.model, world.scene.decisive)
        with world.renderer(supersample=1) as renderer:  # a margin is left, and certificates judge
            frames = list(renderer.frames(world.qpos))
            needed_mask |= _differing_pixels(frames, renderer.frames(world.qpos, without=world.scene.hidden))
            needed_mask |= _differing_pixels(
                frames[settled_from:], renderer.frames(world.qpos[settled_from:], without=decisive)
            )
        videos.append(frames)
    return needed_mask | _differing_pixels(*videos)


def cut_to(occluder: Occluder, camera: Camera, needed: np.ndarray, margin_px: int) -> Occluder:
    """Return the smallest part of an occluder that covers the pixels of a mask (H, W)."""
    rows, columns = np.nonzero(needed)
    if not len(rows):
        return occluder
    left, right = columns.min() - margin_px, columns.max() + 1 + margin_px
    top, bottom = rows.min() - margin_px, rows.max() + 1 + margin_px
    ahead, across = _directions(occluder)
    corners = np.array([[x, y] for x in (left, right) for y in (top, bottom)], dtype=float)
    plane_points = _plane_points(camera, corners, ahead, float(np.array(occluder.centre) @ ahead) - occluder.half[1])
    side, middle = plane_points @ across, float(np.array(occluder.centre) @ across)
    low, high = max(side.min(), middle - occluder.half[0]), min(side.max(), middle + occluder.half[0])
    height = min(float(plane_points[:, 2].max()), 2 * occluder.half[2])
    centre = np.array(occluder.centre) + across * ((low + high) / 2 - middle)
    x, y = (round(float(v), 6) for v in centre[:2])
    half_size = (round((high - low) / 2, 6), occluder.half[1], round(height / 2, 6))
    return replace(occluder, centre=(x, y, half_size[2]), half=half_size)


def _differing_pixels(frames: Iterable[np.ndarray], counterparts: Iterable[np.ndarray]) -> np.ndarray:
    """Return where any frame differs from its counterpart, on the grid of 360 rows."""
    masks = []
    for frame, counterpart in zip(frames, counterparts, strict=True):
        is_different = (frame != counterpart).any(axis=2)
        scale = is_different.shape[0] // HEIGHT
        masks.append(is_different.reshape(HEIGHT, scale, -1, scale).any(axis=(1, 3)))
    return np.any(masks, axis=0)


def _directions(occluder: Occluder) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors of an occluder: away from the camera, to the camera's right."""
    azimuth = np.radians(occluder.yaw_deg + 90.0)
    return np.array([np.cos(azimuth), np.sin(azimuth), 0.0]), np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])


def _plane_points(camera: Camera, pixels: np.ndarray, ahead: np.ndarray, front: float) -> np.ndarray:
    """Return where lines of sight through pixels (N, 2) meet an upright plane, (N, 3)."""
    right, up, forward = camera.axes()
    focal = HEIGHT / 2 / np.tan(np.radians(camera.fovy_deg) / 2)
    ray_x, ray_y = (pixels[:, 0] - camera.width / 2) / focal, (HEIGHT / 2 - pixels[:, 1]) / focal
    rays = forward + ray_x[:, None] * right + ray_y[:, None] * up
    eye = camera.position()
    return eye + rays * ((front - eye @ ahead) / (rays @ ahead))[:, None]
