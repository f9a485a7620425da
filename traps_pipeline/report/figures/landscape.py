"""Plot models in the plane of J and Acc, with contours of PECS (docs/spec.md 10)."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.models.registry.entries import reference_rows
from traps_pipeline.protocol.regimes import BY_NAME, GUIDED, PROMPTING, REGIMES, STANDARD
from traps_pipeline.report.figures.label_placement import LINES, Label, merge_labels, place_labels, short
from traps_pipeline.report.figures.looks import arrow, legend_key, looks, model_family, set_j_accuracy_axes
from traps_pipeline.report.result_frames import Results, datasets_of
from traps_pipeline.report.terms import INCOMPLETE_MARK, TITLE_OF
from traps_pipeline.report.writing import COLUMN_IN, INK, PAGE_IN, NotRun, figure_style, freeze_layout, new_figure
from traps_pipeline.scoring import analyses

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def landscape(results: Results) -> Figure:
    """Return the PECS landscape of the overall scores.

    If no model has all four datasets, it is that of the first dataset.
    """
    overall, cells = results.overall, results.cells
    if len(overall):
        return landscape_figure(overall, TITLE_OF["overall"])
    if not len(cells):
        raise NotRun(results.why("cells"))
    first = datasets_of(cells)[0]
    points = cells.loc[cells["dataset"] == first]
    return landscape_figure(points.assign(j=points["abs_rec"] - points["false_abs"]), TITLE_OF[first])


def landscape_figure(points: pd.DataFrame, scope: str) -> Figure:
    """Return J (x) against Acc (y) of every model with iso-PECS contours.

    points has the columns model, regime, acc, j, pecs, incomplete. Hollow is standard, filled guided, a dot json; thin
    bars are 95 % intervals. The dashed line is the models' frontier under guided, a ring each family's best PECS under
    guided. Reference rows are grey.
    PECS is averaged per run and dataset, so it can differ from the contours. Coinciding points share one label.
    """
    points = points.loc[points["acc"].notna() & points["j"].notna()]
    if not len(points):
        raise NotRun("no model has both Acc and J, since too few of its answers are decided")
    with figure_style():
        figure = new_figure(COLUMN_IN, 3.7)
        axes = figure.add_subplot()
        set_j_accuracy_axes(axes, points, f"Acc, {scope.lower()}", intervals=True)
        labels = merge_labels(_plot_models(axes, points), axes)
        guided = points.loc[points["regime"].eq(GUIDED) & ~points["model"].isin(reference_rows())]
        _plot_frontier(axes, guided)
        _plot_rings(axes, guided)
        _plot_key(figure)
        freeze_layout(figure)
        place_labels(axes, labels, points.loc[:, ["j", "acc"]].to_numpy(float))
    return figure


def reasoning(results: Results) -> Figure:
    """Return arrows from each model to the one that thinks more, under both prompts."""
    points = results.overall
    chains = [list(reversed(pair)) for pair in analyses.REASONING_PAIRS] + [list(analyses.REASONING_LADDER)]
    chains = [[m for m in chain if m in set(points["model"])] for chain in chains]
    chains = [chain for chain in chains if len(chain) > 1]
    if not chains:
        reason = "no reasoning pair has all four datasets" if results.is_study else results.why("cells")
        raise NotRun(reason)
    chain_points = points.loc[points["model"].isin([m for chain in chains for m in chain])]
    with figure_style():
        figure = new_figure(PAGE_IN, 3.5)
        panels = figure.subplots(1, 2, sharey=True)
        labels = [_plot_chains(axes, chain_points.loc[chain_points["regime"] == regime], chains) for axes, regime in
                  zip(panels, PROMPTING, strict=True)]  # fmt: skip
        for axes, regime in zip(panels, PROMPTING, strict=True):
            set_j_accuracy_axes(axes, chain_points, "Acc, overall")
            axes.set_title(f"{regime} (filled: thinks most)", weight="normal", size=7.5)
        panels[1].set_ylabel("")
        freeze_layout(figure)
        for axes, names, regime in zip(panels, labels, PROMPTING, strict=True):
            at = chain_points.loc[chain_points["regime"] == regime, ["j", "acc"]].to_numpy(float)
            place_labels(axes, merge_labels(names, axes), at)
    return figure


def _plot_models(axes: Axes, points: pd.DataFrame) -> list[Label]:
    """Plot all markers; return a label per model at its guided or else first point."""
    labels, look = [], looks(points["model"])
    for model, rows in points.groupby("model", sort=True):
        colour, marker = look[str(model)]
        at = {
            regime: (float(j), float(acc))
            for regime, j, acc in zip(*(rows[c] for c in ("regime", "j", "acc")), strict=True)
        }
        if {*PROMPTING} <= at.keys():
            axes.plot(*np.array([at[regime] for regime in PROMPTING]).T, color=colour, linewidth=0, zorder=LINES)
            arrow(axes, at[STANDARD], at[GUIDED], colour)
        styles: dict[str, dict[str, Any]] = {
            "hollow": {"s": 20, "marker": marker, "facecolors": "white", "edgecolors": colour, "linewidths": 0.9},
            "filled": {"s": 20, "marker": marker, "facecolors": colour, "edgecolors": colour, "linewidths": 0.9},
            "dot": {"s": 5, "marker": "o", "facecolors": colour, "edgecolors": "none", "linewidths": 0},
        }
        for zorder, regime in enumerate(REGIMES, start=3):
            if regime in at:
                axes.scatter(*at[regime], zorder=zorder, clip_on=False, **styles[BY_NAME[regime].marker])
        shown_regime = next(regime for regime in (GUIDED, *at) if regime in at)
        _plot_intervals(axes, rows.loc[rows["regime"] == shown_regime].to_dict("records")[0], colour)
        x, y = at[shown_regime]
        mark = f" {INCOMPLETE_MARK}" if bool(rows["incomplete"].fillna(False).astype(bool).any()) else ""
        labels.append(Label(x, y, short(str(model)) + mark, colour))
    return labels


def _plot_intervals(axes: Axes, row: Mapping[Any, Any], colour: str) -> None:
    """Plot the 95 % intervals of J and Acc, clipped to possible values, if known."""
    style: dict[str, Any] = {"color": colour, "linewidth": 0.6, "alpha": 0.55, "zorder": 1.8, "clip_on": False}
    for name, lower_limit in (("j", -1.0), ("acc", 0.0)):
        low, high = row.get(f"{name}_ci_low", np.nan), row.get(f"{name}_ci_high", np.nan)
        if low is None or high is None or not np.isfinite([low, high]).all():
            continue
        ends, other_value = (max(lower_limit, low), min(1.0, high)), row["acc" if name == "j" else "j"]
        axes.plot(*((ends, (other_value, other_value)) if name == "j" else ((other_value, other_value), ends)), **style)


def _plot_frontier(axes: Axes, guided: pd.DataFrame) -> None:
    """Plot dashed steps around the points that a model equals or exceeds in Acc and J."""
    at = guided.sort_values(["acc", "j"], ascending=False)[["acc", "j"]].to_numpy(float)
    steps, best = [], 0.0
    for acc, j in at:
        if j > best:
            steps += [(best, acc), (j, acc)]
            best = j
    if steps:
        axes.plot(
            *np.array([*steps, (best, axes.get_ylim()[0])]).T,
            color=INK,
            linewidth=0.7,
            linestyle=(0, (4, 2.5)),
            zorder=1.5,
        )


def _plot_rings(axes: Axes, guided: pd.DataFrame) -> None:
    families = guided["model"].map(model_family)
    for _, rows in guided.assign(family=families).dropna(subset=["pecs"]).groupby("family"):
        best = rows.loc[rows["pecs"].idxmax()]
        if best["pecs"] > 0:
            axes.scatter(
                best["j"], best["acc"], s=75, facecolors="none", edgecolors=INK, linewidths=0.7, zorder=6, clip_on=False
            )


def _plot_key(figure: Figure) -> None:
    handles = [
        legend_key("standard", "#475467", "o", size=4.5, markerfacecolor="white"),
        legend_key("guided", "#475467", "o", size=4.5),
        legend_key("json", "#475467", "o", size=1.6),
        legend_key("family’s best, guided", INK, "o", size=7, markerfacecolor="none"),
        legend_key("frontier, guided", INK, line=(0, (4, 2.5)), linewidth=0.7),
    ]
    style: dict[str, Any] = {"handletextpad": 0.4, "columnspacing": 1.2}
    figure.legend(handles=handles, loc="outside lower center", ncols=3, **style)


def _plot_chains(axes: Axes, points: pd.DataFrame, chains: list[list[str]]) -> list[Label]:
    at = {row["model"]: (float(row["j"]), float(row["acc"])) for row in points.to_dict("records")}
    look, labels = looks(at), []
    for chain in chains:
        drawn_models = [model for model in chain if model in at and np.isfinite(at[model]).all()]
        for start, end in pairwise(drawn_models):
            axes.plot(*np.array([at[start], at[end]]).T, linewidth=0, zorder=LINES)
            arrow(axes, at[start], at[end], look[end][0])
        for k, model in enumerate(drawn_models):
            colour, marker = look[model]
            face = colour if k == len(drawn_models) - 1 else "white"  # filled: the member that thinks most
            axes.scatter(*at[model], s=20, marker=marker, facecolors=face, edgecolors=colour, linewidths=0.9, zorder=4)
            labels.append(Label(*at[model], short(model), colour))
    return labels
