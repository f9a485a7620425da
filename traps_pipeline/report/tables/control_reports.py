"""Tabulate controls of mechanistic claims: baselines, nulls, PECS under gates."""

from __future__ import annotations

from typing import TYPE_CHECKING

from traps_pipeline.mechanism.control_rows import LOGITS, RESIDUAL, STATES
from traps_pipeline.protocol.datasets import DATASETS, SHORT
from traps_pipeline.protocol.regimes import PROMPTING
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.inside_columns import (
    DIRECTIONS,
    INFERENCE,
    LAYER,
    PATH,
    SIDES,
    few_marks,
    few_note,
    interval,
    joined_notes,
    path_names,
    short_names,
    why_not,
)
from traps_pipeline.report.tables.table_columns import MODEL
from traps_pipeline.report.writing import Column, PrintedTable

if TYPE_CHECKING:
    import pandas as pd

DOSE = Column("step", "Dose")
SIGNS = {"label": "+ controls, − voids", "plus": "+ everywhere", "minus": "− everywhere"}


# --- steering ---------------------------------------------------------------------------------------------------------


def steering_nulls(results: Results) -> list[PrintedTable]:
    """Return void directions on their own datasets among nulls, then steered PECS."""
    return [_nulls(results), _pecs(results)]


def _dose(rows: pd.DataFrame) -> list[str]:
    words = {"alpha": "α {:g}", "gap": "{:g} gap"}
    return [words[unit].format(dose) if dose else "none" for unit, dose in zip(rows["unit"], rows["dose"], strict=True)]


def _nulls(results: Results) -> PrintedTable:
    rows = results.nulls
    table_rows = rows.assign(step=_dose(rows), dataset=short_names(rows["target"]), mark=few_marks(rows, "n"))
    columns = [
        MODEL, DIRECTIONS, INFERENCE, Column("dataset", "Dataset"), LAYER, DOSE, Column("side", "Side"),
        Column("null", "Null"), Column("effect", "Effect, points", "percent", mark="mark"),
        Column("null_mean", "Null, mean", "percent"), Column("null_lowest", "lowest", "percent"),
        Column("null_highest", "highest", "percent"), Column("draws", "Draws", "count"),
        Column("n_at_least", "Draws at least as large", "count"), Column("p", "p", "p", 3), Column("n", "n", "count"),
    ]  # fmt: skip
    notes = [
        "effect: more abstention on controls (+), less on voids (−), against the unsteered answers of the same items",
        "nulls are orthogonal to the void direction and have its length; p = (1 + draws at least as large) / "
        "(1 + draws), one-sided, not corrected for the number of rows",
        *few_note(table_rows),
    ]
    reason = why_not(results, "the paper has no such nulls")
    return PrintedTable("steering_nulls", "Void directions among their nulls", table_rows, columns, notes, reason)


MODEL_OF = ("model", "directions", "regime")


def _pecs(results: Results) -> PrintedTable:
    import pandas as pd

    rows = results.steering_pecs
    rows = rows.loc[rows["source"] == rows["target"]]
    is_unsteered = rows["dose"] == 0  # once per path: the unsteered model is the same in every unit and under all signs
    table_rows = pd.concat(
        [rows.loc[is_unsteered].drop_duplicates([*MODEL_OF, "source", "target"]), rows.loc[~is_unsteered]]
    )
    rows = table_rows.sort_values([*MODEL_OF, "source"], kind="stable", ignore_index=True)
    table_rows = rows.assign(
        step=_dose(rows),
        policy=[SIGNS[name] if dose else "not steered" for name, dose in zip(rows["signs"], rows["dose"], strict=True)],
        path=path_names(rows),
        mark=few_marks(rows, "n_controls", "n_voids"),
    )
    columns = [
        MODEL, DIRECTIONS, INFERENCE, PATH, LAYER, Column("policy", "Signs"), DOSE,
        Column("acc", "Acc %", "percent"), Column("false_abs", "FalseAbs %", "percent"),
        Column("abs_rec", "AbsRec %", "percent"), Column("j", "J", "fraction"),
        Column("pecs", "PECS", "fraction", mark="mark"), Column("degenerate", "Degenerate %", "percent"),
        Column("n_controls", "Controls", "count"), Column("n_voids", "Voids", "count"),
    ]  # fmt: skip
    notes = [
        "each dataset along its own direction; + on controls and − on voids needs the side of each item, which nobody "
        "has who uses a model",
        "degenerate: cut off, a phrase four times in a row, or another script or language than the unsteered answer",
        *few_note(table_rows),
    ]
    reason = why_not(results, "the paper prints no correctness of steered answers")
    return PrintedTable("steering_pecs", "PECS of the steered model", table_rows, columns, notes, reason)


# --- the gate ---------------------------------------------------------------------------------------------------------

DEFAULT_GATE = {"source": "other datasets", "threshold": "mid"}
SOURCE_NAMES = {f"one:{name}": short for name, short in SHORT.items()}


_GATED = (
    Column("plain_pecs", "PECS, plain", "fraction"), Column("pecs", "PECS, gated", "fraction", mark="mark"),
    *interval("pecs_"),
    Column("acc", "Acc %", "percent"), Column("abs_rec", "AbsRec %", "percent"),
    Column("false_abs", "FalseAbs %", "percent"), Column("expected_false_abs", "expected %", "percent"), *SIDES,
)  # fmt: skip
_GATE_NOTES = (
    "a gated answer becomes an abstention and every other answer keeps its verdict; no gate has seen the scenario that "
    "it decides about",
    "expected: share of the sources’ own unseen controls above the threshold; the difference from FalseAbs of answers "
    "that do not abstain by themselves is the shift of calibration",
)


