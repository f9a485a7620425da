"""Tabulate directions and steering (docs/spec.md 8)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from traps_pipeline.base.wording import count_noun
from traps_pipeline.mechanism import effects
from traps_pipeline.mechanism.directions import KINDS
from traps_pipeline.protocol.datasets import SHORT
from traps_pipeline.protocol.regimes import GUIDED, PROMPTING, STANDARD
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.inside_columns import (
    ALPHA,
    DIRECTIONS,
    FEW,
    FEW_MARK,
    INFERENCE,
    LAYER,
    PATH,
    TYPE,
    few_marks,
    interval,
    path_names,
    short_names,
    why_not,
)
from traps_pipeline.report.tables.table_columns import MODEL, epochs, rightly_empty
from traps_pipeline.report.writing import Column, PrintedTable

if TYPE_CHECKING:
    import pandas as pd

KIND, SET = Column("kind", "Direction"), Column("path_set", "Path set")
CELLS_NOTE = f"{FEW_MARK} and means of such cells: fewer than {FEW} answers in a cell, whose share says little"
SETS = {"transfer": "transfer", "within_domain": "within domain"}


# --- directions -------------------------------------------------------------------------------------------------------


def cosines(results: Results) -> list[PrintedTable]:
    """Return void directions' cosines across datasets or prompts, and reliability."""
    rows = results.cosines
    order = [*SHORT]
    place, other_place = ([order.index(name) for name in rows[column]] for column in ("dataset", "other_dataset"))
    rows = rows.assign(step=np.subtract(other_place, place))
    is_across_prompts = (rows["prompt"] == STANDARD) & (rows["other_prompt"] == GUIDED) & (rows["step"] == 0)
    rows = rows.loc[((rows["prompt"] == rows["other_prompt"]) & (rows["step"] > 0)) | is_across_prompts]
    own_columns = ["model", "prompt", "dataset"]
    halves = results.cosines.drop_duplicates(own_columns).loc[:, [*own_columns, "split_half"]]
    halves = halves.rename(columns={name: f"other_{name}" for name in ("prompt", "dataset", "split_half")})
    rows = rows.merge(halves, on=["model", "other_prompt", "other_dataset"], how="left")
    rows = rows.assign(name=_direction_names(rows, ""), other=_direction_names(rows, "other_"))
    columns = [
        MODEL, LAYER, Column("name", "Direction"), Column("other", "Other"),
        Column("cosine", "Cosine", "fraction", 2), Column("disattenuated", "Disattenuated", "fraction", 2),
        *interval(digits=2),
        Column("split_half", "Split half", "fraction", 2), Column("other_split_half", "of the other", "fraction", 2),
    ]  # fmt: skip
    notes = [
        "disattenuated: of products of different scenarios alone, so that neither the noise of few pairs nor shared "
        "controls count; from, to: its 95 % interval, scenarios resampled; it may lie beyond 1",
        "split half: cosine between the directions of random halves of the pairs; where it is low, a small cosine says "
        "nothing",
    ]
    return [PrintedTable("cosines", "Cosines of void directions", rows, columns, notes, why_not(results))]


def _direction_names(rows: pd.DataFrame, prefix: str) -> list[str]:
    pairs = zip(rows[f"{prefix}dataset"], rows[f"{prefix}prompt"], strict=True)
    return [f"{SHORT.get(dataset, dataset)}, {prompt}" for dataset, prompt in pairs]


def _place(values: pd.Series) -> pd.Series:
    if values.name == "name":
        return values.map({short_name: place for place, short_name in enumerate(SHORT.values())})
    order = {"prompt": PROMPTING, "kind": KINDS}.get(str(values.name))
    return values if order is None else values.map(order.index)


# --- steering ---------------------------------------------------------------------------------------------------------


def steering(results: Results) -> list[PrintedTable]:
    """Return abstention under steering by regime, family, domain, alpha and layer."""
    return [
        _shares(results),
        _regimes(results, "steering_regimes", "Steering: direction regime against inference regime"),
        _regimes(results, "steering_families", "Steering by the family of the direction (guided, guided)"),
        _domains(results),
        _top(results),
        _dose(results),
        _layers(results),
    ]


def _shares(results: Results) -> PrintedTable:
    rows = results.shares
    rows = rows.loc[(rows["path_set"] == "all") & (rows["directions"] == "all") & (rows["regime"] == "all")]
    keys = ["model", "kind", "layer", "alpha"]
    sides = [
        rows.loc[rows["side"] == side].set_index(keys)[["abstention", "low", "high", "n_answers", "n_scenarios"]]
        for side in ("control", "void")
    ]
    by_side = sides[0].add_prefix("control_").join(sides[1].add_prefix("void_"), how="outer").reset_index()
    by_side = by_side.sort_values(keys, key=_place, ignore_index=True)
    columns = [MODEL, KIND, LAYER, ALPHA]
    for side in ("control", "void"):
        columns += [
            Column(f"{side}_abstention", f"{side.capitalize()}s abstained on %", "percent"),
            *interval(f"{side}_", "percent"),
            Column(f"{side}_n_answers", "Answers", "count"), Column(f"{side}_n_scenarios", "Scenarios", "count"),
        ]  # fmt: skip
    notes = [
        "mean over all paths and regimes; answers: distinct answers, each of which may belong to several paths",
        "from, to: 95 % interval from resampled scenarios, not answers; its width is 0 where all scenarios agree",
    ]
    reason = why_not(results, "the paper prints no answers to resample")
    return PrintedTable(
        "steering_shares", "Steering in all, with intervals by scenario", by_side, columns, notes, reason
    )


