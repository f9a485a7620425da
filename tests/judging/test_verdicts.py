"""From votes to verdicts, also with a real panel over HTTP, all of whose votes are known."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from tests.build.errors import raises
from tests.judging.conftest import answered_study, vote_rows
from tests.providers.server import Provider
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.judging import panel as judging
from traps_pipeline.judging.judging_rows import VERDICTS, VOTES
from traps_pipeline.judging.panel import collect_votes
from traps_pipeline.judging.verdicts import decide_cells, verdicts_of
from traps_pipeline.models.registry.judges import JudgeEntry
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.scoring.metrics import cell_metrics
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.workspace import Workspace

CELL = Cell("occlusion", Evaluation("oracle", "standard", 1))
COMBINATIONS = list(product(("yes", "no", "invalid"), repeat=3))


def undone(side: str, outcome: str = "answer", item: int = 0) -> tuple[pd.DataFrame, pd.DataFrame]:
    """One item and its response, as `verdicts_of` reads them."""
    named = {"scenario_id": "s", "category": "hidden", "sub_scenario": "x", "control_answer": "left"}
    item_id = f"occlusion:s-{item:04d}:{side}"
    items = pd.DataFrame([{"item_id": item_id, **named, "benchmark_version": "v1"}])
    about = {"dataset": "occlusion", "model": "m", "regime": "standard", "run": 1, "epoch": "e1"}
    response = {"item_id": item_id, "pair_id": "p", "side": side, "outcome": outcome, "is_json": None, **about}
    return items, pd.DataFrame([response])


def control_votes(abstention: str, correctness: str) -> pd.DataFrame:
    tasks = ((abstention, "control_abstention"), (correctness, "correctness"))
    return pd.concat([vote_rows([said], task) for said, task in tasks], ignore_index=True)


@pytest.mark.parametrize(
    ("abstention", "correctness", "abstained", "correct", "unanimous", "undecided"),
    [
        ("nnn", "yyy", False, True, True, False),
        ("yyy", "yyy", True, True, True, False),  # both at once: they are decided independently
        ("nnn", "yyn", False, True, False, False),
        ("nn-", "yyy", False, True, False, False),
        ("yn-", "yyy", None, True, False, True),
        ("nnn", "y--", False, None, False, True),
        ("---", "---", None, None, False, True),
    ],
)
def test_a_controls_two_decisions_are_made_apart(
    abstention: str, correctness: str, abstained: Any, correct: Any, unanimous: bool, undecided: bool
) -> None:
    (row,) = verdicts_of(*undone("control"), control_votes(abstention, correctness)).to_dict("records")
    assert [None if pd.isna(row[name]) else row[name] for name in ("abstained", "correct")] == [abstained, correct]
    assert (row["unanimous"], row["undecided"]) == (unanimous, undecided)
    assert row["n_valid"] == 3 - abstention.count("-")
    assert row["n_valid_correctness"] == 3 - correctness.count("-")


@pytest.mark.parametrize(
    ("abstention", "correctness", "correct"),
    [("nnn", "---", False), ("nnn", "y--", False), ("nnn", "yy-", True), ("yyy", "---", None), ("---", "---", None)],
)
def test_an_answer_that_names_two_choices_is_not_correct_rather_than_missing(
    abstention: str, correctness: str, correct: bool | None
) -> None:
    """A model that hedges where it does not know must not leave the count of controls."""
    votes = control_votes(abstention, correctness)
    votes.loc[~votes["valid"].astype(bool), "invalid_reason"] = "unread"
    verdicts = verdicts_of(*undone("control"), votes)
    (row,), (cell,) = verdicts.to_dict("records"), cell_metrics(verdicts).query("scope == 'all'").to_dict("records")
    assert (None if pd.isna(row["correct"]) else row["correct"]) is correct
    assert cell["n_acc"] == (correct is not None)


def test_a_rejected_premise_is_decided_by_the_majority_and_counted_beside_abstention() -> None:
    rejecting = {"yyy": True, "yyn": True, "ynn": False, "nnn": False, "yy": True, "yn": None, "y": None, "": None}
    rows = []
    for number, (said, rejects) in enumerate(rejecting.items()):
        votes = vote_rows(["nnn"]).assign(item_id=f"occlusion:s-{number:04d}:void")
        votes["rejects_premise"] = [word == "y" for word in said] + [None] * (3 - len(said))
        (row,) = verdicts_of(*undone("void", item=number), votes).to_dict("records")
        assert (None if pd.isna(row["rejects_premise"]) else row["rejects_premise"]) == rejects, said
        assert row["abstained"] is False
        rows.append(row)
    rows[0]["abstained"] = True
    (cell,) = cell_metrics(pd.DataFrame(rows), {}).to_dict("records")
    assert (cell["n_rejects"], cell["n_rejects_answered"]) == (3, 2)
    (cell,) = cell_metrics(pd.DataFrame(rows[5:]), {}).to_dict("records")
    assert pd.isna(cell["n_rejects"])  # nobody was asked


@pytest.mark.parametrize(
    ("words", "panel", "overruled"),
    [
        ("yyy", "three@1", False),
        ("yyn", "three@1", True),
        ("y--", "three@1", False),  # two judges say nothing
        ("---", "three@1", None),
        ("nnn", "rules@1", None),  # rules have no word of their own
    ],
)
def test_a_verdict_says_where_code_decides_unlike_a_judges_own_word(
    words: str, panel: str, overruled: bool | None
) -> None:
    votes = control_votes("nnn", "yyy").assign(panel=panel)
    own = [None if word == "-" else word == "y" for word in words]
    votes["judge_correct"] = [None] * 3 + own  # the first three votes are on abstention
    (row,) = verdicts_of(*undone("control"), votes).to_dict("records")
    assert (None if pd.isna(row["overruled"]) else row["overruled"]) == overruled
    (cell,) = cell_metrics(pd.DataFrame([row]), {}).to_dict("records")
    assert (None if pd.isna(cell["n_overruled"]) else cell["n_overruled"]) == overruled


def test_an_answer_that_nobody_judges_has_no_verdict_and_is_not_undecided() -> None:
    items, responses = undone("void", "refused")
    (row,) = verdicts_of(items, responses, vote_rows(["yyy"])[:0]).to_dict("records")
    assert pd.isna(row["abstained"])
    assert not row["undecided"] and not row["unanimous"]


def test_an_answer_that_no_judge_could_read_is_unread_and_any_readable_vote_makes_it_undecided() -> None:
    votes = control_votes("---", "---").assign(invalid_reason="unread")
    (row,) = verdicts_of(*undone("control"), votes).to_dict("records")
    assert (row["outcome"], row["undecided"], row["n_valid"]) == ("unread", True, 0)
    assert pd.isna(row["abstained"]) and pd.isna(row["correct"])
    (cell,) = cell_metrics(pd.DataFrame([row]), {}).to_dict("records")
    counts = [cell[name] for name in ("n_unread", "n_answered", "n_acc", "n_missing")]
    assert counts == [1, 0, 0, 1]  # the void was not asked
    for mixed, abstained in ((["n", "n", "-"], False), (["y", "n", "-"], None)):
        votes = control_votes("".join(mixed), "".join(mixed))
        votes.loc[~votes["valid"].astype(bool), "invalid_reason"] = "unread"
        (row,) = verdicts_of(*undone("control"), votes).to_dict("records")
        assert row["outcome"] == "answer" and (None if pd.isna(row["abstained"]) else row["abstained"]) == abstained


def test_a_judged_answer_without_three_votes_a_task_is_refused_by_name() -> None:
    items, responses = undone("control")
    whole = control_votes("nnn", "yyy")
    for votes in (whole[whole["task"] == "abstention"], whole[whole["judge"] != "c"], whole.iloc[1:]):
        with raises(TrapsError, "judging.verdicts._refuse", "votes", "occlusion|m__standard__run1"):
            verdicts_of(items, responses, votes)


def test_a_response_to_an_item_that_is_gone_is_refused_by_name() -> None:
    items, responses = undone("void")
    with raises(TrapsError, "judging.verdicts._refuse", "responses", "occlusion:s-0000:void"):
        verdicts_of(items.iloc[:0], responses, vote_rows(["yyy"]))


def test_a_cell_whose_votes_lack_an_answer_is_named_and_the_others_are_decided(tmp_path: Path) -> None:
    others = [Cell("occlusion", Evaluation("oracle", regime, 1)) for regime in ("guided", "json")]
    answers = {(number, side): "It goes left." for number in range(2) for side in ("control", "void")}
    workspace = answered_study(tmp_path, dict.fromkeys((CELL, *others), answers))
    for cell, made in collect_votes(workspace, [CELL, *others]):
        votes = made.rows(VOTES)
        workspace.tables.write(VOTES, cell.partition, votes[1:] if cell == others[0] else votes, {})
    decided = decide_cells(workspace, [CELL, *others])
    assert isinstance(error := decided.pop(others[0]), TrapsError) and others[0].key in str(error)
    assert {cell: {*rows["regime"]} for cell, rows in decided.items() if isinstance(rows, pd.DataFrame)} == {
        CELL: {"standard"},
        others[1]: {"json"},
    }
    assert [len(rows) for rows in decided.values()] == [4, 4]


# --- over HTTP --------------------------------------------------------------------------------------------------------


def seat(monkeypatch: pytest.MonkeyPatch, judge_at: Callable[[str], JudgeEntry], *names: str) -> None:
    """Seat these judges, whatever panel a study names."""
    seated = tuple(judge_at(name) for name in names)
    monkeypatch.setattr(judging, "load_panel", lambda name: seated)


def said(word: str) -> str:
    """What a judge says on either task to cast this vote; the ground truth is `left`."""
    value = {"yes": "left", "no": "right"}.get(word)
    vote = {"abstained": word == "yes", "confidence": "low", "correct": None, "extracted_value": value}
    return json.dumps(vote | {"correct": True, "reasoning": "r"}) if value else "I would rather not say."


def vote(workspace: Workspace) -> pd.DataFrame:
    """Ask the panel what is missing; the votes and the verdicts of the cell are then written."""
    ((cell, made),) = collect_votes(workspace, [CELL])
    assert cell == CELL and len(made.rows(VOTES)) == 2 * 3 * 27
    workspace.tables.write(VOTES, CELL.partition, made.rows(VOTES), {}, failed=made.tally.errors)
    (rows,) = decide_cells(workspace, [CELL]).values()
    assert isinstance(rows, pd.DataFrame)
    workspace.tables.write(VERDICTS, CELL.partition, rows, {})
    return workspace.tables.read(VERDICTS, CELL.partition)


def test_a_panel_over_http_comes_to_the_expected_verdict_on_all_27_votes_and_asks_no_model_again(
    provider: Provider, judge_at: Callable[[str], JudgeEntry], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    judges = ("one", "two", "three")
    provider.configure(
        scripts={
            judge: {f"case-{k:02d}.": said(cast[seat]) for k, cast in enumerate(COMBINATIONS)}
            for seat, judge in enumerate(judges)
        }
    )
    seat(monkeypatch, judge_at, *judges)
    answers = {(k, "control"): f"It goes left, case-{k:02d}." for k in range(27)}
    workspace = answered_study(tmp_path, {CELL: answers}, budget_usd=10)
    verdicts = vote(workspace).set_index("item_id")
    for k, cast in enumerate(COMBINATIONS):
        verdict = verdicts.loc[f"occlusion:s-{k:04d}:control"]
        expected = True if cast.count("yes") >= 2 else False if cast.count("no") >= 2 else None
        assert (verdict["abstained"], verdict["correct"]) == (expected, expected), cast
        assert verdict["undecided"] == (expected is None)
        assert verdict["unanimous"] == (set(cast) in ({"yes"}, {"no"}))
        assert verdict["n_valid"] == verdict["n_valid_correctness"] == 3 - cast.count("invalid")
    votes = workspace.tables.read(VOTES, CELL.partition)
    assert votes.loc[~votes["valid"], "invalid_reason"].str.startswith("Invalid JSON").all()
    assert provider.stats()["requests"] == 2 * 3 * 27

    # Undecided ones are counted and bounded: 7 of 27 decide for yes, 7 for no, 13 are open.
    (cell,) = cell_metrics(verdicts.reset_index(), {}).to_dict("records")
    assert (cell["acc"], cell["false_abs"]) == pytest.approx((7 / 14, 7 / 14))
    assert cell["n_missing"] == 13  # the voids were never asked
    assert (cell["pecs_low"], cell["pecs_high"]) == pytest.approx((0, 20 / 27 * (1 - 7 / 27)))

    # The same votes again, then another panel: judges are asked what is not known, and the model never.
    pd.testing.assert_frame_equal(vote(workspace).set_index("item_id"), verdicts)
    assert provider.stats()["requests"] == 2 * 3 * 27
    seat(monkeypatch, judge_at, "two", "three", "four")  # the fourth is not scripted: it finds `left` in every answer
    rejudged = vote(workspace)
    assert provider.stats()["requests"] == 2 * 3 * 27 + 2 * 27
    assert {record["body"]["model"] for record in provider.requests()} == {"one", "two", "three", "four"}
    assert not list((tmp_path / "ledger" / "answers").rglob("*.jsonl"))
    assert rejudged["correct"].notna().sum() > verdicts["correct"].notna().sum()
    assert len(workspace.tables.read(ITEMS, {"dataset": "occlusion"})) == 27
