"""Place the labels of points without overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LINES = 2  # z-order of the lines between a model's points, which labels avoid where they can
SAME_POINT = 0.018  # maximum distance, as a share of the axes, at which models share a label: about a marker's radius


@dataclass(frozen=True)
class Label:
    """The label of a point in the plane of Acc and J, with the names of the models at that point."""

    x: float
    y: float
    text: str
    colour: str


def merge_labels(labels: Sequence[Label], axes: Axes) -> list[Label]:
    """Join labels of coinciding points: one name per line, in a neutral colour."""
    size = np.array([np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())])
    result: list[Label] = []
    for label in labels:
        twin = next((m for m in result if np.hypot(*((m.x - label.x, m.y - label.y) / size)) < SAME_POINT), None)
        if twin is None:
            result.append(label)
        else:
            result[result.index(twin)] = Label(twin.x, twin.y, f"{twin.text}\n{label.text}", "#1b1f27")
    return result


def place_labels(axes: Axes, labels: Sequence[Label], markers: np.ndarray) -> None:
    """Draw every label near its point, clear of labels and markers and mostly of lines.

    A leader line connects a label to its point if they are apart, or if several names share a point. markers: (n, 2),
    data units.
    """
    from matplotlib.patheffects import withStroke

    pixel = axes.figure.dpi / 72  # pixels a point: offsets are in points, boxes in pixels
    room = np.array([axes.bbox.extents])
    obstacles = _squares(axes.transData.transform(markers), 3 * pixel)
    lines = _squares(_line_pixels(axes, pixel), 0.5 * pixel)
    offsets = _offsets()
    distance = np.hypot(*offsets.T)
    halo = [withStroke(linewidth=1.2, foreground="white")]
    for label in sorted(labels, key=lambda m: (-m.text.count("\n"), -m.y, m.x, m.text)):
        note = axes.annotate(
            label.text, (label.x, label.y), (0, 0), textcoords="offset points", size=6, color=label.colour, zorder=9,
            linespacing=1.05, annotation_clip=False, parse_math=False, path_effects=halo,
        )  # fmt: skip
        extent = note.get_window_extent()
        size = np.array([extent.width, extent.height])
        boxes = _boxes(
            axes.transData.transform((label.x, label.y)) + offsets * pixel, offsets, size + np.array([4, 1]) * pixel
        )
        outside_area = np.prod(boxes[0, 2:] - boxes[0, :2]) - _overlap(boxes, room)
        area = 10 * (_overlap(boxes, obstacles) + outside_area) + 2 * _overlap(boxes, lines)
        best = int(np.argmin(area / pixel**2 + distance))
        dx, dy = offsets[best]
        note.set(position=(dx, dy), ha=_side(dx, "left", "right"), va=_side(dy, "bottom", "top"))
        obstacles = np.vstack([obstacles, boxes[best]])
        if distance[best] > 8 or "\n" in label.text:
            axes.annotate(
                "", (label.x, label.y), (dx, dy), textcoords="offset points", annotation_clip=False, zorder=1.9,
                arrowprops={"arrowstyle": "-", "linewidth": 0.4, "color": label.colour, "shrinkA": 0, "shrinkB": 2.5},
            )  # fmt: skip


def _offsets() -> np.ndarray:
    """Return candidate offsets (n, 2) of a label in points: near first, sides first."""
    angles = np.deg2rad([0, 180, 90, 270, 30, 330, 150, 210, 60, 120, 240, 300])
    rings = np.array([5, 9, 14, 20, 28, 38, 50, 64, 80])
    return np.round(rings[:, None, None] * np.column_stack([np.cos(angles), np.sin(angles)]), 3).reshape(-1, 2)


def _side(offset: float, positive: str, negative: str) -> str:
    """Return the alignment by which a text extends away from its marker."""
    return "center" if offset == 0 else positive if offset > 0 else negative


def _boxes(anchors: np.ndarray, offsets: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return pixel extents (n, 4) of a text of that size (2,), aligned by `_side`."""
    low = anchors - size * (1 - np.sign(offsets)) / 2
    return np.hstack([low, low + size])


def _squares(spots: np.ndarray, half: float) -> np.ndarray:
    """Return extents (n, 4) of squares around positions (n, 2)."""
    return np.hstack([spots - half, spots + half])


def _line_pixels(axes: Axes, step: float) -> np.ndarray:
    """Return pixels (n, 2), `step` apart, along the lines that join a model's points."""
    points = [np.empty((0, 2))]
    for line in axes.lines:
        ends = axes.transData.transform(line.get_xydata())
        if line.get_zorder() == LINES and len(ends) == 2:
            count = int(np.hypot(*(ends[1] - ends[0])) / step) + 1
            points.append(np.linspace(ends[0], ends[1], count))
    return np.concatenate(points)


def _overlap(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return area (n,) that each box (n, 4) shares with all others (m, 4) together."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    return np.clip(high - low, 0, None).prod(axis=2).sum(axis=1)


def short(model: str) -> str:
    """Return a label's text in one line, shortened to 28 characters."""
    text = "".join(c if c.isprintable() else "?" for c in model)
    return text if len(text) <= 28 else text[:27] + "…"
