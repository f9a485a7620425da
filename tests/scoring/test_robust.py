"""PECS-R, the gap and twin accuracy against figures worked out by hand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.build.errors import raises
from tests.build.verdicts import of_arm, write
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.pipeline.stages import scoring_stages
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.scoring.bootstrap import intervals, resample
from traps_pipeline.scoring.robust import robust, wrong_rows
from traps_pipeline.scoring.score_rows import ROBUST
from traps_pipeline.storage.parquet import TableStore
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

Rows = Callable[..., pd.DataFrame]
Pairs = list[tuple[Any, ...]]
RIGHT, SHY, BOLD = (True, False, True), (False, True, True), (True, False, False)  # BOLD never abstains


def cells(rows: Rows, dataset: str, pairs: Pairs, **cell: Any) -> pd.DataFrame:
    """VERDICTS rows of a dataset or arm. Categories and scenarios are as the benchmark has them; those of an arm are
    occlusion's."""
    chaotic = dataset.startswith("chaotic")
    made = of_arm(rows, dataset, pairs, categories=("plinko",) if chaotic else ("hidden",), **cell)
    numbers = made["scenario_id"].str.rpartition("-")[2]
    return made.assign(scenario_id=("plinko-" if chaotic else "hidden_drop-") + numbers)


def study(rows: Rows, pairs: Pairs, arms: dict[str, Pairs], **cell: Any) -> pd.DataFrame:
    """All four datasets with the same pairs, and arms."""
    parts = {**dict.fromkeys(DATASETS, pairs), **arms}
    return pd.concat([cells(rows, name, of, **cell) for name, of in parts.items()], ignore_index=True)


def only(table: pd.DataFrame) -> Any:
    assert len(table) == 1
    assert wrong_rows(table) == 0
    return table.iloc[0]


def test_kinds_have_equal_weight_however_many_items_they_have(rows: Rows) -> None:
    # Pairs: Acc 1, FalseAbs 0, AbsRec 1, PECS 1. Decoys: Acc 0, FalseAbs 1. Held voids: AbsRec 0.
    # Acc-R = (1 + 0) / 2, FalseAbs-R = (0 + 1) / 2, AbsRec-R = (1 + 0) / 2, so that J-R = 0 and PECS-R = 0.
    arms = {"decoy": [SHY] * 3, "held_void": [BOLD] * 2}
    row = only(robust(study(rows, [RIGHT] * 50, arms), 20))
    assert (row.acc_r, row.false_abs_r, row.abs_rec_r, row.pecs_r) == (0.5, 0.5, 0.5, 0.0)
    assert (row.pecs, row.gap) == (1.0, 1.0)
    assert row.arms == ["decoy", "held_void"]
    assert (row.n_runs, row.n_items, row.n_missing) == (1, 4 * 100 + 3 + 2, 0)


def test_pecs_r_of_arms_of_one_and_of_two_sides(rows: Rows) -> None:
    # Decoys: one of four abstained on and wrong. Swapped choices: of two pairs, controls 1/2 right and 0 abstained on,
    # voids 1/2. Acc-R = (1 + 3/4 + 1/2) / 3 = 3/4, FalseAbs-R = (0 + 1/4 + 0) / 3 = 1/12,
    # AbsRec-R = (1 + 1/2) / 2 = 3/4, PECS-R = 3/4 x (3/4 - 1/12) = 1/2.
    arms = {"decoy": [RIGHT] * 3 + [SHY], "choices_swapped": [(True, False, True), (False, False, False)]}
    row = only(robust(study(rows, [RIGHT] * 4, arms), 20))
    found = row[["acc_r", "false_abs_r", "abs_rec_r", "pecs_r", "gap"]].to_list()
    assert found == pytest.approx([3 / 4, 1 / 12, 3 / 4, 1 / 2, 1 / 2])


