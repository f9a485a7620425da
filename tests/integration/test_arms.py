"""Arms from an experiment to PECS-R: asked on request, made once, and no part of the pairs' figures."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conftest import Checkout
from traps_pipeline.benchmark.tables import ARMS, ITEMS
from traps_pipeline.report.leaderboard import leaderboard_text
from traps_pipeline.scoring.tables import LEADERBOARD, ROBUST
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
EXPERIMENT = """
name: with-arms
models: [oracle, any-rule]
regimes: [standard]
panel: rules
epoch: small
scenarios: [hidden_race-0001, plinko-0001]
datasets:
  [occlusion, occlusion_ill_posed, chaotic, chaotic_ill_posed, removed, held_void, twin_control, choices_swapped]
"""


def test_arms_are_asked_with_the_pairs_and_take_the_shortcuts_gain_away(study: Checkout, tmp_path: Path) -> None:
    path = tmp_path / "with-arms.yaml"
    path.write_text(EXPERIMENT)
    other = Checkout(study.root, tmp_path / "armed")
    (tmp_path / "armed").mkdir()
    (study.workspace / "clips").rename(other.workspace / "clips")
    run = other.traps("run", path, "--until", "leaderboard,robust")
    assert run.code == 0, run.err
    # Pairs: 2 scenarios x 2 datasets x 2 sides. Arms: removed 1, held_void 1, twin_control 2, choices_swapped 2 x 2.
    assert run.counts()["answers"] == 2 * (8 + 1 + 1 + 2 + 4)
    assert run.counts()["frames"] == 50 + 50  # removed and held; the others show the pair's own clips
    tables = Workspace.open(other.workspace).tables
    arms = tables.read_all(ARMS)
    assert arms["refused"].isna().all()
    items = tables.read_all(ITEMS, dataset="held_void")
    assert list(items["side"]) == ["void"] and items["ground_truth"].isna().all()
    robust = tables.read_all(ROBUST).set_index("model")
    board = tables.read_all(LEADERBOARD).query("dataset == 'overall'").set_index("model")
    assert robust.loc["oracle", "pecs_r"] == board.loc["oracle", "pecs"] == 1.0
    assert board.loc["any-rule", "pecs"] == 1.0  # it understands nothing of a void
    assert robust.loc["any-rule", "pecs_r"] < 0.25
    assert robust.loc["any-rule", "gap"] == pytest.approx(1.0 - robust.loc["any-rule", "pecs_r"])
    board_text = leaderboard_text(tables.read(LEADERBOARD, {}), tables.read_all(ROBUST))
    assert "(4 of 9 arms)" in board_text and "nan" not in board_text and "no gap" not in board_text
    again = other.traps("run", path, "--until", "leaderboard,robust")
    assert again.counts() == {"answers": 0, "votes": 0, "frames": 0}
