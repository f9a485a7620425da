"""Tabulate earnings on graded cuts beside an ideal observer and blind strategies."""

from __future__ import annotations

from typing import TYPE_CHECKING

from traps_pipeline.protocol.regimes import ANSWER_FROM, WRONG_COSTS
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.table_columns import MODEL, REGIME, sort_rows
from traps_pipeline.report.writing import Column, PrintedTable, fraction

if TYPE_CHECKING:
    import pandas as pd

WHY_EMPTY = "graded cuts were not asked (name `graded` under datasets)"


def graded(results: Results) -> list[PrintedTable]:
    """Return expected points of each model on clips cut at graded times, and its losses by reason.

    Losses are by ignorance, by rash answers and by needless abstention.
    """
    rows = results.graded
    rows = rows.loc[rows["scope"] == "all"]
    rows = sort_rows(rows, ["regime", "model"])
    columns = [
        MODEL, REGIME, Column("n_items", "Cuts", "count"), Column("n_missing", "Missing", "count"),
        Column("coverage", "Answers %", "percent"), Column("risk", "Wrong %", "percent"),
        Column("points", "Points", "fraction", 2, interval=True),
        Column("regret", "Regret", "fraction", 2, group=True), Column("regret_label", "by answer", "fraction", 2),
        Column("regret_rash", "rash", "fraction", 2), Column("regret_shy", "shy", "fraction", 2),
        Column("abstains_right", "Abstains rightly %", "percent", group=True),
        Column("abstains_wrong", "wrongly %", "percent"),
        Column("brier", "Brier", "fraction", 2, group=True, interval=True),
    ]  # fmt: skip
    return [PrintedTable("graded", "Graded cuts", rows, columns, _notes(rows) if len(rows) else [], WHY_EMPTY)]


def _notes(rows: pd.DataFrame) -> list[str]:
    largest_row = rows.loc[rows["n_items"].idxmax()]
    reference_columns = ("points_ideal", "points_best", "points_prior", "brier_ideal", "brier_even")
    metrics = {name: fraction(largest_row[name], 2) for name in reference_columns}
    return [
        f"points a question: 1 for a right answer, -{WRONG_COSTS} for a wrong one, 0 for an abstention, as expected by "
        f"the cut's posterior; from a probability of {ANSWER_FROM:g} on an answer is worth its risk",
        f"an ideal observer earns {metrics['points_ideal']}; always abstaining earns 0; always the likeliest answer "
        f"{metrics['points_best']}; always the family's commonest answer {metrics['points_prior']}",
        "regret: points that the ideal observer earns more: with the likeliest answer, without answers that are not "
        "worth their risk (rash), with those that are (shy)",
        f"Brier: of probabilities that are stated or those of the first token, from 0 to 2; the posterior has "
        f"{metrics['brier_ideal']}, equal probabilities {metrics['brier_even']}; all other numbers are then of acting "
        f"on them: answering the largest from {ANSWER_FROM:g} on",
        "brackets: 95 % interval, Bayesian bootstrap over scenarios with one unseen; no part of any other number",
    ]
