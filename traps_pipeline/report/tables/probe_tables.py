"""Tabulate probes (docs/spec.md 7): transfer, Cf->Cf, within a dataset, layers."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from traps_pipeline.mechanism.transfer_paths import TRANSFER_PAIRS, path_name
from traps_pipeline.protocol.datasets import transfer_type
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.inside_columns import (
    BASELINE_NOTES,
    DRAWS,
    KEYS,
    LAYER,
    PATH,
    SIDES,
    TYPE,
    baseline_columns,
    baseline_notes,
    best_baselines,
    few_marks,
    few_note,
    interval,
    short_names,
    why_not,
)
from traps_pipeline.report.tables.table_columns import MODEL
from traps_pipeline.report.writing import Column, PrintedTable

if TYPE_CHECKING:
    import pandas as pd


def probes(results: Results) -> list[PrintedTable]:
    """Return probes between datasets at best and chosen layers, Cf->Cf, and means."""
    pairs = _pairs(results)
    tables = [
        _transfer(results, pairs),
        _confabulated_table(results, pairs),
        _means(results, pairs),
        _within_table(results),
    ]
    return [*tables, _catch(results)]


WHY_UNSHARED = "not computed; held out: these datasets share no controls and no scenarios"

# --- transfer ---------------------------------------------------------------------------------------------------------


class RowRule(NamedTuple):
    """A rule that selects a pair's row of PROBES, and its columns.

    The row is of an analysis, at the layer with a flag.
    """

    analysis: str
    flag: str
    columns: tuple[str, ...] = ("value",)


_LAYER_AND_VALUE = ("layer", "value", "low", "high")
# The metrics of a pair of datasets, by the prefix of their columns in `best_layers`.
PAIR_METRICS = {
    "best": RowRule("transfer", "own_best", (*_LAYER_AND_VALUE, "n_voids", "n_controls")),
    "chosen": RowRule("transfer", "chosen", _LAYER_AND_VALUE),
    "held_out": RowRule("held_out", "all_sample_best"),
    "cf": RowRule("confabulated", "all_sample_best", (*_LAYER_AND_VALUE, "n_voids", "n_controls")),
    "cf_own": RowRule("confabulated", "own_best", ("layer", "value")),
    "cf_held_out": RowRule("confabulated_held_out", "all_sample_best"),
}
# The analyses whose baselines stand beside a pair's metrics, by the prefix of their columns.
BASELINES = {"": "transfer", "cf_": "confabulated", "held_": "held_out", "cf_held_": "confabulated_held_out"}


def best_layers(rows: pd.DataFrame) -> pd.DataFrame:
    """Return PAIR_METRICS by model and pair: best, chosen layers, and Cf->Cf at both."""
    import pandas as pd

    def by_pair(analysis: str, chosen: Any) -> dict[tuple[str, ...], dict[str, Any]]:
        layer_rows = rows.loc[(rows["analysis"] == analysis) & chosen].drop_duplicates(KEYS)
        return {tuple(row[key] for key in KEYS): row for row in layer_rows.to_dict("records")}  # pyright: ignore[reportReturnType]

    transfers = by_pair("transfer", rows["model"].notna())
    is_known = rows["value"].notna()
    metrics = {name: by_pair(rule.analysis, rows[rule.flag].eq(True) & is_known) for name, rule in PAIR_METRICS.items()}
    notes = [by_pair(name, rows["note"].notna()) for name in ("confabulated", "confabulated_held_out")]
    table = [
        dict(zip(KEYS, key, strict=True))
        | {"path": path_name(*key[1:]), "transfer_type": transfer_type(*key[1:])}
        | {
            f"{name}_{c}": metrics[name].get(key, {}).get(c, np.nan)
            for name, rule in PAIR_METRICS.items()
            for c in rule.columns
        }
        | {"note": next((notes_of[key]["note"] for notes_of in notes if key in notes_of), "")}
        for model in rows["model"].unique()
        for key in ((str(model), *pair) for pair in TRANSFER_PAIRS)
        if key in transfers
    ]
    return pd.DataFrame(table)


def _pairs(results: Results) -> pd.DataFrame:
    """Return `best_layers` with BASELINES beside its metrics, and marks."""
    rows = best_layers(results.probes)
    if not len(rows):
        return rows
    for prefix, analysis in BASELINES.items():
        rows = rows.join(best_baselines(results, analysis).add_prefix(prefix), on=KEYS)
    return _with_marks(rows)


def _with_marks(rows: pd.DataFrame) -> pd.DataFrame:
    cf = few_marks(rows, "cf_n_voids", "cf_n_controls")
    return rows.assign(mark=few_marks(rows, "best_n_voids", "best_n_controls"), cf_mark=cf)


def _transfer(results: Results, rows: pd.DataFrame) -> PrintedTable:
    cf = [
        Column("cf_value", "Cf→Cf", "fraction"), Column("cf_own_layer", "Cf’s own layer", "count"),
        Column("cf_own_value", "Cf→Cf there", "fraction"),
    ]  # fmt: skip
    columns = [
        MODEL, PATH, TYPE, Column("best_layer", "Best layer", "count"),
        Column("best_value", "AUROC", "fraction", mark="mark"), *interval("best_"),
        Column("chosen_layer", "Chosen layer", "count"), Column("chosen_value", "AUROC there", "fraction"),
        *_held_out_columns(results), *baseline_columns(results), *([] if results.is_study else cf),
        Column("best_n_voids", "Voids", "count"), Column("best_n_controls", "Controls", "count"),
    ]  # fmt: skip
    notes = [
        "best layer: the highest AUROC on the target itself, as in the paper; chosen layer: where the other datasets’ "
        "probes carry over best to each other, which uses no pair of the target",
        *_shared_controls(results),
        "from, to: 95 % interval from resampled scenarios of the target, with the probe held fixed",
        *baseline_notes(results),
        *few_note(rows),
    ]
    title = "Probe transfer: AUROC by ordered pair"
    return PrintedTable(
        "probe_transfer", title, rows, columns, notes, why_not(results), dash=WHY_UNSHARED, deviation=DRAWS
    )


def _confabulated_table(results: Results, pairs: pd.DataFrame) -> PrintedTable:
    rows = pairs.loc[pairs["cf_value"].notna()].reset_index(drop=True) if len(pairs) else pairs
    gap_notes = sorted({note for note in pairs["note"] if note}) if len(pairs) else []
    columns = [
        MODEL, PATH, TYPE, Column("cf_layer", "Best layer", "count"),
        Column("cf_value", "Cf→Cf", "fraction", mark="cf_mark"), *interval("cf_"), *_held_out_columns(results, "cf_"),
        Column("cf_own_layer", "Cf’s own layer", "count"), Column("cf_own_value", "Cf→Cf there", "fraction"),
        *baseline_columns(results, "cf_"), Column("cf_n_voids", "Cf voids", "count"),
        Column("cf_n_controls", "Controls", "count"),
    ]  # fmt: skip
    notes = [
        "source and target have only the voids on which the model confabulated under standard in run 1, each with its "
        "control; best layer: that of all samples",
        *_shared_controls(results),
        *gap_notes,
        *baseline_notes(results),
        *few_note(rows, "cf_mark"),
    ]
    reason = why_not(results, "the paper has these numbers in its table of probe transfer")
    if results.is_study and len(results.probes):
        reason = "; ".join(gap_notes) or reason
    title = "Probes on confabulated voids (Cf→Cf)"
    rows = rows if results.is_study else rows.head(0)
    return PrintedTable("probe_confabulated", title, rows, columns, notes, reason, dash=WHY_UNSHARED, deviation=DRAWS)


def _means(results: Results, rows: pd.DataFrame) -> PrintedTable:
    if len(rows):
        baseline_names = [f"{prefix}{name}" for prefix in ("", "cf_") for name in ("raw_value", "margin", "noise")]
        metrics = [*(f"{name}_value" for name in PAIR_METRICS), *baseline_names, "held_noise", "cf_held_noise"]
        sides = ("best_n_voids", "best_n_controls", "cf_n_voids", "cf_n_controls")
        by = (
            dict[str, Any].fromkeys(metrics, "mean")
            | {"raw": _names_by_frequency, "cf_raw": _names_by_frequency}
            | dict.fromkeys(sides, "min")
        )
        groups = rows.groupby(["model", "transfer_type"], sort=False)
        rows = _with_marks(groups.agg(by).assign(n_paths=groups.size()).reset_index())
    columns = [
        MODEL, TYPE, Column("best_value", "AUROC", "fraction", mark="mark"),
        Column("chosen_value", "Chosen layer", "fraction", mark="mark"),
        *_held_out_columns(results), *baseline_columns(results),
        Column("cf_value", "Cf→Cf", "fraction", mark="cf_mark"),
        Column("cf_own_value", "Cf→Cf, own layer", "fraction", mark="cf_mark"),
        *_held_out_columns(results, "cf_", "Cf→Cf: "),
        *baseline_columns(results, "cf_", "Cf→Cf: "), Column("n_paths", "Paths", "count"),
    ]  # fmt: skip
    notes = [*_shared_controls(results), *baseline_notes(results), *few_note(rows, "mark", "cf_mark")]
    if results.is_study:
        columns += [
            Column("best_n_voids", "Fewest voids", "count"), Column("best_n_controls", "Fewest controls", "count"),
            Column("cf_n_voids", "Fewest Cf voids", "count"),
        ]  # fmt: skip
        notes.append("best raw inputs are the best of each path, and their AUROC is the mean over these")
    title = "Probe transfer: means over paths"
    return PrintedTable(
        "probe_means", title, rows, columns, notes, why_not(results), dash=WHY_UNSHARED, deviation=DRAWS
    )


def _names_by_frequency(names: pd.Series) -> str:
    """Return the names, each once, the most frequent first."""
    return ", ".join(name for name, _ in Counter(str(name) for name in names if name).most_common())


def _held_out_columns(results: Results, prefix: str = "", head: str = "") -> list[Column]:
    """Return columns of the held-out score and of the noise floor under its split."""
    if not results.is_study:
        return []
    noise, spread = f"{prefix}held_noise", f"{prefix}held_noise_spread"
    return [
        Column(f"{prefix}held_out_value", f"{head}Held out", "fraction"),
        Column(noise, f"{head}Noise, held out", "fraction", spread=spread),
    ]


def _shared_controls(results: Results) -> list[str]:
    """Return notes on cross-modality pairs, which share their controls."""
    notes = [
        "cross-modality: both datasets have the same control items, so half of the target’s rows were used in the fit"
    ]
    note = "held out: at the best layer, fitted without the scored scenario, beside the floor of noise under that split"
    return notes + [note] * results.is_study


# --- within a dataset, layers, centroids ------------------------------------------------------------------------------


def _within_table(results: Results) -> PrintedTable:
    rows = results.probes
    shuffled_means = rows.loc[rows["analysis"] == "shuffled"].groupby(["model", "source"], sort=False, dropna=False)
    table = shuffled_means.agg(shuffled=("value", "mean"), spread=("spread", "mean")).reset_index()
    best = rows.loc[(rows["analysis"] == "within") & rows["own_best"], ["model", "source", "layer", "value"]]
    table = table.merge(best, on=["model", "source"], how="left")
    own_rows = rows.loc[(rows["analysis"] == "held_out") & (rows["source"] == rows["target"]) & rows["chosen"]]
    own_rows = own_rows[["model", "source", "target", "value", "low", "high", "n_voids", "n_controls"]]
    table = table.merge(own_rows.rename(columns={"value": "pooled"}), on=["model", "source"], how="left")
    table = table.join(best_baselines(results, "held_out"), on=KEYS)
    table = table.assign(dataset=short_names(table["source"]), mark=few_marks(table, "n_voids", "n_controls"))
    columns = [
        MODEL, Column("dataset", "Dataset"), Column("layer", "Best layer", "count"),
        Column("value", "AUROC", "fraction", mark="mark"),
        Column("shuffled", "Shuffled labels", "fraction", spread="spread"),
    ]  # fmt: skip
    notes = ["cross-validated, folds by scenario; shuffled: mean over shuffles and layers ± deviation over shuffles"]
    if results.is_study:
        columns += [
            Column("pooled", "Over all folds", "fraction"), *interval(), *baseline_columns(results), *SIDES,
        ]  # fmt: skip
        notes += [
            "AUROC: mean over folds; over all folds: of the scores of all folds together, with its 95 % interval from "
            "resampled scenarios; baselines are to be compared with it",
            *BASELINE_NOTES,
        ]
    notes += few_note(table)
    title, spread_note = (
        "Probes within a dataset",
        "± standard deviation over shuffles of labels, or over draws of noise",
    )
    return PrintedTable("probe_within", title, table, columns, notes, why_not(results), deviation=spread_note)


def _catch(results: Results) -> PrintedTable:
    rows = _centroids(results.probes)
    keys = ["model", "layer", "target", "sub_scenario"]
    voids = rows.loc[rows["analysis"] == "centroid_void"].groupby(keys, sort=False)
    table = voids.agg(rate=("value", "mean"), lowest=("value", "min"), highest=("value", "max"), n=("n_voids", "max"))
    controls = rows.loc[rows["analysis"] == "centroid_control"].groupby(keys, sort=False)
    alarms = controls.agg(false_alarm=("value", "mean"), n_controls=("n_controls", "max"))
    table = table.join(alarms).reset_index()
    table = table.assign(dataset=short_names(table["target"]), mark=few_marks(table, "n", "n_controls"))
    columns = [
        MODEL, Column("dataset", "Target"), Column("sub_scenario", "Sub-scenario"), LAYER,
        Column("rate", "Catch rate %", "percent", mark="mark"), Column("lowest", "lowest", "percent"),
        Column("highest", "highest", "percent"), Column("false_alarm", "Controls %", "percent"),
        Column("n", "n", "count"),
    ]  # fmt: skip
    notes = ["voids that the source’s nearest centroid assigns to void, mean over the other datasets as sources"]
    if results.is_study:
        notes += [
            "one source of each target is the other dataset of its taxonomy, which has the same controls: these shares "
            "of controls are too low",
        ]
    notes += few_note(table)
    return PrintedTable("probe_catch_rates", "Nearest centroid: catch rates", table, columns, notes, why_not(results))


def _centroids(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows of nearest centroids by sub-scenario, with the column sub_scenario."""
    rows = rows.loc[rows["analysis"].isin(["centroid_void", "centroid_control"]) & (rows["scope"] != "all")]
    names = rows["scope"].astype(object).str.removeprefix("sub_scenario:")
    return rows.assign(sub_scenario=names, target=rows["target"].astype(object).fillna(""))
