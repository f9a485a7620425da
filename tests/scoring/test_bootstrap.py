"""The cluster bootstrap compared with a slow loop that computes the same."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from traps_pipeline.base.partitions import DATASETS
from traps_pipeline.scoring.bootstrap import ENTRY, INTERVAL_COLUMNS, intervals, resample, scenario_weights


def random_pairs(n, seed, acc=0.7, false_abs=0.1, abs_rec=0.6):
    draws = np.random.default_rng(seed).random((n, 3)) < [acc, false_abs, abs_rec]
    return [tuple(bool(x) for x in row) for row in draws]


def everywhere(rows, pairs, **cell):
    return pd.concat([rows(pairs, dataset=dataset, **cell) for dataset in DATASETS], ignore_index=True)


def pecs_intervals(verdicts, resamples, seed=20260101):
    return intervals(resample(verdicts, resamples, seed))


def interval(table, dataset="occlusion", model="m", regime="standard"):
    row = table.set_index(["model", "regime", "dataset"]).loc[(model, regime, dataset)]
    return row["pecs_ci_low"], row["pecs_ci_high"]


def test_the_oracles_interval_is_exactly_one_to_one(rows, strategy):
    found = pecs_intervals(everywhere(rows, strategy("oracle", 30)), resamples=500)
    assert list(found.columns) == [*ENTRY, *INTERVAL_COLUMNS]
    assert list(found["dataset"]) == [*DATASETS, "overall"]
    assert (found[["pecs_ci_low", "pecs_ci_high"]] == 1.0).all(axis=None)


@pytest.mark.parametrize("name", ["always-abstain", "never-abstain", "perfect-answerer", "inverse-oracle"])
def test_degenerate_strategies_have_the_interval_zero_to_zero(name, rows, strategy):
    found = pecs_intervals(everywhere(rows, strategy(name, 30)), resamples=200)
    assert (found[["pecs_ci_low", "pecs_ci_high"]] == 0.0).all(axis=None)


def test_the_matrix_product_agrees_with_a_loop_over_resamples(rows):
    n, resamples, seed = 40, 300, 5
    pairs = {run: random_pairs(n, run) for run in (1, 2, 3)}
    verdicts = pd.concat([rows(p, run=run) for run, p in pairs.items()], ignore_index=True)
    weights = scenario_weights(n, resamples, [seed, 0])  # the weights of the occlusion taxonomy
    means = []
    for weight in weights:
        drawn = np.repeat(np.arange(n), weight.astype(int))
        per_run = []
        for cell in pairs.values():
            acc, false_abs, abs_rec = np.array(cell, float)[drawn].mean(axis=0)
            per_run.append(acc * max(0.0, abs_rec - false_abs))
        means.append(np.mean(per_run))
    expected = np.quantile(means, [0.025, 0.975])
    assert interval(pecs_intervals(verdicts, resamples, seed)) == pytest.approx(expected, abs=1e-12)


def test_a_single_proportions_interval_is_the_binomials(rows):
    # Acc 1, FalseAbs 0: PECS is AbsRec = 60/100; the binomial's central 95 % is 0.50 to 0.69 (sd 0.049).
    pairs = [(True, False, k < 60) for k in range(100)]
    low, high = interval(pecs_intervals(rows(pairs), resamples=4000))
    assert (low, high) == pytest.approx((0.50, 0.695), abs=0.015)


def test_the_two_datasets_of_a_taxonomy_share_their_resamples(rows):
    pairs = random_pairs(50, 3)
    found = pecs_intervals(everywhere(rows, pairs), resamples=500)
    assert interval(found, "occlusion") == interval(found, "occlusion_ill_posed")
    assert interval(found, "occlusion") != interval(found, "chaotic")


def test_opposite_cells_of_one_taxonomy_cancel_because_clusters_stay_together(rows):
    # Where one dataset's void is abstained on, the other's is not: their mean AbsRec is 1/2 in every resample.
    a = [(True, False, k % 2 == 0) for k in range(20)]
    b = [(True, False, k % 2 == 1) for k in range(20)]
    placed = {"occlusion": a, "occlusion_ill_posed": b, "chaotic": a, "chaotic_ill_posed": b}
    verdicts = pd.concat([rows(pairs, dataset=d) for d, pairs in placed.items()], ignore_index=True)
    assert interval(pecs_intervals(verdicts, resamples=300), "overall") == pytest.approx((0.5, 0.5))


def test_a_models_interval_does_not_depend_on_who_else_is_scored(rows):
    alone = rows(random_pairs(30, 1))
    others = [rows(random_pairs(30, 2), model="n"), rows(random_pairs(30, 4), dataset="chaotic", model="n")]
    together = pd.concat([alone, *others], ignore_index=True)
    assert interval(pecs_intervals(alone, 400)) == interval(pecs_intervals(together, 400))


def test_runs_of_one_scenario_stay_together(rows):
    # Three equal runs carry no more information than one.
    pairs = random_pairs(40, 8)
    once = pecs_intervals(rows(pairs), 400)
    thrice = pecs_intervals(pd.concat([rows(pairs, run=r) for r in (1, 2, 3)], ignore_index=True), 400)
    assert interval(thrice) == pytest.approx(interval(once), abs=1e-12)


def test_resamples_with_an_empty_denominator_are_dropped(rows):
    # Of four voids one is decided: (3/4)^4 = 32 % of the resamples miss it, the others give PECS 1.
    pairs = [(True, False, True), *[(True, False, None)] * 3]
    assert interval(pecs_intervals(rows(pairs), 300)) == (1.0, 1.0)


def test_a_cell_without_any_decision_has_no_interval(rows):
    assert np.isnan(interval(pecs_intervals(rows([(None, None, None)] * 3), 50))).all()


def test_overall_is_null_unless_all_four_datasets_are_present(rows):
    three = pd.concat([rows(random_pairs(10, 1), dataset=d) for d in DATASETS[:3]], ignore_index=True)
    assert np.isnan(interval(pecs_intervals(three, 50), "overall")).all()


def test_the_same_seed_gives_the_same_interval_and_another_seed_another(rows):
    verdicts = rows(random_pairs(40, 6))
    assert pecs_intervals(verdicts, 200, seed=1).equals(pecs_intervals(verdicts, 200, seed=1))
    assert not pecs_intervals(verdicts, 200, seed=1).equals(pecs_intervals(verdicts, 200, seed=2))
