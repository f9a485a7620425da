"""Locate and track colours in frames, for observers (classical vision).

Frames are RGB uint8, shape (360, 480, 3); pixel coordinates are x to the right, y down. Colours are named as in
`kit.COLOURS`. A colour that is none of them (most occluders') belongs to no mask.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from traps_pipeline.scenes.parts.look import OCCLUDERS

FLAG_PX = (60, 50)  # a flag is no wider and no higher
OCCLUDER_PX = 7000  # an occluder that comes before a scene is larger, whatever moves is smaller
STEP_PX = 4000  # of it that come in one step
COMING_PX = 600  # of an occluder on its way, that are new in a frame
COMES_FRAMES = 4  # of five a second, in which it may be seen on its way
EDGE = 60  # least contrast of an edge
MOVED_PX = 24  # what moves changes more pixels from frame to frame
# Levels of 255: by more than the first a pixel changes, by no more than the second two are of one colour.
CHANGED_LEVELS, SAME_COLOUR_LEVELS = 16, 12
# Hue (degrees), least saturation and value (0-1) of the saturated colours. Shade lowers the value, not the hue.
_HUES: Mapping[str, tuple[float, float, float, float]] = {
    "red": (346, 8, 0.62, 0.22),
    "orange": (18, 37, 0.74, 0.30),
    "yellow": (40, 60, 0.62, 0.35),
    "green": (115, 155, 0.50, 0.16),
    "cyan": (174, 196, 0.50, 0.25),
    "blue": (208, 236, 0.55, 0.33),
    "purple": (268, 300, 0.40, 0.20),
}


@dataclass(frozen=True)
class Blob:
    """A connected region of pixels: centroid, box (x, y, width, height) and area, in pixels."""

    x: float
    y: float
    box: tuple[int, int, int, int]
    area: int

    @property
    def fill(self) -> float:
        """Share of the bounding box that the region covers; 0.79 for a disc."""
        return self.area / (self.box[2] * self.box[3])


def colour_mask(frame: np.ndarray, colour: str) -> np.ndarray:
    """Return the mask of a colour in a frame, bool (H, W), tolerant of shade."""
    hsv = cv2.cvtColor(frame.astype(np.float32) / 255, cv2.COLOR_RGB2HSV)
    hue, saturation, value = hsv[..., 0], hsv[..., 1], hsv[..., 2]
    if colour in _HUES:
        low, high, least_saturation, least_value = _HUES[colour]
        is_in_hue = (hue >= low) & (hue <= high) if low < high else (hue >= low) | (hue <= high)
        return is_in_hue & (saturation >= least_saturation) & (value >= least_value)
    match colour:
        case "wood":
            return (hue >= 18) & (hue <= 42) & (saturation >= 0.40) & (saturation < 0.72) & (value >= 0.2)
        case "white":
            return (saturation < 0.10) & (value >= 0.86)
        case "grey":
            return (saturation < 0.12) & (value >= 0.25) & (value < 0.68)
        case "black":
            return (value < 0.19) & ((saturation < 0.35) | (value < 0.07))
        case "navy":
            return (hue >= 215) & (hue <= 245) & (saturation >= 0.5) & (value < 0.33)
    raise ValueError(f"no colour {colour!r}")


def blobs(mask: np.ndarray, min_area: int = 12) -> list[Blob]:
    """Return the connected regions of a mask, largest first."""
    count, _, stats, centres = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    contours = [
        Blob(
            float(centres[i][0]),
            float(centres[i][1]),
            (int(stats[i][0]), int(stats[i][1]), int(stats[i][2]), int(stats[i][3])),
            int(stats[i][4]),
        )
        for i in range(1, count)
        if stats[i][4] >= min_area
    ]
    return sorted(contours, key=lambda blob: -blob.area)


def largest(frame: np.ndarray, colour: str, min_area: int = 12) -> Blob | None:
    """Return the largest region of a colour, None if the colour is not seen."""
    return next(iter(blobs(colour_mask(frame, colour), min_area)), None)


def largest_board(frame: np.ndarray, min_area: int = 12) -> Blob | None:
    """Return the largest region of an occluder's colour, with the lines on it."""
    pixels, mask = frame.astype(np.float32) / 255, np.zeros(frame.shape[:2], bool)
    for rgb in OCCLUDERS.values():
        colour = np.array(rgb, np.float32)
        brightness = pixels @ colour / (colour @ colour)
        colour_error = np.linalg.norm(pixels - brightness[..., None] * colour, axis=2) / np.linalg.norm(colour)
        mask |= (brightness > 0.5) & (brightness < 1.1) & (colour_error < 0.06 * brightness)
    lines = np.ones((9, 9), np.uint8)  # are no wider
    return next(iter(blobs(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, lines), min_area)), None)


