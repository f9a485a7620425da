"""One look a model in every figure: its family's colour, its own marker. And what figures in (Acc, J) share."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.models.registry import load_models
from traps_pipeline.report.writing import COLOURS, GRID, MARKERS, SOFT

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

OWN, REFERENCE = "own", "reference"


def family_of(model: str) -> str:
    """The registry's family of a model; `own` where it does not know the model."""
    entry = load_models().get(model)
    return entry.groups.family if entry else OWN


def families() -> list[str]:
    """All families: those of the registry in its order, the paper's first, then `own`."""
    known = [entry.groups for entry in load_models().values()]
    order = [g.family for g in known if g.group != "reference"] + [g.family for g in known if g.group == "reference"]
    return list(dict.fromkeys([*order, OWN]))


def family_colour(family: str) -> str:
    """The same colour for a family in every figure; grey is the reference strategies'."""
    others = [name for name in families() if name != REFERENCE]
    return COLOURS[-1] if family == REFERENCE else COLOURS[others.index(family) % (len(COLOURS) - 1)]


def looks(models: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Colour and marker of each model: its family's colour, and within a colour no two markers alike (up to 13)."""
    known = dict.fromkeys([*load_models(), *sorted(set(models))])
    colours = {model: family_colour(family_of(model)) for model in known}
    alike = {colour: [m for m in known if colours[m] == colour] for colour in COLOURS}
    return {m: (colours[m], MARKERS[alike[colours[m]].index(m) % len(MARKERS)]) for m in set(models)}


def frame_plane(axes: Axes, points: pd.DataFrame, xlabel: str) -> None:
    """Limits around points (columns acc and j), never less than half of either axis, with contours of PECS."""
    left, right = _limits(points.loc[:, "acc"], 0.0, 0.0)
    low, high = _limits(points.loc[:, "j"], min([-0.08, *(points["j"] - 0.08)]), 0.3)
    axes.set(xlim=(left - 0.03, right + 0.03), ylim=(low, high + 0.04), xlabel=xlabel, ylabel="J = AbsRec − FalseAbs")
    axes.axhline(0, color="#98a2b3", linewidth=0.8, zorder=0.5)
    edge: dict[str, Any] = {"annotation_clip": False, "va": "center", "color": SOFT, "size": 6}
    labelled = right + 0.05 * (right - left)
    for pecs in np.arange(1, 10) / 10:
        acc = np.linspace(max(left, pecs / high), right, 200)
        if pecs / right <= high:
            axes.plot(acc, pecs / acc, color=GRID, linewidth=0.6, zorder=0.4)
            axes.annotate(f"{pecs:.1f}", (right, pecs / right), (labelled, pecs / right), **edge)
    axes.annotate("PECS", (right, high), (labelled, high + 0.035), **edge)


def _limits(values: pd.Series, low: float, least: float) -> tuple[float, float]:
    """Ends of an axis of fractions: tenths around the values, at most [low, 1]; up to at least `least`."""
    if not len(values):
        return low, 1.0
    bottom = low if least else max(low, float(np.floor(10 * values.min() - 0.8)) / 10)
    top = min(1.0, max(least, float(np.ceil(10 * values.max() + 0.8)) / 10))
    return min(bottom, top - 0.5) if not least else bottom, top


def arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], colour: str) -> None:
    """A thin arrow between two markers' rims."""
    style = {"arrowstyle": "-|>,head_width=0.12,head_length=0.25", "color": colour, "linewidth": 0.8}
    style |= {"shrinkA": 2.5, "shrinkB": 2.5, "mutation_scale": 10}
    axes.annotate("", end, start, arrowprops=style, zorder=2.5, annotation_clip=False)
