"""Draw the Cf->Cf strip, dose and response, and cosines."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.mechanism import effects
from traps_pipeline.mechanism.transfer_paths import PATH_SETS, STEERING_PATHS, TRANSFER, TRANSFER_TYPES, path_name
from traps_pipeline.protocol.datasets import DATASETS, is_ill_posed, taxonomy_of
from traps_pipeline.report.figures.looks import legend_key, range_text
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.inside_columns import why_not
from traps_pipeline.report.tables.probe_tables import best_layers
from traps_pipeline.report.terms import TITLE_OF
from traps_pipeline.report.writing import COLOURS, GRID, PAGE_IN, SOFT, NotRun, figure_style, new_figure, plain

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

# A source has a colour and a line style, a target a marker, so that they also differ without colour.
COLOUR: dict[str, str] = dict(zip(DATASETS, COLOURS, strict=False))
LINE: dict[str, Any] = dict(zip(DATASETS, ("-", "--", "-.", ":"), strict=True))
MARKER: dict[str, str] = dict(zip(DATASETS, ("o", "s", "^", "D"), strict=True))
FAMILY_COLOUR = {"occlusion": "#0072B2", "chaotic": "#C8102E"}  # colours of directions in dose and response
# The paper draws four key paths and does not name them. These cross the domains onto visual voids.
KEY_PATHS = [(s, t) for s, t in TRANSFER if taxonomy_of(s) != taxonomy_of(t) and not is_ill_posed(t)]
COSINE_SCALE = 0.6  # scale of the paper's heatmaps
CROSSING = TRANSFER_TYPES[:3]
SETS = {"transfer": "transfer", "within_domain": "within"}


def _legend(figure: Figure, *more: Line2D, colours: Mapping[str, str] = COLOUR) -> None:
    """Draw the legend below the panels: sources by colour and line, targets by marker."""
    sources = [legend_key(f"from {TITLE_OF[d].lower()}", colours[d], line=LINE[d]) for d in DATASETS]
    targets = [legend_key(f"to {TITLE_OF[d].lower()}", SOFT, MARKER[d], size=3.5) for d in DATASETS]
    handles = [*sources, *targets, *more]
    style: dict[str, Any] = {"columnspacing": 1.0, "handlelength": 2.0, "handletextpad": 0.4}
    figure.legend(handles=handles, loc="outside lower center", ncols=4, **style)


def _bar_key(label: str, width: float = 2.2, color: str = SOFT) -> Line2D:
    return legend_key(label, color, line="-", linewidth=width, solid_capstyle="butt")


def confabulated_strip(results: Results) -> Figure:
    """Return AUROC of every ordered pair on all samples and on confabulated voids.

    Hollow: all samples. Filled: confabulated voids with their controls. Both are at the best layer of all samples; the
    bar is the median of the model's filled markers, the dashed line is chance.
    """
    rows = best_layers(results.probes)
    if not len(rows) or rows.loc[:, "cf_value"].isna().all():
        reason = "no dataset has confabulated voids" if len(rows) else why_not(results)
        raise NotRun(reason)
    models = list(dict.fromkeys(rows["model"]))
    with figure_style():
        figure = new_figure(PAGE_IN, 2.5)
        axes = figure.subplots(1, len(models), sharey=True, squeeze=False)[0]
        for ax, model in zip(axes, models, strict=True):
            _strip(ax, rows.loc[rows["model"] == model])
            ax.set_title(plain(model)[:30], size=7.5)
        lowest = np.nanmin(rows[["best_value", "cf_value"]].to_numpy(float))
        axes[0].set(ylim=(min(0.45, lowest - 0.04), 1.03), ylabel="AUROC on the target")
        chance = legend_key("chance", SOFT, line=(0, (4, 2.5)), linewidth=0.8)
        hollow_key, filled_key = (
            legend_key("all samples", SOFT, "o", markerfacecolor="white"),
            legend_key("Cf→Cf", SOFT, "o"),
        )
        _legend(figure, hollow_key, filled_key, _bar_key("median of Cf→Cf"), chance)
    return figure


def _strip(ax: Axes, rows: pd.DataFrame) -> None:
    for place, crossing in enumerate(CROSSING):
        part = rows.loc[rows["transfer_type"] == crossing]
        for k, row in enumerate(part.to_dict("records")):
            x = place + 0.19 * (k - (len(part) - 1) / 2)
            style: dict[str, Any] = {"color": COLOUR[row["source"]], "marker": MARKER[row["target"]], "markersize": 4}
            ax.plot([x, x], [row["best_value"], row["cf_value"]], color=COLOUR[row["source"]], linewidth=0.8)
            ax.plot(x, row["best_value"], linestyle="none", markerfacecolor="white", **style)
            ax.plot(x, row["cf_value"], linestyle="none", **style)
    ax.axhline(float(np.nanmedian(rows["cf_value"].to_numpy(float))), color=SOFT, linewidth=1.4, zorder=0.6)
    ax.axhline(0.5, color=SOFT, linewidth=0.8, linestyle=(0, (4, 2.5)), zorder=0.5)
    names = [crossing.replace("Cross-", "cross-\n") for crossing in CROSSING]
    ax.set_xticks(range(3), names)
    ax.set_xlim(-0.6, 2.6)
    ax.tick_params(axis="x", length=0)


def dose_response(results: Results) -> Figure:
    """Return abstention against α on controls (+α) and voids (−α).

    Each model and each of its path sets has a panel, along directions of the standard prompt under guided inference if
    they were run. Directions of the occlusion family are blue, those of the chaotic family red; of the transfer set,
    the four paths between the domains onto visual voids are strong and the others faint. n is the number of answers of
    a marker. Grey is the mean over the paths with its 95 % interval from resampled scenarios.
    """
    rows = effects.paths(results.effects)
    rows = rows.loc[rows["kind"] == "void"]
    panels = _panels(rows)
    if not panels:
        raise NotRun(why_not(results))
    across = 2 if len(panels) > 1 else 1
    lines = -(-len(panels) // across)
    with figure_style():
        figure = new_figure(PAGE_IN, 0.75 + 1.85 * lines)
        axes = figure.subplots(lines, 2 * across, sharey=True, squeeze=False)
        pairs = axes.reshape(-1, 2)
        for pair, ((model, path_set), part) in zip(pairs, panels.items(), strict=False):
            for ax, side, sign in zip(pair, ("control", "void"), ("+α on controls", "−α on voids"), strict=True):
                _mean_band(ax, _panel_shares(results.shares, part, path_set, side))
                _doses(ax, part, side, KEY_PATHS if path_set == "transfer" else STEERING_PATHS)
                title = [plain(model)[:20], f"{sign}, {SETS[path_set]}", *_count_answers(part, side)]
                ax.set_title("\n".join(title), size=6.5)
                ax.set_xlabel("α")
        for ax in pairs[len(panels) :].flat:
            ax.set_axis_off()
        for line in axes:
            line[0].set_ylabel("abstained, %")
        axes[0, 0].set_ylim(-4, 104)
        interval_key = [_bar_key("mean, 95 % by scenario")] if len(results.shares) else []
        _legend(figure, *interval_key, colours={d: FAMILY_COLOUR[taxonomy_of(d)] for d in DATASETS})
    return figure


def _count_answers(part: pd.DataFrame, side: str) -> list[str]:
    """Return a line with the number of answers behind a marker, if it is known."""
    counts = part[f"{side}_n"].dropna().astype(int) if f"{side}_n" in part else []
    return [f"n {range_text(min(counts), max(counts))}"] if len(counts) else []


def _panel_shares(shares: pd.DataFrame, part: pd.DataFrame, path_set: str, side: str) -> pd.DataFrame:
    """Return the shares over a panel's paths along void directions, by alpha."""
    side_shares = shares.loc[(shares["path_set"] == path_set) & (shares["side"] == side)]
    return side_shares.merge(part[[*effects.CELL, "kind"]].drop_duplicates()).sort_values("alpha")


