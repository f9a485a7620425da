"""Show observers the scene of one lane, in frames of two lanes side by side.

A board stands from first frame to last before the scene, which is then never seen, or before the bench. The plate of a
bench tells it from a scene.
"""

import cv2
import numpy as np

from traps_pipeline.scenes.parts.vision import Blob, blobs, colour_mask
from traps_pipeline.scenes.picture.camera import HEIGHT, WIDTH

BOARD_PX, STRIP_PX = 400, 100  # least areas
MARGIN, INNER = 1.08, 0.8  # of the strip's length, that the scene is shown in; share of what is added on the inner side
PLATE_ROWS, PLATE_BELOW_PX = 2, 10  # of a bench's plate, at a board's place and so far below


def scenes_of_lane(frames: np.ndarray, strip: str) -> list[np.ndarray]:
    """Return the frames (M, 360, 480, 3) that show a lane's scene without a board before it.

    frames: (N, H, W, 3). First come these after those in which a board stands before the scene from the first frame on,
    since what begins beside it is seen in them; then these alone.
    """
    halves = np.split(frames, 2, axis=2)
    strips = [_strip(half, strip) for half in halves]
    side = int(np.argmax([0 if blob is None else blob.area for blob in strips]))
    lane, strip_blob = halves[side], strips[side]
    boards = np.stack([colour_mask(frame, "navy") for frame in lane])
    still = next(iter(blobs(boards.min(axis=0), BOARD_PX)), None)
    if strip_blob is None or still is None:
        return []
    _, top, _, height = still.box
    boards[:, top - 2 : top + height + 3] = False
    moving = [[blob for blob in blobs(mask, BOARD_PX) if blob.fill > 0.5] for mask in boards]
    open_frames = np.array([not seen for seen in moving])
    if open_frames.all() or not open_frames.any():
        return []
    place = max(
        (blob for seen in moving for blob in seen), key=lambda blob: ((blob.box[1] + blob.box[3]) // 4, blob.area)
    )
    background = np.median(lane[open_frames], axis=0).astype(np.uint8)
    if _is_bench(background, place):
        return []
    first = int(open_frames.argmax())
    stands = [any(np.ptp([blob.box, place.box], axis=0).max() < 4 for blob in seen) for seen in moving[:first]]
    is_shown = np.concatenate([stands, open_frames[first:]]).astype(bool)
    rows = slice(0, top - 1) if top > place.box[1] else slice(top + height + 1, strip_blob.box[1] - 1)
    scene = _cropped(lane[is_shown], background, rows, strip_blob, side)
    return [scene, scene[sum(stands) :]]


def _strip(half: np.ndarray, colour: str) -> Blob | None:
    """Return the largest region of a colour that may be a strip."""
    found = blobs(colour_mask(np.median(half, axis=0).astype(np.uint8), colour), STRIP_PX)
    return next((blob for blob in found if blob.box[2] > 4 * blob.box[3]), None)


def _is_bench(background: np.ndarray, place: Blob) -> bool:
    """Return whether the plate of a bench is seen at a board's place."""
    x, y, width, height = place.box
    part = background[y : y + height + PLATE_BELOW_PX, x : x + width].astype(int)
    red, green, blue = np.moveaxis(part, 2, 0)
    plate = (abs(red - blue) < 10) & (red - green > 3) & (red - green < 16) & (red > 60) & (red < 125)
    return int((plate.mean(axis=1) > 0.5).sum()) >= PLATE_ROWS


def _cropped(lane: np.ndarray, background: np.ndarray, rows: slice, strip: Blob, side: int) -> np.ndarray:
    """Return what some rows show behind a strip (nearer to the middle of the picture), at an observer's size."""
    x, _, length, _ = strip.box
    width = min(round(MARGIN * length) + 8, lane.shape[2])
    outer = round((width - length) * (1 - INNER if side == 0 else INNER))
    left = int(np.clip(x - outer, 0, lane.shape[2] - width))
    bottom = min(max(rows.stop + 4, height := width * HEIGHT // WIDTH), lane.shape[1])
    shown = np.empty_like(lane)
    shown[:] = np.median(background[rows].reshape(-1, 3), axis=0).astype(np.uint8)
    shown[:, rows] = lane[:, rows]
    part = shown[:, bottom - height : bottom, left : left + width]
    return np.stack([cv2.resize(frame, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC) for frame in part])
