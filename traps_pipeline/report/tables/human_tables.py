"""Tabulate people's scores and agreement, and scores corrected for panel errors."""

from __future__ import annotations

from typing import TYPE_CHECKING

from traps_pipeline.base.wording import count_noun
from traps_pipeline.protocol.metric_words import METRIC_WORDS
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.table_columns import (
    DATASET,
    MODEL,
    REGIME,
    RUNS,
    sort_rows,
    with_titles,
)
from traps_pipeline.report.writing import NOT_RUN, Column, PrintedTable

if TYPE_CHECKING:
    import pandas as pd

BY_PEOPLE = "nobody has labelled yet (run traps people annotate)"
_METRICS = [Column(name, metric.heading, metric.unit, interval=True) for name, metric in METRIC_WORDS.items()]
_RATES = [Column(name, f"{name.capitalize()} %", "percent", interval=True) for name in ("sensitivity", "specificity")]


def people(results: Results) -> list[PrintedTable]:
    """Return people's scores by dataset, and their agreement on clips and answers."""
    rows = sort_rows(with_titles(results.human_row), ["dataset"])
    columns = [
        DATASET, *_METRICS, Column("agreement", "Agree %", "percent"),
        Column("alpha", "Krippendorff’s α", "fraction", 2),
        Column("seconds", "Seconds", "ratio"), Column("n_people", "People", "count"),
        Column("n_clips", "Clips", "count"), Column("n_labels", "Labels", "count"),
    ]  # fmt: skip
    notes = [
        "labels of all people pooled; brackets: 95 % interval, Bayesian bootstrap over scenarios with one unseen",
        "agree, α: on whether the clip lets the question be answered",
    ]
    agreement = sort_rows(results.human_agreement, ["task", "decision"])
    task_notes = [
        Column("task", "Task"), Column("decision", "Decision"), Column("agreement", "Agree %", "percent"),
        Column("alpha", "Krippendorff’s α", "fraction", 2), Column("n_shared", "Labelled twice", "count"),
        Column("n_units", "Labelled", "count"), Column("seconds", "Seconds", "ratio"),
    ]  # fmt: skip
    undefined = sorted(set(agreement["undefined"].dropna()))
    return [
        PrintedTable("people", "People", rows, columns, notes if len(rows) else [], BY_PEOPLE),
        PrintedTable(
            "people_agreement", "Agreement of people", agreement, task_notes, [], BY_PEOPLE,
            dash="; ".join(undefined) or "undefined",
        ),
    ]  # fmt: skip


def judge_corrected(results: Results) -> list[PrintedTable]:
    """Return the panel against people, and the leaderboard corrected for its errors."""
    panel_notes = [
        Column("task", "Task"), *_RATES, Column("n_answers", "Answers", "count"),
        Column("n_yes", "People’s yes", "count"), Column("n_tied", "Tied", "count"),
        Column("n_people", "People", "count"),
    ]  # fmt: skip
    rows = results.corrected
    overall = rows.loc[rows["dataset"] == "overall"] if "overall" in set(rows["dataset"]) else rows
    entries = sort_rows(with_titles(overall), ["dataset", "model", "regime"])
    metrics = [
        Column(f"{name}{end}", f"{m.heading}{', corrected' if end else ''}", m.unit, group=not end, interval=True)
        for name, m in METRIC_WORDS.items()
        for end in ("", "_corrected")
        if name != "j"
    ]
    notes = [
        "judged and corrected in the same resamples of scenarios; a correction assumes that the panel errs alike on "
        "the answers of all models"
    ]
    reason = "not validated: people labelled no answers (run traps people annotate)"
    reasons = sorted(set(results.panel_errors["undefined"].dropna()))
    return [
        PrintedTable("panel_errors", "The panel against people", results.panel_errors, panel_notes, reasons, reason),
        PrintedTable(
            "judge_corrected", "Judged, and corrected for the panel’s errors", entries,
            [MODEL, REGIME, DATASET, *metrics, RUNS], notes if len(entries) else [], reason,
        ),
    ]  # fmt: skip


def people_notes(human_row: pd.DataFrame, panel_errors: pd.DataFrame, certified: str = "") -> list[str]:
    """Return leaderboard notes: recorded pairs' certificates, people's scores, whether the panel was validated."""
    notes = [certified] if certified else []
    return [*notes, f"people: {_score_of_people(human_row)}", f"the panel: {_validation_note(panel_errors)}"]


def _score_of_people(rows: pd.DataFrame) -> str:
    if rows.empty:
        return f"{NOT_RUN}, {BY_PEOPLE}"
    row_of = {row["dataset"]: row for row in rows.to_dict("records")}
    row = row_of.get("overall", {})
    if not row or row["pecs"] != row["pecs"]:
        return f"{NOT_RUN} in full, since PECS needs labels of both sides of all four datasets"
    metrics = ", ".join(f"{each.heading.removesuffix(' %')} {each.text(row)}" for each in _METRICS)
    readers, clips_seen = count_noun(row["n_people"], "person", "people"), count_noun(row["n_clips"], "clip")
    return f"{metrics} ({readers}, {clips_seen}, {row['seconds']:.0f} s a clip)"


def _validation_note(rows: pd.DataFrame) -> str:
    if rows.empty:
        return "not validated, people have labelled none of its answers (run traps people annotate)"
    remarks = [
        f"{row['task']} {', '.join(f'{rate.field} {rate.text(row)} %' for rate in _RATES)}"
        for row in rows.to_dict("records")
    ]
    remainder = " (the other task is not validated)" if len(remarks) == 1 else ""
    return f"against people {'; '.join(remarks)}{remainder}"