def _mean_band(ax: Axes, shares: pd.DataFrame) -> None:
    alphas, percent = shares["alpha"].to_numpy(float), 100 * shares[["low", "high", "abstention"]].astype(float)
    ax.fill_between(alphas, percent["low"], percent["high"], color=GRID, alpha=0.7, linewidth=0, zorder=0.2)
    ax.plot(alphas, percent["abstention"], color=SOFT, linewidth=2.2, zorder=0.3)


def _panels(rows: pd.DataFrame) -> Mapping[tuple[str, str], pd.DataFrame]:
    """Return rows by model and complete path set, of standard under guided if any."""
    panels: dict[tuple[str, str], pd.DataFrame] = {}
    for model, of in rows.groupby("model", sort=False):
        guided = (of["directions"] == "standard").astype(int) + 2 * (of["regime"] == "guided").astype(int)
        of = of.loc[guided == guided.max()]
        for path_set, members in PATH_SETS.items():
            part = of.loc[[pair in members for pair in zip(of["source"], of["target"], strict=True)]]
            if set(zip(part["source"], part["target"], strict=True)) == set(members):
                panels[str(model), path_set] = part
    return panels


def _doses(ax: Axes, part: pd.DataFrame, side: str, strong: Collection[tuple[str, str]]) -> None:
    alphas = sorted(set(part["alpha"]))
    for key, line in part.groupby(["source", "target"], sort=False):
        source, target = str(key[0]), str(key[1])  # pyright: ignore[reportIndexIssue]
        line = line.sort_values("alpha")
        key = (source, target) in strong
        ax.plot(
            line["alpha"], 100 * line[side], color=FAMILY_COLOUR[taxonomy_of(source)], linestyle=LINE[source],
            marker=MARKER[target], markersize=3.5, linewidth=1.2 if key else 0.7, alpha=1.0 if key else 0.45,
            zorder=3 if key else 2, clip_on=False, label=path_name(source, target),
        )  # fmt: skip
    ax.set_xticks(alphas, [f"{alpha:g}" for alpha in alphas])


