"""How well one cue alone separates control from void."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pandas as pd

from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.report.terms import TITLES
from traps_pipeline.report.writing import COLOURS, COLUMN_IN, MARKERS, figure_style, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def shortcut_figure(table: pd.DataFrame) -> Figure:
    """Return how well each cue alone predicts the side, from `benchmark.shortcuts`; a line is at chance."""
    datasets = [name for name in TITLES if name in set(table["dataset"])] or list(DATASETS)
    cues = list(dict.fromkeys(table["cue"]))
    with figure_style():
        figure = new_figure(COLUMN_IN, 0.75 + 0.42 * len(datasets))
        axes = figure.add_subplot()
        axes.axvline(0.5, color="#98a2b3", linewidth=0.8, zorder=0.5)
        for k, cue in enumerate(cues):
            rows = table.loc[table["cue"] == cue].set_index("dataset")
            at = [datasets.index(str(name)) + 0.17 * (k - (len(cues) - 1) / 2) for name in rows.index]
            axes.errorbar(
                rows["accuracy"], at, xerr=rows["half_width"], fmt=MARKERS[k], color=COLOURS[k], markersize=4,
                linestyle="none", linewidth=0.8, label=cue, clip_on=False, zorder=3,
            )  # fmt: skip
        axes.set(xlim=(0.38, 1.02), ylim=(len(datasets) - 0.5, -0.5), xlabel="share of sides predicted correctly")
        axes.set_yticks(range(len(datasets)), [TITLES[name] for name in datasets])
        if cues:
            columns = len(cues)
            figure.legend(loc="outside upper center", ncols=columns, handletextpad=0.1, columnspacing=0.8, fontsize=6)
    return figure