def _regimes(results: Results, name: str, title: str) -> PrintedTable:
    rows: pd.DataFrame = getattr(results, name)
    rows = rows.assign(path_set=rows["path_set"].replace(SETS))
    columns = [
        MODEL, SET, *([Column("family", "Family")] if name.endswith("families") else [DIRECTIONS, INFERENCE]), KIND,
        ALPHA, Column("control_0", "Control, α 0, %", "percent"),
        Column("control_top", "Control, α, %", "percent"), Column("void_0", "Void, α 0, %", "percent"),
        Column("void_top", "Void, α, %", "percent"), Column("n_paths", "Paths", "count"),
    ]  # fmt: skip
    notes = ["mean over the paths of a set; +α on controls, −α on voids", *_cell_notes(results)]
    reason = why_not(results)
    if name.endswith("families") and len(results.effects):
        reason = "no directions of the guided prompt were steered under guided inference"
    return PrintedTable(name, title, rows, columns, notes, reason)


def _domains(results: Results) -> PrintedTable:
    rows = results.steering_domains
    rows = rows.assign(path=short_names(rows["source"]))
    columns = [
        MODEL, DIRECTIONS, INFERENCE, Column("path", "Direction"), ALPHA,
        Column("same", "Same domain, controls %", "percent"),
        Column("cross", "Cross domain, controls %", "percent"),
    ]  # fmt: skip
    notes = ["abstention on the well-posed dataset of the source’s own taxonomy (same) and of the other (cross)"]
    notes += _cell_notes(results)
    if results.is_study:
        notes.append(
            "judged by the panel; the paper judged its two same-domain rates by keywords, which it does not print: "
            "no keyword judge here would be its own"
        )
    return PrintedTable("steering_domains", "Same against cross domain", rows, columns, notes, why_not(results))


def _top(results: Results) -> PrintedTable:
    rows = effects.paths(results.effects)
    rows = rows.loc[(rows["kind"] == "void") & (rows["alpha"] == rows.groupby("model")["alpha"].transform("max"))]
    rows = _with_names(rows)
    columns = [MODEL, DIRECTIONS, INFERENCE, PATH, TYPE, ALPHA, *_in_gaps(results), *_SIDES, *_counts(results)]
    notes = _cell_notes(results)
    return PrintedTable("steering_top", "Steering at the largest α", rows, columns, notes, why_not(results))


def _dose(results: Results) -> PrintedTable:
    rows = _with_names(effects.paths(results.effects))
    columns = [MODEL, DIRECTIONS, INFERENCE, KIND, PATH, LAYER, ALPHA, *_in_gaps(results)]
    for side in _SIDES:
        columns += [side, *(interval(f"{side.field}_", "percent") if results.is_study else ())]
    columns += _counts(results)
    notes = [epochs(results.effects), *_cell_notes(results)]
    notes += ["from, to: 95 % Wilson interval"] * results.is_study
    return PrintedTable("steering_dose", "Dose and response", rows, columns, notes, why_not(results))


def _layers(results: Results) -> PrintedTable:
    rows = results.steering_layers
    columns = [
        MODEL, DIRECTIONS, INFERENCE, LAYER, ALPHA,
        Column("control", "Controls abstained on %", "percent"), Column("n_splits", "Splits", "count"),
    ]  # fmt: skip
    notes = ["each dataset’s direction on its own controls, mean over the four splits", *_cell_notes(results)]
    reason = "only one layer was steered" if len(results.effects) else why_not(results)
    table = PrintedTable("steering_layers", "Steering by layer", rows, columns, notes, reason)
    return rightly_empty(table, results.is_study and bool(len(results.effects)))


_SIDES = (
    Column("control", "Controls abstained on %", "percent", mark="control_mark"),
    Column("void", "Voids abstained on %", "percent", mark="void_mark"),
)


def _in_gaps(results: Results) -> list[Column]:
    """Return the column of doses in units of the class gap, none for the paper."""
    return [Column("control_gaps", "in class gaps", "ratio", 2)] if results.is_study else []


def _counts(results: Results) -> list[Column]:
    """Return columns of answer counts behind a cell's shares, none for the paper."""
    if not results.is_study:
        return []
    return [
        Column("control_broken", "Degenerate %, controls", "percent"), Column("void_broken", "voids", "percent"),
        Column("control_n", "Controls", "count"), Column("void_n", "Voids", "count"),
    ]  # fmt: skip


def _cell_notes(results: Results) -> list[str]:
    """Return notes on a cell's largest n, and what it means for scores of cells."""
    counts = results.effects["n"].dropna().to_numpy(int)
    if not len(counts):
        return []
    notes = [f"n = {count_noun(int(counts.max()), 'answer')} per cell at most, one per scenario"]
    return notes + [CELLS_NOTE] * bool(results.is_study and counts.min() < FEW)


def _with_names(rows: pd.DataFrame) -> pd.DataFrame:
    marks = {f"{side}_mark": few_marks(rows, f"{side}_n") for side in ("control", "void") if f"{side}_n" in rows}
    return rows.assign(path=path_names(rows), **marks).reset_index(drop=True)
