"""PECS without one judge, worked out by hand."""

from __future__ import annotations

from itertools import product

import pandas as pd
import pytest

from tests.judging.conftest import vote_rows
from traps_pipeline.judging.verdicts import verdicts_of
from traps_pipeline.scoring.leave_one_out import leave_one_out, two_judge_verdicts
from traps_pipeline.scoring.metrics import cell_metrics
from traps_pipeline.scoring.score_rows import LEAVE_ONE_OUT
from traps_pipeline.scoring.standings import standings
from traps_pipeline.storage.parquet import TableStore

TASKS = ("correctness", "control_abstention", "void_abstention")


def study(answers: dict[str, list[str]], **cell: object) -> tuple[pd.DataFrame, pd.DataFrame]:
    """VERDICTS and VOTES rows of one cell, from what judges a, b and c said of each pair on each task."""
    votes = pd.concat([vote_rows(answers[task], task, **cell) for task in TASKS], ignore_index=True)
    seen = votes.drop_duplicates("item_id")
    items = pd.DataFrame({"item_id": seen["item_id"], "scenario_id": seen["item_id"].str.split(":").str[1]})
    items = items.assign(category="hidden", sub_scenario="x", control_answer="left", benchmark_version="v1")
    named = ["dataset", "model", "regime", "run", "item_id", "side", "epoch"]
    responses = seen[named].assign(outcome="answer", is_json=None, pair_id=seen["item_id"].str.rsplit(":", n=1).str[0])
    return verdicts_of(items, responses, votes), votes


def board(verdicts: pd.DataFrame) -> pd.DataFrame:
    cells = [cell_metrics(rows, {}) for _, rows in verdicts.groupby("dataset")]
    return standings(pd.concat(cells, ignore_index=True))


# Four pairs. c finds the second control wrong and abstained, and misses the abstention on the last void.
ANSWERS = {
    "correctness": ["yyy", "yyn", "yyy", "nnn"],
    "control_abstention": ["nnn", "nny", "nnn", "nnn"],
    "void_abstention": ["yyy", "yyy", "nnn", "yyn"],
}


@pytest.mark.slow
def test_two_judges_decide_where_they_agree_and_leave_open_where_they_do_not(tmp_path) -> None:
    verdicts, votes = study(ANSWERS)
    rows = leave_one_out(verdicts, votes, board(verdicts)).set_index("without")
    # The panel, and a and b alone: Acc 3/4, FalseAbs 0, AbsRec 3/4, so PECS 9/16.
    assert rows["pecs_panel"].tolist() == pytest.approx([9 / 16] * 3)
    assert (rows.loc["c", "pecs"], rows.loc["c", "n_missing"]) == (pytest.approx(9 / 16), 0)
    # Without a or b the second control and the last void are 1-1: Acc 2/3, FalseAbs 0 of 3, AbsRec 2/3.
    for judge in ("a", "b"):
        row = rows.loc[judge]
        assert (row.pecs, row.difference) == pytest.approx((4 / 9, 4 / 9 - 9 / 16))
        assert (row.n_missing, row.n_missing_panel, row.n_pairs, row.n_runs) == (2, 0, 4, 1)
        # At worst both open decisions are wrong (Acc 2/4, AbsRec 2/4, FalseAbs 1/4), at best right (3/4, 3/4, 0).
        assert (row.pecs_low, row.pecs_high) == pytest.approx((1 / 2 * 1 / 4, 9 / 16))
    TableStore(tmp_path).write(LEAVE_ONE_OUT, {}, leave_one_out(verdicts, votes, board(verdicts)), {})


def test_of_every_three_votes_the_other_two_decide_only_together() -> None:
    casts = ["".join(cast) for cast in product("yn-", repeat=3)]
    alike = {"correctness": ["yyy"] * 27, "control_abstention": ["nnn"] * 27}
    for seat, (_, two) in enumerate(two_judge_verdicts(*study(alike | {"void_abstention": casts}))):
        others = [cast[:seat] + cast[seat + 1 :] for cast in casts]
        found = two.loc[two["side"] == "void"].sort_values("item_id")["abstained"]
        assert [None if pd.isna(said) else said for said in found] == [{"yy": True, "nn": False}.get(o) for o in others]


@pytest.mark.slow
def test_runs_are_averaged_and_overall_needs_all_four_datasets() -> None:
    parts = [study(ANSWERS, dataset=d, run=run) for run in (1, 2) for d in ("occlusion", "chaotic")]
    verdicts, votes = (pd.concat(frames, ignore_index=True) for frames in zip(*parts, strict=True))
    rows = leave_one_out(verdicts, votes, board(verdicts))
    assert set(rows["dataset"]) == {"occlusion", "chaotic"}
    assert set(rows["n_runs"]) == {2}
    more = [study(ANSWERS, dataset=f"{d}_ill_posed", run=run) for run in (1, 2) for d in ("occlusion", "chaotic")]
    verdicts, votes = (pd.concat(frames, ignore_index=True) for frames in zip(*parts, *more, strict=True))
    rows = leave_one_out(verdicts, votes, board(verdicts)).set_index(["dataset", "without"])
    assert rows.loc[("overall", "a"), "pecs"] == pytest.approx(4 / 9)
    assert rows.loc[("overall", "a"), "n_missing"] == 2 * 4 * 2
