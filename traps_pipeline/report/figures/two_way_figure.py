"""Plot abstention on two events: by which of them is hidden."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.report.figures.looks import legend_key
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.two_way_table import WHY_EMPTY
from traps_pipeline.report.writing import (
    COLOURS,
    COLUMN_IN,
    PAGE_IN,
    SOFT,
    NotRun,
    figure_style,
    fraction,
    new_figure,
    plain,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLUMNS, _PANEL_IN = 5, 1.35
_LINES: dict[str, dict[str, Any]] = {  # thick below thin, so that both are seen where they coincide
    "other event seen": {"color": COLOURS[4], "linewidth": 3.0, "marker": "o", "markersize": 5},
    "other event hidden": {"color": COLOURS[1], "linewidth": 1.2, "marker": "D", "markersize": 3.5, "linestyle": "--"},
}


def two_way(results: Results) -> Figure:
    """Return abstention where the asked event is seen and where it is hidden.

    A panel is a model, the most specific first. Thick: the other event is seen; dashed: it is hidden. A reader has both
    lines in one, from 0 to 100; a rule that sees how many events are hidden has them apart; flat lines follow no
    hiding.
    """
    rows = results.two_way
    rows = rows.dropna(subset=["specificity"]).sort_values(
        ["specificity", "model", "regime"], ascending=[False, True, True]
    )
    if not len(rows):
        raise NotRun(WHY_EMPTY)
    entries, n_columns = rows.to_dict("records"), 2 if len(rows) <= 2 else _COLUMNS
    n_rows = -(-len(entries) // n_columns)
    with figure_style():
        figure = new_figure(COLUMN_IN if n_columns == 2 else PAGE_IN, 0.45 + _PANEL_IN * n_rows)
        panels = figure.subplots(n_rows, n_columns, sharex=True, sharey=True, squeeze=False)
        for place, axes in enumerate(panels.flat):
            axes.set_visible(place < len(entries))
            axes.tick_params(labelbottom=place + n_columns >= len(entries))
        for axes, row in zip(panels.flat, entries, strict=False):
            seen, hidden = ("neither", "asked"), ("other", "both")
            for cells, look in zip((seen, hidden), _LINES.values(), strict=True):
                shares = np.array([row[f"abstains_{cell}"] for cell in cells], float)
                axes.plot([0, 1], 100 * shares, clip_on=False, **look)
            axes.set(xlim=(-0.25, 1.25), ylim=(-4, 104), xticks=(0, 1), yticks=(0, 50, 100))
            axes.set_xticklabels(("seen", "hidden"))
            name, specificity = plain(row["model"])[:24], fraction(row["specificity"], 2)
            axes.set_title(f"{name}\n{row['regime']}, specificity {specificity}", size=6, weight="normal")
            axes.grid(axis="y", color="#eaecf0", linewidth=0.6)
        figure.supylabel("abstains, %", size=7, color=SOFT)
        figure.supxlabel("asked event", size=7, color=SOFT)
        handles = [legend_key(name, look["color"], look["marker"], look.get("linestyle", "-"), look["markersize"],
                              linewidth=look["linewidth"]) for name, look in _LINES.items()]  # fmt: skip
        figure.legend(handles=handles, loc="outside upper center", ncols=2, fontsize=6.5)
    return figure
