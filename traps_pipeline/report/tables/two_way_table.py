"""Tabulate two events: whether abstention follows the event that is asked about."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.table_columns import MODEL, REGIME, figure_with_interval
from traps_pipeline.report.writing import Column, PrintedTable, fraction, percent

if TYPE_CHECKING:
    import pandas as pd

WHY_EMPTY = "two events were not asked (name `two_events` under datasets)"
_FIGURES = {
    "conjunction": ("Conjunction %", percent),
    "own_effect": ("Own effect", partial(fraction, digits=2)),
    "other_effect": ("Other effect", partial(fraction, digits=2)),
    "specificity": ("Specificity", partial(fraction, digits=2)),
}
_SHARES = {"neither": "Abstains %: neither hidden", "other": "the other", "asked": "the asked", "both": "both"}
_NOTES = (
    "conjunction: share of scenarios with all eight items right; own and other effect: by how much abstention rises "
    "where the asked event alone, or the other one alone, is hidden; specificity: own minus other effect",
    "what needs no understanding gets: 0 in every figure for always or never abstaining, whatever it answers; "
    "conjunction 0 and specificity 0 for a rule of the clip alone or of the question alone; an oracle has 100, 1, 0, 1",
    "inferred: late_occluder and predictable_cut, whose outcome is not shown; to abstain there is caution",
    "brackets: 95 % interval, Bayesian bootstrap over scenarios with one unseen; no part of PECS",
)


def two_way(results: Results) -> list[PrintedTable]:
    """Return by how much hiding the asked event, or the other one, makes a model abstain."""
    return [two_way_table(results.two_way)]


def two_way_table(rows: pd.DataFrame) -> PrintedTable:
    """Return the printed table of TWO_WAY rows, the most specific entry first."""
    columns_of = {
        f"{name}_shown": [figure_with_interval(row, name, words) for row in rows.to_dict("records")]
        for name, (_, words) in _FIGURES.items()
    }
    rows = rows.assign(**columns_of).sort_values(
        ["specificity", "model", "regime"], ascending=[False, True, True], na_position="last", ignore_index=True
    )
    columns = [
        MODEL, REGIME, *[Column(f"{name}_shown", heading, "range") for name, (heading, _) in _FIGURES.items()],
        *[Column(f"abstains_{name}", words, "percent", group=name == "neither") for name, words in _SHARES.items()],
        Column("acc", "Acc %", "percent", group=True),
        Column("n_scenarios", "Scenarios", "count"), Column("n_missing", "Missing", "count"),
        Column("inference_acc", "Inferred %", "percent", group=True),
        Column("inference_abstains", "abstained %", "percent"),
    ]  # fmt: skip
    refusals = [f"{row['model']} {row['regime']}: no figure, {row['refused']}"
                for row in rows.dropna(subset=["refused"]).to_dict("records")]  # fmt: skip
    notes = [*_NOTES, *refusals] if len(rows) else []
    return PrintedTable("two_way", "Two events, one of them hidden", rows, columns, notes, WHY_EMPTY)
