"""Tabulate controls of mechanistic claims: baselines, nulls, PECS under gates."""

from __future__ import annotations

from typing import TYPE_CHECKING

from traps_pipeline.mechanism.transfer_paths import probed_taxonomy
from traps_pipeline.protocol.datasets import DATASETS, SHORT, taxonomy_of
from traps_pipeline.protocol.regimes import PROMPTING
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.inside_columns import (
    DIRECTIONS,
    DRAWS,
    INFERENCE,
    LAYER,
    PATH,
    PROBE_KEY,
    SHORTCUTS,
    SIDES,
    best_baselines,
    by_features,
    few_marks,
    few_note,
    interval,
    path_names,
    short_names,
    why,
)
from traps_pipeline.report.tables.table_columns import MODEL
from traps_pipeline.report.writing import Column, PrintedTable

if TYPE_CHECKING:
    import pandas as pd

DOSE = Column("step", "Dose")
SIGNS = {"label": "+ controls, − voids", "plus": "+ everywhere", "minus": "− everywhere"}


# --- probes and their baselines ---------------------------------------------------------------------------------------

SOURCE_WORDS = {
    "occlusion_answerable": "void clip, answerable question",
    "decoy": "decoy: an occluder that hides nothing",
    "removed": "the void’s own occluder, gone before the end",
    "length_matched": "whole clip as short as a void",
    "chaotic_time_swapped": "frame times of the other side",
}


def probe_baselines(results: Results) -> list[PrintedTable]:
    """Return the probe beside raw inputs, margin and noise; also on look-alikes."""
    return [_baseline_table(results), _look_alikes(results)]


def beside(results: Results) -> pd.DataFrame:
    """Return the probe's score and each baseline, by model and pair of datasets.

    Pairs include a dataset on itself. The figure is at the target's chosen layer, with its interval. Within a taxonomy
    all are fitted without the scored scenario (`held_out`), otherwise on all of the source (`transfer`).
    """
    import pandas as pd

    target_layers = pd.DataFrame(
        [(s, t, "held_out" if taxonomy_of(s) == taxonomy_of(t) else "transfer") for s in DATASETS for t in DATASETS],
        columns=pd.Index(["source", "target", "analysis"]),
    )
    probe = results.probes.loc[results.probes["chosen"].eq(True)]
    return _with_baselines(results, probe.merge(target_layers, on=["source", "target", "analysis"]))


def look_alikes(results: Results) -> pd.DataFrame:
    """Return `beside` for look-alikes of voids, by probes of their own taxonomy."""
    probe = results.probes.loc[results.probes["chosen"].eq(True) & results.probes["target"].isin([*SOURCE_WORDS])]
    is_own_taxonomy = [
        taxonomy_of(s) == probed_taxonomy(t) for s, t in zip(probe["source"], probe["target"], strict=True)
    ]
    return _with_baselines(results, probe.loc[is_own_taxonomy])


def _with_baselines(results: Results, probe: pd.DataFrame) -> pd.DataFrame:
    probe = (probe if len(results.baselines) else probe.head(0)).astype({"prompt": object})
    states = probe[[*PROBE_KEY, "layer", "value", "low", "high", "n_voids", "n_controls"]]
    table = states.merge(by_features(results), on=PROBE_KEY, how="left")
    return table.assign(mark=few_marks(table, "n_voids", "n_controls"))


_PROBE = (LAYER, Column("value", "States", "fraction", mark="mark"), *interval())
_BASELINES = (
    *(Column(name, name.capitalize(), "fraction") for name in SHORTCUTS),
    Column("output margin", "Output margin", "fraction"),
    Column("noise", "Noise", "fraction", spread="noise_spread"),
)
_NOTES = (
    "AUROC of the same protocol on other features than states; the layer is chosen on pairs of other datasets than "
    "the target (probe_layers)",
    "output margin: log-odds that the first answer token begins an abstention; noise: random vectors as wide as "
    "states, mean ± deviation over draws, the floor of the split",
    "a probe shows understanding only as far as it is above the raw inputs, and a gap between states and output only "
    "as far as it is above the output margin",
)


def _baseline_table(results: Results) -> PrintedTable:
    rows = beside(results)
    rows = rows.assign(path=path_names(rows))
    columns = [MODEL, PATH, *_PROBE, *_BASELINES, *SIDES]
    notes = [
        *_NOTES,
        "pairs within a taxonomy and a dataset on itself: fitted without the scored scenario, controls included",
        *few_note(rows),
    ]
    reason = why(results, "the paper has no such baselines")
    title = "Probes beside their baselines"
    return PrintedTable("probe_baselines", title, rows, columns, notes, reason, deviation=DRAWS)


