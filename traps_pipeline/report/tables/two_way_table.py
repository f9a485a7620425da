"""Tabulate two events: whether abstention follows the event that is asked about."""

from __future__ import annotations

from typing import TYPE_CHECKING

from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.table_columns import MODEL, REGIME, two_events_trace
from traps_pipeline.report.writing import Column, PrintedTable

if TYPE_CHECKING:
    import pandas as pd

WHY_EMPTY = "two events were not asked (name `two_events` under datasets)"
COLUMNS = (
    MODEL, REGIME, Column("conjunction", "Conjunction %", "percent", interval=True),
    Column("own_effect", "Own effect", "fraction", 2, interval=True),
    Column("other_effect", "Other effect", "fraction", 2, interval=True),
    Column("specificity", "Specificity", "fraction", 2, interval=True),
    Column("abstains_neither", "Abstains %: neither hidden", "percent", group=True),
    Column("abstains_other", "the other", "percent"), Column("abstains_asked", "the asked", "percent"),
    Column("abstains_both", "both", "percent"), Column("acc", "Acc %", "percent", group=True),
    Column("n_scenarios", "Scenarios", "count"), Column("n_missing", "Missing", "count"),
    Column("inference_acc", "Inferred %", "percent", group=True),
    Column("inference_abstains", "abstained %", "percent"),
)  # fmt: skip
_NOTES = (
    "conjunction: share of scenarios with all eight items right; own and other effect: by how much abstention rises "
    "where the asked event alone, or the other one alone, is hidden; specificity: own minus other effect",
    "what needs no understanding gets: 0 in every metric for always or never abstaining, whatever it answers; "
    "conjunction 0 and specificity 0 for a rule of the clip alone or of the question alone; an oracle has 100, 1, 0, 1",
    "inferred: late_occluder and predictable_cut, whose outcome is not shown; to abstain there is caution",
    "brackets: 95 % interval, Bayesian bootstrap over scenarios with one unseen; no part of PECS",
)


def two_way(results: Results) -> list[PrintedTable]:
    """Return by how much hiding the asked event, or the other one, makes a model abstain."""
    return [two_way_table(results.two_way)]


def two_way_table(rows: pd.DataFrame) -> PrintedTable:
    """Return the printed table of TWO_WAY rows, the most specific entry first."""
    columns = COLUMNS if rows["inference_acc"].notna().to_numpy().any() else COLUMNS[:-2]
    rows = rows.sort_values(["specificity", "model", "regime"], ascending=[False, True, True], ignore_index=True)
    refusals = [f"{row['model']} {row['regime']}: no metric, {row['refused']}"
                for row in rows.dropna(subset=["refused"]).to_dict("records")]  # fmt: skip
    notes = [*_NOTES, *refusals] if len(rows) else []
    return PrintedTable("two_way", "Two events, one of them hidden", rows, columns, notes, WHY_EMPTY, two_events_trace)
