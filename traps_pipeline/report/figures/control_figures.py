"""Draw tests of mechanistic claims: patching, doses and nulls."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.base.wording import count_noun
from traps_pipeline.mechanism.directions import NULLS
from traps_pipeline.protocol.datasets import SHORT
from traps_pipeline.report.figures.looks import legend_key, range_text
from traps_pipeline.report.result_frames import Results, datasets_of
from traps_pipeline.report.tables.inside_columns import few_marks, why
from traps_pipeline.report.tables.patching_tables import SITES
from traps_pipeline.report.terms import TITLES
from traps_pipeline.report.writing import (
    COLOURS,
    GRID,
    INK,
    PAGE_IN,
    SOFT,
    NotRun,
    figure_style,
    fraction,
    new_figure,
    plain,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GROUPS = ("system", "stamps", "changed", "unchanged", "question", "last", "all")


def _colours(names: Sequence[str]) -> dict[str, str]:
    return dict(zip(names, COLOURS, strict=False))


def patching(results: Results) -> Figure:
    """Return the indirect effect of each group of positions at each layer.

    Patches go from the void into the control and back; 1 is the whole difference of the outcome. Framed cells were
    patched; the others are first-order estimates, from one backward pass per pair. The residual stream is the whole
    output of a block, without all of its positions, which give 1 by construction; attention and MLP, where they were
    patched, are one block's additions to it. stamps are the time stamps, changed and unchanged the visual tokens whose
    pixels differ or agree between the sides; last is the last token.
    """
    rows = results.patching
    rows = rows.loc[(rows["source"] == "pair") & rows["attributed"].notna()]
    rows = rows.loc[(rows["site"] != "residual") | (rows["group"] != "all")]  # 1 by construction, and never patched
    if not len(rows):
        reason = "the experiment asks for no `patching`" if results.is_study else "the paper patches nothing"
        raise NotRun(reason)
    sites = [site for site in SITES if site in set(rows["site"])]
    cases = dict.fromkeys(zip(rows["model"], rows["dataset"], rows["into"], strict=True))
    has_one_site = len(sites) == 1  # then cases are columns; otherwise a row has the sites of one case
    across = min(2, len(cases)) if has_one_site else len(sites)
    panels = [(case, site) for case in cases for site in sites]
    lines = -(-len(panels) // across)
    with figure_style():
        figure = new_figure(PAGE_IN, 0.3 + 1.9 * lines)
        axes = figure.subplots(lines, across, squeeze=False)
        images = []
        for place, (ax, ((model, dataset, patched_side), site)) in enumerate(zip(axes.flat, panels, strict=False)):
            is_in_panel = (rows["model"] == model) & (rows["dataset"] == dataset) & (rows["into"] == patched_side)
            part = rows.loc[is_in_panel & (rows["site"] == site)]
            if not len(part):
                ax.set_axis_off()
                continue
            images.append(_effects(ax, part))
            n = int(part["n"].max())
            if has_one_site:
                ax.set_title(
                    f"{plain(model)[:20]}: {TITLES[dataset].lower()}, into the {patched_side}, {count_noun(n, 'pair')}",
                    size=7,
                )
                continue
            if place < across:
                ax.set_title(SITES[site], size=7.5)
            if place % across == 0:
                ax.set_ylabel(
                    f"{plain(model)[:20]}: {TITLES[dataset].lower()},\n"
                    f"into the {patched_side}, {count_noun(n, 'pair')}",
                    size=7,
                )
        for ax in axes.flat[len(panels) :]:
            ax.set_axis_off()
        figure.colorbar(images[-1], ax=list(axes.flat), label="indirect effect", shrink=0.8, aspect=25, pad=0.01)
    return figure


def _effects(ax: Axes, part: pd.DataFrame) -> Any:
    from matplotlib.patches import Rectangle

    values = part.assign(value=part["effect"].fillna(part["attributed"]), measured=part["effect"].notna().astype(float))
    effect_grid = values.pivot_table(index="group", columns="layer", values="value", observed=True).reindex([*GROUPS])
    effect_grid = effect_grid.dropna(how="all")
    measured_grid = values.pivot_table(index="group", columns="layer", values="measured", observed=True).reindex(
        effect_grid.index
    )
    values = effect_grid.to_numpy(float)
    image = ax.imshow(values, cmap="PuOr", vmin=-1, vmax=1, aspect="auto")
    ax.set_xticks(range(values.shape[1]), [str(layer) for layer in effect_grid.columns])
    ax.set_yticks(range(len(effect_grid)), [str(name) for name in effect_grid.index])
    ax.set_xlabel("layer (0: embeddings)")
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    for row, column in np.argwhere(measured_grid.to_numpy(float) > 0):
        ax.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, fill=False, edgecolor=INK, linewidth=0.8))
    if values.shape[1] <= 12:
        for (row, column), value in np.ndenumerate(values):
            if value == value:
                shade = "white" if abs(value) > 0.6 else "black"
                ax.text(column, row, fraction(value, 2), ha="center", va="center", size=6, color=shade)
    return image


def doses_among_nulls(results: Results) -> Figure:
    """Return abstention of controls (+) and voids (−) along a direction, by dose.

    Each dataset has its own direction; the dose is in units of the class gap, on pairs that the direction does not come
    from; doses beyond the cap, in states, are left out. Right of the line: the nulls, which are orthogonal to the
    direction, at the largest dose, added on controls (+) and subtracted on voids (−); a larger dot means more draws.
    The direction has a specific effect where its line ends away from the dots. oc and ch are occlusion and chaotic, and
    with _ip their ill-posed questions. n: answers of a side, † fewer than ten. p: share of the draws of each null, in
    the order of the legend, with at least the direction's effect, counting the direction itself; on controls, then on
    voids.
    """
    rows = results.own_effects
    if not len(rows):
        raise NotRun(why(results, "the paper has no such nulls"))
    cells = list(dict.fromkeys(zip(rows["model"], rows["directions"], rows["regime"], strict=True)))
    datasets, colour = datasets_of(rows.assign(dataset=rows["target"])), _colours(NULLS)
    kinds = [null for null in NULLS if null in set(rows["kind"])]
    with figure_style():
        figure = new_figure(PAGE_IN, 0.7 + 2.0 * len(cells))
        axes = figure.subplots(len(cells), len(datasets), squeeze=False, sharey=True)
        for line, (model, directions, regime) in zip(axes, cells, strict=True):
            of = rows.loc[(rows["model"] == model) & (rows["directions"] == directions) & (rows["regime"] == regime)]
            for ax, dataset in zip(line, datasets, strict=True):
                part = of.loc[of["target"] == dataset]
                _dose(ax, part, colour)
                own = part.loc[part["kind"] == "void"].assign(mark=few_marks(part.loc[part["kind"] == "void"], "n"))
                n = range_text(int(own["n"].min()), int(own["n"].max())) + max(own["mark"])
                ranks = _p_values(results.nulls, kinds, str(model), str(directions), str(regime), dataset)
                ax.set_title("\n".join([f"{SHORT[dataset]}, {directions}→{regime}", f"n {n}", *ranks]), size=6)
            line[0].set_ylabel(f"{plain(str(model))[:14]}\nabstained, %")
        for ax in axes[-1]:
            ax.set_xlabel("dose in class gaps | nulls", size=7)
        axes[0, 0].set_ylim(-6, 106)
        handles = [legend_key("+ on controls", INK, "o", "-", 3.5), legend_key("− on voids", SOFT, "s", "--", 3.5)]
        handles += [legend_key(f"{null} null", colour[null], "o", size=3) for null in kinds]
        figure.legend(handles=handles, loc="outside lower center", ncols=5)
    return figure


def _p_values(
    nulls: pd.DataFrame, kinds: Sequence[str], model: str, directions: str, regime: str, dataset: str
) -> list[str]:
    """Return a direction's p among each null at the largest dose, one line per side."""
    of = nulls.loc[(nulls["model"] == model) & (nulls["directions"] == directions) & (nulls["regime"] == regime)]
    of = of.loc[(of["target"] == dataset) & (of["unit"] == "gap")]
    lines: list[str] = []
    for side, sign in (("control", "+"), ("void", "−")):
        rows = of.loc[of["side"] == side].sort_values("dose").drop_duplicates("null", keep="last")
        known = {str(row["null"]): f"{row['p']:.2f}".removeprefix("0") for row in rows.to_dict("records")}
        lines += [f"p {sign} {' '.join(known.get(null, '–') for null in kinds)}"] if known else []
    return lines