def slanting_edges(
    frame: np.ndarray, part: tuple[slice, slice], slants: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the masks of a part's edges that fall to the left, and to the right.

    slants: least and greatest slope, in rows a column.
    """
    grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY).astype(np.float32)
    across, down = (cv2.Sobel(grey, cv2.CV_32F, x, 1 - x)[part] for x in (1, 0))
    slope = -across / np.where(down == 0, 1e-3, down)
    edges = (np.hypot(across, down) > EDGE) & (np.abs(slope) > slants[0]) & (np.abs(slope) < slants[1])
    return edges & (slope < 0), edges & (slope > 0)


def track(frames: Sequence[np.ndarray] | np.ndarray, colour: str, min_area: int = 12) -> list[Blob | None]:
    """Return the largest region of a colour in every frame."""
    return [largest(frame, colour, min_area) for frame in frames]


def before_occluder(frames: np.ndarray) -> np.ndarray:
    """Return the frames before an occluder comes and stays; all of them if none does.

    An occluder comes in large steps: a large region turns to one colour (but for its shadow), which is not that of what
    is around it, and soon a large region has that colour and keeps it. What stands from the first frame on does not
    come; where an occluder goes, the scene goes on.
    """
    for at in range(1, len(frames)):
        is_new = _levels(frames[at], frames[at - 1]) > CHANGED_LEVELS
        if is_new.sum() < STEP_PX:
            continue
        count, names = cv2.connectedComponents(is_new.astype(np.uint8), connectivity=4)
        sizes = np.bincount(names.ravel(), minlength=count)
        sizes[0] = 0
        region = names == sizes.argmax()
        ring = cv2.dilate(region.astype(np.uint8), np.ones((17, 17), np.uint8)).astype(bool) & ~region
        previous_colour, colour = (
            np.median(frame[region], axis=0).astype(np.uint8) for frame in (frames[at - 1], frames[at])
        )
        region_share, ring_share = (
            (_levels(frames[at][part], colour) <= SAME_COLOUR_LEVELS).mean() for part in (region, ring)
        )
        was_even = (_levels(frames[at - 1][region], previous_colour) <= SAME_COLOUR_LEVELS).mean()
        # Some of what is around it may be as dark.
        stands_out = ring_share < 0.4 or (ring_share < 0.75 and was_even < region_share)
        if sizes.max() >= STEP_PX and region_share > 0.5 and stands_out and _is_standing_later(frames, at, colour):
            return frames[: _first_moving_frame(frames, at, colour)]
    return frames


def _is_standing_later(frames: np.ndarray, comes: int, colour: np.ndarray) -> bool:
    """Return whether a region that turned to a colour has it soon and at the end."""
    earlier_frame, later_frame = max(0, comes - 1 - COMES_FRAMES), min(comes + COMES_FRAMES, len(frames) - 1)
    level_before, level_early, soon_after, level_at_end = (
        _levels(frames[at], colour) <= SAME_COLOUR_LEVELS for at in (comes - 1, earlier_frame, later_frame, -1)
    )
    new_region = level_at_end & ~level_before & ~level_early
    # Lines between slats are filled.
    filled_mask = cv2.morphologyEx(new_region.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
    return bool(filled_mask.sum() >= OCCLUDER_PX and (soon_after & new_region).sum() > 0.9 * new_region.sum())


def _first_moving_frame(frames: np.ndarray, comes: int, colour: np.ndarray) -> int:
    """Return the first frame in which an occluder that comes is seen on its way."""
    first = comes
    while first > max(1, comes - COMES_FRAMES):
        current, previous_level = (
            _levels(frame, colour) <= SAME_COLOUR_LEVELS for frame in (frames[first - 1], frames[first - 2])
        )
        if (current & ~previous_level).sum() < COMING_PX:
            break
        first -= 1
    return first


def until_covered(frames: np.ndarray, n_before: int) -> np.ndarray:
    """Return the frames before an occluder, and then those of its way in which it is before nothing that moves.

    n_before: frames before it is in view. What it hides on its way is painted as it was before.
    """
    seen = [*frames[:n_before]]
    for frame in frames[n_before : n_before + COMES_FRAMES] if n_before > 1 else ():
        is_new = _levels(frame, seen[-1]) > CHANGED_LEVELS
        board = largest_board(np.where(is_new[..., None], frame, 255), COMING_PX)
        if board is None:
            break
        x, y, width, height = board.box
        part = np.s_[max(0, y - 2) : y + height + 2, max(0, x - 2) : x + width + 2]
        moved = motion_mask(np.stack(seen[-2:])) & ~_is_shaded(seen[-2], seen[-1])
        _, names = cv2.connectedComponents(moved.astype(np.uint8))
        sizes, covered = np.bincount(names.ravel()), np.bincount(names[part].ravel(), minlength=names.max() + 1)
        if ((sizes >= MOVED_PX) & (covered > sizes / 2))[1:].any():
            break
        seen.append(frame.copy())
        seen[-1][part] = seen[-2][part]
    return np.stack(seen)


def _is_shaded(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the mask of pixels that turned darker and kept their hue, bool (H, W), as in a shadow."""
    old, new = before.astype(np.float32) + 1, after.astype(np.float32) + 1
    light = (new * old).sum(axis=2) / (old * old).sum(axis=2)
    error = np.linalg.norm(new - light[..., None] * old, axis=2) / np.linalg.norm(old, axis=2)
    return (light < 1) & (error < 0.06)


def after_occluder(frames: np.ndarray) -> np.ndarray:
    """Return the frames after an occluder that stood from the first on has gone."""
    return before_occluder(frames[::-1])[::-1]


def motion_mask(frames: np.ndarray) -> np.ndarray:
    """Return the mask of pixels that changed in the last frame, bool (H, W)."""
    return _levels(frames[-1], frames[-2]) > CHANGED_LEVELS if len(frames) > 1 else np.zeros(frames.shape[1:3], bool)


def is_still(frames: np.ndarray) -> bool:
    """Return whether nothing moves in the last two steps."""
    return motion_mask(frames).sum() < MOVED_PX and motion_mask(frames[:-1]).sum() < MOVED_PX


def _levels(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return by how many levels two pictures differ at most in a channel, by pixel."""
    levels = np.maximum(a, b) - np.minimum(a, b)
    return np.maximum(np.maximum(levels[..., 0], levels[..., 1]), levels[..., 2])  # 20 times as fast as max(axis=-1)


def without_flags(frames: np.ndarray) -> np.ndarray:
    """Return frames (F, H, W, 3) whose flags (signs over hidden things) are painted over.

    A flag is a small upright patch of one colour at the top of a thin dark mast, to its right; both stand still. Of a
    black flag the mast is told apart only below.
    """
    background = np.median(frames, axis=0).astype(np.uint8)
    painted_frames = frames.copy()
    for left, top, width in _mast_tops(background):
        for seed in ((left + width + 3, top + 5), (left + width + 3, top - 4)):
            patch = _flag_patch(background, seed)
            if patch is None or patch[0] > left + width + 3:
                continue
            x, y, flag_width, height = patch
            box = np.s_[y : y + height, x : x + flag_width]
            changes = np.abs(np.stack([frames[0][box], frames[-1][box]]).astype(int) - background[box])
            rest_share = (changes[1] > 40).any(axis=-1).mean()  # a thing that lies before the patch is smaller than it
            if min(abs(y - top), abs(y + height - top)) > 6 or changes.mean() > 12 or rest_share > 0.03:
                continue  # neither flies at the end of the mast, or it moves
            row_above = max(0, min(top, y) - 4)
            colour_beside = painted_frames[:, row_above, max(0, left - 4)]
            painted_frames[:, row_above + 2 : y + height + 3, left - 1 : x + flag_width + 3] = colour_beside[
                :, None, None
            ]
            break
    return painted_frames


def _flag_patch(background: np.ndarray, seed: tuple[int, int]) -> tuple[int, int, int, int] | None:
    """Return the box of the patch of one colour around a pixel, if it may be a flag."""
    height, width = background.shape[:2]
    if not (0 <= seed[0] < width and 0 <= seed[1] < height):
        return None
    region = np.zeros((height + 2, width + 2), np.uint8)
    flags = 4 | cv2.FLOODFILL_MASK_ONLY | cv2.FLOODFILL_FIXED_RANGE | (1 << 8)
    _, _, _, (x, y, patch_width, patch_height) = cv2.floodFill(
        background.copy(), region, seed, (0, 0, 0), (22,) * 3, (22,) * 3, flags
    )
    filled_share = region[1:-1, 1:-1][y : y + patch_height, x : x + patch_width].mean()
    is_flag = 8 <= patch_width <= FLAG_PX[0] and 6 <= patch_height <= FLAG_PX[1] and filled_share > 0.6
    return (x, y, patch_width, patch_height) if is_flag else None


def _mast_tops(background: np.ndarray) -> list[tuple[int, int, int]]:
    """Return upper ends (left, top, width) of thin, dark, upright lines."""
    light = background.max(axis=2)
    closed_light = cv2.morphologyEx(light, cv2.MORPH_CLOSE, np.ones((1, 7), np.uint8))
    thin_mask = ((light < 125) & (np.ptp(background, axis=2) < 30) & (cv2.subtract(closed_light, light) > 30)).astype(
        np.uint8
    )
    tall_mask = cv2.morphologyEx(
        cv2.dilate(thin_mask, np.ones((1, 3), np.uint8)), cv2.MORPH_OPEN, np.ones((6, 1), np.uint8)
    )
    count, names = cv2.connectedComponents(tall_mask, connectivity=8)
    masts = []
    for name in range(1, count):
        y, x = np.nonzero(names == name)
        end = x[y < y.min() + 6]
        if np.ptp(x) < 3 * np.ptp(y) and np.ptp(end) < 12:
            masts.append((int(end.min()), int(y.min()), int(np.ptp(end)) + 1))
    return masts


def is_at_rest(path: Sequence[Blob | None], last: int = 3, tolerance_px: float = 1.5) -> bool:
    """Return whether the thing is seen in each of the last frames and stays in place."""
    tail = path[-last:]
    visible = [blob for blob in tail if blob is not None]
    if len(visible) < last:
        return False
    xs, ys = [blob.x for blob in visible], [blob.y for blob in visible]
    return max(xs) - min(xs) <= tolerance_px and max(ys) - min(ys) <= tolerance_px


def is_occluder(blob: Blob, longest_px: int = 130) -> bool:
    """Return whether a region is too long or too thin for a thing of a scene."""
    return max(blob.box[2:]) > longest_px or min(blob.box[2:]) < 5
