"""Plot activation patching."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.base.wording import count_noun
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.patching_tables import SITES
from traps_pipeline.report.terms import TITLE_OF
from traps_pipeline.report.writing import INK, PAGE_IN, NotRun, figure_style, fraction, new_figure, plain

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GROUPS = ("system", "stamps", "changed", "unchanged", "question", "last", "all")


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
            model_and_dataset = f"{plain(model)[:20]}: {TITLE_OF[dataset].lower()},"
            pairs = f"into the {patched_side}, {count_noun(int(part['n'].max()), 'pair')}"
            if has_one_site:
                ax.set_title(f"{model_and_dataset} {pairs}", size=7)
                continue
            if place < across:
                ax.set_title(SITES[site], size=7.5)
            if place % across == 0:
                ax.set_ylabel(f"{model_and_dataset}\n{pairs}", size=7)
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
