"""Draw tests of mechanistic claims: baselines, gates, patching, doses and nulls."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.base.wording import count_noun
from traps_pipeline.mechanism.directions import NULLS
from traps_pipeline.protocol.datasets import DATASETS, SHORT
from traps_pipeline.protocol.regimes import PROMPTING
from traps_pipeline.report.figures.looks import arrow, frame_plane, legend_key, range_text
from traps_pipeline.report.result_frames import Results, datasets_of
from traps_pipeline.report.tables.control_reports import beside
from traps_pipeline.report.tables.inside_columns import SHORTCUTS, few_marks, why
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

_BASELINES = dict(zip((*SHORTCUTS, "output margin"), ("s", "^", "v", "D", "P", "X"), strict=True))
_FEATURES = ("states", "question words", "time stamps", "output margin", "shuffled labels", "untrained model")
GROUPS = ("system", "stamps", "changed", "unchanged", "question", "last", "all")


def probe_baselines(results: Results) -> Figure:
    """Return AUROC of each dataset's probe on itself and on the other datasets.

    It is black, with its interval, and compared with probes on raw inputs and on the output margin; grey is the floor
    of noise under the same split, mean ± 2 deviations. oc and ch are occlusion and chaotic, and with _ip their
    ill-posed questions; oc→ch is fitted on oc and scored on ch; † is from fewer than ten items a side. A probe shows
    information of the states only as far as it exceeds all coloured marks.
    """
    rows = beside(results)
    if not len(rows):
        raise NotRun(why(results))
    models = list(dict.fromkeys(rows["model"]))
    with figure_style():
        figure = new_figure(PAGE_IN, 0.9 + 2.4 * len(models))
        axes = figure.subplots(len(models), 1, squeeze=False, sharex=True)[:, 0]
        for ax, model in zip(axes, models, strict=True):
            _baselines(ax, rows.loc[rows["model"] == model])
            sides = rows.loc[rows["model"] == model, ["n_voids", "n_controls"]].astype(int).to_numpy()
            ax.set_title(f"{plain(model)[:40]}, {range_text(sides.min(), sides.max())} items a side", size=7.5)
            ax.set_ylabel("AUROC")
        handles = [legend_key("states, layer chosen without the target", INK, "o", "-")]
        looks = zip(_BASELINES.items(), COLOURS, strict=False)
        handles += [legend_key(name, colour, marker) for (name, marker), colour in looks]
        handles += [legend_key("noise, mean ± 2 sd", GRID, line="-", linewidth=6)]
        figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def _baselines(ax: Axes, rows: pd.DataFrame) -> None:
    order = [(s, t) for s in DATASETS for t in sorted(DATASETS, key=lambda t: (t != s, DATASETS.index(t)))]
    row_of = {(row["source"], row["target"]): row for row in rows.to_dict("records")}
    pairs = [pair for pair in order if pair in row_of]
    for x, pair in enumerate(pairs):
        row = row_of[pair]
        if row["noise_spread"] == row["noise_spread"]:
            low, high = row["noise"] - 2 * row["noise_spread"], row["noise"] + 2 * row["noise_spread"]
            ax.plot([x, x], [max(low, 0), min(high, 1)], color=GRID, linewidth=7, solid_capstyle="butt", zorder=1)
        for k, ((name, marker), colour) in enumerate(zip(_BASELINES.items(), COLOURS, strict=False)):
            ax.plot(x + 0.09 * (k - 2.5) + 0.07, row[name], marker=marker, color=colour, markersize=3, linestyle="none")
        ax.plot([x - 0.32, x - 0.32], [row["low"], row["high"]], color=INK, linewidth=0.8)
        ax.plot(x - 0.32, row["value"], marker="o", color=INK, markersize=3.5)
    ax.axhline(0.5, color=GRID, linewidth=0.8, zorder=0.5)
    names = ["itself" if s == t else f"{SHORT[s]}→{SHORT[t]}" for s, t in pairs]
    names = [SHORT[s] if s == t else n for n, (s, t) in zip(names, pairs, strict=True)]
    marked_names = [f"{name} {row_of[pair]['mark']}".strip() for name, pair in zip(names, pairs, strict=True)]
    ax.set_xticks(range(len(pairs)), marked_names)
    ax.tick_params(axis="x", labelrotation=60, length=0)
    ax.set_ylim(-0.03, 1.05)


def gate_arrows(results: Results) -> Figure:
    """Return each model's answers before (hollow) and after (filled) the gate.

    Arrows are drawn in the plane of Acc and J, for gates on states and their controls (from other datasets, mid
    threshold, all datasets); and risk against coverage. J is AbsRec minus FalseAbs: an arrow to the right means better
    separation of voids from controls, an arrow downwards a loss of right answers.
    """
    rows = results.gate
    rows = rows.loc[(rows["source"] == "other datasets") & (rows["threshold"] == "mid") & (rows["target"] == "all")]
    rows = rows.loc[rows["features"].isin(_FEATURES)]
    if not len(rows):
        raise NotRun(why(results, "the paper gates nothing"))
    regimes = [name for name in PROMPTING if name in set(rows["regime"])]
    colour = _colours(_FEATURES)
    rows = rows.assign(j=rows["abs_rec"] - rows["false_abs"], plain_j=rows["plain_abs_rec"] - rows["plain_false_abs"])
    with figure_style():
        figure = new_figure(PAGE_IN, 3.6)
        panels = figure.subplots(1, len(regimes) + 1, squeeze=False)[0]
        for ax, regime in zip(panels, regimes, strict=False):
            part = rows.loc[rows["regime"] == regime]
            _arrows(ax, part, colour)
            ax.set_title(f"{regime}, {plain(' and '.join(dict.fromkeys(part['model'])))[:30]}", size=7.5)
        _risk(panels[-1], results.risk_coverage, regimes[-1], colour)
        features = [name for name in _FEATURES if name in set(rows["features"])]
        handles = [legend_key(f"gate on {name}", colour[name], "o", "-") for name in features]
        handles += [legend_key("no gate", INK, "o", size=6, markerfacecolor="white")]
        figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def _colours(names: Sequence[str]) -> dict[str, str]:
    return dict(zip(names, COLOURS, strict=False))


def _arrows(ax: Axes, rows: pd.DataFrame, colour: dict[str, str]) -> None:
    import pandas as pd

    points = pd.DataFrame({"acc": [*rows["acc"], *rows["plain_acc"]], "j": [*rows["j"], *rows["plain_j"]]})
    frame_plane(ax, points, "Acc, overall")
    for row in rows.to_dict("records"):
        start, end = (row["plain_j"], row["plain_acc"]), (row["j"], row["acc"])
        arrow(ax, start, end, colour[row["features"]])
        ax.scatter(*end, s=16, color=colour[row["features"]], zorder=4, clip_on=False)
        ax.scatter(*start, s=22, facecolors="white", edgecolors=INK, linewidths=0.9, zorder=5, clip_on=False)


def _risk(ax: Axes, rows: pd.DataFrame, regime: str, colour: dict[str, str]) -> None:
    rows = rows.loc[rows["regime"] == regime]
    for features, curve in rows.groupby("features", sort=False):
        curve = curve.sort_values("coverage")
        if features == "no gate":
            ax.scatter(curve["coverage"], curve["risk"], s=22, facecolors="white", edgecolors=INK, zorder=4)
        elif features in colour:
            ax.plot(curve["coverage"], curve["risk"], color=colour[str(features)], linewidth=1.1)
    ax.set(xlabel="coverage: share answered", ylabel="risk: share of answers that are wrong", xlim=(0, 1))
    ax.set_ylim(-0.02, max(0.5, *rows["risk"]) + 0.05 if len(rows) else 1)
    ax.set_title(f"risk and coverage, {regime}", size=7.5)


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
