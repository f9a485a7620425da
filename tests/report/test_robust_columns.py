"""Figures of arms on the printed leaderboard: only where an arm was run, with the arms behind them."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.build.boards import board_of, board_row
from tests.build.cells import row
from traps_pipeline.protocol.datasets import ARMS, DATASETS
from traps_pipeline.report.leaderboard_page import LEGEND, leaderboard_markdown, leaderboard_text, leaderboards
from traps_pipeline.report.page import report_html
from traps_pipeline.report.terms import TITLES
from traps_pipeline.scoring.score_rows import ROBUST

BOARD = board_of(*(board_row(model, dataset=d) for model in ("asked", "alone") for d in ("overall", *DATASETS)))


HEADINGS = ("Conjunction %", "Robust", "Inferred %")


def robust_of(**values: Any) -> pd.DataFrame:
    """A ROBUST row of `asked`."""
    figures = {"arms": [*ARMS], "conjunction": 0.125, "robust": 0.05, "inference_acc": 0.625, "refused": None}
    return pd.DataFrame([vars(row(ROBUST, model="asked", regime="standard", **figures | values))])


def shown(robust: pd.DataFrame | None, board: pd.DataFrame = BOARD) -> list[str]:
    return [leaderboard_text(board, robust), leaderboard_markdown(board, robust), report_html(board, robust=robust)]


@pytest.mark.slow
def test_without_any_arm_the_leaderboard_is_what_it_was_byte_for_byte() -> None:
    before = [leaderboard_text(BOARD), leaderboard_markdown(BOARD), report_html(BOARD)]
    assert shown(None) == shown(robust_of().iloc[:0]) == before
    assert not [text for text in before if any(heading in text for heading in HEADINGS)]


def test_an_entry_with_arms_has_their_figures_and_one_without_says_not_run() -> None:
    cells = {line.heading: column for line, column in _columns(robust_of())}
    assert [cells[heading] for heading in HEADINGS] == [["not run", said] for said in ("12.5", "0.050", "62.5")]
    for text in shown(robust_of()):
        assert text.count("not run") >= 3 and "0.050" in text
        assert re.search(rf"\b{len(ARMS)}\b[^:]*\b{len(ARMS)}\b[^:]*: decoy, ", text.replace("\\", ""))


def test_entries_over_different_arms_are_told_apart() -> None:
    both = pd.concat([robust_of(arms=["decoy"]), robust_of(arms=["crossed"]).assign(model="alone")])
    for text in shown(both):
        for entry, arm in (("asked standard", "decoy"), ("alone standard", "crossed")):
            assert re.search(rf"{entry}\b[^:]*\b1\b[^:]*\b{len(ARMS)}\b[^:]*: {arm}", text.replace("\\", ""))


def test_figures_that_cannot_join_pairs_and_arms_are_dashes_with_the_reason() -> None:
    refused = robust_of(conjunction=np.nan, robust=np.nan, refused="pairs of epoch e1, arms of epoch e2")
    cells = {line.heading: column for line, column in _columns(refused)}
    assert cells["Conjunction %"] == cells["Robust"] == ["not run", "–"]
    for text in shown(refused):
        assert "pairs of epoch e1, arms of epoch e2" in text


def _columns(robust: pd.DataFrame) -> list[tuple[Any, list[str]]]:
    """The columns of the overall table with their cells."""
    table = leaderboards(BOARD, robust)[0]
    return [(column, [cells[k] for cells in table.cells]) for k, column in enumerate(table.columns)]


def test_every_column_of_the_ranking_is_in_the_legend() -> None:
    headings = {column.heading for column in leaderboards(BOARD, robust_of())[0].columns}
    own_words = {"Model", "Regime", "Runs", *(f"PECS {TITLES[dataset]}" for dataset in DATASETS)}
    assert headings - {*LEGEND} == own_words
