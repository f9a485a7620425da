"""The bootstrap with its unseen scenario: against exact binomial intervals, and a slow loop that computes the same."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from statsmodels.stats.proportion import proportion_confint

from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.scoring import bootstrap
from traps_pipeline.scoring.bootstrap import ENTRY, INTERVAL_COLUMNS, draw_scenarios, intervals, quantile, resample


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


def share_interval(rows, yes, n, resamples=4000):
    """The interval of AbsRec where n voids are decided and yes of them abstained on."""
    table = intervals(resample(rows([(True, False, k < yes) for k in range(n)]), resamples))
    row = table.set_index("dataset").loc["occlusion"]
    return row["abs_rec_ci_low"], row["abs_rec_ci_high"]


@pytest.mark.parametrize(("yes", "n"), [(0, 1), (1, 1), (1, 2), (0, 64), (64, 64), (3, 16), (60, 100)])
def test_a_shares_interval_is_that_of_clopper_and_pearson(yes, n, rows):
    # 1 of 1: the lower end is 0.025. 0 of 64: the upper end is 1 - 0.025^(1/64) = 0.056.
    assert share_interval(rows, yes, n) == pytest.approx(proportion_confint(yes, n, method="beta"), abs=0.012)


def test_the_oracles_interval_ends_at_one_and_has_a_width(rows, strategy):
    table = pecs_intervals(everywhere(rows, strategy("oracle", 30)), resamples=500)
    assert list(table.columns) == [*ENTRY, *INTERVAL_COLUMNS]
    assert list(table["dataset"]) == [*DATASETS, "overall"]
    assert (table["pecs_ci_high"] == 1.0).all()
    assert table["pecs_ci_low"].between(0.7, 0.95).all()


@pytest.mark.parametrize("name", ["always-abstain", "never-abstain", "perfect-answerer", "inverse-oracle"])
def test_the_interval_of_a_degenerate_strategy_begins_at_zero_and_has_a_width(name, rows, strategy):
    table = pecs_intervals(everywhere(rows, strategy(name, 30)), resamples=200)
    assert (table["pecs_ci_low"] == 0.0).all()
    if name != "inverse-oracle":  # J is -1, far from any PECS above 0
        assert table["pecs_ci_high"].between(0.001, 0.15).all()


def test_the_matrix_product_agrees_with_a_loop_over_resamples(rows):
    n, resamples, seed = 40, 300, 5
    pairs = {run: random_pairs(n, run) for run in (1, 2, 3)}
    verdicts = pd.concat([rows(p, run=run) for run, p in pairs.items()], ignore_index=True)
    drawn = draw_scenarios(verdicts.assign(taxonomy="occlusion"), resamples, seed)
    weights, unseen = drawn.scenarios["occlusion"][1], drawn.unseen("m|standard|occlusion", 3)
    lower, upper = [], []
    for k in range(1, resamples + 1):
        low, high = [], []
        for cell in pairs.values():
            yes, made = weights[k].astype(float) @ np.array(cell, float), weights[k].astype(float).sum()
            least = yes / (made + unseen[:3, k])
            most = (yes + unseen[:3, k]) / (made + unseen[:3, k])
            low.append(least[0] * (least[2] - most[1]))
            high.append(most[0] * max(0.0, most[2] - least[1]))
        lower.append(np.mean(low))
        upper.append(np.mean(high))
    expected = max(0.0, np.quantile(lower, 0.025)), np.quantile(upper, 0.975)
    assert interval(pecs_intervals(verdicts, resamples, seed)) == pytest.approx(expected, abs=1e-6)


def test_scenarios_of_a_taxonomy_stay_together_in_both_of_its_datasets(rows):
    # Where one dataset's void is abstained on, the other's is not: their mean AbsRec is the same in every resample.
    a, b = ([(True, False, k % 2 == rest) for k in range(100)] for rest in (0, 1))
    widths = []
    for other in (a, b):
        placed = {"occlusion": a, "occlusion_ill_posed": other, "chaotic": a, "chaotic_ill_posed": other}
        verdicts = pd.concat([rows(pairs, dataset=d) for d, pairs in placed.items()], ignore_index=True)
        low, high = interval(pecs_intervals(verdicts, resamples=300), "overall")
        widths.append(high - low)
    assert widths[1] < 0.5 * widths[0]


def test_an_interval_contains_the_metric_that_it_is_of():
    ends = np.array([[0.4, 0.5, 0.6], [0.5, 0.6, 0.7]])
    assert bootstrap.interval(ends, 0.95, (0.0, 1.0)).tolist() == pytest.approx([0.405, 0.95])
    assert bootstrap.interval(ends - 0.5, 0.0, (0.0, 1.0)).tolist() == pytest.approx([0.0, 0.195])
    assert np.isnan(bootstrap.interval(ends * np.nan, np.nan, (0.0, 1.0))).all()


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


def test_items_that_are_not_decided_are_no_evidence(rows):
    # Of four voids one is decided: what is known is 1 of 1.
    table = intervals(resample(rows([(True, False, True), *[(True, False, None)] * 3]), 2000)).iloc[0]
    assert (table["abs_rec_ci_low"], table["abs_rec_ci_high"]) == (pytest.approx(0.025, abs=0.01), 1.0)


def test_a_cell_without_any_decision_has_no_interval(rows):
    assert np.isnan(interval(pecs_intervals(rows([(None, None, None)] * 3), 50))).all()


def test_the_same_seed_gives_the_same_interval_and_another_seed_another(rows):
    verdicts = rows(random_pairs(40, 6))
    assert pecs_intervals(verdicts, 200, seed=1).equals(pecs_intervals(verdicts, 200, seed=1))
    assert not pecs_intervals(verdicts, 200, seed=1).equals(pecs_intervals(verdicts, 200, seed=2))


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_quantiles_are_those_of_numpy_over_what_is_defined(kind):
    draws = np.random.default_rng(1).normal(size=(3, 4, 101)).astype(kind)
    draws[0, 1, :40], draws[1, 2, 1:], draws[2] = np.nan, np.nan, np.round(draws[2])
    for q in (0.0, 0.025, 0.5, 0.975, 1.0):
        assert quantile(draws, q) == pytest.approx(np.nanquantile(draws, q, axis=-1), abs=1e-6)
    assert np.isnan(quantile(np.full((2, 5), np.nan), 0.5)).all()
