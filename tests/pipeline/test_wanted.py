"""What a study wants follows from what its experiments ask."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.build.cells import row
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.pipeline.graph import the_graph
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.report.printed_board import NO_BOARD, stored_leaderboard_text
from traps_pipeline.storage.study import Asked, Study
from traps_pipeline.storage.workspace import Workspace

OF_PAIRS = {"contrasts", "regime_tests", "leaderboard", "agreement", "judge_bias", "leave_one_out"}


@pytest.mark.parametrize(
    ("datasets", "of_pairs"),
    [(("graded",), set()), (("two_events",), set()), (("chaotic", "graded"), OF_PAIRS)],
)
def test_a_study_without_pairs_wants_no_table_of_pairs(
    tmp_path: Path, datasets: tuple[str, ...], of_pairs: set[str]
) -> None:
    asked = Asked(datasets=datasets, models=("oracle",), regimes=("priced",), runs=(1,))
    study = Study(scenarios=["plinko-0001", "hidden_race-0001"], experiments={"mine": asked})
    partitions = StudyPartitions(Workspace.create(tmp_path / "study", study))
    wanted = {stage.name for stage in the_graph().stages if list(stage.wanted(partitions))}
    assert wanted & OF_PAIRS == of_pairs
    assert {"verdicts", "graded", "report_page"} <= wanted


def test_a_run_without_pairs_ends_with_a_sentence_in_place_of_the_leaderboard(tmp_path: Path) -> None:
    assert stored_leaderboard_text(Workspace.create(tmp_path / "study", Study(scenarios=["plinko-0001"]))) == NO_BOARD


def test_rows_that_the_study_no_longer_asks_for_are_named_below_the_leaderboard(tmp_path: Path) -> None:
    asked = Asked(datasets=("chaotic",), models=("oracle",), regimes=("standard",), runs=(1,))
    workspace = Workspace.create(tmp_path / "study", Study(scenarios=["plinko-0001"], experiments={"mine": asked}))
    for model, regime in (("oracle", "standard"), ("oracle", "json"), ("prior", "standard"), ("prior", "json")):
        cell = {"dataset": "chaotic", "model": model, "regime": regime, "run": 1}
        workspace.tables.write(VERDICTS, cell, [row(VERDICTS, item_id="a", **cell)], {})
    told = stored_leaderboard_text(workspace).splitlines()[-1]
    assert re.findall(r"\b(?:oracle|prior)\b(?: \(\w+\))?", told) == ["oracle (json)", "prior"]
