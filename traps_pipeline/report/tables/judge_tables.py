"""Tabulate judges' agreement, bias and confabulation (docs/spec.md 4.4 and 6)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.table_columns import (
    DATASET,
    MISSING,
    MODEL,
    REGIME,
    RUNS,
    N,
    cell_trace,
    epochs,
    sort_rows,
    with_titles,
)
from traps_pipeline.report.writing import Column, PrintedTable, SourceItems, Trace

if TYPE_CHECKING:
    import pandas as pd


def agreement(results: Results) -> list[PrintedTable]:
    """Return panel agreement by dataset and task, and the lowest between two judges."""
    rows = results.agreement
    pairs = rows.loc[rows["judges"] != "panel"].groupby(["dataset", "task"])["agreement"].min().rename("lowest_pair")
    rows = rows.loc[rows["judges"] == "panel"].merge(pairs.reset_index(), on=["dataset", "task"], how="left")
    rows = sort_rows(with_titles(rows), ["dataset", "task"])
    columns = [
        DATASET, Column("task", "Task"), Column("agreement", "Unanimous %", "percent"),
        Column("fleiss_kappa", "Fleiss’ κ", "fraction"), Column("alpha", "Krippendorff’s α", "fraction"),
        Column("lowest_pair", "Lowest pair %", "percent"), Column("prevalence", "Yes %", "percent"),
        Column("invalid", "Invalid %", "percent", 2), Column("n_items", "n", "count"),
        Column("n_undecided", "Undecided", "count"),
    ]  # fmt: skip
    notes = [epochs(rows), *_undefined_reasons(rows), "unanimous and κ over answers with three valid votes"]
    reason = results.why("agreement")
    return [PrintedTable("judge_agreement", "Agreement of the judges", rows, columns, notes, reason, _task_trace)]


def _task_trace(row: Mapping[str, Any], field: str) -> SourceItems:
    return SourceItems(row["dataset"], "", "", "void" if row["task"] == "void_abstention" else "control")


def _undefined_reasons(rows: pd.DataFrame) -> list[str]:
    reasons = [str(reason) for reason in rows["undefined"].dropna().unique()]
    return [f"undefined: {'; '.join(sorted(reasons))}"] if reasons else []


def judge_bias(results: Results) -> list[PrintedTable]:
    """Return the bias of every judge against the panel, and PECS without that judge."""
    bias = sort_rows(with_titles(results.bias), ["dataset", "task", "judge"])
    columns = [
        DATASET, Column("task", "Task"), Column("judge", "Judge"), Column("yes", "Yes %", "percent"),
        Column("panel_yes", "Panel’s yes %", "percent"), Column("bias", "Bias, points", "percent"),
        Column("dissent_yes", "Yes against it %", "percent", 2), Column("dissent_no", "No against it %", "percent", 2),
        Column("n_votes", "Votes", "count"), Column("n_invalid", "Invalid", "count"),
    ]  # fmt: skip
    leave_one_out = results.leave_one_out
    leave_one_out = (
        leave_one_out.loc[leave_one_out["dataset"] == "overall"]
        if "overall" in set(leave_one_out["dataset"])
        else leave_one_out
    )
    leave_one_out = sort_rows(with_titles(leave_one_out), ["model", "regime", "without"])
    leave_one_out_columns = [
        MODEL, REGIME, DATASET, Column("without", "Without"),
        Column("pecs", "PECS of two", "fraction"), Column("pecs_panel", "PECS of three", "fraction"),
        Column("difference", "Difference", "fraction"), N, RUNS, MISSING,
    ]  # fmt: skip
    notes = ["two judges: one against one is undecided and counts as missing", epochs(leave_one_out)]
    reason = results.why("bias")
    return [
        PrintedTable("judge_bias", "Each judge against the panel", bias, columns, [epochs(bias)], reason, _task_trace),
        PrintedTable(
            "leave_one_judge_out",
            "PECS without one judge",
            leave_one_out,
            leave_one_out_columns,
            notes,
            reason,
            cell_trace,
        ),
    ]


def validation(results: Results) -> list[PrintedTable]:
    """Return the confabulation judge against human labels."""
    rows = results.validation
    columns = [
        Column("axis", "Axis"), Column("accuracy", "Accuracy %", "percent"),
        Column("precision", "Precision", "fraction", 2), Column("recall", "Recall", "fraction", 2),
        Column("f1", "F1", "fraction", 2), Column("human_agreement", "Annotators agree %", "percent"),
        Column("human_kappa", "Cohen’s κ", "fraction", 2), Column("kappa_note", "κ note"),
        Column("n_failures", "Failures", "count"), Column("n_labels", "Labels", "count"),
    ]  # fmt: skip
    notes = ["labels of both annotators side by side, no consensus"] + ([] if results.is_study else ["epoch original"])
    reason = "no label files of annotators (`traps people validate`)" if results.is_study else ""
    return [
        PrintedTable(
            "judge_validation",
            "The confabulation judge against annotators",
            rows,
            columns,
            notes,
            reason,
            lambda row, field: SourceItems("", "", "standard", "void"),
            dash="undefined",
        )
    ]


def confabulation(results: Results) -> list[PrintedTable]:
    """Return how often each axis of confabulation applies to a model's void failures."""
    rows = results.confabulation
    names = {"hp": "HP %", "ii": "II %", "hp_and_ii": "HP and II %", "es": "ES %", "doubt": "Doubt %"}
    columns = [MODEL, Column("n", "n", "count"), *(Column(field, text, "percent", 0) for field, text in names.items())]
    notes = [
        epochs(rows.assign(dataset=rows["model"])),
        "void failures of run 1 under standard; HP hallucinated premise, II invalid inference, ES epistemic surrender",
    ]
    if results.is_study:
        columns += [Column("n_sampled", "Sampled", "count"), Column("evidence", "Evidence"), Column("judge", "Judge")]
    reason = "no judge of confabulation is configured for this study’s panel" if results.is_study else ""
    trace: Trace = lambda row, field: SourceItems("", row["model"], "standard", "void")  # noqa: E731
    return [PrintedTable("confabulation", "Confabulation: prevalence by model", rows, columns, notes, reason, trace)]
