"""Figures from the leaderboard (benchmark.md section 10). The same table gives the same bytes."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from traps_pipeline.partitions import DATASETS
from traps_pipeline.paths import ASSETS
from traps_pipeline.report.page import TITLES, entries_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STYLE = ASSETS / "figures.mplstyle"
COLUMN_IN = 3.4
# Okabe and Ito's palette without its yellow, which is too light for a hollow marker, and with its black as grey.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#4D4D4D")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", "p", ">", "h")  # 7 colours x 11 shapes: 77 models stay distinct
LINES = 2  # z-order of the lines from standard to guided
SAME_POINT = 0.02  # distance in (Acc, J) under which two models share a label: about a marker's radius


@dataclass(frozen=True)
class Label:
    """The names of the models that end at one point of (Acc, J)."""

    x: float
    y: float
    text: str
    colour: str


@contextmanager
def figure_style() -> Iterator[None]:
    """The house style, for drawing and for saving: some of it (the SVG salt) counts only then."""
    import matplotlib.style

    with matplotlib.style.context(STYLE):
        yield


def figure_bytes(figure: Figure, kind: str = "png") -> bytes:
    """The figure as a PNG or SVG file, without a date.

    A layout engine would move things again on every save: it runs once, in a draw, and is then switched off.
    """
    with figure_style():
        figure.canvas.draw()
        figure.set_layout_engine("none")
        stream = io.BytesIO()
        metadata = {"Date": None} if kind == "svg" else {"Software": None}
        figure.savefig(stream, format=kind, metadata=metadata)  # pyright: ignore[reportArgumentType]
    return stream.getvalue()


def landscape_figure(board: pd.DataFrame) -> Figure:
    """Acc (x) against J (y) of every model with iso-PECS contours, one column wide.

    Hollow is standard, filled is guided, a thin line joins them, a dot is json. Points are aggregate (Acc, J) of the
    `overall` rows (of the first dataset where nobody has all four); the reported PECS is averaged per run and dataset,
    so it can differ a little from what the contours say at that point. Models whose named points coincide (reference
    strategies) share one label.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scope, _ = entries_of(board)
    points = board.loc[(board["dataset"] == scope) & board["acc"].notna() & board["j"].notna()]
    lowest = min([-0.1, *(points["j"] - 0.08)])
    with figure_style():
        figure = Figure(figsize=(COLUMN_IN, 2.4 + 1.15 * (1.06 - lowest)), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        axes.set(
            xlim=(-0.04, 1.04),
            ylim=(lowest, 1.06),
            xlabel=f"Acc, {TITLES[scope].lower()}",
            ylabel="J = AbsRec − FalseAbs",
        )
        _draw_contours(axes)
        labels = merged_labels(_draw_models(axes, points))
        _draw_key(figure)
        figure.canvas.draw()
        figure.set_layout_engine("none")
        _place_labels(axes, labels, points.loc[:, ["acc", "j"]].to_numpy(float))
    return figure


def shortcut_figure(table: pd.DataFrame) -> Figure:
    """How well side can be told from each cue alone, one column wide: a row of points a dataset, chance as a line.

    table is what `benchmark.shortcuts` gives.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    datasets = [name for name in TITLES if name in set(table["dataset"])] or list(DATASETS)
    cues = list(dict.fromkeys(table["cue"]))
    with figure_style():
        figure = Figure(figsize=(COLUMN_IN, 0.75 + 0.42 * len(datasets)), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        axes.axvline(0.5, color="#98a2b3", linewidth=0.8, zorder=0.5)
        for k, cue in enumerate(cues):
            rows = table.loc[table["cue"] == cue].set_index("dataset")
            at = [datasets.index(str(name)) + 0.17 * (k - (len(cues) - 1) / 2) for name in rows.index]
            axes.errorbar(
                rows["accuracy"], at, xerr=rows["half_width"], fmt=MARKERS[k], color=COLOURS[k], markersize=4,
                linestyle="none", linewidth=0.8, label=cue, clip_on=False, zorder=3,
            )  # fmt: skip
        axes.set(xlim=(0.38, 1.02), ylim=(len(datasets) - 0.5, -0.5), xlabel="control and void told apart, share")
        axes.set_yticks(range(len(datasets)), [TITLES[name] for name in datasets])
        if cues:
            columns = len(cues)
            figure.legend(loc="outside upper center", ncols=columns, handletextpad=0.1, columnspacing=0.8, fontsize=6)
    return figure


def merged_labels(labels: Sequence[Label]) -> list[Label]:
    """Labels of coinciding points joined, one name a line, in the order given; a shared label is neutral in colour."""
    merged: list[Label] = []
    for label in labels:
        twin = next((m for m in merged if np.hypot(m.x - label.x, m.y - label.y) < SAME_POINT), None)
        if twin is None:
            merged.append(label)
        else:
            merged[merged.index(twin)] = Label(twin.x, twin.y, f"{twin.text}\n{label.text}", "#1b1f27")
    return merged


def _draw_contours(axes: Axes) -> None:
    """J = PECS / Acc for PECS of 0.1 to 0.9, labelled in the right margin, where the curve ends at Acc = 1."""
    axes.axhline(0, color="#98a2b3", linewidth=0.8, zorder=0.5)
    for pecs in np.arange(1, 10) / 10:
        acc = np.linspace(pecs, 1, 200)
        axes.plot(acc, pecs / acc, color="#d0d5dd", linewidth=0.6, zorder=0.4)
        axes.annotate(
            f"{pecs:.1f}", (1, pecs), (1.055, pecs), annotation_clip=False, va="center", color="#667085", size=6
        )
    axes.annotate("PECS", (1, 1), (1.055, 1), annotation_clip=False, va="center", color="#667085", size=6)


def _draw_models(axes: Axes, points: pd.DataFrame) -> list[Label]:
    """Markers of every model; returns a label a model, at its guided point, else at the first it has."""
    labels = []
    for k, (model, rows) in enumerate(points.sort_values("model").groupby("model", sort=True)):
        colour, marker = COLOURS[k % len(COLOURS)], MARKERS[k % len(MARKERS)]
        at = {
            regime: (float(acc), float(j))
            for regime, acc, j in zip(*(rows[c] for c in ("regime", "acc", "j")), strict=True)
        }
        pair = np.array([at[r] for r in ("standard", "guided") if r in at]).reshape(-1, 2)
        axes.plot(*pair.T, color=colour, linewidth=0.7, alpha=0.7, zorder=LINES)
        styles = {
            "standard": {"s": 20, "marker": marker, "facecolors": "white", "edgecolors": colour, "linewidths": 0.9},
            "guided": {"s": 20, "marker": marker, "facecolors": colour, "edgecolors": colour, "linewidths": 0.9},
            "json": {"s": 5, "marker": "o", "facecolors": colour, "edgecolors": "none", "linewidths": 0},
        }
        for zorder, (regime, style) in enumerate(styles.items(), start=3):
            if regime in at:
                axes.scatter(*at[regime], zorder=zorder, clip_on=False, **style)
        x, y = next(at[r] for r in ("guided", *at) if r in at)
        labels.append(Label(x, y, _short(str(model)), colour))
    return labels


def _draw_key(figure: Figure) -> None:
    from matplotlib.lines import Line2D

    def handle(size: float, face: str) -> Line2D:
        return Line2D([], [], linestyle="none", marker="o", markersize=size, color="#475467", markerfacecolor=face)

    handles = [handle(4.5, "white"), handle(4.5, "#475467"), handle(1.6, "#475467")]
    figure.legend(
        handles,
        ["standard", "guided", "json"],
        loc="outside lower center",
        ncols=3,
        handletextpad=0.1,
        columnspacing=1.2,
    )


def _place_labels(axes: Axes, labels: Sequence[Label], markers: np.ndarray) -> None:
    """Put every label near its point where it hits no marker, no other label and, if that is not far, no line.

    A leader line joins the two where they are apart. markers is (n, 2) in data coordinates. Greedy and without chance:
    the outcome depends on the table alone.
    """
    from matplotlib.patheffects import withStroke

    pixel = axes.figure.dpi / 72  # pixels a point: offsets are in points, boxes in pixels
    room = np.array([axes.bbox.extents])
    taken = _around(axes.transData.transform(markers), 3 * pixel)
    lines = _around(_along_lines(axes, pixel), 0.5 * pixel)
    offsets = _offsets()
    distance = np.hypot(*offsets.T)
    halo = [withStroke(linewidth=1.2, foreground="white")]
    for label in sorted(labels, key=lambda m: (-m.text.count("\n"), -m.y, m.x, m.text)):
        note = axes.annotate(
            label.text, (label.x, label.y), (0, 0), textcoords="offset points", size=5.6, color=label.colour, zorder=9,
            linespacing=1.05, annotation_clip=False, parse_math=False, path_effects=halo,
        )  # fmt: skip
        extent = note.get_window_extent()
        size = np.array([extent.width, extent.height])
        boxes = _boxes(
            axes.transData.transform((label.x, label.y)) + offsets * pixel, offsets, size + np.array([4, 1]) * pixel
        )
        outside = np.prod(boxes[0, 2:] - boxes[0, :2]) - _overlap(boxes, room)
        area = 10 * (_overlap(boxes, taken) + outside) + 2 * _overlap(boxes, lines)
        best = int(np.argmin(area / pixel**2 + distance))
        dx, dy = offsets[best]
        note.set(position=(dx, dy), ha=_side(dx, "left", "right"), va=_side(dy, "bottom", "top"))
        taken = np.vstack([taken, boxes[best]])
        if distance[best] > 12:
            axes.annotate(
                "", (label.x, label.y), (dx, dy), textcoords="offset points", annotation_clip=False, zorder=1.9,
                arrowprops={"arrowstyle": "-", "linewidth": 0.4, "color": label.colour, "shrinkA": 0, "shrinkB": 2.5},
            )  # fmt: skip


def _offsets() -> np.ndarray:
    """Candidate offsets (n, 2) in points of a label from its marker: rings, nearest first, sides before diagonals."""
    angles = np.deg2rad([0, 180, 90, 270, 30, 330, 150, 210, 60, 120, 240, 300])
    rings = np.array([5, 9, 14, 20, 28, 38, 50, 64, 80])
    return np.round(rings[:, None, None] * np.column_stack([np.cos(angles), np.sin(angles)]), 3).reshape(-1, 2)


def _side(offset: float, positive: str, negative: str) -> str:
    """Alignment that lets text grow away from its marker."""
    return "center" if offset == 0 else positive if offset > 0 else negative


def _boxes(anchors: np.ndarray, offsets: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Extents (n, 4) of a text of that size (2,), aligned by `_side` at each anchor; all in pixels."""
    low = anchors - size * (1 - np.sign(offsets)) / 2
    return np.hstack([low, low + size])


def _around(spots: np.ndarray, half: float) -> np.ndarray:
    """Extents (n, 4) of squares around positions (n, 2)."""
    return np.hstack([spots - half, spots + half])


def _along_lines(axes: Axes, step: float) -> np.ndarray:
    """Pixel positions (n, 2) along the lines that join a model's points, `step` pixels apart."""
    found = [np.empty((0, 2))]
    for line in axes.lines:
        ends = axes.transData.transform(line.get_xydata())
        if line.get_zorder() == LINES and len(ends) == 2:
            count = int(np.hypot(*(ends[1] - ends[0])) / step) + 1
            found.append(np.linspace(ends[0], ends[1], count))
    return np.concatenate(found)


def _overlap(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Area (n,) that each box (n, 4) shares with all others (m, 4) together."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    return np.clip(high - low, 0, None).prod(axis=2).sum(axis=1)


def _short(model: str) -> str:
    """A label's text: no line break, no more than 28 characters."""
    text = "".join(c if c.isprintable() else "?" for c in model)
    return text if len(text) <= 28 else text[:27] + "…"