def _dose(ax: Axes, rows: pd.DataFrame, colour: dict[str, str]) -> None:
    # Doses in alpha have their own figure; with a small gap they would dominate the scale of this one.
    rows = rows.loc[rows["unit"] == "gap"]
    for side, line, marker, ink in (("control", "-", "o", INK), ("void", "--", "s", SOFT)):
        of = rows.loc[rows["side"] == side]
        void = of.loc[of["kind"] == "void"].sort_values("gaps").drop_duplicates("gaps")
        ax.plot(void["gaps"], 100 * void["abstention"].astype(float), color=ink, linestyle=line, marker=marker,
                markersize=3.2, linewidth=1.0, clip_on=False)  # fmt: skip
        for place, null_kind in enumerate(NULLS):
            nulls = of.loc[(of["kind"] == null_kind) & (of["dose"] > 0)]
            if not len(nulls):
                continue
            top = float(nulls["gaps"].iloc[0])
            at = top * (1.25 + 0.14 * place + (0.55 if side == "void" else 0))
            counts = (100 * nulls["abstention"].astype(float)).round(6).value_counts()
            ax.scatter([at] * len(counts), counts.index, s=3 + 1.6 * counts.to_numpy(), color=colour[null_kind],
                       marker=marker, linewidths=0, clip_on=False)  # fmt: skip
            ax.axvline(1.12 * top, color=GRID, linewidth=0.7, zorder=0)
            doses = [dose for dose in sorted(set(void["gaps"])) if dose == 0 or dose >= top / 4]
            ax.set_xticks([*doses, 1.39 * top, 1.94 * top], [*(f"{dose:g}" for dose in doses), "+", "−"])
