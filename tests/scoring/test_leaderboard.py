"""Averages over runs and datasets, and the pooled J of random strategies."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.scoring.bootstrap import intervals, resample
from traps_pipeline.scoring.contrasts import contrasts
from traps_pipeline.scoring.metrics import cell_metrics
from traps_pipeline.scoring.score_rows import LEADERBOARD
from traps_pipeline.scoring.standings import leaderboard, wrong_intervals
from traps_pipeline.storage.parquet import TableStore

STRATEGIES = ["oracle", "always-abstain", "never-abstain", "perfect-answerer", "inverse-oracle"]


def board_of(verdicts):
    parts = [cell_metrics(rows) for _, rows in verdicts.groupby("dataset")] or [cell_metrics(verdicts)]
    metrics = pd.concat(parts, ignore_index=True)
    resampled = resample(verdicts, resamples=100)
    return leaderboard(metrics, intervals(resampled), contrasts(resampled, metrics, verdicts))


def entry(board, dataset="occlusion", model="m", regime="standard"):
    return board.set_index(["model", "regime", "dataset"]).loc[(model, regime, dataset)]


def test_pecs_is_averaged_per_run_and_not_computed_from_averages(rows):
    # Run 1: Acc 1, J 1, PECS 1. Run 2: Acc 0, J 0, PECS 0. Mean 0.5; the averages would give 0.5 x 0.5 = 0.25.
    verdicts = pd.concat([rows([(True, False, True)]), rows([(False, False, False)], run=2)], ignore_index=True)
    row = entry(board_of(verdicts))
    assert (row.n_runs, row.acc, row.j, row.pecs) == (2, 0.5, 0.5, 0.5)


def test_the_deviation_over_runs_divides_by_the_number_of_runs(rows):
    # Acc 1, 0.5, 0 over three runs: population sd = sqrt((0.25 + 0 + 0.25) / 3).
    runs = {1: [True, True], 2: [True, False], 3: [False, False]}
    parts = [rows([(c, False, True) for c in correct], run=run) for run, correct in runs.items()]
    row = entry(board_of(pd.concat(parts, ignore_index=True)))
    assert row.acc_std == pytest.approx(np.sqrt(0.5 / 3))
    assert (row.abs_rec_std, row.false_abs_std, row.j_std) == (0.0, 0.0, 0.0)


def test_overall_weighs_datasets_equally_within_each_run(rows):
    # PECS per run = AbsRec here. Run 1: 1, 0, 0, 0 -> 0.25. Run 2: 1, 1, 1, 0 -> 0.75. Sizes differ and do not matter.
    recognised = {1: (True, False, False, False), 2: (True, True, True, False)}
    parts = [
        rows([(True, False, yes)] * (5 if dataset == "chaotic" else 2), dataset=dataset, run=run)
        for run, flags in recognised.items()
        for dataset, yes in zip(DATASETS, flags, strict=True)
    ]
    row = entry(board_of(pd.concat(parts, ignore_index=True)), "overall")
    assert (row.pecs, row.pecs_std) == (0.5, 0.25)
    assert (row.n_pairs, row.n_items, row.n_runs) == (2 + 2 + 5 + 2, 22, 2)
    assert row.pecs_ci_low <= 0.5 <= row.pecs_ci_high


def test_a_model_that_lacks_a_dataset_has_no_overall_row(rows):
    whole = [rows([(True, False, True)], dataset=d) for d in DATASETS]
    partial = [rows([(True, False, True)], dataset=d, model="n") for d in DATASETS[1:]]
    board = board_of(pd.concat([*whole, *partial], ignore_index=True))
    assert set(board.loc[board["model"] == "m", "dataset"]) == {*DATASETS, "overall"}
    assert set(board.loc[board["model"] == "n", "dataset"]) == set(DATASETS[1:])


def test_a_run_that_lacks_a_dataset_stays_out_of_overall(rows):
    parts = [rows([(True, False, True)], dataset=d) for d in DATASETS]
    parts.append(rows([(False, False, True)], dataset="chaotic", run=2))
    row = entry(board_of(pd.concat(parts, ignore_index=True)), "overall")
    assert (row.n_runs, row.acc, row.pecs_ci_high) == (1, 1.0, 1.0)
    assert row.pecs_ci_low < 0.1  # one scenario of each taxonomy says next to nothing


def test_a_null_run_makes_the_mean_null_instead_of_resting_on_fewer_runs(rows):
    verdicts = pd.concat([rows([(True, False, True)]), rows([(True, False, None)], run=2)], ignore_index=True)
    row = entry(board_of(verdicts))
    assert (row.acc, row.n_missing) == (1.0, 1)
    assert np.isnan([row.abs_rec, row.pecs, row.pecs_std, row.pecs_ci_low]).all()


def test_bounds_are_averaged_over_runs_and_datasets(rows):
    # Run 1 is perfect; run 2 lacks its only void in one dataset, where PECS may be 0 to 1. There: (1 + 0) / 2 to 1.
    parts = [rows([(True, False, True)], dataset=d, run=r) for d in DATASETS for r in (1, 2)]
    parts[1] = rows([(True, False, None)], run=2, outcomes=["answer", "empty"])
    board = board_of(pd.concat(parts, ignore_index=True))
    assert tuple(entry(board)[["pecs_low", "pecs_high"]]) == (0.5, 1.0)
    assert tuple(entry(board, "overall")[["pecs_low", "pecs_high"]]) == ((1 + (3 + 0) / 4) / 2, 1.0)
    assert tuple(entry(board, "chaotic")[["pecs_low", "pecs", "pecs_high"]]) == (1.0, 1.0, 1.0)


def test_what_became_of_the_items_is_summed_over_runs_and_datasets(rows):
    # Of the four items of two pairs one has an answer in each run; in run 2 another is cut off before it answers.
    pairs = [(True, False, None), (None, None, None)]
    kinds = {1: ["answer", "refused", "empty", "error"], 2: ["answer", "truncated", "empty", "error"]}
    parts = [rows(pairs, dataset=d, run=r, outcomes=o) for d in DATASETS for r, o in kinds.items()]
    board = board_of(pd.concat(parts, ignore_index=True))
    columns = ["n_refused", "n_empty", "n_truncated", "n_errors", "answered", "incomplete", "broken"]
    assert tuple(entry(board)[columns]) == (1, 2, 1, 2, 2 / 8, True, 3 / 8)
    assert tuple(entry(board, "overall")[columns]) == (4, 8, 4, 8, 8 / 32, True, 12 / 32)


@pytest.mark.parametrize(
    ("outcome", "dots", "is_broken"),
    [("degenerate", 1, False), ("degenerate", 2, True), ("unfinished", 2, True), ("unread", 2, True)],
)
def test_an_entry_is_broken_where_more_than_1_percent_of_its_texts_say_nothing(outcome, dots, is_broken, rows):
    verdicts = rows([(True, False, True)] * 50, outcomes=[outcome] * dots + ["answer"] * (100 - dots))
    row = entry(board_of(verdicts))
    assert (row[f"n_{outcome}"], row.broken, row.is_broken) == (dots, dots / 100, is_broken)


def test_models_of_two_panels_are_neither_ranked_nor_contrasted_together_and_a_mixed_one_has_no_rank(rows):
    good, bad = [(True, False, True)] * 40, [(True, False, False)] * 40
    parts = [
        rows(good, model="a", panel="one@1"),
        rows(bad, model="b", panel="one@1"),
        rows(bad, model="c", panel="two@1"),
        rows(good, model="d", panel="one@1"),
        rows(good, model="d", panel="two@1", run=2),
    ]
    verdicts = pd.concat(parts, ignore_index=True)
    cells = pd.concat([cell_metrics(part) for _, part in verdicts.groupby("dataset")])
    table = contrasts(resample(verdicts, 200), cells, verdicts)
    board = leaderboard(cells, intervals(resample(verdicts, 200)), table).set_index("model")
    assert board["panel"].to_dict() == {"a": "one@1", "b": "one@1", "c": "two@1", "d": "one@1+two@1"}
    assert board["rank"].astype("object").where(board["rank"].notna(), None).to_dict() == {
        "a": 1, "b": 2, "c": 1, "d": None,
    }  # fmt: skip
    of_j = table.loc[table["metric"] == "j"].to_dict("records")
    refused = {(row["left_model"], row["right_model"]): row["refused"] for row in of_j}
    assert {pair for pair, why in refused.items() if pd.isna(why)} == {("a", "b")}
    assert -1 < refused["a", "c"].find("one@1") < refused["a", "c"].find("two@1")  # left, right


@pytest.mark.parametrize(("lost", "incomplete"), [(0, False), (1, False), (2, True)])
def test_an_entry_is_incomplete_below_99_percent_answered(lost, incomplete, rows):
    verdicts = rows([(True, False, True)] * 50, outcomes=["error"] * lost + ["answer"] * (100 - lost))
    row = entry(board_of(verdicts))
    assert (row.answered, row.incomplete) == (1 - lost / 100, incomplete)


def test_an_entry_that_answered_every_item_of_a_held_out_set_is_complete(rows):
    verdicts = rows([(True, False, True)] * 4).iloc[[0, 3, 4, 7]]  # one side of each pair
    row = entry(board_of(verdicts))
    assert (row.n_pairs, row.n_items, row.n_missing, row.answered, row.incomplete) == (4, 4, 0, 1.0, False)
    assert (row.pecs, row["rank"]) == (1.0, 1)


def test_an_item_without_a_majority_is_answered_all_the_same(rows):
    row = entry(board_of(rows([(None, False, True)])))
    assert (row.n_missing, row.answered, row.incomplete) == (1, 1.0, False)


def test_overall_is_incomplete_where_any_of_its_datasets_is(rows):
    # 1 of 602 items is lost, but it is half of a small dataset.
    parts = [rows([(True, False, True)] * 100, dataset=d) for d in DATASETS[:3]]
    small = rows([(True, False, None)], dataset=DATASETS[3], outcomes=["answer", "refused"])
    board = board_of(pd.concat([*parts, small, rows([(True, False, True)], model="n")], ignore_index=True))
    flags = board.set_index(["model", "dataset"])["incomplete"].to_dict()
    assert flags == {("m", d): d in (DATASETS[3], "overall") for d in (*DATASETS, "overall")} | {
        ("n", "occlusion"): False
    }
    assert entry(board, "overall").answered == 601 / 602


def test_an_entry_of_errors_alone_has_a_row_without_a_pecs(rows, tmp_path):
    parts = [rows([(None, None, None)] * 2, dataset=d, outcomes=["error"]) for d in DATASETS]
    board = board_of(pd.concat(parts, ignore_index=True))
    row = entry(board, "overall")
    assert (row.n_missing, row.n_errors, row.answered, row.incomplete) == (16, 16, 0.0, True)
    assert (row.pecs_low, row.pecs_high) == (0.0, 1.0)
    assert np.isnan(row.pecs)
    TableStore(tmp_path).write(LEADERBOARD, {}, board, {})


def test_degenerate_strategies_score_zero_overall_and_the_oracle_one(rows, strategy, tmp_path):
    parts = [rows(strategy(s, 10), dataset=d, model=s, run=r) for s in STRATEGIES for d in DATASETS for r in (1, 2)]
    board = board_of(pd.concat(parts, ignore_index=True))
    overall = board[board["dataset"] == "overall"].set_index("model")
    assert overall["pecs"].to_dict() == {s: float(s == "oracle") for s in STRATEGIES}
    oracle = entry(board, "overall", "oracle")
    assert 0.4 < oracle.pecs_ci_low < 0.8 and oracle.pecs_ci_high == 1.0
    assert entry(board, "overall", "inverse-oracle").j == -1.0
    store = TableStore(tmp_path)
    store.write(LEADERBOARD, {}, board, {})
    assert len(store.read(LEADERBOARD, {})) == len(STRATEGIES) * 5


def test_overall_names_every_version_and_epoch_it_rests_on(rows):
    parts = [rows([(True, False, True)], dataset=d, epoch="e2" if d == "chaotic" else "e1") for d in DATASETS]
    versions = {d: "v1+ab12" if d == "chaotic" else "v1" for d in DATASETS}
    verdicts = pd.concat(parts, ignore_index=True)
    board = board_of(verdicts.assign(benchmark_version=verdicts["dataset"].map(versions)))
    assert tuple(entry(board, "overall")[["benchmark_version", "epoch"]]) == ("v1 + v1+ab12", "e1+e2")
    assert tuple(entry(board, "chaotic")[["benchmark_version", "epoch"]]) == ("v1+ab12", "e2")


def test_nothing_scored_gives_an_empty_board(rows, tmp_path):
    verdicts = rows([])
    board = board_of(verdicts)
    assert board.empty
    TableStore(tmp_path).write(LEADERBOARD, {}, board, {})


@pytest.mark.parametrize(
    ("metric", "low", "wrong"), [("pecs", -0.1, 1), ("j", -0.1, 0), ("j", -1.1, 1), ("acc", 0.0, 0)]
)
def test_intervals_out_of_order_or_range_are_counted(metric, low, wrong, rows):
    board = board_of(rows([(True, False, True), (True, False, False), (True, False, True)])).head(1)
    assert wrong_intervals(board) == 0
    assert wrong_intervals(board.assign(**{f"{metric}_ci_low": low})) == wrong
    assert wrong_intervals(board.assign(**{f"{metric}_ci_high": 1.1})) == 1
    assert wrong_intervals(board.assign(**{f"{metric}_ci_low": 0.6, f"{metric}_ci_high": 0.4})) == 1
    assert wrong_intervals(board.assign(**{f"{metric}_ci_low": np.nan, f"{metric}_ci_high": np.nan})) == 0
