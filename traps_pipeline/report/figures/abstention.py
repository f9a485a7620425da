"""Plot figures of abstention: by kind of void, by prompt, and against doubt."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.models.registry.entries import is_reference
from traps_pipeline.protocol.datasets import taxonomy_of
from traps_pipeline.protocol.regimes import PROMPTING
from traps_pipeline.report.figures.looks import REFERENCE, family_colour, family_order, legend_key, looks, model_family
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.terms import INCOMPLETE_MARK, TITLE_OF
from traps_pipeline.report.writing import COLUMN_IN, INK, PAGE_IN, SOFT, NotRun, figure_style, new_figure, plain
from traps_pipeline.scoring import analyses

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PERCENT = (0, 25, 50, 75, 100)


def visual_textual(results: Results) -> Figure:
    """Return AbsRec on visual (x) against textual voids (y), one point per model.

    Each is averaged over its taxonomies; a second panel has the means by family.
    """
    rates = results.rates
    if not len(rates):
        raise NotRun(results.why("rates"))
    models = list(dict.fromkeys(rates["model"]))
    with figure_style():
        figure = new_figure(PAGE_IN, 2.9 + 0.13 * int(np.ceil(len(models) / 5)))
        scatter, bars = figure.subplots(1, 2, width_ratios=(1, 1))
        _plot_rates(scatter, rates)
        _plot_families(bars, rates)
        _plot_models_key(figure, models)
    return figure


def _plot_rates(axes: Axes, rates: pd.DataFrame) -> None:
    look = looks(rates["model"])
    axes.plot([0, 100], [0, 100], color=SOFT, linewidth=0.7, linestyle=(0, (4, 2.5)), zorder=1)
    for row in rates.loc[_average(rates)].to_dict("records"):
        colour, marker = look[row["model"]]
        axes.scatter(
            100 * row["visual"], 100 * row["textual"], s=22, marker=marker, facecolors=colour, edgecolors=colour,
            linewidths=0.9, zorder=3, clip_on=False,
        )  # fmt: skip
    axes.set(xlim=(-3, 103), ylim=(-3, 103), xticks=PERCENT, yticks=PERCENT)
    axes.set(xlabel="AbsRec on visual voids, %", ylabel="AbsRec on textual voids, %", aspect="equal")
    axes.set_title("above the line: textual voids are noticed more", weight="normal", size=7)


def _average(rates: pd.DataFrame) -> pd.Series | pd.DataFrame:
    """Return which rows pool a model's taxonomies, or are of its only taxonomy."""
    models = rates.loc[rates["taxonomy"] == "pooled", "model"]
    return rates["taxonomy"].eq("pooled") | ~rates["model"].isin(models)


def _plot_families(axes: Axes, rates: pd.DataFrame) -> None:
    """Plot both rates as means over a family's models."""
    averaged_rates = rates.loc[_average(rates)]
    means = (
        averaged_rates.assign(family=averaged_rates["model"].map(model_family))
        .groupby("family")[["visual", "textual"]]
        .mean()
    )
    names = [name for name in family_order() if name in means.index]
    at = np.arange(len(names))
    for k, (kind, hatch) in enumerate((("visual", ""), ("textual", "/////"))):
        bars = axes.bar(
            at + 0.38 * (k - 0.5), 100 * means.loc[names, kind], width=0.36, label=kind, hatch=hatch,
            color=[family_colour(name) if not k else "white" for name in names],
            edgecolor=[family_colour(name) for name in names], linewidth=0.8,
        )  # fmt: skip
        axes.bar_label(bars, fmt="%.0f", size=6, padding=1, color=SOFT)
    axes.set_xticks(at, names, rotation=30 if len(names) > 4 else 0, ha="right" if len(names) > 4 else "center")
    top = max(60.0, float(100 * means.to_numpy(float).max()) * 1.08)
    axes.set(ylabel="AbsRec, mean over models, %", ylim=(0, top))
    axes.set_title("filled: visual, hatched: textual", weight="normal", size=7)


def _plot_models_key(figure: Figure, models: list[str]) -> None:
    look = looks(models)
    handles = [legend_key(plain(model)[:26], *look[model], size=4.5) for model in models]
    style: dict[str, Any] = {"fontsize": 6, "handletextpad": 0.1, "columnspacing": 0.8}
    figure.legend(handles=handles, loc="outside lower center", ncols=5, **style)