def test_figures_are_computed_per_run_and_then_averaged(rows: Rows) -> None:
    # Run 1: decoys right, PECS-R 1. Run 2: decoys abstained on: Acc-R 1/2, J-R 1 - 1/2, PECS-R 1/4.
    runs = [study(rows, [RIGHT] * 2, {"decoy": [said] * 2}, run=run) for run, said in ((1, RIGHT), (2, SHY))]
    row = only(robust(pd.concat(runs, ignore_index=True), 20))
    assert (row.n_runs, row.pecs_r, row.pecs_r_std, row.gap) == (2, 0.625, 0.375, 0.375)


def test_an_entry_rests_on_the_runs_that_have_most_arms(rows: Rows) -> None:
    # Run 1 alone has the held voids, run 3 no arm, run 4 lacks a dataset.
    one = study(rows, [RIGHT], {"decoy": [RIGHT], "held_void": [RIGHT]}, run=1)
    others = [study(rows, [BOLD], {"decoy": [SHY]}, run=2), study(rows, [BOLD], {}, run=3)]
    partial = study(rows, [BOLD], {"decoy": [SHY], "held_void": [BOLD]}, run=4)
    partial = partial.loc[partial["dataset"] != "chaotic"]
    row = only(robust(pd.concat([one, *others, partial], ignore_index=True), 20))
    assert (row.arms, row.n_runs, row.pecs, row.pecs_r) == (["decoy", "held_void"], 1, 1.0, 1.0)


def test_a_model_without_arms_or_without_all_datasets_has_no_row(rows: Rows) -> None:
    without = study(rows, [RIGHT], {}, model="none")
    partial = pd.concat([cells(rows, name, [RIGHT], model="partial") for name in (*DATASETS[:3], "decoy")])
    whole = study(rows, [RIGHT], {"decoy": [RIGHT]}, model="whole")
    table = robust(pd.concat([without, partial, whole], ignore_index=True), 20)
    assert list(table["model"]) == ["whole"]
    assert robust(without, 20).empty


def test_twin_accuracy_is_the_share_of_scenarios_with_both_worlds_right(rows: Rows) -> None:
    # Controls of five scenarios: right, right, wrong, right, right. Their twins: right, wrong, right, undecided; the
    # fifth has none. Both are decided of three scenarios, and right of one.
    own = [(True, False, True)] * 2 + [(False, False, True)] + [(True, False, True)] * 2
    twins = [(True, False, None), (False, False, None), (True, False, None), (None, None, None)]
    row = only(robust(study(rows, own, {"twin_control": twins}), 20))
    assert (row.twin_accuracy, row.n_twins, row.n_missing) == (pytest.approx(1 / 3), 3, 1)
    assert row.twin_accuracy_std == 0  # of one run
    other = only(robust(study(rows, own, {"decoy": own}), 20))
    assert (other.twin_accuracy, other.n_twins) == (None, 0)


def test_a_figure_without_a_decided_item_is_null(rows: Rows, tmp_path: Path) -> None:
    table = robust(study(rows, [RIGHT], {"held_void": [(True, False, None)]}), 20)
    row = only(table)
    assert np.isnan([row.abs_rec_r, row.pecs_r, row.gap, row.pecs_r_ci_low]).all()
    assert (row.acc_r, row.pecs, row.n_missing) == (1.0, 1.0, 1)
    TableStore(tmp_path).write(ROBUST, {}, table, {})


def test_the_interval_of_pecs_r_is_that_of_pecs_where_the_arm_repeats_the_pairs(rows: Rows) -> None:
    # All controls are right and none abstained on, so that both are means of AbsRec: over the four datasets, and over
    # these and the arm. The arm's voids are the scenarios of occlusion; scenarios are drawn as for PECS.
    pairs = [(True, False, k % 3 > 0) for k in range(30)]
    verdicts = study(rows, pairs, {"held_void": pairs})
    row = only(robust(verdicts, 300))
    board = intervals(resample(verdicts.loc[verdicts["dataset"].isin(DATASETS)], 300)).set_index("dataset")
    overall = board.loc["overall", "pecs_ci_high"] - board.loc["overall", "pecs_ci_low"]
    assert row.pecs_r == pytest.approx(2 / 3) and row.pecs_r_ci_low < 2 / 3 < row.pecs_r_ci_high
    assert row.pecs_r_ci_high - row.pecs_r_ci_low == pytest.approx(overall, rel=0.25)
    assert row.gap == pytest.approx(0.0) and row.gap_ci_low < 0 < row.gap_ci_high
    assert list(board.index) == [*DATASETS, "overall"]


