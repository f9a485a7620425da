"""Decide every answer by the panel's majority (docs/spec.md 4.1)."""

from collections.abc import Sequence
from itertools import groupby

import numpy as np
import pandas as pd
import pyarrow as pa

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.judging.judging_rows import VERDICTS, VOTES
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.reading.judged_answers import UNREAD
from traps_pipeline.models.registry.judges import PANEL_SIZES, is_of_rules, panel_id
from traps_pipeline.models.request import JUDGED_OUTCOMES
from traps_pipeline.protocol.cells import Cell
from traps_pipeline.protocol.ratings import (
    ABSTENTION,
    ANSWER,
    CORRECTNESS,
    INVALID,
    NO,
    VOTE_COLUMNS,
    majority,
    ratings,
    vote_decisions,
)
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.workspace import Workspace

CELL = ["dataset", "model", "regime", "run"]
ITEM_COLUMNS = ["item_id", "scenario_id", "category", "sub_scenario", "control_answer", "benchmark_version"]
RESPONSE_COLUMNS = [*ANSWER, "pair_id", "side", "outcome", "is_json", "epoch"]


def decide_cells(workspace: Workspace, cells: Sequence[Cell]) -> dict[Cell, pd.DataFrame | TrapsError]:
    """Return each cell's VERDICTS rows, or the error where its inputs do not match.

    All cells are decided at once, since a cell takes as long as hundreds; if that fails, each alone.
    """
    try:
        return _decide_group(workspace, cells)
    except TrapsError as error:
        if len(cells) == 1:
            return {cells[0]: error}
        return {cell: rows for cell_alone in cells for cell, rows in decide_cells(workspace, [cell_alone]).items()}


def _decide_group(workspace: Workspace, cells: Sequence[Cell]) -> dict[Cell, pd.DataFrame | TrapsError]:
    tables, result_by_cell = workspace.tables, dict[Cell, pd.DataFrame | TrapsError]()
    vote_columns = [*VOTE_COLUMNS, "invalid_reason", "rejects_premise", "judge_correct", "panel"]
    votes = {cell: tables.arrow(VOTES, cell.partition, vote_columns) for cell in cells}

    def alike(cell: Cell) -> tuple[str, list[str]]:
        """Return what cells must share to be decided together: dataset and judges."""
        return cell.dataset, sorted(votes[cell]["judge"].unique().to_pylist())

    for (dataset, _), group in groupby(sorted(cells, key=alike), alike):
        chunk = [*group]
        items = tables.read(ITEMS, {"dataset": dataset}, ITEM_COLUMNS)
        responses = pa.concat_tables([tables.arrow(RESPONSES, cell.partition, RESPONSE_COLUMNS) for cell in chunk])
        rows = verdicts_of(items, responses.to_pandas(), pa.concat_tables([votes[cell] for cell in chunk]).to_pandas())
        # If no answer of a cell is judged, no vote names a panel, so the rows name the study's.
        rows_by_cell = dict([*rows.fillna({"panel": panel_id(workspace.study.panel)}).groupby(CELL)])
        for cell in chunk:
            key = tuple(cell.partition.values())
            result_by_cell[cell] = rows_by_cell[key] if key in rows_by_cell else rows.iloc[:0]
    return result_by_cell


