"""Tabulate controls of mechanistic claims: baselines, nulls, PECS under gates."""

from __future__ import annotations

from typing import TYPE_CHECKING

from traps_pipeline.protocol.datasets import DATASETS, SHORT
from traps_pipeline.protocol.regimes import PROMPTING
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.inside_columns import (
    DIRECTIONS,
    DRAWS,
    INFERENCE,
    LAYER,
    PATH,
    SIDES,
    best_baselines,
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
        *_extent_beyond_nulls(rows),
        *few_note(table_rows),
    ]
    reason = why_not(results, "the paper has no such nulls")
    return PrintedTable("steering_nulls", "Void directions among their nulls", table_rows, columns, notes, reason)


def _extent_beyond_nulls(rows: pd.DataFrame) -> list[str]:
    """Return where the void direction exceeds at least 95 % of its nulls, in words."""
    targets = rows.loc[rows["target"] != "all"]
    if targets.empty:
        return []
    count = int((20 * targets["n_at_least"] <= targets["draws"]).sum())
    extent = f"in {count} of {len(targets)} rows" if count else "nowhere"
    return [f"the void direction is ahead of 19 of 20 draws {extent}; one row in ten would be so by chance"]


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


def gate(results: Results) -> list[PrintedTable]:
    """Return PECS before and after gates and prompts, by source, threshold, features."""
    return [_gate_sources(results), _prompts(results)]


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


def _gates(results: Results) -> pd.DataFrame:
    """Return gate rows; states, other datasets, mid threshold, all datasets first."""
    rows = results.gate
    first_values = {"features": "states", **DEFAULT_GATE, "target": "all"}
    is_later = {f"{name}_later": rows[name].astype(object) != first for name, first in first_values.items()}
    rows = rows.assign(**is_later).sort_values(["model", "regime", *is_later], kind="stable", ignore_index=True)
    return rows.assign(
        mark=few_marks(rows, "n_controls", "n_voids"),
        layer=rows["layer"].where(rows["layer"] >= 0),  # a mean over datasets has no layer of its own
        dataset=short_names(rows["target"]),
        sources=[SOURCE_NAMES.get(name, name) for name in rows["source"]],
    ).drop(columns=[*is_later])


def _gate_sources(results: Results) -> PrintedTable:
    rows = _gates(results)
    rows = rows.loc[(rows["features"] == "states") & rows["target"].isin([*SHORT, "all"])]
    columns = [
        MODEL, Column("regime", "Answers"), Column("sources", "Gate from"), Column("threshold", "Threshold"),
        Column("dataset", "Target"), LAYER, *_GATED,
    ]  # fmt: skip
    notes = [
        *_GATE_NOTES,
        "mid: half-way between the means of the sides; J: the cut with the largest J on unseen source items; "
        "conformal: at most 5 % of new source controls in expectation, or as the experiment says",
        *joined_notes(rows),
        *few_note(rows),
    ]
    reason = why_not(results, "the paper gates nothing")
    return PrintedTable("gate", "Probe-gated abstention", rows, columns, notes, reason)


def prompts(results: Results) -> pd.DataFrame:
    """Return AbsRec (shares) under standard and guided, by model and dataset.

    Also, for both prompts, the AUROC of the probe (at the dataset's chosen layer, fitted without the scored scenario)
    and of the output margin; those of the best raw input and of noise; n_answered, the fewest voids answered under
    either prompt, n_voids and n_controls of the probe.
    """
    import pandas as pd

    keys = ["model", "dataset"]
    gate_rows = results.gate.loc[results.gate["target"].isin(DATASETS)].rename(columns={"target": "dataset"})
    gate_rows = gate_rows.astype({"regime": object, "dataset": object})
    table = gate_rows.pivot_table(index=keys, columns="regime", values="plain_abs_rec", observed=True)
    table = table.reindex(columns=pd.Index(PROMPTING)).add_prefix("said_")
    table["change"] = table["said_guided"] - table["said_standard"]
    count_columns = {"n_answered": (gate_rows, "n_voids")}
    prompt_probes = [results.prompted_probes.loc[results.prompted_probes["chosen"].eq(True)]]
    prompt_probes += [results.prompted_baselines.loc[results.prompted_baselines["features"] == "output margin"]]
    for name, rows in zip(("probe", "margin"), prompt_probes, strict=True):
        rows = rows.loc[(rows["analysis"] == "held_out") & (rows["source"] == rows["target"])]
        rows = rows.rename(columns={"target": "dataset"}).astype({"prompt": object, "dataset": object})
        by_prompt = rows.pivot_table(index=keys, columns="prompt", values="value", observed=True)
        table = table.join(by_prompt.reindex(columns=pd.Index(PROMPTING)).add_prefix(f"{name}_"))
        if name == "probe":
            count_columns |= {count: (rows, count) for count in ("n_voids", "n_controls")}
    for name, (rows, count) in count_columns.items():
        table[name] = rows.groupby(keys)[count].min().reindex(table.index)
    floor = best_baselines(results, "held_out").reset_index()
    floor = floor.loc[floor["source"] == floor["target"]].rename(columns={"target": "dataset"})
    return table.reset_index().merge(floor[[*keys, "raw", "raw_value", "noise", "noise_spread"]], on=keys, how="left")


def _prompts(results: Results) -> PrintedTable:
    rows = prompts(results)
    rows = rows.assign(
        name=short_names(rows["dataset"]),
        said_mark=few_marks(rows, "n_answered"),
        probe_mark=few_marks(rows, "n_voids", "n_controls"),
    )
    columns = [
        MODEL, Column("name", "Dataset"), Column("said_standard", "AbsRec %, standard", "percent", mark="said_mark"),
        Column("said_guided", "guided", "percent", mark="said_mark"),
        Column("change", "guided − standard", "percent", mark="said_mark"),
        *(Column(f"{kind}_{prompt}", f"{label}, {prompt}", "fraction", mark="probe_mark")
          for kind, label in (("probe", "Probe"), ("margin", "Output margin")) for prompt in PROMPTING),
        Column("raw", "Best raw input"), Column("raw_value", "its AUROC", "fraction"),
        Column("noise", "Noise", "fraction", spread="noise_spread"),
        Column("n_answered", "Voids answered about", "count"), *SIDES,
    ]  # fmt: skip
    notes = [
        "what the prompt changes: the answers (AbsRec), or what is represented (AUROC of voids against controls, "
        "states under the VQA prompt of that name, fitted without the scored scenario); the best raw input and noise "
        "are the same under both prompts",
        "output margin: log-odds that the first answer token begins an abstention; noise: random vectors as wide as "
        "states, mean ± deviation over draws, the floor of the split",
        *few_note(rows, "said_mark", "probe_mark"),
    ]
    reason = why_not(results, "the paper prints no such numbers")
    title = "What the prompt changes, in answers and in states"
    return PrintedTable("prompt_gate", title, rows, columns, notes, reason, deviation=DRAWS)