def test_a_scenarios_items_in_pairs_and_arm_are_drawn_together(rows: Rows) -> None:
    # The arm's voids are abstained on where those of the occlusion pairs are not, so that their sum never varies.
    even, odd = ([(True, False, k % 2 == rest) for k in range(20)] for rest in (0, 1))
    parts = {"occlusion": even, "occlusion_ill_posed": even, "chaotic": [RIGHT] * 20, "chaotic_ill_posed": [RIGHT] * 20}
    verdicts = pd.concat([cells(rows, d, p) for d, p in {**parts, "held_void": odd}.items()], ignore_index=True)
    opposite = only(robust(verdicts, 400))
    alike = pd.concat([cells(rows, d, p) for d, p in {**parts, "held_void": even}.items()], ignore_index=True)
    same = only(robust(alike, 400))
    # With the share s of even scenarios AbsRec-R is 3/4 - s/4, of which s cancels in part, against 1/4 + 3s/4.
    assert opposite.pecs_r_ci_high - opposite.pecs_r_ci_low < 0.8 * (same.pecs_r_ci_high - same.pecs_r_ci_low)


def test_an_arm_of_both_taxonomies_is_one_kind_over_all_its_items(rows: Rows) -> None:
    # Swapped choices of one occlusion scenario (all right) and of three chaotic ones (abstained on): Acc 1/4.
    swapped = [
        cells(rows, "choices_swapped", [RIGHT]),
        cells(rows, "chaotic", [SHY] * 3).assign(dataset="choices_swapped"),
    ]
    row = only(robust(pd.concat([study(rows, [RIGHT] * 3, {}), *swapped], ignore_index=True), 20))
    assert (row.acc_r, row.false_abs_r, row.abs_rec_r) == ((1 + 1 / 4) / 2, (0 + 3 / 4) / 2, 1.0)


def test_pairs_and_arms_of_different_campaigns_make_no_gap(rows: Rows, tmp_path: Path) -> None:
    verdicts = pd.concat([study(rows, [RIGHT], {}), cells(rows, "decoy", [RIGHT], epoch="e2")], ignore_index=True)
    table = robust(verdicts, 20)
    row = only(table)
    assert (row.pecs_r, row.gap, row.epoch) == (1.0, None, "e1+e2")
    assert "pairs of epoch e1, arms of epoch e2" in row.refused
    TableStore(tmp_path).write(ROBUST, {}, table, {})


@pytest.mark.parametrize("arms", [{}, {"decoy": [SHY], "twin_control": [RIGHT]}])
def test_the_stage_writes_a_table_with_arms_and_an_empty_one_without(
    rows: Rows, tmp_path: Path, arms: dict[str, Pairs]
) -> None:
    workspace = Workspace.create(tmp_path / "study", Study(scenarios=["plinko-0001"]))
    with raises(TrapsError, "pipeline.stages.scoring_stages._make_robust"):
        scoring_stages._make_robust(workspace, None)
    write(workspace, study(rows, [RIGHT], arms))
    made = scoring_stages._make_robust(workspace, None)
    assert scoring_stages._wrong_robust(workspace, None, made) == ""
    workspace.tables.write(ROBUST, {}, made.frame, {})
    assert [list(row.arms) for row in workspace.tables.read(ROBUST, {}).itertuples()] == ([list(arms)] if arms else [])