def gate(results: Results) -> list[PrintedTable]:
    """Return PECS before and after gates by source and threshold on states, and of all features by the default gate."""
    rows = results.gate
    first_values = {"features": STATES, **DEFAULT_GATE, "target": "all"}
    is_later = {f"{name}_later": rows[name].astype(object) != first for name, first in first_values.items()}
    rows = rows.assign(**is_later).sort_values(["model", "regime", *is_later], kind="stable", ignore_index=True)
    is_default = ~rows[[f"{name}_later" for name in first_values if name != "features"]].any(axis=1)
    rows = rows.loc[is_default | (rows["features"] == STATES) & rows["target"].isin([*SHORT, "all"])]
    rows = rows.assign(
        mark=few_marks(rows, "n_controls", "n_voids"),
        layer=rows["layer"].where(rows["layer"] >= 0),  # a mean over datasets has no layer of its own
        dataset=short_names(rows["target"]),
        sources=[SOURCE_NAMES.get(name, name) for name in rows["source"]],
    ).drop(columns=[*is_later])
    columns = [
        MODEL, Column("regime", "Answers"), Column("features", "Gate on"), Column("sources", "Gate from"),
        Column("threshold", "Threshold"), Column("dataset", "Target"), LAYER, *_GATED,
    ]  # fmt: skip
    notes = [
        *_GATE_NOTES,
        "mid: half-way between the means of the sides; J: the cut with the largest J on unseen source items; "
        "conformal: at most 5 % of new source controls in expectation, or as the experiment says",
        *joined_notes(rows),
        *few_note(rows),
    ]
    reason = why_not(results, "the paper gates nothing")
    return [PrintedTable("gate", "Probe-gated abstention", rows, columns, notes, reason)]


def prompts(results: Results) -> pd.DataFrame:
    """Return what a prompt changes by model and dataset: `change`, AbsRec (shares) under guided less standard.

    Also, under both prompts, the AUROC of the probe (at the dataset's chosen layer, fitted without the scored scenario)
    and of the output margin.
    """
    import pandas as pd

    keys = ["model", "dataset"]
    gate_rows = results.gate.loc[results.gate["target"].isin(DATASETS)].rename(columns={"target": "dataset"})
    gate_rows = gate_rows.astype({"regime": object, "dataset": object})
    shares = gate_rows.pivot_table(index=keys, columns="regime", values="plain_abs_rec", observed=True)
    shares = shares.reindex(columns=pd.Index(PROMPTING))
    table = (shares["guided"] - shares["standard"]).to_frame("change")
    probes = results.prompted_probes.loc[results.prompted_probes["chosen"].eq(True)]
    probes = probes.loc[(probes["analysis"] == "held_out") & (probes["source"] == probes["target"])]
    probes = probes.rename(columns={"target": "dataset", "value": "auroc"})
    margins = results.lens.loc[results.lens["layer"] == results.lens.groupby("model")["layer"].transform("max")]
    for name, rows in (("probe", probes), ("margin", margins)):
        rows = rows.astype({"prompt": object, "dataset": object, "auroc": float})
        by_prompt = rows.pivot_table(index=keys, columns="prompt", values="auroc", observed=True)
        table = table.join(by_prompt.reindex(columns=pd.Index(PROMPTING)).add_prefix(f"{name}_"))
    return table.reset_index()


# --- rivals -----------------------------------------------------------------------------------------------------------

OTHER_GATES = ("question words", "first frame", "all frames", "length", "time stamps", "output margin", LOGITS)


def lead_rows(results: Results) -> pd.DataFrame:
    """Return a frame with a row by model, subject and target, with the AUROC of each kind of features."""
    rows, keys = results.leads, ["model", "subject", "target"]
    rows = rows.astype(dict.fromkeys((*keys, "features"), object))
    own = rows.loc[rows["features"] == STATES, [*keys, "layer", "low", "high", "rival", "lead", "lead_low", "lead_high",
                                                "n_voids", "n_controls"]]  # fmt: skip
    areas = rows.pivot_table(index=keys, columns="features", values="auroc", observed=True).reset_index()
    return own.merge(areas, on=keys, how="left")


def leads(results: Results) -> PrintedTable:
    """Return the table of how well states and rivals tell each dataset's voids, in the model and its controls."""
    rows = lead_rows(results)
    rows = rows.assign(dataset=short_names(rows["target"]))
    rivals = [name for name in OTHER_GATES if name in rows]
    columns = [
        MODEL, Column("subject", "Subject"), Column("dataset", "Target"), Column("layer", "Layer", "count"),
        Column(STATES, "States", "fraction"), Column("low", "from", "fraction"), Column("high", "to", "fraction"),
        *(Column(name, name.capitalize(), "fraction") for name in (RESIDUAL, *rivals) if name in rows),
        Column("rival", "Best rival"), Column("lead", "Lead", "fraction"), Column("lead_low", "from", "fraction"),
        Column("lead_high", "to", "fraction"), Column("n_voids", "Voids", "count"),
        Column("n_controls", "Controls", "count"),
    ]  # fmt: skip
    notes = ["AUROC of voids against controls, by probes of the other datasets that have not seen the scenario"]
    reason = why_not(results, "the paper has no such rivals")
    return PrintedTable(
        "leads", "States and their rivals, in the model and in its controls", rows, columns, notes, reason
    )
