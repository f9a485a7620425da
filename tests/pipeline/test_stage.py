"""The code version of a stage that takes no money follows the files of its rooms."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from traps_pipeline.base.paths import PACKAGE
from traps_pipeline.pipeline import stage
from traps_pipeline.pipeline.graph import the_graph


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the rooms whose files decide, in the place of the package."""
    for room in ("judging", "scoring", "report"):
        shutil.copytree(PACKAGE / room, tmp_path / room)
    monkeypatch.setattr(stage, "PACKAGE", tmp_path)
    return tmp_path


def code_of(group: str) -> str:
    stage.code_of.cache_clear()
    return stage.code_of(group)


def test_a_changed_formula_is_another_code_of_what_is_made_with_it_and_of_nothing_else(package: Path) -> None:
    before = {group: code_of(group) for group in ("scoring", "people", "report", "evaluation")}
    formula = package / "scoring" / "metrics.py"
    formula.write_text(formula.read_text(encoding="utf-8") + "\n\nHALF = 0.5\n", encoding="utf-8")
    after = {group: code_of(group) for group in before}
    assert {group for group in before if before[group] != after[group]} == {"scoring", "people"}
    stage.code_of.cache_clear()


def test_stages_of_scoring_carry_it_and_stages_that_cost_money_state_their_own() -> None:
    graph = the_graph()
    assert graph["leaderboard"].code == code_of("scoring")
    assert all(len(one.code) < 12 for one in graph.stages if one.cost == "money")