def verdicts_of(items: pd.DataFrame, responses: pd.DataFrame, votes: pd.DataFrame) -> pd.DataFrame:
    """Return a VERDICTS row per response, from ITEMS, RESPONSES and VOTES rows.

    The rows need the columns named above. The panel is that of the cell's votes, null if it has none. The outcome is
    the response's, or UNREAD if that is the vote of every judge.

    A response without a text is not judged, so its decisions are null. Two valid votes that agree decide; 1-1 with an
    invalid vote, or fewer valid votes, is undecided. Raises TrapsError for a response to an item that is no longer in
    the benchmark, and for a judged answer that lacks the vote of a judge on a task.
    """
    rows = responses.merge(items, on="item_id", how="left", validate="many_to_one")
    _refuse(rows, rows["scenario_id"].isna().to_numpy(), "item {} is no longer in items", "responses")
    cast, judged = ratings(votes), rows["outcome"].isin(JUDGED_OUTCOMES).to_numpy()
    is_control = (rows["side"] == "control").to_numpy()
    abstention, has_abstention = cast.on(rows, ABSTENTION)
    correctness, has_correctness = cast.on(rows, CORRECTNESS)
    is_missing = judged & ~(has_abstention & (has_correctness | ~is_control))
    if len(cast.judges) not in PANEL_SIZES:
        is_missing = judged
    sizes = " or ".join(map(str, PANEL_SIZES))
    _refuse(rows, is_missing, f"item {{}} does not have the votes of {sizes} judges per task", "votes")
    abstained, correct = majority(abstention), majority(correctness)
    # Most judges see an answer and read several choices in it: a hedge is no gap in the data, and is not right.
    hedged = is_control & (abstained == NO) & (_unread(rows, votes, "correctness") > len(cast.judges) / 2)
    correct = np.where(hedged, NO, correct)
    is_undecided = (abstained == INVALID) | (is_control & (correct == INVALID))
    rows["abstained"], rows["correct"] = vote_decisions(abstained), vote_decisions(correct)
    rows["rejects_premise"] = _rejects_premise(rows, votes, len(cast.judges))
    rows["overruled"] = _overruled(rows, votes)
    rows["n_valid"] = (abstention != INVALID).sum(axis=1)
    rows["n_valid_correctness"] = (correctness != INVALID).sum(axis=1)
    rows["unanimous"] = judged & _unanimous(abstention) & (~is_control | _unanimous(correctness))
    rows["undecided"] = judged & is_undecided
    if cast.judges:
        rows.loc[_unread(rows, votes, "abstention") == len(cast.judges), "outcome"] = UNREAD
    panels = votes.loc[:, [*CELL, "panel"]].drop_duplicates(CELL)
    return rows.merge(panels, on=CELL, how="left").loc[:, VERDICTS.names]


def _unread(rows: pd.DataFrame, votes: pd.DataFrame, task: str) -> np.ndarray:
    """Return how many judges read nothing on a task, (rows,)."""
    unread = votes.loc[votes["invalid_reason"].eq(UNREAD) & votes["task"].eq(task), ANSWER]
    if unread.empty:
        return np.zeros(len(rows))
    counts = rows[ANSWER].merge(unread.value_counts().reset_index(name="n"), on=ANSWER, how="left")["n"]
    return counts.fillna(0).to_numpy(float)


def _rejects_premise(rows: pd.DataFrame, votes: pd.DataFrame, n_judges: int) -> pd.arrays.BooleanArray:
    """Return the majority on rejecting the premise, (rows,), null if none or unasked."""
    marks = votes.loc[votes["task"].eq("abstention") & votes["rejects_premise"].notna(), [*ANSWER, "rejects_premise"]]
    if marks.empty:
        return pd.arrays.BooleanArray(np.zeros(len(rows), bool), np.ones(len(rows), bool))
    yes = marks.astype({"rejects_premise": "int64"}).groupby(ANSWER)["rejects_premise"].agg(["sum", "size"])
    counts = rows[ANSWER].merge(yes.reset_index(), on=ANSWER, how="left").fillna(0)
    n_rejecting, n_accepting = counts["sum"].to_numpy(), (counts["size"] - counts["sum"]).to_numpy()
    return pd.arrays.BooleanArray(n_rejecting > n_judges / 2, np.maximum(n_rejecting, n_accepting) <= n_judges / 2)


def _overruled(rows: pd.DataFrame, votes: pd.DataFrame) -> pd.arrays.BooleanArray:
    """Return whether code differs from some judge's own word on correctness, (rows,), null without such a word."""
    rules = [panel for panel in votes["panel"].unique() if is_of_rules(panel.partition("@")[0])]
    has_word = votes["judge_correct"].notna() & votes["correct"].notna() & ~votes["panel"].isin(rules)
    words = votes.loc[has_word, [*ANSWER, "judge_correct", "correct"]]
    flags = words[ANSWER].assign(overruled=words["judge_correct"].astype(bool) != words["correct"].astype(bool))
    flags = flags.groupby(ANSWER, as_index=False)["overruled"].any()
    found = rows[ANSWER].merge(flags, on=ANSWER, how="left")["overruled"]
    return pd.arrays.BooleanArray(found.eq(True).to_numpy(bool), found.isna().to_numpy(bool))


def _unanimous(values: np.ndarray) -> np.ndarray:
    return (values[:, :1] != INVALID).all(axis=1) & (values == values[:, :1]).all(axis=1)


def _refuse(rows: pd.DataFrame, wrong: np.ndarray, complaint: str, stage: str) -> None:
    """Raise TrapsError naming the first wrong row's item and the cell to materialize."""
    if not wrong.any():
        return
    row = rows.iloc[int(np.argmax(wrong))]
    cell = f"{row['dataset']}|{row['model']}__{row['regime']}__run{row['run']}"
    raise TrapsError(f"{stage} {cell}: {complaint.format(row['item_id'])}; materialize {stage} for {cell}")
