"""Tabulate sub-scenarios of both taxonomies (docs/spec.md 2.2 and 5.4)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from traps_pipeline.protocol.datasets import taxonomy_of
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.table_columns import (
    DATASET,
    MISSING,
    PECS,
    SHARE_COLUMNS,
    N,
    epochs,
    mark_notes,
    with_marks,
    with_titles,
)
from traps_pipeline.report.terms import SIDE_OF
from traps_pipeline.report.writing import Column, PrintedTable, SourceItems, Trace
from traps_pipeline.scoring import analyses

if TYPE_CHECKING:
    import pandas as pd


def occlusion_sub_scenarios(results: Results) -> list[PrintedTable]:
    """Return means over models by occlusion sub-scenario, and hidden against others."""
    rows = _sub_rows(results, "occlusion")
    tables = [_sub_table(results, rows, "occlusion_sub_scenarios", "Occlusion sub-scenarios")]
    hidden = analyses.hidden_against_others(rows) if len(rows) else rows
    columns = [
        Column("kind", "Sub-scenarios"), Column("n", "Number", "count"),
        Column("abs_rec", "AbsRec %, standard", "percent"), Column("guided_abs_rec", "AbsRec %, guided", "percent"),
    ]  # fmt: skip
    notes = [epochs(rows), "unweighted means over sub-scenarios", f"hidden: {', '.join(analyses.HIDDEN_SUB_SCENARIOS)}"]
    if results.is_study:
        columns += [N, MISSING]
    title = "Hidden sub-scenarios against the others"
    reason = results.why("sub_scenarios")
    return [
        *tables,
        PrintedTable("hidden_sub_scenarios", title, hidden, columns, notes, reason, _sub_trace("occlusion")),
    ]


def chaotic_sub_scenarios(results: Results) -> list[PrintedTable]:
    """Return means over models by chaotic family, and Acc by the control's answer."""
    rows = _sub_rows(results, "chaotic")
    labels = results.labels
    labels = with_titles(labels.loc[labels["dataset"].map(taxonomy_of) == "chaotic"])
    columns = [
        DATASET, Column("sub_scenario", "Sub-scenario"), Column("label", "Ground truth"),
        Column("acc", "Acc %", "percent"),
    ]  # fmt: skip
    notes = ["mean over models under standard"]
    if results.is_study:
        columns += [N, Column("n_models", "Models", "count"), MISSING]
    reason = results.why("labels")
    title = "Accuracy by ground truth, chaotic"
    return [
        _sub_table(results, rows, "chaotic_sub_scenarios", "Chaotic sub-scenarios"),
        PrintedTable("accuracy_by_label", title, labels, columns, notes, reason, _sub_trace("chaotic")),
    ]


def _sub_rows(results: Results, taxonomy: str) -> pd.DataFrame:
    rows = results.sub_scenarios
    rows = with_marks(rows.loc[rows["dataset"] == taxonomy].assign(incomplete=False))
    return rows.sort_values(["acc", "sub_scenario"], ignore_index=True)


def _sub_table(results: Results, rows: pd.DataFrame, name: str, title: str) -> PrintedTable:
    columns = [
        Column("sub_scenario", "Sub-scenario"), Column("answer_type", "Answer"), N,
        Column("n_models", "Models", "count"), *SHARE_COLUMNS, PECS,
        Column("guided_abs_rec", "AbsRec %, guided", "percent"), Column("guided_pecs", "PECS, guided", "fraction"),
        Column("abs_rec_uplift", "Δ AbsRec, guided", "percent"),
        Column("false_abs_uplift", "Δ FalseAbs, guided", "percent"),
        Column("abs_rec_ill_posed", "AbsRec %, ill-posed", "percent"),
        Column("textual_over_visual", "Textual / visual", "ratio"), MISSING,
    ]  # fmt: skip
    omission_note = "; reference strategies left out where others were asked" if results.is_study else ""
    notes = [epochs(rows), f"means over models{omission_note}", "standard, where no regime is named"]
    count_columns = {"guided": "guided_n_models", "Δ": "uplift_n_models", "ill-posed": "ill_posed_n_models"}
    if any(((rows[name] != rows["n_models"]) & (rows[name] > 0)).any() for name in count_columns.values()):
        columns += [Column(name, f"Models, {words}", "count") for words, name in count_columns.items()]
    notes += mark_notes(rows)
    taxonomy = "occlusion" if name.startswith("occlusion") else "chaotic"
    return PrintedTable(name, title, rows, columns, notes, results.why("sub_scenarios"), _sub_trace(taxonomy))


def _sub_trace(taxonomy: str) -> Trace:
    def trace(row: Mapping[str, Any], field: str) -> SourceItems:
        if field in ("n_pairs", "n_models", "n", "n_missing"):
            return SourceItems(taxonomy)
        regime = "guided" if field.startswith("guided_") else "standard"
        ill_posed = field == "abs_rec_ill_posed"
        dataset = str(row.get("dataset") or taxonomy)
        return SourceItems(f"{taxonomy}_ill_posed" if ill_posed else dataset, "", regime, SIDE_OF.get(field, ""))

    return trace
