"""Build observers: functions that answer a question from frames and its slots, or abstain.

An `Observer(frames, slots)` gets the sampled frames (N, 360, 480, 3) RGB and what the question names, read back from
its templates: part -> colour, and 'choices' where it offers some. It gives a label, or None if the decisive thing is
not to be seen or not at rest. A `Finder(frame, colour)` finds one thing in one frame.

An observer with `ahead` is for frames that end before the outcome: it asks for no rest, and takes a thing to go on for
so many frames as it moved last.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from traps_pipeline.scenes.parts.vision import (
    Blob,
    blobs,
    colour_mask,
    is_at_rest,
    is_occluder,
    largest,
    motion_mask,
    track,
)
from traps_pipeline.scenes.parts.wording import choices_in

Observer = Callable[[np.ndarray, Mapping[str, str]], str | None]
Finder = Callable[[np.ndarray, str], Blob | None]

AHEAD = 1.5  # frames after which what is about to happen has happened
BEGUN_PX = 3.0  # what is so far from its first place has left it
FLIGHT = 3.0  # for so many frames a thing may fly on
STRUCK_SHARE = 0.2  # of a thing's area: so much changes where something moves at it
MAX_FRAMES_LOST = 2  # for so many frames a moving thing may be out of sight


# --- one thing in one frame -------------------------------------------------------------------------------------------


def small_blob(frame: np.ndarray, colour: str) -> Blob | None:
    """Return the largest region of a colour that is no longer than a ball (80 px); None if there is none."""
    return next((blob for blob in blobs(colour_mask(frame, colour), 60) if max(blob.box[2:]) < 80), None)


def compact_blob(
    frame: np.ndarray, colour: str, *, area: int = 4000, shape: tuple[float, float] = (0.4, 2.5), fill: float = 0.5
) -> Blob | None:
    """Return the largest region of a colour that may be a ball (filled, about round); None if there is none.

    area: maximum in pixels. shape: range of width over height. fill: minimum share of its bounding box.
    """
    for blob in blobs(colour_mask(frame, colour), 60):
        if blob.area < area and shape[0] < blob.box[2] / blob.box[3] < shape[1] and blob.fill > fill:
            return blob
    return None


def offered(slots: Mapping[str, str], otherwise: Sequence[str]) -> Sequence[str]:
    """Return the answer choices that the question offers, or `otherwise` if it offers none."""
    return choices_in(slots["choices"]) if "choices" in slots else otherwise


def colours_of_balls(frames: np.ndarray, slots: Mapping[str, str], pool: Sequence[str]) -> Sequence[str]:
    """Return the offered colours, or else those of the pool that a ball has at first."""
    ball_colours = [
        colour for colour in pool if sum(compact_blob(frame, colour) is not None for frame in frames[:3]) >= 2
    ]
    return offered(slots, ball_colours)


def round_blob(frame: np.ndarray, colour: str, *, fill: float = 0.9, longer: float = 1.9) -> Blob | None:
    """Return the largest region of a colour that may be a ball, and no occluder.

    fill: greatest share of its bounding box. longer: how many times as long as it is wide, at most.
    """
    for blob in blobs(colour_mask(frame, colour)):
        if 60 <= blob.area <= 4000 and blob.fill < fill and max(blob.box[2:]) < longer * min(blob.box[2:]):
            return blob
    return None


def is_upper_half_in_place(frames: np.ndarray, colour: str, first: Blob) -> bool:
    """Return whether a thing's upper half keeps its initial place in the last frame."""
    x, y, width, height = first.box
    part = np.s_[y : y + height // 2, x : x + width]
    mask_before, mask_after = (colour_mask(frame, colour)[part] for frame in (frames[0], frames[-1]))
    return bool((mask_before & mask_after).sum() > 0.7 * mask_before.sum())


# --- where a thing comes to be ---------------------------------------------------------------------------------------


def end_of(path: Sequence[Blob | None], ahead: float | None = None, tolerance_px: float = 1.5) -> Blob | None:
    """Return the region of a thing at rest, or extrapolated by `ahead` frames; else None."""
    if ahead is not None:
        return extrapolate(path, ahead)
    return path[-1] if is_at_rest(path, tolerance_px=tolerance_px) else None


def extrapolate(path: Sequence[Blob | None], ahead: float) -> Blob | None:
    """Return a thing's region some frames ahead at its last speed; None if long lost."""
    sightings = [(index, blob) for index, blob in enumerate(path) if blob is not None]
    if not sightings or len(path) - 1 - sightings[-1][0] > MAX_FRAMES_LOST:
        return None
    index, last = sightings[-1]
    if len(sightings) == 1 or index - sightings[-2][0] > MAX_FRAMES_LOST + 1:
        return last
    previous_sighting, frames = sightings[-2], ahead + len(path) - 1 - index
    steps = frames / (index - previous_sighting[0])
    dx, dy = steps * (last.x - previous_sighting[1].x), steps * (last.y - previous_sighting[1].y)
    x, y, width, height = last.box
    return replace(last, x=last.x + dx, y=last.y + dy, box=(round(x + dx), round(y + dy), width, height))


def is_struck(frames: np.ndarray, thing: Blob, reach: float) -> bool:
    """Return whether much moved at a thing, or `reach` lengths off, in the last step."""
    return bool(motion_mask(frames)[surrounding_slices(thing, reach)].sum() > STRUCK_SHARE * thing.area)


def surrounding_slices(thing: Blob, reach: float) -> tuple[slice, slice]:
    """Return the slices of a frame around a thing, with a margin in its longer sides."""
    x, y, width, height = thing.box
    margin = round(reach * max(width, height))
    return slice(max(0, y - margin), y + height + margin), slice(max(0, x - margin), x + width + margin)


# --- observers --------------------------------------------------------------------------------------------------------


def beyond(thing: str, mark: str, ahead: float | None = None) -> Observer:
    """Return an observer that tells whether the thing rests on the far side of the mark."""

    def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
        path, line = track(frames, slots[thing], 60), largest(frames[-1], slots[mark], 60)
        start, end = next((blob for blob in path if blob), None), end_of(path, ahead)
        if line is None or start is None or end is None:
            return None
        return "yes" if (end.x - line.x) * (line.x - start.x) > 0 else "no"

    return observe


def past_far_edge(thing: str, screen: str, ahead: float | None = None) -> Observer:
    """Return an observer that tells whether the thing rests past the screen's farther edge."""

    def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
        path = [small_blob(frame, slots[thing]) for frame in frames]
        start = next((blob.x for blob in path if blob), None)
        wall, end = largest(frames[-1], slots[screen], 200), end_of(path, ahead, tolerance_px=4)
        if start is None or wall is None or end is None:
            return None
        left, width = wall.box[0], wall.box[2]
        return "yes" if (end.x > left + width if start < wall.x else end.x < left) else "no"

    return observe


def rests_over(thing: str, goal: str, find: Finder = compact_blob, ahead: float | None = None) -> Observer:
    """Return an observer that tells whether the thing rests within the goal's width + 2 px."""

    def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
        path = [find(frame, slots[thing]) for frame in frames]
        box, end = largest(frames[-1], slots[goal], 60), end_of(path, ahead)
        if box is None or end is None:
            return None
        left, width = box.box[0], box.box[2]
        return "yes" if left - 2 <= end.x <= left + width + 2 else "no"

    return observe


def nearer_side(
    thing: str,
    left: str,
    right: str,
    *,
    find: Finder = small_blob,
    least: int = 60,
    tolerance_px: float = 1.5,
    ahead: float | None = None,
) -> Observer:
    """Return an observer that tells which of two marks the resting thing is nearer to.

    left, right: slots, or colours. least: smallest area of a mark (pixels).
    """

    def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
        path = [find(frame, slots[thing]) for frame in frames[-3:]]
        marks = [largest(frames[-1], slots.get(mark, mark), least) for mark in (left, right)]
        end = end_of(path, ahead, tolerance_px)
        if end is None or marks[0] is None or marks[1] is None:
            return None
        return "left" if abs(end.x - marks[0].x) < abs(end.x - marks[1].x) else "right"

    return observe


def reaches(thing: str, goal: str, foot: float | None = None, ahead: float | None = None) -> Observer:
    """Return an observer that tells whether the thing rests nearer the goal than the start.

    foot: which share of the thing's height, from its top, stands for its place; None takes its middle.
    """

    def place(blob: Blob) -> np.ndarray:
        return np.array([blob.x, blob.y if foot is None else blob.box[1] + foot * blob.box[3]])

    def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
        path, box = track(frames, slots[thing], 60), largest(frames[0], slots[goal], 60)
        first, last = path[0], end_of(path, ahead)
        if first is None or last is None or box is None or is_occluder(last) or is_occluder(box):
            return None
        direction = np.array([box.x, box.y]) - place(first)
        return "yes" if (place(last) - place(first)) @ direction / (direction @ direction) > 0.6 else "no"

    return observe


def has_fallen(thing: str) -> Observer:
    """Return an observer that tells whether the resting thing has left its first stand."""

    def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
        path = track(frames, slots[thing], 60)
        if path[0] is None or is_occluder(path[0]) or path[0].box[3] < path[0].box[2] or not is_at_rest(path):
            return None  # neither an occluder nor a flag stands like a domino
        return "no" if is_upper_half_in_place(frames, slots[thing], path[0]) else "yes"

    return observe


def has_begun(thing: str, reach: float) -> Observer:
    """Return an observer that tells whether a thing has begun to move, or is about to be struck."""

    def foresee(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
        first, last = largest(frames[0], slots[thing], 60), largest(frames[-1], slots[thing], 60)
        if first is None or last is None or is_occluder(first):
            return None
        has_left = np.hypot(last.x - first.x, last.y - first.y) > BEGUN_PX or not is_upper_half_in_place(
            frames, slots[thing], first
        )
        return "yes" if has_left or is_struck(frames, last, reach) else "no"

    return foresee


def will_clear(thing: str, mark: str) -> Observer:
    """Return an observer that tells whether the thing is beyond the mark or will fly over it."""

    def foresee(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
        path, wall = track(frames, slots[thing], 60), largest(frames[-1], slots[mark], 60)
        start, now, later_blob = (
            next((blob for blob in path if blob), None),
            extrapolate(path, 0.0),
            extrapolate(path, 1.0),
        )
        if wall is None or start is None or now is None or later_blob is None:
            return None
        side = 1.0 if wall.x > start.x else -1.0
        lead_px, speed = side * (now.x - wall.x), side * (later_blob.x - now.x)
        if lead_px > 0:
            return "yes"
        if speed <= 0 or lead_px + FLIGHT * speed < 0:
            return "no"  # it comes back, or does not get there
        height = now.y - lead_px / speed * (later_blob.y - now.y)
        return "yes" if height < wall.box[1] else "no"

    return foresee


def lies_on(thing: str, goal: str) -> Observer:
    """Return an observer that tells whether the thing rests between the goal's ends."""

    def look(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
        end = end_of(track(frames, slots[thing], 60))
        boxes = [blob.box for blob in blobs(colour_mask(frames[-1], slots[goal]), 30)]
        if end is None or not boxes:
            return None
        left, right = min(box[0] for box in boxes), max(box[0] + box[2] for box in boxes)
        return "yes" if left < end.x < right else "no"

    return look


def lies_flat(thing: str) -> Observer:
    """Return an observer that tells whether the resting thing is wider than high."""

    def look(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
        end = end_of(track(frames, slots[thing], 60))
        return None if end is None else "yes" if end.box[2] > end.box[3] else "no"

    return look
