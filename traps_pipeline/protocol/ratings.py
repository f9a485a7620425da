"""Arrange votes as a matrix, answers and tasks by judges; count majorities.

Verdicts, agreement, bias and scores without one judge are all computed from this matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

YES, NO, INVALID = 1, 0, -1  # values of a vote; for a majority, INVALID means undecided
PANEL = "panel"  # stands for all judges together in a column that names a judge
ANSWER = ["dataset", "model", "regime", "run", "item_id"]
ABSTENTION, CORRECTNESS = ("void_abstention", "control_abstention"), ("correctness",)
TASKS = (*ABSTENTION, *CORRECTNESS)
# The axes on which a judge labels a void failure (docs/spec.md 6.2).
AXES = ("hallucinated_premise", "invalid_inference", "epistemic_surrender", "doubt_in_reasoning")
VOTE_COLUMNS = [*ANSWER, "side", "task", "judge", "valid", "abstained", "correct", "epoch", "benchmark_version"]


@dataclass(frozen=True)
class Ratings:
    """Judges' votes as a matrix: a row for each answer, a column for each judge.

    answers: one row per answer and task, with the columns `answer` (which identify an answer), task (one of TASKS),
    epoch and benchmark_version. values: (rows, judges) int8 of YES, NO and INVALID, columns in the order of `judges`.
    """

    answers: pd.DataFrame
    values: np.ndarray
    judges: tuple[str, ...]
    answer: Sequence[str]

    def select(self, chosen: np.ndarray) -> Ratings:
        """Return the rows that a boolean mask selects."""
        return replace(self, answers=self.answers.loc[chosen].reset_index(drop=True), values=self.values[chosen])

    def on(self, items: pd.DataFrame, tasks: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Return the votes on items, each on the one of `tasks` in which it was judged.

        items: rows with the columns `answer`. Two arrays: values, (items, judges), all INVALID for an item that was not
        judged; and whether it was judged, (items,).
        """
        keys = [*self.answer]
        judged = self.answers.loc[self.answers["task"].isin(tasks), keys]
        item_rows = items[keys].merge(judged.assign(row=judged.index), on=keys, how="left", validate="many_to_one")
        rows = item_rows["row"].to_numpy(float)
        is_judged = ~np.isnan(rows)
        values = np.full((len(items), len(self.judges)), INVALID, np.int8)
        values[is_judged] = self.values[rows[is_judged].astype(np.int64)]
        return values, is_judged


def ratings(votes: pd.DataFrame, judges: Sequence[str] | None = None, answer: Sequence[str] = ANSWER) -> Ratings:
    """Return judges' votes as a matrix, from VOTES rows (with `VOTE_COLUMNS` at least).

    judges: default all, in alphabetical order. Rows of another table of votes work too, if the columns `answer`
    identify an answer. An answer without a vote of each of these judges is left out: another panel judged it.
    """
    import pandas as pd

    seats = tuple(sorted(votes["judge"].unique()) if judges is None else judges)
    votes = votes.loc[votes["judge"].isin(seats)].reset_index(drop=True)
    rows, first = _group_votes(votes, [*answer, "task"])
    values = np.full((len(first), len(seats)), INVALID, np.int8)
    has_vote = np.zeros(values.shape, bool)
    places = rows, pd.Index(seats).get_indexer(pd.Index(votes["judge"]))
    values[places], has_vote[places] = _decisions(votes), True
    answers = votes.loc[first, [*answer, "epoch", "benchmark_version"]].reset_index(drop=True)
    first_votes = votes.loc[first, ["task", "side"]]
    answers["task"] = np.where(first_votes["task"] == "correctness", "correctness", first_votes["side"] + "_abstention")
    is_complete = has_vote.all(axis=1)
    return Ratings(answers.loc[is_complete].reset_index(drop=True), values[is_complete], seats, answer)


def _group_votes(votes: pd.DataFrame, by: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return each vote's group (votes,), and each group's first vote (groups,)."""
    import pandas as pd

    code = np.zeros(len(votes), np.int64)
    for name in by:
        codes, levels = pd.factorize(votes[name])
        code = code * max(len(levels), 1) + codes
    _, first, rows = np.unique(code, return_index=True, return_inverse=True)
    return rows.ravel(), first


def _decisions(votes: pd.DataFrame) -> np.ndarray:
    """Return YES, NO or INVALID of each vote, (votes,) int8."""
    decisions = votes.reindex(columns=["abstained", "correct"]).to_numpy(object)  # a table of one task has one of them
    yes = (decisions == True).astype(bool).any(axis=1)  # noqa: E712 - null compares as not true
    return np.where(votes["valid"].to_numpy(bool), yes, INVALID).astype(np.int8)


def majority(values: np.ndarray) -> np.ndarray:
    """Return the vote of more than half of the judges, else INVALID; (rows,) int8."""
    half_of_judges = values.shape[1] / 2
    is_yes, is_no = ((values == vote).sum(axis=1) > half_of_judges for vote in (YES, NO))
    return np.where(is_yes, YES, np.where(is_no, NO, INVALID)).astype(np.int8)


def vote_decisions(votes: np.ndarray) -> pd.arrays.BooleanArray:
    """Return the votes as true (YES), false (NO) and null (INVALID)."""
    import pandas as pd

    return pd.arrays.BooleanArray(votes == YES, votes == INVALID)
