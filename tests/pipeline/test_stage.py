"""The code version of a stage that takes no money follows the files of its rooms."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests.pipeline.stage_codes import REVIEWED, codes, is_followed, statements
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
    assert not any(is_followed(one.code) for one in graph.stages if one.cost == "money")


def test_a_dear_stage_whose_formula_changed_has_a_reviewed_code() -> None:
    reviewed = json.loads(REVIEWED.read_text(encoding="utf-8"))
    changed = {name for name, found in codes().items() if found != reviewed.get(name)}
    assert not changed, (
        f"what decides the rows of {', '.join(sorted(changed))} has changed: raise `code` in pipeline/stages/ where "
        "any row may differ (finished studies make it again), then run `python -m tests.pipeline.stage_codes`"
    )


def test_comments_docstrings_errors_sentences_and_layout_are_no_change_of_a_formula_and_a_number_is(
    tmp_path: Path,
) -> None:
    def of(source: str) -> str:
        path = tmp_path / "formula.py"
        path.write_text(source, encoding="utf-8")
        return statements(path)

    formula = of("def half(x):\n    return x / 2\n")
    assert of('"""About."""\n\n\ndef half(x):  # of it\n    """Return half."""\n    return x / 2\n') == formula
    assert of("def half(x):\n    return x / 3\n") != formula
    refusals = [
        f"def half(x):\n    if x {sign} 0:\n        raise ValueError({why!r})\n" for sign in "<>" for why in ("no", "")
    ]
    assert [of(one) == of(refusals[0]) for one in refusals] == [True, True, False, False]
