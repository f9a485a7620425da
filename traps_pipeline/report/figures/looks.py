"""Choose each model's colour (by family) and marker; frame figures in (Acc, J)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.models.registry.entries import is_reference, load_models
from traps_pipeline.report.writing import COLOURS, GRID, MARKERS, REFERENCE_ROWS, SOFT

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

OWN, REFERENCE = "own", REFERENCE_ROWS.lower()


def model_family(model: str) -> str:
    """Return a model's family in the registry, or `own` if it is not there; REFERENCE of all reference rows."""
    entry = load_models().get(model)
    return OWN if not entry else REFERENCE if is_reference(model) else entry.groups.family


def family_order() -> list[str]:
    """Return all families: the paper's, then the registry's others, REFERENCE and OWN."""
    order = dict.fromkeys(map(model_family, load_models()))
    return [*(name for name in order if name != REFERENCE), REFERENCE, OWN]


def family_colour(family: str) -> str:
    """Return the colour of a family in every figure; reference strategies are grey."""
    other_families = [name for name in family_order() if name != REFERENCE]
    return COLOURS[-1] if family == REFERENCE else COLOURS[other_families.index(family) % (len(COLOURS) - 1)]


def looks(models: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Return each model's colour (its family's) and marker (13 differ per family, and among these reference rows)."""
    models = set(models)
    model_names = dict.fromkeys([*load_models(), *sorted(models)])
    model_names = [name for name in model_names if name in models or not is_reference(name)]
    colours = {model: family_colour(model_family(model)) for model in model_names}
    models_by_colour = {colour: [m for m in model_names if colours[m] == colour] for colour in COLOURS}
    return {m: (colours[m], MARKERS[models_by_colour[colours[m]].index(m) % len(MARKERS)]) for m in models}


def set_j_accuracy_axes(axes: Axes, points: pd.DataFrame, ylabel: str, *, intervals: bool = False) -> None:
    """Set axes of J and accuracy that hold all points, and draw contours of PECS.

    At least half of each axis is shown. intervals: whether the limits include the points' 95 % intervals.
    """
    acc, j = (
        _values(points, name, lower_limit, intervals=intervals) for name, lower_limit in (("acc", 0.0), ("j", -1.0))
    )
    low, high = _limits(acc, 0.0, 0.0)
    left, right = _limits(j, min([-0.08, *(j - 0.08)]), 0.3)
    axes.set(xlim=(left, right + 0.03), ylim=(low - 0.03, high + 0.03), xlabel="J = AbsRec − FalseAbs", ylabel=ylabel)
    axes.locator_params(axis="x", nbins=6)
    axes.axvline(0, color="#98a2b3", linewidth=0.8, zorder=0.5)
    edge: dict[str, Any] = {"annotation_clip": False, "va": "center", "color": SOFT, "size": 6}
    label_edge = right + 0.05 * (right - left)
    for pecs in np.arange(1, 10) / 10:
        j = np.linspace(max(pecs / high, 1e-3), right, 200)
        if pecs / right <= high:
            axes.plot(j, pecs / j, color=GRID, linewidth=0.6, zorder=0.4)
            if pecs / right >= low:
                axes.annotate(f"{pecs:.1f}", (right, pecs / right), (label_edge, pecs / right), **edge)
    axes.annotate("PECS", (right, high), (label_edge, high + 0.035), **edge)


def _values(points: pd.DataFrame, name: str, least: float, *, intervals: bool) -> np.ndarray:
    """Return a column's values and interval ends, clipped to possible values."""
    names = [name, *(end for end in (f"{name}_ci_low", f"{name}_ci_high") if intervals and end in points)]
    values = points[names].to_numpy(float).ravel()
    return np.clip(values[np.isfinite(values)], least, 1.0)


def _limits(values: np.ndarray, low: float, least: float) -> tuple[float, float]:
    """Return axis limits in tenths around the values, within [low, 1], upper ≥ least."""
    if not len(values):
        return low, 1.0
    bottom = low if least else max(low, float(np.floor(10 * values.min() - 0.8)) / 10)
    top = min(1.0, max(least, float(np.ceil(10 * values.max() + 0.8)) / 10))
    if least:
        return bottom, top
    bottom = max(low, min(bottom, top - 0.5))
    return bottom, max(top, min(1.0, bottom + 0.5))


def legend_key(label: str, colour: str, marker: str = "", line: Any = "none", size: float = 4, **look: Any) -> Line2D:
    """Return an entry of a figure's legend: a marker of some size, a line, or both."""
    from matplotlib.lines import Line2D

    return Line2D([], [], label=label, color=colour, marker=marker, linestyle=line, markersize=size, **look)


def arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], colour: str) -> None:
    """Draw a thin arrow between two markers' rims; none where either is undefined."""
    if not np.isfinite([*start, *end]).all():
        return  # matplotlib's arrow raises StopIteration while the figure is saved
    style = {"arrowstyle": "-|>,head_width=0.12,head_length=0.25", "color": colour, "linewidth": 0.8}
    style |= {"shrinkA": 2.5, "shrinkB": 2.5, "mutation_scale": 10}
    axes.annotate("", end, start, arrowprops=style, zorder=2.5, annotation_clip=False)


def range_text(low: int, high: int) -> str:
    """Return a range of whole numbers as text: `5`, or `5 to 16`."""
    return f"{low}" if low == high else f"{low} to {high}"
