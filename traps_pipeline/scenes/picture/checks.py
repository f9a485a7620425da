"""Pixel evidence: what is seen of a geom, what is seen past an occluder, whether two worlds give one video."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.picture.camera import HEIGHT, WIDTH, Camera, Occluder
from traps_pipeline.scenes.picture.coming_board import LANDED, Coming
from traps_pipeline.scenes.picture.render import Renderer

SAMPLED_FPS = 5  # models are shown this rate (docs/spec.md 3.1)


def last_sampled(n_frames: int, fps: int, count: int = 3) -> list[int]:
    """Return indices of the last frames that the 5 FPS sample shows of a clip."""
    return list(range(0, n_frames, fps // SAMPLED_FPS))[-count:]


def least_visible(renderer: Renderer, qpos: np.ndarray, groups: Sequence[tuple[tuple[str, ...], float]]) -> list[float]:
    """Return the least number of pixels that each group of geoms has in any of the given frames of the control."""
    geoms = sorted({name for names, _ in groups for name in names})
    counts = renderer.visible_pixels(qpos, geoms)
    return [float(counts[:, [geoms.index(n) for n in names]].sum(axis=1).min()) for names, _ in groups]


@dataclass(frozen=True)
class PastOccluder:
    """What is seen past the occluder in frames of a void: pixels (F,) of the decisive bodies, and of the hidden
    element."""

    decisive: np.ndarray
    hidden: np.ndarray

    def hidden_from(self) -> int:
        """Return first frame from which no decisive body has a pixel until the end; the number of frames if none is."""
        showing = np.flatnonzero(self.decisive)
        return int(showing[-1]) + 1 if showing.size else 0

    def leaked(self, first: int) -> float:
        """Return pixels of decisive bodies from a frame on, and of the hidden element in any frame. 0: the occluder
        hides.
        """
        return float(self.decisive[first:].sum() + self.hidden.sum())


def past_occluder(renderer: Renderer, qpos: np.ndarray, decisive: Sequence[str], hidden: Sequence[str]) -> PastOccluder:
    """Return what is seen past the occluder of the geoms of decisive bodies and of the hidden element, by
    segmentation."""
    counts = renderer.visible_pixels(qpos, [*decisive, *hidden], occluder=True)
    return PastOccluder(counts[:, : len(decisive)].sum(axis=1), counts[:, len(decisive) :].sum(axis=1))


def seen_moving(pixels: np.ndarray, places: np.ndarray, *, least_px: float, step_px: float) -> int:
    """Count the steps between frames in which a body is seen to move: it has at least so many pixels in both and goes
    so far.

    pixels (F,), places (F, 2) in pixels.
    """
    moves = np.abs(np.diff(places, axis=0)).max(axis=1) >= step_px
    visible = pixels >= least_px
    return int((moves & visible[1:] & visible[:-1]).sum())


def swept_behind(camera: Camera, swept: Sequence[np.ndarray], occluder: Occluder) -> float:
    """Return share of the picture's pixels over which anything moves that the occluder covers. swept: corners (8, 3) of
    every moving geom's box in every frame."""
    import cv2

    moving, board = (np.zeros((HEIGHT, WIDTH), np.uint8) for _ in range(2))
    for mask, solids in ((moving, swept), (board, [occluder.corners()])):
        for corners in solids:
            outline = cv2.convexHull(camera.project(corners).round().astype(np.int32))
            cv2.fillConvexPoly(mask, outline, 1)
    return float((moving & board).sum() / max(1, moving.sum()))


def void_frames(renderer: Renderer, qpos: np.ndarray, without: Sequence[str] = ()) -> Iterator[np.ndarray]:
    """Yield the void that a trajectory makes, without the geoms that are named."""
    yield from renderer.frames(qpos, occluder=True, without=without)


def closing_frames(
    renderer: Renderer, qpos: np.ndarray, board: Coming, *, occluder: bool = False
) -> Iterator[np.ndarray]:
    """Draw what a trajectory (F, nq) makes of a control, or of a void, whose occluder stands from the start.

    board: of each row, where the board is that closes it; once it stands it is drawn in the place of the void's own.
    """
    for row, offset in zip(qpos, board, strict=True):
        stands = offset == LANDED
        yield from renderer.frames([row], occluder=occluder or stands, board=None if stands else offset)


def ablation_pixels(
    renderer: Renderer, qpos: np.ndarray, geoms: Sequence[str], void: Iterable[np.ndarray] | None = None
) -> int:
    """Return how many void pixels change, over the given frames, when the geoms are taken away. 0 proves that nothing
    of them, shadow included, reaches the eye. void: the frames with them, if they are drawn already."""
    with_them = void_frames(renderer, qpos) if void is None else void
    return differing_pixels(with_them, void_frames(renderer, qpos, without=geoms))[0]


def differing_pixels(frames: Iterable[np.ndarray], others: Iterable[np.ndarray]) -> tuple[int, int]:
    """Return, over all frames of two worlds, how many pixels differ, and the largest difference of a channel
    (0-255)."""
    pixels, largest = 0, 0
    for a, b in zip(frames, others, strict=True):
        if not np.array_equal(a, b):
            difference = np.abs(a.astype(np.int16) - b)
            pixels += int(difference.any(axis=2).sum())
            largest = max(largest, int(difference.max()))
    return pixels, largest