def cosine_heatmaps(results: Results) -> Figure:
    """Return cosines of the four void directions at the steered layer.

    Each model (and VQA prompt) has a panel, on one scale of ±0.6. Below the diagonal: of the directions themselves.
    Above it: corrected for the noise of few pairs and of shared controls, with a star if the 95 % interval excludes 0.
    On the diagonal: of the directions of two halves of the pairs; if it is low, a small cosine is uninformative. A dash
    is a pair without a figure; the paper has one figure per pair.
    """
    rows = results.cosines
    rows = rows.loc[rows["prompt"] == rows["other_prompt"]]
    if not len(rows):
        raise NotRun(why_not(results))
    panels = [(str(key[0]), str(key[1]), part) for key, part in rows.groupby(["model", "prompt"], sort=False)]  # pyright: ignore[reportIndexIssue]
    has_several_prompts = len({prompt for _, prompt, _ in panels}) > 1
    columns = min(3, len(panels))
    lines = -(-len(panels) // columns)
    with figure_style():
        figure = new_figure(PAGE_IN, 0.2 + 1.95 * lines)
        axes = figure.subplots(lines, columns, squeeze=False)
        images = [_heatmap(ax, part) for ax, (_, _, part) in zip(axes.flat, panels, strict=False)]
        for ax, (model, prompt, _) in zip(axes.flat, panels, strict=False):
            ax.set_title(f"{plain(model)[:26]}\n{prompt} prompt" if has_several_prompts else plain(model)[:26], size=7)
        for ax in axes.flat[len(panels) :]:
            ax.set_axis_off()
        figure.colorbar(images[-1], ax=list(axes.flat), label="cosine", shrink=0.85, aspect=25, pad=0.01)
    return figure


def _heatmap(ax: Axes, part: pd.DataFrame) -> Any:
    names = [TITLE_OF[name].replace(", ill", ",\nill") for name in DATASETS]
    row_of = {(row["dataset"], row["other_dataset"]): row for row in part.to_dict("records")}
    values, texts = np.full((4, 4), np.nan), dict[tuple[int, ...], str]()
    for (row, row_dataset), (column, column_dataset) in product(enumerate(DATASETS), repeat=2):
        at = row_of.get((row_dataset, column_dataset), {})
        is_corrected = row < column and _is_known(at.get("disattenuated"))
        figure = at.get("split_half" if row == column else "disattenuated" if is_corrected else "cosine")
        if not _is_known(figure):
            texts[row, column] = "1" if row == column else "–"
            continue
        values[row, column] = np.nan if row == column else figure
        star = "*" if is_corrected and _is_known(at["low"]) and at["low"] * at["high"] > 0 else ""
        texts[row, column] = f"{figure:.2f}{star}".replace("-", "−")
    image = ax.imshow(values, cmap="PuOr", vmin=-COSINE_SCALE, vmax=COSINE_SCALE)
    ax.set_facecolor("#f2f4f7")
    ax.set_xticks(range(4), names, rotation=90)
    ax.set_yticks(range(4), names)
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    for (row, column), value in np.ndenumerate(values):
        colour = SOFT if np.isnan(value) else "white" if abs(value) > 0.4 else "black"
        ax.text(column, row, texts[row, column], ha="center", va="center", size=6, color=colour)
    return image


def _is_known(value: Any) -> bool:
    return value is not None and value == value
