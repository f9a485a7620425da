"""Verdicts: what the panel's majority says of every answer (docs/spec.md 4.1)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from traps_pipeline.benchmark.tables import ITEMS
from traps_pipeline.errors import TrapsError
from traps_pipeline.judging.ratings import (
    ABSTENTION,
    ANSWER,
    CORRECTNESS,
    INVALID,
    VOTE_COLUMNS,
    decided,
    majority,
    ratings,
)
from traps_pipeline.judging.tables import VERDICTS, VOTES
from traps_pipeline.models.judges import PANEL_SIZE
from traps_pipeline.models.request import JUDGED
from traps_pipeline.models.tables import RESPONSES
from traps_pipeline.partitions import DATASETS, Cell
from traps_pipeline.storage.tables import Table
from traps_pipeline.storage.workspace import Workspace

ITEM_COLUMNS = ["item_id", "scenario_id", "category", "sub_scenario", "control_answer", "benchmark_version"]
RESPONSE_COLUMNS = [*ANSWER, "pair_id", "side", "outcome", "epoch"]


def current(
    workspace: Workspace, table: Table, columns: Sequence[str] | None = None, dataset: str | Sequence[str] = DATASETS
) -> pd.DataFrame:
    """The rows of a table on items that are still in the benchmark: cells that nobody has evaluated since a correction
    may hold others. What is counted is counted over these.

    dataset: which are meant; the four of the pairs unless arms are named, so that no arm enters a figure by chance.
    """
    rows = workspace.tables.read_all(table, columns, dataset=dataset)
    there = workspace.tables.read_all(ITEMS, ["item_id"])["item_id"]
    return rows.loc[rows["item_id"].isin(there)].reset_index(drop=True)


def decide_cell(workspace: Workspace, cell: Cell) -> pd.DataFrame:
    """VERDICTS rows of a cell, from its items, responses and votes. Raises TrapsError where these do not fit."""
    items = workspace.tables.read(ITEMS, {"dataset": cell.dataset}, ITEM_COLUMNS)
    responses = workspace.tables.read(RESPONSES, cell.partition, RESPONSE_COLUMNS)
    return decide(items, responses, workspace.tables.read(VOTES, cell.partition, VOTE_COLUMNS))


def decide(items: pd.DataFrame, responses: pd.DataFrame, votes: pd.DataFrame) -> pd.DataFrame:
    """VERDICTS rows, one a response of any cells, from ITEMS, RESPONSES and VOTES rows with the columns named above.

    An answer that no one judges has no verdict: its decisions are null. Two valid votes that agree decide; 1-1 with an
    invalid one, or fewer, is undecided. Raises TrapsError for a response to an item that is gone, and for a judged
    answer without three votes a task.
    """
    rows = responses.merge(items, on="item_id", how="left", validate="many_to_one")
    _refuse(rows, rows["scenario_id"].isna().to_numpy(), "item {} is no longer in items", "responses")
    cast, judged = ratings(votes), rows["outcome"].isin(JUDGED).to_numpy()
    on_control = (rows["side"] == "control").to_numpy()
    abstention, has_abstention = cast.on(rows, ABSTENTION)
    correctness, has_correctness = cast.on(rows, CORRECTNESS)
    lacking = judged & ~(has_abstention & (has_correctness | ~on_control))
    if len(cast.judges) != PANEL_SIZE:
        lacking = judged
    _refuse(rows, lacking, f"item {{}} has not {PANEL_SIZE} votes a task", "votes")
    abstained, correct = majority(abstention), majority(correctness)
    undecided = (abstained == INVALID) | (on_control & (correct == INVALID))
    rows["abstained"], rows["correct"] = decided(abstained), decided(correct)
    rows["n_valid"] = (abstention != INVALID).sum(axis=1)
    rows["n_valid_correctness"] = (correctness != INVALID).sum(axis=1)
    rows["unanimous"] = judged & _unanimous(abstention) & (~on_control | _unanimous(correctness))
    rows["undecided"] = judged & undecided
    return rows.loc[:, VERDICTS.names]


def _unanimous(values: np.ndarray) -> np.ndarray:
    return (values[:, :1] != INVALID).all(axis=1) & (values == values[:, :1]).all(axis=1)


def _refuse(rows: pd.DataFrame, wrong: np.ndarray, complaint: str, stage: str) -> None:
    """Raises TrapsError naming the first wrong row's item and the cell to materialize."""
    if not wrong.any():
        return
    row = rows.iloc[int(np.argmax(wrong))]
    cell = f"{row['dataset']}|{row['model']}__{row['regime']}__run{row['run']}"
    raise TrapsError(f"{stage} {cell}: {complaint.format(row['item_id'])}; materialize {stage} for {cell}")
