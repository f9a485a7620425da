"""PECS-R and gap on the printed leaderboard: only where an arm was run, with the number of arms behind them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from tests.build.boards import board_of, board_row, tables
from tests.build.cells import row
from traps_pipeline.protocol.datasets import ARMS, DATASETS
from traps_pipeline.report.leaderboard_page import leaderboard_markdown, leaderboard_text, leaderboards
from traps_pipeline.report.page import report_html
from traps_pipeline.scoring.score_rows import ROBUST

BOARD = board_of(*(board_row(model, dataset=d) for model in ("asked", "alone") for d in ("overall", *DATASETS)))


def robust_of(**values: Any) -> pd.DataFrame:
    """A ROBUST row of `asked`."""
    figures = {"arms": [*ARMS], "pecs": 0.25, "pecs_r": 0.05, "gap": 0.2, "refused": None}
    return pd.DataFrame([vars(row(ROBUST, model="asked", regime="standard", **figures | values))])


def shown(robust: pd.DataFrame | None, board: pd.DataFrame = BOARD) -> list[str]:
    return [leaderboard_text(board, robust), leaderboard_markdown(board, robust), report_html(board, robust=robust)]


def test_without_any_arm_the_leaderboard_is_what_it_was_byte_for_byte() -> None:
    before = [leaderboard_text(BOARD), leaderboard_markdown(BOARD), report_html(BOARD)]
    assert shown(None) == shown(robust_of().iloc[:0]) == before
    assert not [text for text in before if "PECS-R" in text or ">gap<" in text]


def test_an_entry_with_arms_has_pecs_r_and_gap_and_one_without_says_not_run() -> None:
    cells = {line.heading: column for line, column in _columns(robust_of())}
    assert (cells["PECS-R"], cells["gap"]) == (["not run", "0.050"], ["not run", "0.200"])
    for text in shown(robust_of()):
        assert text.count("not run") >= 2
        assert "0.050" in text
        assert f"over {len(ARMS)} of {len(ARMS)} arms: decoy, " in text.replace("\\", "")


def test_over_some_arms_pecs_r_carries_their_number_and_a_note_names_them() -> None:
    cells = {line.heading: column for line, column in _columns(robust_of(arms=["decoy", "held_void"]))}
    assert cells["PECS-R"] == ["not run", f"0.050 (2 of {len(ARMS)} arms)"]
    for text in shown(robust_of(arms=["decoy", "held_void"])):
        assert f"PECS-R is over 2 of {len(ARMS)} arms: decoy, held_void" in text.replace("\\", "")


def test_entries_over_different_arms_are_told_apart() -> None:
    both = pd.concat([robust_of(arms=["decoy"]), robust_of(arms=["held_void"]).assign(model="alone")])
    for text in shown(both):
        plain = text.replace("\\", "")
        assert "PECS-R of asked standard is over 1 of" in plain
        assert "PECS-R of alone standard is over 1 of" in plain


def test_a_refused_gap_is_a_dash_with_its_reason() -> None:
    refused = robust_of(gap=np.nan, refused="pairs of epoch e1, arms of epoch e2")
    assert {line.heading: column for line, column in _columns(refused)}["gap"] == ["not run", "–"]
    for text in shown(refused):
        assert "o gap: pairs of epoch e1, arms of epoch e2" in text


def test_other_columns_stay_as_they_are_and_datasets_have_no_pecs_r() -> None:
    overall, *datasets = leaderboards(BOARD, robust_of())
    plain = leaderboards(BOARD)[0]
    assert [c for c in overall.columns if c.heading not in ("PECS-R", "gap")] == plain.columns
    assert overall.rows[plain.rows.columns].equals(plain.rows)
    assert not [table for table in datasets if "PECS-R" in [column.heading for column in table.columns]]
    assert tables(BOARD)[0][0]["PECS"] == "0.250"


def _columns(robust: pd.DataFrame) -> list[tuple[Any, list[str]]]:
    """The columns of the overall table with their cells."""
    table = leaderboards(BOARD, robust)[0]
    return [(column, [cells[k] for cells in table.cells]) for k, column in enumerate(table.columns)]
