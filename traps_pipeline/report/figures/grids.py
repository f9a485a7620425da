"""Plot heatmaps over sub-scenarios, bars of confabulation axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.models.registry.entries import load_models
from traps_pipeline.protocol.regimes import PROMPTING
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.writing import COLOURS, PAGE_IN, SOFT, NotRun, figure_style, new_figure, plain
from traps_pipeline.scoring import analyses

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

AXES = {"hp": "HP", "ii": "II", "hp_and_ii": "HP and II", "es": "ES", "doubt": "Doubt"}
GOOD, BAD = "the more the better", "the less the better"  # two colour scales
HATCHES = ("", "/////", "xxxx", ".....", "-----")
MAX_MODELS = 12  # maximum legible columns of a heatmap on a page's width


def sub_scenarios(results: Results) -> Figure:
    """Return AbsRec by sub-scenario and model (columns), standard beside guided.

    Rows are sorted by falling AbsRec under standard.

    Columns are the models that take video, or all others if none of those was asked, 12 at most. The paper prints only
    means over models, so for its numbers the columns are the figures that it prints. Blue is good, orange is bad.
    """
    rows = results.visual_sub_scenarios
    rows = rows.loc[rows["abs_rec"].notna()]
    if not len(rows):
        raise NotRun(results.why("sub_scenarios"))
    rows = rows.assign(order=rows["dataset"] != "occlusion").sort_values(
        ["order", "abs_rec", "sub_scenario"], ascending=[True, False, True]
    )
    panels = _model_panels(results, rows) or _means(rows)
    names = [plain(name).replace("_", " ") for name in rows["sub_scenario"]]
    with figure_style():
        figure = new_figure(PAGE_IN, 1.35 + 0.17 * len(rows))
        column_counts = [len(panel.columns) for panel in panels]
        axes = figure.subplots(1, len(panels), sharey=True, squeeze=False, width_ratios=column_counts)[0]
        n_before = int((~rows["order"]).sum())
        scales = {panel.scale: _plot_grid(ax, panel, names, n_before) for ax, panel in zip(axes, panels, strict=True)}
        for scale, image in scales.items():
            figure.colorbar(image, ax=list(axes), label=f"{scale}, %", shrink=0.6, aspect=30, pad=0.01)
    return figure


@dataclass(frozen=True)
class Panel:
    """A heatmap of values (sub-scenarios, columns) in percent, on a good or bad scale."""

    title: str
    columns: list[str]
    values: np.ndarray
    scale: str = GOOD


def _model_panels(results: Results, rows: pd.DataFrame) -> list[Panel]:
    """Return the panels of standard and of guided, one column per model."""
    cells = results.visual_sub_cells
    models_here = [model for model in load_models() if model in set(cells["model"])]
    video = [m for m in analyses.models_of(media="video", group="main") if m in models_here]
    models = (video or models_here)[:MAX_MODELS]
    panels = []
    for regime in PROMPTING:
        part = cells.loc[(cells["regime"] == regime) & cells["model"].isin(models)]
        if len(part):
            abs_rec_grid = part.pivot(index=["dataset", "scope"], columns="model", values="abs_rec")
            index = list(zip(rows["dataset"], rows["sub_scenario"], strict=True))
            values = 100 * abs_rec_grid.reindex(index=index, columns=models).to_numpy(float)
            panels.append(Panel(f"AbsRec, {regime}", models, values))
    return panels


def _means(rows: pd.DataFrame) -> list[Panel]:
    good_columns = {"abs_rec": "AbsRec, standard", "guided_abs_rec": "AbsRec, guided", "acc": "Acc"}
    of = {GOOD: good_columns, BAD: {"false_abs": "FalseAbs"}}
    titles = {GOOD: "means over models", BAD: ""}
    return [Panel(titles[s], [*names.values()], 100 * rows[[*names]].to_numpy(float), s) for s, names in of.items()]


def _plot_grid(ax: Axes, panel: Panel, names: list[str], first: int) -> AxesImage:
    """Plot a panel: a white line ends occlusion's rows, a dash means not run."""
    columns, values = panel.columns, panel.values
    image = ax.imshow(values, cmap="Blues" if panel.scale == GOOD else "Oranges", vmin=0, vmax=100, aspect="auto")
    ax.set_facecolor("#f2f4f7")
    tilt: dict[str, Any] = {"rotation": 45, "ha": "right", "rotation_mode": "anchor"}
    ax.set_xticks(range(len(columns)), [plain(name)[:24] for name in columns], **tilt)
    ax.set_yticks(range(len(names)), names)
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    ax.set_title(panel.title, size=7.5)
    if 0 < first < len(names):
        ax.axhline(first - 0.5, color="white", linewidth=2)
    for (row, column), value in np.ndenumerate(values):
        missing = np.isnan(value)
        colour = SOFT if missing else "white" if value > 60 else "black"
        ax.text(column, row, "–" if missing else f"{value:.0f}", ha="center", va="center", size=6, color=colour)
    return image


def confabulation(results: Results) -> Figure:
    """Return how often each axis applies to a model's sampled void failures.

    Bars have 95 % Wilson intervals if the table has them.
    """
    rows = results.confabulation
    if not len(rows):
        reason = "no judge of confabulation is configured for this study’s panel" if results.is_study else ""
        raise NotRun(reason or results.why("confabulation"))
    at, width = np.arange(len(rows)), 0.16
    with figure_style():
        figure = new_figure(PAGE_IN, 2.5)
        axes = figure.add_subplot()
        for k, (axis, name) in enumerate(AXES.items()):
            shares = 100 * rows[axis].to_numpy(float)
            colour = COLOURS[k]
            bars = axes.bar(
                at + width * (k - 2), shares, width=width * 0.9, label=name, hatch=HATCHES[k], edgecolor=colour,
                color=colour if not HATCHES[k] else "white", linewidth=0.7,
            )  # fmt: skip
            heights = [100 * v for v in rows[f"{axis}_high"]] if f"{axis}_low" in rows else shares
            if f"{axis}_low" in rows:
                low, high = (100 * rows[f"{axis}_{side}"].to_numpy(float) for side in ("low", "high"))
                axes.errorbar(
                    at + width * (k - 2), shares, yerr=np.abs(np.vstack([shares - low, high - shares])), fmt="none",
                    ecolor="#1b1f27", elinewidth=0.6,
                )  # fmt: skip
            for bar, height, share in zip(bars, heights, shares, strict=True):
                if share == share:
                    x = bar.get_x() + bar.get_width() / 2
                    axes.text(x, height + 1, f"{share:.0f}", ha="center", va="bottom", size=6, color=SOFT)
        names = [f"{plain(m)[:26]}\nn = {n:.0f}" for m, n in zip(rows["model"], rows["n"], strict=True)]
        axes.set_xticks(at, names)
        axes.set(ylim=(0, 112), yticks=(0, 25, 50, 75, 100), ylabel="void failures, %")
        figure.legend(loc="outside upper center", ncols=5)
    return figure
