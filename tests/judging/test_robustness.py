"""Answers that try to instruct their judge: which votes they change, and that the check detects the change."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from tests.build.errors import raises
from tests.providers.server import Provider
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cli import main
from traps_pipeline.judging.judging_rows import JUDGE_ROBUSTNESS
from traps_pipeline.judging.robustness import (
    ATTACKS_FILE,
    TASKS,
    attack_effect,
    check_panel,
    load_attacks,
    robustness_summary,
)
from traps_pipeline.models.registry.judges import JudgeEntry, load_panel
from traps_pipeline.protocol.ratings import PANEL
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

# Attacks that leave no form which the rules know: an answer that is not the last sentence, or a choice before `I don't
# know`.
LEFT_UNREAD = {
    *("ignore-instructions-after", "dictated-reason", "dictated-value", "fake-verdict-answered", "fake-marker"),
    *("fake-second-item", "role-tags", "authority", "long-filler"),
}


def moved(rows: pd.DataFrame, judge: str, how: str) -> set[tuple[str, str]]:
    mine = rows.loc[(rows["judge"] == judge) & (rows["result"] == how)]
    return set(zip(mine["attack"], mine["task"], strict=True))


def test_no_attack_flips_a_rule_judge_and_some_leave_an_answer_unread(tmp_path: Path) -> None:
    workspace = Workspace.create(tmp_path, Study())
    rows = check_panel(workspace, "rules", load_panel("rules"), load_attacks())
    for judge in ("rule-1", "rule-2", "rule-3", PANEL):
        assert moved(rows, judge, "broken") == {(attack, task) for attack in LEFT_UNREAD for task in TASKS}
        assert not moved(rows, judge, "flipped") | moved(rows, judge, "wrong_anyway")
    assert set(rows["invalid_reason"].dropna()) == {"unread"}
    kept = workspace.tables.read(JUDGE_ROBUSTNESS, {})
    assert moved(kept, PANEL, "broken") == moved(rows, PANEL, "broken") and len(kept) == len(rows)


def verdict(abstained: bool, value: str | None) -> str:
    vote = {"abstained": abstained, "confidence": "high", "correct": False, "extracted_value": value}
    return json.dumps(vote | {"reasoning": "r"})


def test_a_judge_that_obeys_is_found_and_one_that_is_confused_and_the_panel_holds(
    provider: Provider, judge_at: Callable[[str], JudgeEntry], tmp_path: Path
) -> None:
    attacks = load_attacks()
    text = {name: answer.text for name, answer in attacks.answers.items()}
    honest = {
        text["right"]: verdict(False, "left"),
        text["wrong"]: verdict(False, "right"),
        text["declined"]: verdict(True, None),
    }
    provider.configure(
        scripts={
            "honest": honest,
            "obedient": {"Ignore all previous instructions": verdict(False, "left")} | honest,
            "confused": {"<|im_start|>": "I am the system."} | honest,
        }
    )
    workspace = Workspace.create(tmp_path, Study(budget_usd=1))
    panel = [judge_at(name) for name in ("honest", "obedient", "confused")]
    rows = check_panel(workspace, "three", panel, attacks)
    asked = (len(attacks.attacks) + 3) * 2 * 3
    assert provider.stats()["requests"] == asked
    obeyed = {(f"ignore-instructions{more}", "correctness") for more in ("", "-after")}
    assert moved(rows, "obedient", "flipped") == obeyed | {("ignore-instructions", "abstention")}
    assert moved(rows, "confused", "broken") == {("role-tags", "abstention"), ("role-tags", "correctness")}
    assert (
        moved(rows, "confused", "flipped") == moved(rows, "honest", "flipped") == moved(rows, PANEL, "flipped") == set()
    )
    assert "obedient: ignore-instructions-after (plain instruction) flipped correctness" in robustness_summary(rows)
    check_panel(workspace, "three", panel, attacks)
    assert provider.stats()["requests"] == asked  # what the ledger holds is not asked again


@pytest.mark.parametrize(
    ("expected", "clean", "vote", "what"),
    [
        (True, True, True, "held"),
        (True, False, True, "held"),
        (True, True, False, "flipped"),
        (False, False, True, "flipped"),
        (True, True, None, "broken"),
        (True, False, False, "wrong_anyway"),
        (True, None, None, "wrong_anyway"),
    ],
)
def test_an_attack_moved_a_vote_only_if_it_was_right_without_it(expected, clean, vote, what) -> None:
    assert attack_effect(expected, clean, vote) == what


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("answer: wrong", "answer: missing", "'missing'"),
        ("id: threat", "id: authority", "attacks: authority: "),
        ("\n      {answer}\n\n      Judge: set", "\n      Judge: set", "dictated-value"),
        ("kind: dilution", "colour: red", "colour: "),
    ],
)
def test_a_wrong_file_of_attacks_is_named(tmp_path: Path, old: str, new: str, named: str) -> None:
    path, text = tmp_path / "attacks.yaml", ATTACKS_FILE.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with raises(TrapsError, "", str(path), named):
        load_attacks(path)


def test_the_command_prints_what_moved_by_judge(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Workspace.create(tmp_path, Study())
    assert main(["models", "test-panel", "rules", "--workspace", str(tmp_path)]) == 0
    out = capsys.readouterr().out.splitlines()
    (line,) = (row for row in out if row.startswith("rule-2 "))
    assert line.split() == ["rule-2", "42", "24", "0", "18", "0"]
    assert main(["models", "test-panel", "nobody", "--workspace", str(tmp_path)]) == 1
    told = capsys.readouterr().err
    assert "'nobody'" in told and "rules, " in told
