"""Metrics of a cell against numbers worked out by hand (docs/spec.md 5.1)."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from tests.build.errors import raises
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.scoring.metrics import BOUNDS, CELL_METRICS, cell_metrics, wrong_metrics
from traps_pipeline.scoring.score_rows import LEADERBOARD, METRICS
from traps_pipeline.storage.parquet import TableStore


def one(metrics: pd.DataFrame, **equal: object) -> pd.Series:
    """The single row with these values."""
    for name, value in equal.items():
        metrics = metrics[metrics[name] == value]
    assert len(metrics) == 1
    return metrics.iloc[0]


def test_every_metric_of_a_cell_is_a_column_of_its_table_and_of_the_leaderboard():
    assert {*CELL_METRICS} <= {*METRICS.names} & {*LEADERBOARD.names}


def test_metrics_follow_their_definitions(rows):
    # Five pairs: controls right 4/5, abstained on 1/5; voids abstained on 3/5.
    pairs = [(True, False, True), (True, False, True), (True, True, True), (True, False, False), (False, False, False)]
    cell = one(cell_metrics(rows(pairs)), scope="all")
    assert (cell.n_pairs, cell.n_missing) == (5, 0)
    # J = 0.6 - 0.2 = 0.4; PECS = 0.8 x 0.4 = 0.32; Naive = 0.8 x 0.6 = 0.48
    metrics = {"acc": 0.8, "abs_rec": 0.6, "false_abs": 0.2, "j": 0.4, "pecs": 0.32, "naive": 0.48}
    assert {name: cell[name] for name in CELL_METRICS} == pytest.approx(metrics)
    assert (cell.epoch, cell.benchmark_version) == ("e1", "v1")


def test_a_control_answer_can_be_both_abstained_on_and_correct(rows):
    cell = one(cell_metrics(rows([(True, True, True)])), scope="all")
    assert (cell.acc, cell.false_abs, cell.j, cell.pecs) == (1.0, 1.0, 0.0, 0.0)


def test_pecs_is_not_negative_where_j_is(rows):
    cell = one(cell_metrics(rows([(True, True, False), (True, False, False)])), scope="all")
    assert (cell.j, cell.pecs) == (-0.5, 0.0)


def test_the_oracle_scores_one_on_every_scope(rows, strategy):
    metrics = cell_metrics(rows(strategy("oracle", 12), labels=("yes", "no", "no"), categories=("a", "b")))
    scopes = ["all", *("category:a", "category:b"), *("sub_scenario:a_sub", "sub_scenario:b_sub")]
    scopes += ["label:a_sub/yes", "label:a_sub/no", "label:b_sub/yes", "label:b_sub/no"]
    assert set(metrics["scope"]) == {*scopes}
    assert (metrics["pecs"] == 1.0).all()


def test_undecided_items_leave_their_denominators_and_count_as_missing(rows):
    # Pair 2 lacks correctness only, pair 3 lacks control abstention only, pair 4 lacks its void, pair 5 all three.
    pairs = [(True, False, True), (None, True, True), (True, None, False), (False, False, None), (None, None, None)]
    outcomes = ["answer"] * 8 + ["refused", "empty"]
    cell = one(cell_metrics(rows(pairs, outcomes=outcomes)), scope="all")
    # Missing: controls of 2, 3, 5, voids of 4, 5. Acc over pairs 1, 3, 4; FalseAbs 1, 2, 4; AbsRec 1, 2, 3.
    assert (cell.n_pairs, cell.n_missing, cell.n_refused, cell.n_empty) == (5, 5, 1, 1)
    assert [cell.acc, cell.false_abs, cell.abs_rec] == pytest.approx([2 / 3, 1 / 3, 2 / 3])


def test_a_side_that_nobody_is_asked_is_not_missing(rows):
    # As in a held-out set: controls of pairs 0 to 3, voids of pairs 4 to 7; one of each without a majority.
    pairs = [(True, False, True), (True, False, True), (False, True, True), (None, None, True)]
    pairs += [(True, False, True)] * 2 + [(True, False, False), (True, False, None)]
    verdicts = rows(pairs).iloc[[0, 2, 4, 6, 9, 11, 13, 15]]
    cell = one(cell_metrics(verdicts), scope="all")
    assert (cell.n_pairs, cell.n_missing, cell.n_answered) == (8, 2, 8)
    assert cell.pecs == pytest.approx(2 / 3 * (2 / 3 - 1 / 3))
    assert [cell.pecs_low, cell.pecs_high] == pytest.approx([0.0, 3 / 4 * (3 / 4 - 1 / 4)])  # worst: J = 1/2 - 2/4
    whole = one(cell_metrics(verdicts.loc[verdicts["abstained"].notna()]), scope="all")
    assert (whole.n_missing, whole.pecs_low, whole.pecs_high) == (0, whole.pecs, whole.pecs)
    alone = one(cell_metrics(verdicts.loc[verdicts["side"].eq("void")]), scope="all")
    assert (alone.n_acc, alone.n_missing, alone.pecs_low, alone.pecs_high) == (0, 1, 0.0, 3 / 4)


def test_bounds_of_a_cell_with_three_of_a_hundred_items_missing(rows):
    # Missing: the voids of pairs 47 (empty) and 48 (error), the control of pair 49 (refused). Decided: of 49 controls
    # 40 are right and 5 abstained on; of 48 voids 36 are abstained on.
    pairs = [(k < 40, 40 <= k < 45, k < 36) for k in range(47)]
    pairs += [(False, False, None), (False, False, None), (None, None, False)]
    outcomes = ["answer"] * 98 + ["refused", "answer"]
    outcomes[2 * 47 + 1], outcomes[2 * 48 + 1] = "empty", "error"
    cell = one(cell_metrics(rows(pairs, outcomes=outcomes)), scope="all")
    assert (cell.n_pairs, cell.n_missing, cell.n_answered) == (50, 3, 97)
    assert (cell.n_refused, cell.n_empty, cell.n_errors) == (1, 1, 1)
    assert cell.pecs == pytest.approx(40 / 49 * (36 / 48 - 5 / 49))
    # Worst: Acc 40/50, FalseAbs 6/50, AbsRec 36/50. Best: Acc 41/50, FalseAbs 5/50, AbsRec 38/50.
    assert [cell.pecs_low, cell.pecs_high] == pytest.approx([0.8 * (0.72 - 0.12), 0.82 * (0.76 - 0.10)])


@pytest.mark.parametrize("undecided", [(None, False, True), (True, None, True), (True, False, None)])
def test_a_single_undecided_decision_is_bounded_by_itself(undecided, rows):
    # The other three pairs are perfect. Acc, FalseAbs or AbsRec alone may go wrong in one of four: PECS 3/4 at worst.
    cell = one(cell_metrics(rows([(True, False, True)] * 3 + [undecided])), scope="all")
    assert (cell.n_missing, cell.n_answered) == (1, 8)
    assert (cell.pecs_low, cell.pecs, cell.pecs_high) == (0.75, 1.0, 1.0)


def test_bounds_are_pecs_itself_where_nothing_is_missing(rows, strategy):
    metrics = cell_metrics(rows(strategy("random-50", 37), labels=("yes", "no", "no")))
    assert (metrics[BOUNDS[0]] == metrics["pecs"]).all()
    assert (metrics[BOUNDS[1]] == metrics["pecs"]).all()


SOUND = {"acc": 0.8, "abs_rec": 0.75, "false_abs": 0.25, "pecs": 0.4, "pecs_low": 0.3, "pecs_high": 0.5}


@pytest.mark.parametrize(
    ("altered", "wrong"),
    [
        ({}, 0),
        ({"pecs_low": 0.4, "pecs_high": 0.4}, 0),
        ({"pecs_high": 1.0}, 0),
        ({"pecs_high": 1.1}, 1),
        ({"pecs_low": -0.1}, 1),
        ({"pecs_low": 0.4 + 1e-9}, 1),
        ({"pecs_high": 0.4 - 1e-9}, 1),
        ({"pecs_low": 0.5, "pecs_high": 0.3}, 1),
        ({"pecs": 0.41}, 1),
        ({"acc": 0.9}, 1),
        ({"false_abs": 0.8, "abs_rec": 0.75, "pecs": 0.0, "pecs_low": 0.0}, 0),
        ({"false_abs": -0.25, "pecs": 0.8, "pecs_high": 0.9}, 1),
        ({"abs_rec": 1.25, "pecs": 0.8, "pecs_high": 0.9}, 1),
        ({"acc": 1.5, "pecs": 0.9, "pecs_low": 0.7, "pecs_high": 0.6}, 3),  # a share, its bounds, the product
    ],
)
def test_each_wrong_metric_of_a_cell_is_counted_once(altered, wrong):
    assert [name for name in SOUND if name.startswith("pecs_")] == BOUNDS
    assert wrong_metrics(pd.DataFrame([SOUND | altered])) == wrong
    assert wrong_metrics(pd.DataFrame([SOUND, SOUND | altered])) == wrong


def test_an_empty_denominator_makes_a_metric_null_and_what_depends_on_it(rows):
    cell = one(cell_metrics(rows([(True, False, None), (False, False, None)])), scope="all")
    assert (cell.acc, cell.false_abs) == (0.5, 0.0)
    assert cell[["abs_rec", "j", "pecs", "naive"]].isna().all()
    no_correctness = one(cell_metrics(rows([(None, False, True)])), scope="all")
    assert no_correctness.j == 1.0
    assert no_correctness[["acc", "pecs", "naive"]].isna().all()


def test_a_label_groups_both_sides_by_the_control_answer_within_a_sub_scenario(rows):
    # Labels alternate: pairs 1 and 3 are `left`, pair 2 is `right`.
    pairs = [(True, False, True), (False, False, False), (True, False, False)]
    metrics = cell_metrics(rows(pairs, labels=("left", "right")))
    left, right = (one(metrics, scope=f"label:hidden_sub/{name}") for name in ("left", "right"))
    assert (left.n_pairs, left.acc, left.abs_rec) == (2, 1.0, 0.5)
    assert (right.n_pairs, right.acc, right.abs_rec) == (1, 0.0, 0.0)


def test_cells_do_not_mix_models_regimes_or_runs(rows):
    good, bad = [(True, False, True)], [(False, False, False)]
    parts = [rows(good), rows(bad, run=2), rows(bad, regime="guided"), rows(bad, model="n")]
    metrics = cell_metrics(pd.concat(parts, ignore_index=True))
    cells = metrics[metrics["scope"] == "all"]
    assert len(cells) == 4
    assert cells["pecs"].sum() == one(cells, model="m", regime="standard", run=1).pecs == 1.0


def test_epochs_are_joined_once_each_in_order(rows):
    verdicts = rows([(True, False, True)] * 3)
    verdicts["epoch"] = ["e2", "e1", "e2", "e2", "e1", "e1"]
    assert one(cell_metrics(verdicts), scope="all").epoch == "e1+e2"


def test_several_datasets_at_once_are_refused(rows):
    verdicts = pd.concat([rows([(True, False, True)], dataset=d) for d in ("occlusion", "chaotic")], ignore_index=True)
    with raises(ValueError, "scoring.metrics.cell_metrics"):
        cell_metrics(verdicts)


def test_rows_fit_the_tables_schema_and_survive_a_round_trip(rows, tmp_path):
    store = TableStore(tmp_path)
    verdicts = rows([(True, False, True), (None, None, None), (False, True, None)])
    store.write(VERDICTS, {"dataset": "occlusion", "model": "m", "regime": "standard", "run": 1}, verdicts, {})
    metrics = cell_metrics(store.read_all(VERDICTS))
    store.write(METRICS, {"dataset": "occlusion"}, metrics, {})
    again = store.read_all(METRICS).set_index("scope")
    before = metrics.set_index("scope").loc[again.index]
    assert np.array_equal(again[CELL_METRICS].to_numpy(float), before[CELL_METRICS].to_numpy(float), equal_nan=True)
    assert again["n_missing"].to_dict()["all"] == 3


def test_no_verdicts_give_an_empty_table(rows, tmp_path):
    metrics = cell_metrics(rows([]))
    assert metrics.empty
    TableStore(tmp_path).write(METRICS, {"dataset": "occlusion"}, metrics, {})
