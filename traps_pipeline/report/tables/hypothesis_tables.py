"""Tabulate the paper's untested assumptions, dose by dose (docs/hypotheses.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.table_columns import MODEL, REGIME, sort_rows
from traps_pipeline.report.writing import NONE, NOT_RUN, Column, PrintedTable, percent

if TYPE_CHECKING:
    import pandas as pd

    from traps_pipeline.scoring.doses import Hypothesis

WHY_EMPTY = "no variation was run (traps run hypotheses)"
_TITLES = {
    "answer space": "Answers to choose from",
    "occluder": "Look of the occluder",
    "schema": "Form of the answer",
    "frames": "Frames shown",
    "cut": "A cut that leaves the outcome predictable",
}
_HEADINGS = {"acc": "Acc %", "false_abs": "FalseAbs %", "abs_rec": "AbsRec %", "j": "J %"}


def hypotheses(results: Results) -> list[PrintedTable]:
    """Return answers and abstentions by steps of one property, beside shortcut rules."""
    from traps_pipeline.scoring.doses import HYPOTHESES

    return [_hypothesis_table(results.hypotheses, hypothesis) for hypothesis in HYPOTHESES]


def _hypothesis_table(rows: pd.DataFrame, hypothesis: Hypothesis) -> PrintedTable:
    doses = rows.loc[rows["hypothesis"] == hypothesis.name]
    place = {dose.name: k for k, dose in enumerate(hypothesis.doses)}
    doses = doses.assign(place=doses["dose"].map(place))
    rules = {f"{name}_shown": [_rule(row, name) for row in doses.to_dict("records")] for name in ("value", "change")}
    doses = doses.assign(**{f"rule_{name}": values for name, values in rules.items()})
    kind = "J" if hypothesis.metric == "j" else "abstentions"
    columns = [
        MODEL, REGIME, Column("dose", "Dose"), Column("counts_as", "Counts as"),
        Column("n_scenarios", "Scenarios", "count"),
        *[Column(name, heading, "percent", interval=True) for name, heading in _HEADINGS.items()],
        Column("change", f"Change of {kind}", "percent", group=True, interval=True),
        Column("chance", "Guess %", "percent", group=True),
        Column("rule_value_shown", f"Best rule’s {kind} %"), Column("rule_change_shown", "Largest change of a rule"),
    ]  # fmt: skip
    notes = [
        f"change: in points, from “{hypothesis.doses[0].name}”, on the scenarios that both have; brackets: 95 % "
        "interval, Bayesian bootstrap over scenarios with one unseen",
        "rules: occluder-rule, length-rule and wording-rule, each of which reads one cue and understands nothing; what "
        "a rule gets too, a model need not understand anything for; guess: Acc of a guess among the answers offered",
        "no part of PECS or of the arms' metrics",
    ]
    if any(dose.counts_as.startswith("no void") for dose in hypothesis.doses):
        notes.append(
            "through an occluder of these alphas the outcome is seen: FalseAbs is the share that abstains all the same"
        )
    refusals = doses.dropna(subset=["refused"]).to_dict("records")
    notes += [f"{row['model']}, {row['dose']}: not compared, {row['refused']}" for row in refusals]
    rows = sort_rows(doses, ["model", "regime", "place"])
    name = f"hypothesis_{hypothesis.name.replace(' ', '_')}"
    return PrintedTable(name, _TITLES[hypothesis.name], rows, columns, notes if len(doses) else [], WHY_EMPTY)


def _rule(row: Mapping[Any, Any], name: str) -> str:
    """Return a rule's metric with its name, or "not run"."""
    rule, value = row["rule" if name == "value" else "rule_changing"], percent(row[f"rule_{name}"])
    if isinstance(rule, str):
        return f"{value} ({rule.removesuffix('-rule')})"
    is_reference = name == "change" and percent(row["change"]) == NONE
    return NONE if is_reference else NOT_RUN
