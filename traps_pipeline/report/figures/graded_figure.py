"""Plot abstention and stated probability on graded cuts against true probability."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from traps_pipeline.protocol.regimes import ANSWER_FROM, REGIMES
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.graded_tables import WHY_EMPTY
from traps_pipeline.report.tables.table_columns import sort_rows
from traps_pipeline.report.writing import COLOURS, MARKERS, PAGE_IN, SOFT, NotRun, figure_style, new_figure, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LINES = ("-", "--", ":", "-.")
_FROM = 0.2  # about the lowest probability of the likeliest of six answers
_APART = 0.008  # horizontal offset between models, since several abstain and state alike


def graded(results: Results) -> Figure:
    """Return abstention and stated probability on graded cuts.

    Left: the share of abstentions under regimes that ask for a decision. Right: the mean probability given to the
    likeliest answer under regimes that ask for probabilities. Both over cuts with similar probability of the likeliest
    answer. Grey: an ideal observer, which answers if the probability makes an answer worth its risk, and states the
    true one. A shifted step means another threshold; another slope means other knowledge. Models are drawn side by
    side.
    """
    from matplotlib.lines import Line2D

    rows = results.graded
    rows = sort_rows(rows.loc[rows["scope"] != "all"], ["model", "regime", "top"])
    if not len(rows):
        raise NotRun(WHY_EMPTY)
    models, regimes = list(dict.fromkeys(rows["model"])), sorted(set(rows["regime"]), key=REGIMES.index)
    lines: dict[str, Any] = {regime: _LINES[k % len(_LINES)] for k, regime in enumerate(regimes)}
    states = set(rows.loc[rows["stated"].notna(), "regime"])
    with figure_style():
        figure = new_figure(PAGE_IN, 2.6 + 0.03 * (len(models) + len(regimes)))
        left, right = figure.subplots(1, 2)
        ideal: dict[str, Any] = {"color": SOFT, "linewidth": 2.5, "alpha": 0.45, "zorder": 0.5}
        legend = left.plot([_FROM, ANSWER_FROM, ANSWER_FROM, 1], [1, 1, 0, 0], label="ideal observer", **ideal)
        right.plot([_FROM, 1], [_FROM, 1], **ideal)
        for k, model in enumerate(models):
            look: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)], "marker": MARKERS[k % len(MARKERS)]}
            look |= {"markersize": 4, "clip_on": False}
            legend.append(Line2D([], [], label=plain(str(model)), **look))
            for regime in regimes:
                part = rows.loc[rows["model"].eq(model) & rows["regime"].eq(regime)]
                if not len(part):  # the layout would reserve room for an unclipped empty line
                    continue
                axes, share = (right, part["stated"]) if regime in states else (left, 1 - part["coverage"])
                axes.plot(part["top"] + _APART * (k - len(models) / 2), share, linestyle=lines[regime], **look)
        legend += [Line2D([], [], color=SOFT, linestyle=lines[one], label=f"regime {one}") for one in regimes]
        left.set(ylim=(-0.03, 1.03), ylabel="share of abstentions")
        right.set(ylim=(-0.03, 1.03), ylabel="mean probability given to it")
        for axes in (left, right):
            axes.set(xlim=(_FROM - 0.03, 1.03), xlabel="probability of the likeliest answer")
        figure.legend(handles=legend, loc="outside lower center", ncols=5, fontsize=6)
    return figure
