"""Heatmaps over sub-scenarios, bars over the axes of confabulation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.models.registry import load_models
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
HATCHES = ("", "/////", "xxxx", ".....", "-----")
MOST_MODELS = 12  # columns of a heatmap that stay legible on a page's width


def sub_scenarios(results: Results) -> Figure:
    """AbsRec by sub-scenario (rows, by falling AbsRec under standard) and model (columns), standard beside guided.

    Columns are the models that take video, or all others if none of those was asked, 12 at most. The paper prints only
    means over models, so for its numbers the columns are the figures that it prints.
    """
    rows = results.sub_scenarios
    rows = rows.loc[rows["abs_rec"].notna()]
    if not len(rows):
        raise NotRun(results.why("sub_scenarios"))
    rows = rows.assign(order=rows["dataset"] != "occlusion").sort_values(
        ["order", "abs_rec", "sub_scenario"], ascending=[True, False, True]
    )
    panels = _by_model(results, rows) or _means(rows)
    names = [f"{plain(name)}" for name in rows["sub_scenario"]]
    with figure_style():
        figure = new_figure(PAGE_IN, 1.35 + 0.17 * len(rows))
        axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        first = int((~rows["order"]).sum())
        images = [_draw_grid(ax, *panel, names, first) for ax, panel in zip(axes, panels, strict=True)]
        figure.colorbar(images[-1], ax=list(axes), label="%", shrink=0.6, aspect=30, pad=0.01)
    return figure


def _by_model(results: Results, rows: pd.DataFrame) -> list[tuple[str, list[str], np.ndarray]]:
    """Title, column names and values (sub-scenarios, models) in percent, under standard and under guided."""
    cells = results.sub_cells
    cells = cells.loc[cells["dataset"].isin(analyses.TAXONOMIES)]
    asked = [model for model in load_models() if model in set(cells["model"])]
    video = [m for m in analyses.models_of(media="video", group="main") if m in asked]
    models = (video or asked)[:MOST_MODELS]
    panels = []
    for regime in PROMPTING:
        part = cells.loc[(cells["regime"] == regime) & cells["model"].isin(models)]
        if len(part):
            wide = part.pivot(index=["dataset", "scope"], columns="model", values="abs_rec")
            index = list(zip(rows["dataset"], rows["sub_scenario"], strict=True))
            panels.append(
                (f"AbsRec, {regime}", models, 100 * wide.reindex(index=index, columns=models).to_numpy(float))
            )
    return panels


def _means(rows: pd.DataFrame) -> list[tuple[str, list[str], np.ndarray]]:
    shown = {"abs_rec": "AbsRec, standard", "guided_abs_rec": "AbsRec, guided", "false_abs": "FalseAbs", "acc": "Acc"}
    return [("means over models", [*shown.values()], 100 * rows[[*shown]].to_numpy(float))]


def _draw_grid(ax: Axes, title: str, columns: list[str], values: np.ndarray, names: list[str], first: int) -> AxesImage:
    """Draw one panel. A white line separates occlusion (the first rows) from chaotic; a dash means not run."""
    image = ax.imshow(values, cmap="cividis", vmin=0, vmax=100, aspect="auto")
    ax.set_facecolor("#f2f4f7")
    tilt: dict[str, Any] = {"rotation": 45, "ha": "right", "rotation_mode": "anchor"} if len(columns) > 4 else {}
    ax.set_xticks(range(len(columns)), [plain(name)[:24] for name in columns], **tilt)
    ax.set_yticks(range(len(names)), names)
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    ax.set_title(title, size=7.5)
    if 0 < first < len(names):
        ax.axhline(first - 0.5, color="white", linewidth=2)
    for (row, column), value in np.ndenumerate(values):
        missing = np.isnan(value)
        colour = SOFT if missing else "white" if value < 55 else "black"
        ax.text(column, row, "–" if missing else f"{value:.0f}", ha="center", va="center", size=6, color=colour)
    return image


def confabulation(results: Results) -> Figure:
    """How often each axis applies to a model's sampled void failures, with 95 % Wilson intervals if the table has
    them."""
    rows = results.confabulation
    if not len(rows):
        why = "no judge of confabulation is configured for this study’s panel" if results.is_study else ""
        raise NotRun(why or results.why("confabulation"))
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
