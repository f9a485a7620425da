"""Abstention and stated probability on graded cuts, against how probable the likeliest answer is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from traps_pipeline.protocol.regimes import ANSWER_FROM
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.graded_tables import WHY
from traps_pipeline.report.tables.table_columns import ordered
from traps_pipeline.report.writing import COLOURS, MARKERS, PAGE_IN, SOFT, NotRun, figure_style, new_figure, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LINES = ("-", "--", ":", "-.")


def graded(results: Results) -> Figure:
    """Return, for cuts of like probability of the likeliest answer, left the share of abstentions and right the mean
    probability that is stated for this answer. Grey: an ideal observer, who abstains up to the probability from which
    an answer is worth its risk, and states the true one. A step at another place is another threshold; a slope is
    another knowledge."""
    rows = results.graded
    rows = ordered(rows.loc[rows["scope"] != "all"], ["model", "regime"])
    if not len(rows):
        raise NotRun(WHY)
    models, regimes = list(dict.fromkeys(rows["model"])), list(dict.fromkeys(rows["regime"]))
    lines = {regime: _LINES[k % len(_LINES)] for k, regime in enumerate(regimes)}
    with figure_style():
        figure = new_figure(PAGE_IN, 2.7 + 0.12 * len(models))
        left, right = figure.subplots(1, 2)
        ideal: dict[str, Any] = {"color": SOFT, "linewidth": 0.8, "zorder": 0.5}
        left.plot([0.3, ANSWER_FROM, ANSWER_FROM, 1], [1, 1, 0, 0], label="ideal observer", **ideal)
        right.plot([0.3, 1], [0.3, 1], **ideal)
        for (model, regime), part in cast(Any, rows.sort_values("top").groupby(["model", "regime"], sort=False)):
            k = models.index(model)
            look: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)], "marker": MARKERS[k % len(MARKERS)]}
            look |= {"linestyle": lines[str(regime)], "markersize": 4, "clip_on": False}
            left.plot(part["top"], 1 - part["coverage"], label=f"{plain(str(model))}, {regime}", **look)
            right.plot(part["top"], part["stated"], **look)
        left.set(xlim=(0.3, 1.0), ylim=(-0.03, 1.03), ylabel="share of abstentions")
        right.set(xlim=(0.3, 1.0), ylim=(0.0, 1.03), ylabel="probability stated for it")
        for axes in (left, right):
            axes.set_xlabel("probability of the likeliest answer")
        figure.legend(loc="outside lower center", ncols=3, fontsize=6)
    return figure
