"""Measure pixels: of a geom, past an occluder, between two worlds."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.picture.camera import HEIGHT, Camera, Occluder
from traps_pipeline.scenes.picture.coming_board import LANDED, Coming
from traps_pipeline.scenes.picture.render import Renderer

SAMPLED_FPS = 5  # models are shown this rate (docs/spec.md 3.1)


def last_sampled(n_frames: int, fps: int) -> list[int]:
    """Return indices of the last three frames of a 5 FPS sample."""
    return list(range(0, n_frames, fps // SAMPLED_FPS))[-3:]


def least_visible(renderer: Renderer, qpos: np.ndarray, groups: Sequence[tuple[tuple[str, ...], float]]) -> list[float]:
    """Return each geom group's minimum of visible pixels over some control frames."""
    geoms = sorted({name for names, _ in groups for name in names})
    counts = renderer.visible_pixels(qpos, geoms)
    return [float(counts[:, [geoms.index(n) for n in names]].sum(axis=1).min()) for names, _ in groups]


@dataclass(frozen=True)
class PastOccluder:
    """The pixels (F,) that decisive bodies and the hidden element show in a void's frames."""

    decisive: np.ndarray
    hidden: np.ndarray

    def hidden_from(self) -> int:
        """Return the first frame from which no decisive pixel is seen; F if none."""
        visible_frames = np.flatnonzero(self.decisive)
        return int(visible_frames[-1]) + 1 if visible_frames.size else 0

    def leaked(self, first: int) -> float:
        """Return the number of decisive pixels from a frame on, and of all of the hidden element."""
        return float(self.decisive[first:].sum() + self.hidden.sum())


def past_occluder(renderer: Renderer, qpos: np.ndarray, decisive: Sequence[str], hidden: Sequence[str]) -> PastOccluder:
    """Return the numbers of pixels that some geoms show past the occluder, by segmentation."""
    counts = renderer.visible_pixels(qpos, [*decisive, *hidden], occluder=True)
    return PastOccluder(counts[:, : len(decisive)].sum(axis=1), counts[:, len(decisive) :].sum(axis=1))


def seen_moving(pixels: np.ndarray, places: np.ndarray, *, least_px: float, step_px: float) -> int:
    """Return the number of steps of at least `step_px` whose body is visible in both frames.

    pixels (F,), places (F, 2) in pixels.
    """
    is_moving = np.abs(np.diff(places, axis=0)).max(axis=1) >= step_px
    visible = pixels >= least_px
    return int((is_moving & visible[1:] & visible[:-1]).sum())


def swept_behind(camera: Camera, swept: Sequence[np.ndarray], occluder: Occluder) -> float:
    """Return the share of the pixels of motion that an occluder covers.

    swept: corners (8, 3) of every moving geom's box in every frame.
    """
    import cv2

    motion_mask, board = (np.zeros((HEIGHT, camera.width), np.uint8) for _ in range(2))
    for mask, solids in ((motion_mask, swept), (board, [occluder.corners()])):
        for corners in solids:
            outline = cv2.convexHull(camera.project(corners).round().astype(np.int32))
            cv2.fillConvexPoly(mask, outline, 1)
    return float((motion_mask & board).sum() / max(1, motion_mask.sum()))


def occluded_frames(renderer: Renderer, qpos: np.ndarray, without: Sequence[str] = ()) -> Iterator[np.ndarray]:
    """Yield the frames of a trajectory drawn with the void's occluder, without some geoms."""
    yield from renderer.frames(qpos, occluder=True, without=without)


def closing_frames(
    renderer: Renderer, qpos: np.ndarray, board: Coming, *, occluder: bool = False
) -> Iterator[np.ndarray]:
    """Yield frames of a trajectory (F, nq) with the board that closes it, and the void's if `occluder`.

    board: offset of the board in each row; once it stands it is drawn in place of the void's own.
    """
    for row, offset in zip(qpos, board, strict=True):
        is_standing = offset == LANDED
        yield from renderer.frames([row], occluder=occluder or is_standing, board=None if is_standing else offset)


def ablation_pixels(
    renderer: Renderer, qpos: np.ndarray, geoms: Sequence[str], void: Iterable[np.ndarray] | None = None
) -> int:
    """Return the number of void pixels that change without some geoms (0: no trace).

    void: the frames with them, if they are drawn already.
    """
    complete_frames = occluded_frames(renderer, qpos) if void is None else void
    return differing_pixels(complete_frames, occluded_frames(renderer, qpos, without=geoms))[0]


def differing_pixels(frames: Iterable[np.ndarray], counterparts: Iterable[np.ndarray]) -> tuple[int, int]:
    """Return how many pixels of two videos differ, and the largest difference (0-255)."""
    pixels, largest_difference = 0, 0
    for a, b in zip(frames, counterparts, strict=True):
        if not np.array_equal(a, b):
            difference = np.abs(a.astype(np.int16) - b)
            pixels += int(difference.any(axis=2).sum())
            largest_difference = max(largest_difference, int(difference.max()))
    return pixels, largest_difference
