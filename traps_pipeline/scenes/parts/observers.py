"""What an observer sees, as values: each takes the frames and the words of the question, and answers or abstains.

An `Observer(frames, named)` gets the sampled frames (N, 360, 480, 3) RGB and what the question names, read back from
its templates: part -> colour, and 'choices'. It gives a label, or None if the decisive thing is not to be seen or not
at rest. A `Finder(frame, colour)` finds one thing in one frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from traps_pipeline.scenes.vision import Blob, at_rest, blobs, colour_mask, is_panel, largest, track

Observer = Callable[[np.ndarray, Mapping[str, str]], str | None]
Finder = Callable[[np.ndarray, str], Blob | None]


# --- one thing in one frame -------------------------------------------------------------------------------------------


def small(frame: np.ndarray, colour: str) -> Blob | None:
    """The largest region of a colour that is no longer than a ball (80 px)."""
    return next((blob for blob in blobs(colour_mask(frame, colour), 60) if max(blob.box[2:]) < 80), None)


def compact(
    frame: np.ndarray, colour: str, *, area: int = 4000, shape: tuple[float, float] = (0.4, 2.5), fill: float = 0.5
) -> Blob | None:
    """The largest region of a colour that may be a ball: filled, about as wide as high, small beside the frame.

    area: at most so many pixels. shape: width over height, between. fill: least share of its bounding box.
    """
    for blob in blobs(colour_mask(frame, colour), 60):
        if blob.area < area and shape[0] < blob.box[2] / blob.box[3] < shape[1] and blob.fill > fill:
            return blob
    return None


def rounded(frame: np.ndarray, colour: str, *, fill: float = 0.9, longer: float = 1.9) -> Blob | None:
    """The largest region of a colour that may be a ball: neither as large nor as rectangular as a panel.

    fill: greatest share of its bounding box. longer: how many times as long as it is wide, at most.
    """
    for blob in blobs(colour_mask(frame, colour)):
        if 60 <= blob.area <= 4000 and blob.fill < fill and max(blob.box[2:]) < longer * min(blob.box[2:]):
            return blob
    return None


def upper_half_stays(frames: np.ndarray, colour: str, first: Blob) -> bool:
    """Whether the upper half of a thing that the first frame shows is still where it was in the last frame."""
    x, y, width, height = first.box
    part = np.s_[y : y + height // 2, x : x + width]
    before, after = (colour_mask(frame, colour)[part] for frame in (frames[0], frames[-1]))
    return bool((before & after).sum() > 0.7 * before.sum())


# --- observers --------------------------------------------------------------------------------------------------------


def beyond(thing: str, mark: str) -> Observer:
    """'yes' if the thing rests on the far side of the mark, seen from where it was first, else 'no'."""

    def observe(frames: np.ndarray, named: Mapping[str, str]) -> str | None:
        path, line = track(frames, named[thing], 60), largest(frames[-1], named[mark], 60)
        start, end = next((blob for blob in path if blob), None), path[-1]
        if line is None or start is None or end is None or not at_rest(path):
            return None
        return "yes" if (end.x - line.x) * (line.x - start.x) > 0 else "no"

    return observe


def past_far_edge(thing: str, screen: str) -> Observer:
    """'yes' if the thing rests past that edge of the screen which is farther from where it was first, else 'no'."""

    def observe(frames: np.ndarray, named: Mapping[str, str]) -> str | None:
        path = [small(frame, named[thing]) for frame in frames]
        start = next((blob.x for blob in path if blob), None)
        wall, end = largest(frames[-1], named[screen], 200), path[-1]
        if start is None or wall is None or end is None or not at_rest(path, tolerance_px=4):
            return None
        left, width = wall.box[0], wall.box[2]
        return "yes" if (end.x > left + width if start < wall.x else end.x < left) else "no"

    return observe


def rests_over(thing: str, goal: str, find: Finder = compact) -> Observer:
    """'yes' if the thing rests within the goal from left to right (2 px more to either side), else 'no'."""

    def observe(frames: np.ndarray, named: Mapping[str, str]) -> str | None:
        path = [find(frame, named[thing]) for frame in frames]
        box, end = largest(frames[-1], named[goal], 60), path[-1]
        if box is None or end is None or not at_rest(path):
            return None
        left, width = box.box[0], box.box[2]
        return "yes" if left - 2 <= end.x <= left + width + 2 else "no"

    return observe


def nearer_side(
    thing: str, left: str, right: str, *, find: Finder = small, least: int = 60, tolerance_px: float = 1.5
) -> Observer:
    """'left' or 'right': which of two marks the resting thing is nearer to. left, right: what the question names, or
    colours; least: of the marks (pixels)."""

    def observe(frames: np.ndarray, named: Mapping[str, str]) -> str | None:
        path = [find(frame, named[thing]) for frame in frames[-3:]]
        marks = [largest(frames[-1], named.get(mark, mark), least) for mark in (left, right)]
        end = path[-1]
        if end is None or marks[0] is None or marks[1] is None or not at_rest(path, tolerance_px=tolerance_px):
            return None
        return "left" if abs(end.x - marks[0].x) < abs(end.x - marks[1].x) else "right"

    return observe


def reaches(thing: str, goal: str, foot: float | None = None) -> Observer:
    """'yes' if the thing rests nearer to the middle of the goal than to where it was first, else 'no'.

    foot: which share of the thing's height, from its top, stands for its place; None takes its middle.
    """

    def place(blob: Blob) -> np.ndarray:
        return np.array([blob.x, blob.y if foot is None else blob.box[1] + foot * blob.box[3]])

    def observe(frames: np.ndarray, named: Mapping[str, str]) -> str | None:
        path, box = track(frames, named[thing], 60), largest(frames[0], named[goal], 60)
        first, last = path[0], path[-1]
        if first is None or last is None or box is None or not at_rest(path) or is_panel(last) or is_panel(box):
            return None
        way = np.array([box.x, box.y]) - place(first)
        return "yes" if (place(last) - place(first)) @ way / (way @ way) > 0.6 else "no"

    return observe


def has_fallen(thing: str) -> Observer:
    """'yes' if the thing, once at rest, no longer stands where it stood at first, else 'no'."""

    def observe(frames: np.ndarray, named: Mapping[str, str]) -> str | None:
        path = track(frames, named[thing], 60)
        if path[0] is None or is_panel(path[0]) or not at_rest(path):
            return None
        return "no" if upper_half_stays(frames, named[thing], path[0]) else "yes"

    return observe
