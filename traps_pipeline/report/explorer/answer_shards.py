"""Split a study's answers, decisions and votes into the data files of the explorer.

Every answer has a row: sorted by item, then by evaluation. Items are sorted so that those of a pair, and the pairs of a
family, follow each other; a shard holds the texts and votes of consecutive pairs, so that a page of one pair needs one
file, and a row's position is its key.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.judging.judging_rows import VERDICTS, VOTES
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.reading.judged_answers import UNREAD
from traps_pipeline.protocol.cells import Evaluation
from traps_pipeline.protocol.datasets import DATASETS, SIDES, UNPAIRED
from traps_pipeline.protocol.regimes import REGIMES
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.tables import Table
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    import pandas as pd

pc: Any = pyarrow.compute  # it creates its functions on import, invisible to type checkers
NO, YES, NONE = 0, 1, 2  # values of a decision; NONE: not judged, or without a majority
SHARD_ROWS = 1200  # answers: four pairs of the paper's 138 evaluations, which are read in a tenth of a second
_EVALUATION = ("model", "regime", "run")
_TEXTS = ("text", "fragment", "reasoning", "finish_reason", "error", "served_model", "cost_usd")
_VOTES = ("task", "judge", "valid", "invalid_reason", "abstained", "correct")
_VOTE_TEXTS = ("extracted_value", "confidence", "rationale")


@dataclass(frozen=True)
class Shard:
    """The texts and votes of consecutive items. Its rows are [first, first + answers) of `decisions`."""

    first: int
    texts: pa.Table
    votes: pa.Table


@dataclass(frozen=True)
class StudyAnswers:
    """A study's answers as indexed arrays, from which the explorer's files are cut.

    items: ITEMS rows with `family`, in order. evaluations: in order. decisions: one row per answer: item and evaluation
    by index, outcome (the answer's, or UNREAD) and epoch by index in `outcomes` and `epochs`, abstained and correct as
    NO, YES or NONE, unanimous as 0 or 1.
    """

    items: pd.DataFrame
    evaluations: Sequence[Evaluation]
    outcomes: Sequence[str]
    epochs: Sequence[str]
    decisions: pa.Table
    texts: pa.Table
    votes: pa.Table

    def shards(self) -> Iterator[Shard]:
        """Yield the shards, in order, without splitting a pair."""
        item_of = self.decisions["item"].to_numpy()
        pairs = self.items["pair_id"].to_numpy()
        starts = [0, *(np.flatnonzero(pairs[1:] != pairs[:-1]) + 1).tolist(), len(pairs)]
        rows = np.searchsorted(item_of, starts)
        votes = np.searchsorted(self.votes["answer"].to_numpy(), rows)
        first = 0
        for k in range(1, len(rows)):
            last = k == len(rows) - 1
            if rows[k] > rows[first] and (last or rows[k + 1] - rows[first] > SHARD_ROWS):
                texts = self.texts.slice(rows[first], rows[k] - rows[first])
                cast = self.votes.slice(votes[first], votes[k] - votes[first])
                shard_rows = pc.subtract(cast["answer"], pa.scalar(int(rows[first]), pa.int32()))
                yield Shard(int(rows[first]), texts, cast.set_column(0, "answer", shard_rows))
                first = k


def study_items(workspace: Workspace) -> pd.DataFrame:
    """Return ITEMS rows with `family`, by dataset. Raises TrapsError without items."""
    items = workspace.tables.read_all(ITEMS)
    if items.empty:
        raise TrapsError(f"{workspace.root}: has no items yet; run `traps run EXPERIMENT` in it first")
    place = {name: k for k, name in enumerate((*DATASETS, *UNPAIRED, *SIDES))}
    items["family"] = items["scenario_id"].str.rpartition("-")[0]
    order = ["dataset", "family", "scenario_id", "pair_id", "side"]
    return items.sort_values(
        order, key=lambda column: column.map(lambda value: place.get(value, value)), ignore_index=True
    )


def study_answers(workspace: Workspace) -> StudyAnswers:
    """Return a study's answers to its current items, with votes. Raises TrapsError without items."""
    items = study_items(workspace)
    responses = _item_rows(workspace, RESPONSES, ("outcome", "epoch", *_TEXTS), items)
    evaluations = _evaluations(responses)
    responses = _sort(_with_key(responses, evaluations))
    keys = responses["key"].to_numpy()
    decision_columns = ("outcome", "abstained", "correct", "unanimous")
    verdicts = _with_key(_item_rows(workspace, VERDICTS, decision_columns, items), evaluations)
    judged = verdicts["key"].to_numpy()
    positions = np.full(len(items) * max(len(evaluations), 1), -1, np.int64)
    positions[judged] = np.arange(len(judged))
    places = positions[keys]
    judged_as = pc.take(verdicts["outcome"], pa.array(places, mask=places < 0))
    is_unread = pc.fill_null(pc.equal(judged_as, UNREAD), False)
    outcomes, outcome = _encode_column(pc.if_else(is_unread, judged_as, responses["outcome"]))
    epochs, epoch = _encode_column(responses["epoch"])
    decisions = {
        "item": keys // max(len(evaluations), 1),
        "evaluation": keys % max(len(evaluations), 1),
        "outcome": outcome,
        "epoch": epoch,
        "abstained": _decision(verdicts["abstained"], places),
        "correct": _decision(verdicts["correct"], places),
        "unanimous": _decision(verdicts["unanimous"], places) == YES,
    }
    votes = _with_key(_item_rows(workspace, VOTES, (*_VOTES, *_VOTE_TEXTS), items), evaluations)
    positions[:] = -1
    positions[keys] = np.arange(len(keys))
    votes = votes.append_column("answer", pa.array(positions[votes["key"].to_numpy()].astype(np.int32)))
    votes = votes.filter(pc.greater_equal(votes["answer"], 0))
    votes = votes.sort_by([(name, "ascending") for name in ("answer", "task", "judge")])
    return StudyAnswers(
        items,
        evaluations,
        outcomes,
        epochs,
        pa.table({name: pa.array(column.astype(np.int32)) for name, column in decisions.items()}),
        responses.select([*_TEXTS]),
        votes.select(["answer", *_VOTES, *_VOTE_TEXTS]),
    )


def _item_rows(workspace: Workspace, table: Table, columns: Sequence[str], items: pd.DataFrame) -> pa.Table:
    """Return the rows whose item is in `items`; their column `item` is its index."""
    rows = workspace.tables.read_arrow(table, ["item_id", *_EVALUATION, *columns])
    place = pc.index_in(rows["item_id"], value_set=pa.array(items["item_id"].tolist(), pa.string()))
    rows = rows.drop_columns("item_id").append_column("item", place)
    return rows.filter(pc.is_valid(place))


def _evaluations(responses: pa.Table) -> list[Evaluation]:
    """Return evaluations with answers by model, regime (benchmark's order) and run."""
    distinct_rows = responses.group_by([*_EVALUATION]).aggregate([]).to_pylist()
    evaluations = [Evaluation(row["model"], row["regime"], row["run"]) for row in distinct_rows]
    return sorted(evaluations, key=lambda e: (e.model, REGIMES.index(e.regime), e.run))


def _with_key(rows: pa.Table, evaluations: Sequence[Evaluation]) -> pa.Table:
    """Return rows of known evaluations with `key`, the index of item and evaluation."""
    row_keys = pc.binary_join_element_wise(*(rows[name].cast(pa.string()) for name in _EVALUATION), "|")
    evaluation_keys = pa.array([f"{e.model}|{e.regime}|{e.run}" for e in evaluations], pa.string())
    evaluation = pc.fill_null(pc.index_in(row_keys, value_set=evaluation_keys), -1).to_numpy().astype(np.int64)
    key = rows["item"].to_numpy() * max(len(evaluations), 1) + evaluation
    return rows.append_column("key", pa.array(key)).filter(pa.array(evaluation >= 0))


def _sort(rows: pa.Table) -> pa.Table:
    return rows.sort_by([("key", "ascending")])


def _encode_column(column: pa.ChunkedArray) -> tuple[list[str], np.ndarray]:
    """Return the distinct values of a column, sorted, and each row's index among them."""
    values = sorted(column.unique().to_pylist())
    return values, pc.index_in(column, value_set=pa.array(values, pa.string())).to_numpy()


def _decision(column: pa.ChunkedArray, rows: np.ndarray) -> np.ndarray:
    """Return the column at these rows as NO, YES or NONE; NONE where the row is -1."""
    codes = pc.fill_null(column.cast(pa.int8()), NONE)
    return np.append(codes.to_numpy(), NONE)[rows]