def abs_rec_by_model(results: Results) -> Figure:
    """Return AbsRec of every model under standard (hollow) and guided (filled).

    Datasets have equal weights; bars are the deviation over runs. Reference rows lie below a line.
    """
    overall = results.overall
    rows = overall.loc[overall["regime"].isin(PROMPTING) & overall["abs_rec"].notna()]
    if not len(rows):
        reason = "no model has all four datasets" if len(results.cells) else results.why("cells")
        raise NotRun(reason)
    sides: dict[tuple[str, str], Any] = {(r["model"], r["regime"]): r for r in rows.to_dict("records")}
    models = sorted(
        {m for m, _ in sides},
        key=lambda m: (not is_reference(m), *(_abs_rec(sides, m, regime) for regime in PROMPTING), m),
    )
    n_references = sum(map(is_reference, models))
    look = looks(models)
    with figure_style():
        figure = new_figure(COLUMN_IN, 0.75 + 0.155 * len(models))
        axes = figure.add_subplot()
        for k, model in enumerate(models):
            colour, marker = look[model]
            percentages = [100 * sides[model, r]["abs_rec"] for r in PROMPTING if (model, r) in sides]
            axes.plot(percentages, [k] * len(percentages), color=colour, linewidth=0.9, zorder=2)
            for regime, face in (("standard", "white"), ("guided", colour)):
                if (row := sides.get((model, regime))) is None:
                    continue
                spread = row.get("abs_rec_std")
                width = 100 * spread if isinstance(spread, float) and spread == spread else 0
                axes.errorbar(
                    100 * row["abs_rec"], k, xerr=width or None, fmt=marker, color=colour, markerfacecolor=face,
                    markersize=4.5, elinewidth=0.8, capsize=1.5, clip_on=False, zorder=3,
                )  # fmt: skip
        incomplete = {m for (m, _), row in sides.items() if row["incomplete"] is True or row["incomplete"] == 1}
        names = [plain(m)[:30] + (f" {INCOMPLETE_MARK}" if m in incomplete else "") for m in models]
        axes.set_yticks(range(len(models)), names)
        axes.set(xlim=(-2, 102), ylim=(-0.7, len(models) - 0.3), xticks=PERCENT)
        axes.set_xlabel("AbsRec, mean over datasets, %")
        title = "hollow: standard, filled: guided"
        if n_references:
            axes.axhline(n_references - 0.5, color=SOFT, linewidth=0.6)
            title += f"\nbelow the line: {REFERENCE}"
        axes.set_title(title, weight="normal", size=7)
        axes.grid(axis="x", color="#eaecf0", linewidth=0.6)
    return figure


def _abs_rec(sides: dict[tuple[str, str], Any], model: str, regime: str) -> float:
    row = sides.get((model, regime))
    return -1.0 if row is None else float(row["abs_rec"])


def doubt(results: Results) -> Figure:
    """Return doubt of a pair's thinking member (x) against its gain in AbsRec (y).

    The gain is its AbsRec minus the other's: a dot for each dataset, and a large marker for the mean. Both figures must
    be of one epoch; other pairs are left out, and the title gives the reason.
    """
    points, refusals = doubt_points(results)
    if not len(points):
        raise NotRun(refusals or _no_doubt(results))
    look = looks(points["thinking"])
    with figure_style():
        figure = new_figure(COLUMN_IN, 2.6)
        axes = figure.add_subplot()
        axes.axhline(0, color=SOFT, linewidth=0.7, zorder=1)
        for thinking, rows in points.groupby("thinking", sort=False):
            colour, marker = look[str(thinking)]
            axes.scatter(
                100 * rows["doubt"], 100 * rows["gain"], s=12, marker=marker, color=colour, alpha=0.75, zorder=3
            )
            axes.scatter(
                100 * rows["doubt"].mean(), 100 * rows["gain"].mean(), s=60, marker=marker, facecolors=colour,
                edgecolors=INK, linewidths=0.8, zorder=4, label=plain(f"{thinking} − {rows['other'].iloc[0]}"),
            )  # fmt: skip
        axes.margins(x=0.15)
        axes.set(xlabel="doubt in the thinking member’s failures, %", ylabel="AbsRec, thinking minus other, points")
        figure.legend(loc="outside upper center", ncols=1, handletextpad=0.2)
    return figure


def _no_doubt(results: Results) -> str:
    if not results.is_study:
        return results.why("confabulation")
    return "no confabulation labels of a reasoning pair’s thinking member; they need a configured judge"


def doubt_points(results: Results) -> tuple[pd.DataFrame, str]:
    """Return doubt and gain by reasoning pair and dataset, and reasons for refusals.

    Columns: thinking, other, dataset, doubt, gain (fractions). AbsRec is that of `results.rates` (standard), whose
    epoch must be that of the labels (docs/spec.md 9.2).
    """
    import pandas as pd

    labels = results.confabulation.set_index("model") if len(results.confabulation) else pd.DataFrame()
    rates = results.rates.loc[results.rates["taxonomy"] != "pooled"]
    rows, refusals = [], []
    for thinking, base in analyses.REASONING_PAIRS:
        sides = {m: rates.loc[rates["model"] == m].set_index("taxonomy") for m in (thinking, base)}
        if thinking not in labels.index or not all(len(side) for side in sides.values()):
            continue
        epochs = {str(labels.at[thinking, "epoch"])} | {e for side in sides.values() for e in side["epoch"]}
        if len(epochs) > 1:
            refusals.append(f"{thinking}: doubt and AbsRec are of epochs {', '.join(sorted(epochs))}")
            continue
        for dataset in TITLE_OF:
            taxonomy, kind = taxonomy_of(dataset), "textual" if dataset.endswith("_ill_posed") else "visual"
            if all(taxonomy in side.index for side in sides.values()):
                gain = sides[thinking].at[taxonomy, kind] - sides[base].at[taxonomy, kind]
                row = {"thinking": thinking, "other": base, "dataset": dataset, "doubt": labels.at[thinking, "doubt"]}
                rows.append({**row, "gain": gain})
    return pd.DataFrame(rows), "; ".join(refusals)