def _look_alikes(results: Results) -> PrintedTable:
    rows = look_alikes(results)
    table_rows = rows.assign(
        what=[SOURCE_WORDS[name] for name in rows["target"]],
        against=[OPPOSITES[name] for name in rows["analysis"]],
        path=short_names(rows["source"]),
    )
    columns = [
        MODEL, Column("what", "Items"), Column("against", "Told apart from"), Column("path", "Source"), *_PROBE,
        *_BASELINES, *SIDES,
    ]  # fmt: skip
    notes = [
        *_NOTES[:2],
        "told apart from voids: 1 for a probe that detects what cannot be known, 0.5 for one that detects what both "
        "have; from controls: the reverse",
        "frame times of the other side: 1 for a probe that reads the frames, 0 for one that reads the time stamps",
        *few_note(rows),
    ]
    reason = why(results, "the paper has no such items")
    title = "What only looks like a void"
    return PrintedTable("probe_look_alikes", title, table_rows, columns, notes, reason, deviation=DRAWS)


OPPOSITES = {"answerable_void": "voids", "answerable_control": "controls", "time_swapped": "its other side"}


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
    reason = why(results, "the paper has no such nulls")
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
    reason = why(results, "the paper prints no correctness of steered answers")
    return PrintedTable("steering_pecs", "PECS of the steered model", table_rows, columns, notes, reason)


# --- the gate ---------------------------------------------------------------------------------------------------------

DEFAULT_GATE = {"source": "other datasets", "threshold": "mid"}
SOURCE_NAMES = {f"one:{name}": short for name, short in SHORT.items()}


def gate(results: Results) -> list[PrintedTable]:
    """Return PECS before and after gates and prompts, by source, threshold, features."""
    return [_gate_sources(results), _gate_controls(results), _gate_answerable(results), _prompts(results)]


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
        *few_note(rows),
    ]
    reason = why(results, "the paper gates nothing")
    return PrintedTable("gate", "Probe-gated abstention", rows, columns, notes, reason)


def _gate_controls(results: Results) -> PrintedTable:
    rows = _gates(results)
    for name, value in (DEFAULT_GATE | {"target": "all"}).items():
        rows = rows.loc[rows[name] == value]
    columns = [MODEL, Column("regime", "Answers"), Column("features", "Features"), *_GATED]
    notes = [
        "gates from other datasets at the mid threshold, mean over the four datasets",
        "a gate on states shows what states add only as far as it is above gates on raw inputs, on the output margin "
        "and on an untrained model’s states",
        *few_note(rows),
    ]
    reason = why(results, "the paper gates nothing")
    return PrintedTable("gate_controls", "The gate beside its controls", rows, columns, notes, reason)


def _gate_answerable(results: Results) -> PrintedTable:
    rows = _gates(results)
    rows = rows.loc[~rows["target"].isin([*SHORT, "all"]) & (rows["source"] == DEFAULT_GATE["source"])]
    rows = rows.loc[rows["target"].isin([*SOURCE_WORDS]) & (rows["target"] != "chaotic_time_swapped")]
    rows = rows.drop_duplicates(["model", "features", "threshold", "target"])  # gates know no regime here
    rows = rows.assign(what=[SOURCE_WORDS[name] for name in rows["target"]], mark=few_marks(rows, "n_controls"))
    columns = [
        MODEL, Column("features", "Features"), Column("threshold", "Threshold"), Column("what", "Items"),
        Column("false_abs", "Abstained on %", "percent", mark="mark"),
        Column("expected_false_abs", "expected %", "percent"), Column("n_controls", "n", "count"),
    ]  # fmt: skip
    notes = [
        "all of these items can be answered, so that every abstention of a gate is a false one",
        *few_note(rows, of="items"),
    ]
    reason = why(results, "the paper gates nothing")
    return PrintedTable("gate_answerable", "The gate on items that can be answered", rows, columns, notes, reason)


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
        _NOTES[1],
        *few_note(rows, "said_mark", "probe_mark"),
    ]
    reason = why(results, "the paper prints no such numbers")
    title = "What the prompt changes, in answers and in states"
    return PrintedTable("prompt_gate", title, rows, columns, notes, reason, deviation=DRAWS)
