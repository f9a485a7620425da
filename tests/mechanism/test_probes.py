"""Probes: the exact solver against scikit-learn, AUROC, which data a fit may use, and the rows of the protocol."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score
from sklearn.model_selection import PredefinedSplit, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.probes import (
    Split,
    auroc,
    auroc_interval,
    fit_probe,
    nearest_centroid,
    scenario_folds,
    side_swapped_labels,
    solve_gram,
    standardiser,
    within_split,
)
from traps_pipeline.mechanism.probing import Confabulated, NothingConfabulated, ProbeRun, confabulated_scenarios
from traps_pipeline.mechanism.transfer_paths import STEERING_PATHS, TRANSFER_PAIRS
from traps_pipeline.protocol.datasets import ANSWERABLE, DATASETS, LONG, transfer_type
from traps_pipeline.scoring.bootstrap import scenario_weights
from traps_pipeline.scoring.published import published
from traps_pipeline.storage.study import ProbeSettings


def random_states(rows: int, columns: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    void = np.arange(rows) % 2 == 1
    states = rng.normal(size=(rows, columns)) * rng.lognormal(size=columns) + rng.normal(size=columns)
    states[void, : columns // 4] += 0.7
    return states, void


def collinear_states(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Every column twice, one of them constant, one scenario's rows equal."""
    states, void = random_states(rows, columns // 2, 1)
    states[:, 3] = 5.0
    states[1] = states[0]
    return np.hstack([states, 2 * states - 1]), void


CASES = {
    "wide": random_states(60, 300),
    "narrow": random_states(200, 12),
    "collinear": collinear_states(60, 200),
    "unbalanced": (lambda s, v: (s[v | (np.arange(80) < 20)], v[v | (np.arange(80) < 20)]))(*random_states(80, 50)),
}


@pytest.mark.parametrize("case", CASES)
def test_the_exact_solver_finds_the_minimum_that_scikit_learn_approaches(case: str) -> None:
    states, void = CASES[case]
    probe = fit_probe(states, void)
    scaled = StandardScaler().fit_transform(states)
    reference = LogisticRegression(solver="newton-cholesky", tol=1e-12, max_iter=1000).fit(scaled, void)
    assert np.allclose(probe.scores(states), reference.decision_function(scaled), atol=1e-6)
    assert np.allclose(probe.weights, reference.coef_[0], atol=1e-7)
    chance = 1 / (1 + np.exp(-probe.scores(states)))
    assert np.allclose(chance, reference.predict_proba(scaled)[:, 1], atol=1e-7)
    # At the minimum the gradient is zero: w = C X' (y - p), and the intercept's: sum (y - p) = 0.
    assert np.allclose(probe.weights, scaled.T @ (void - chance), atol=1e-8)
    assert abs((void - chance).sum()) < 1e-8


def test_auroc_counts_ties_half_and_takes_many_columns_at_once() -> None:
    void = np.array([True, True, False, False])
    assert float(auroc(void, np.array([2.0, 1.0, 1.0, 0.0]))) == pytest.approx(0.875)  # 3 wins and a tie of 4
    rng = np.random.default_rng(0)
    labels, scores = rng.random(200) < 0.3, rng.integers(0, 9, (200, 5)).astype(float)
    expected = [roc_auc_score(labels, column) for column in scores.T]
    assert np.allclose(auroc(labels, scores), expected, atol=1e-12)
    assert np.isnan(auroc(np.ones(3, bool), np.arange(3.0)))


@pytest.mark.slow
def test_an_interval_resamples_scenarios_as_a_loop_over_resamples_does() -> None:
    rng = np.random.default_rng(3)
    scenario, void = np.repeat(np.arange(12), 2), np.tile([True, False], 12)
    scores = np.round(rng.normal(size=24) + void, 1)
    weights = scenario_weights(12, 300, 5)
    drawn = [roc_auc_score(np.repeat(void, w), np.repeat(scores, w)) for w in weights[:, scenario].astype(int)]
    assert auroc_interval(void, scores, scenario, weights) == pytest.approx(tuple(np.quantile(drawn, [0.025, 0.975])))


def test_an_interval_of_a_perfect_probe_is_as_wide_as_its_scenarios_are_few() -> None:
    """16 pairs that are all told apart: a share of failures up to 1 - .025^(1/16) = .206 cannot be excluded."""
    scenario, void = np.repeat(np.arange(16), 2), np.tile([True, False], 16)
    weights = scenario_weights(16, 200, 5)
    assert auroc_interval(void, void.astype(float), scenario, weights) == pytest.approx((0.025 ** (1 / 16), 1.0))
    assert pytest.approx(0.794, abs=5e-4) == 0.025 ** (1 / 16)
    assert auroc_interval(void, -void.astype(float), scenario, weights) == pytest.approx((0.0, 1 - 0.025 ** (1 / 16)))


def test_a_constant_column_is_not_blown_up_by_rounding() -> None:
    states = np.full((50, 2), 0.1) * np.array([1e6, 1.0]) + np.array([1e-11, 0]) * np.arange(50)[:, None]
    assert np.array_equal(standardiser(states)[1], [1.0, 1.0])
    assert np.array_equal(StandardScaler().fit(states).scale_, [1.0, 1.0])


def test_folds_keep_a_scenario_together_and_differ_by_one_at_most() -> None:
    scenario = np.repeat(np.arange(13), 2)
    folds = scenario_folds(scenario, 5, seed=1)
    assert all(len(set(folds[scenario == s])) == 1 for s in range(13))
    sizes = [len(set(scenario[folds == f])) for f in range(5)]
    assert sorted(sizes) == [2, 2, 3, 3, 3]
    with raises(TrapsError, "mechanism.probes.scenario_folds"):
        scenario_folds(np.arange(4), 5, seed=1)


def test_shuffled_labels_give_half_on_average_even_where_the_signal_is_perfect() -> None:
    rng = np.random.default_rng(0)
    scenario, void = np.repeat(np.arange(40), 2), np.tile([True, False], 40)
    states = np.repeat(rng.normal(size=(40, 30)), 2, axis=0) + rng.normal(size=(80, 30))
    states[void, 0] += 6
    split, folds = Split(states, void, scenario), scenario_folds(scenario, 5, 0)
    swapped = side_swapped_labels(void, scenario, 40, seed=2)
    assert (swapped.sum(axis=0) == 40).all()  # one void a scenario, whichever it is
    areas = within_split(split, np.column_stack([void, swapped]), folds)
    assert areas[0] > 0.99
    error = areas[1:].std() / np.sqrt(40)
    assert abs(areas[1:].mean() - 0.5) < 3 * error < 0.1
    newton = LogisticRegression(solver="newton-cholesky", tol=1e-12, max_iter=1000)
    for labels, area in ((void, areas[0]), (swapped[:, 0], areas[1])):
        by_fold = cross_val_score(
            make_pipeline(StandardScaler(), newton), states, labels, cv=PredefinedSplit(folds), scoring="roc_auc"
        )
        assert by_fold.mean() == pytest.approx(area)


def test_states_that_are_no_numbers_and_a_missing_class_are_told() -> None:
    states, void = random_states(20, 5)
    with raises(TrapsError, "mechanism.probes._check_labels", "20"):
        fit_probe(states, np.ones(20, bool))
    with raises(TrapsError, "mechanism.probes.solve_gram"):
        solve_gram(np.full((20, 20), np.nan), void)


def test_nearest_centroid_goes_by_direction_alone() -> None:
    rng = np.random.default_rng(0)
    void = np.arange(40) % 2 == 1
    states = rng.normal(size=(40, 6)) + 5
    states[void, 0] += 8
    source = Split(states, void, np.arange(40) // 2)
    mean, scale = standardiser(states)
    towards = np.zeros(6)
    towards[0] = 1
    near, far = mean + 0.01 * towards * scale, mean + 100 * towards * scale
    assert nearest_centroid(source, np.stack([near, far, 2 * mean - near])).tolist() == [True, True, False]


# --- the protocol -----------------------------------------------------------------------------------------------------

LAYERS, PLANTED, WIDTH = 4, 2, 20


def study(pairs: int = 12, seed: int = 0) -> tuple[pd.DataFrame, dict[tuple[str, int], np.ndarray]]:
    """Items of all datasets and states of four layers; sides differ at layer 2 alone."""
    rng, rows, states = np.random.default_rng(seed), [], {}
    for dataset in (*DATASETS, ANSWERABLE):
        sides = ("control",) if dataset == ANSWERABLE else ("control", "void")
        taxonomy = "chaotic" if dataset.startswith("chaotic") else "occlusion"
        of = [(dataset, f"{taxonomy}-{n:02d}", side, f"sub{n % 2}") for n in range(pairs) for side in sides]
        rows += of
        void = np.array([side == "void" for _, _, side, _ in of])
        for layer in range(LAYERS):
            states[dataset, layer] = rng.normal(size=(len(of), WIDTH)).astype(np.float32)
            if layer == PLANTED:
                states[dataset, layer][void, :5] += 3
    items = pd.DataFrame(rows, columns=["dataset", "scenario_id", "side", "sub_scenario"])
    return items, states


def run_of(items: pd.DataFrame, states: dict, cf: Confabulated | None = None, folds: int = 3) -> ProbeRun:
    settings = ProbeSettings(folds=folds, shuffles=20, resamples=100)
    return ProbeRun(items, lambda d, n: states[d, n], LAYERS, 1, settings, 7, cf or Confabulated({}))


@pytest.fixture(scope="module")
def rows() -> pd.DataFrame:
    items, states = study()
    some = {d: frozenset(f"{d.split('_')[0]}-{n:02d}" for n in range(8)) for d in DATASETS if d != "chaotic"}
    return pd.DataFrame(run_of(items, states, Confabulated(some, {"chaotic": "none there"})).rows())


@pytest.mark.slow
def test_a_planted_signal_is_found_at_its_layer_and_nowhere_else(rows: pd.DataFrame) -> None:
    transfer = rows[rows["analysis"] == "transfer"]
    assert len(transfer) == len(TRANSFER_PAIRS) * LAYERS == 48
    best = transfer[transfer["own_best"]]
    assert best["layer"].tolist() == [PLANTED] * 12 and best["value"].min() > 0.99
    assert (best["low"] <= best["value"]).all() and (best["value"] <= best["high"]).all()
    elsewhere = transfer[transfer["layer"] != PLANTED].groupby("layer")["value"].mean()
    assert (elsewhere - 0.5).abs().max() < 0.12  # twelve paths of 24 items: standard error 0.035
    chosen = transfer[transfer["chosen"]]
    assert chosen["layer"].tolist() == [PLANTED] * 12


@pytest.mark.promise
def test_shuffled_rows_lie_around_half_at_every_layer(rows: pd.DataFrame) -> None:
    shuffled = rows[rows["analysis"] == "shuffled"]
    assert len(shuffled) == 4 * LAYERS and (shuffled["spread"] > 0).all()
    assert abs(shuffled["value"].mean() - 0.5) < 0.05
    within = rows[(rows["analysis"] == "within") & (rows["layer"] == PLANTED)]
    assert within["value"].min() > 0.95


def test_cf_restricts_both_sets_and_says_why_where_it_cannot(rows: pd.DataFrame) -> None:
    cf = rows[(rows["analysis"] == "confabulated") & rows["value"].notna()]
    assert set(zip(cf["source"], cf["target"], strict=True)) == {p for p in TRANSFER_PAIRS if "chaotic" not in p}
    assert set(cf["n_voids"]) == set(cf["n_controls"]) == {8}
    silent = rows[(rows["analysis"] == "confabulated") & rows["value"].isna()]
    assert len(silent) == 6 and set(silent["note"]) == {"none there"}
    assert cf.groupby(["source", "target"])["own_best"].sum().tolist() == [1] * 6
    assert cf[cf["all_sample_best"]]["layer"].unique().tolist() == [PLANTED]


def test_cf_of_shared_controls_is_held_out_by_scenario_too_or_says_that_too_few_are_left(rows: pd.DataFrame) -> None:
    """Noise, with the same controls in both datasets of a taxonomy, restricted to 12 and to 2 scenarios."""
    held = rows[rows["analysis"] == "confabulated_held_out"]
    pairs = {("occlusion", "occlusion_ill_posed"), ("occlusion_ill_posed", "occlusion")}
    assert set(zip(held["source"], held["target"], strict=True)) == pairs
    assert held.loc[held["layer"] == PLANTED, "value"].min() > 0.95 and set(held["n_voids"]) == {8}
    items, states = study(pairs=15)
    items = items[items["dataset"].isin(["occlusion", "occlusion_ill_posed"])].reset_index(drop=True)
    for dataset in ("occlusion", "occlusion_ill_posed"):
        states[dataset, 0] = np.random.default_rng(len(dataset)).normal(size=(30, 200))
    states["occlusion_ill_posed", 0][::2] = states["occlusion", 0][::2]

    def of(scenarios: int) -> dict[str, pd.DataFrame]:
        some = frozenset(f"occlusion-{n:02d}" for n in range(scenarios))
        run = run_of(items, states, Confabulated({"occlusion": some, "occlusion_ill_posed": some}), folds=5)
        return {str(name): part for name, part in pd.DataFrame(run.comparable_rows(0)).groupby("analysis")}

    many, two = of(12), of(2)
    assert many["confabulated"]["value"].min() > 0.9 > 0.8 > many["confabulated_held_out"]["value"].max()
    assert two["confabulated_held_out"]["value"].isna().all()
    assert re.findall(r"\d+", two["confabulated_held_out"]["note"].iloc[0]) == ["2", "5"]  # voids, folds


@pytest.mark.slow
@pytest.mark.promise
def test_a_target_label_never_influences_a_fit() -> None:
    """Swapping the sides of a target mirrors its AUROC exactly, and leaves every figure of other targets as it is."""
    items, states = study(pairs=6)
    before = pd.DataFrame(run_of(items, states).rows())
    swapped = items.copy()
    target = (items["dataset"] == "chaotic").to_numpy()
    swapped.loc[target, "side"] = np.where(items.loc[target, "side"] == "void", "control", "void")
    after = pd.DataFrame(run_of(swapped, states).rows())
    keys = ["analysis", "source", "target", "layer", "scope"]
    both = before.merge(after, on=keys, suffixes=("", "_after"))
    both = both[both["analysis"] == "transfer"]
    of_target = both[both["target"] == "chaotic"]
    assert np.allclose(of_target["value"] + of_target["value_after"], 1, atol=1e-12)
    others = both[(both["target"] != "chaotic") & (both["source"] != "chaotic")]
    assert len(others) == 6 * LAYERS and (others["value"] == others["value_after"]).all()
    assert (of_target["chosen"] == of_target["chosen_after"]).all()  # the source's choice saw no target label


@pytest.mark.slow
def test_shared_controls_flatter_pairs_of_one_taxonomy_unless_their_scenario_is_held_out() -> None:
    """Pure noise, the same control items in both datasets of a taxonomy, fewer rows than columns."""
    items, states = study(pairs=15)
    rng = np.random.default_rng(5)
    for dataset in (*DATASETS, ANSWERABLE):
        states[dataset, 0] = rng.normal(size=(len(states[dataset, 0]), 200))
    for dataset in ("occlusion", "chaotic"):
        states[f"{dataset}_ill_posed", 0][::2] = states[dataset, 0][::2]
    assert set(items.loc[items["dataset"] == "chaotic", "side"].iloc[::2]) == {"control"}
    found = pd.DataFrame(run_of(items, states, folds=5).layer_rows(0))
    value = {name: rows.set_index(["source", "target"])["value"] for name, rows in found.groupby("analysis")}
    pairs = [(s, t) for s, t in TRANSFER_PAIRS if s.split("_")[0] == t.split("_")[0]]
    itself = [(name, name) for name in DATASETS]
    assert sorted(value["held_out"].index) == sorted([*pairs, *itself]) and len(pairs) == 4
    assert value["transfer"][pairs].min() > 0.9
    assert abs(value["held_out"].mean() - 0.5) < 0.15  # four pairs of 30 items
    across = [pair for pair in TRANSFER_PAIRS if pair not in pairs]
    assert abs(value["transfer"][across].mean() - 0.5) < 0.15


def test_a_sub_scenario_whose_voids_look_like_controls_is_not_caught_and_the_other_one_is() -> None:
    items, states = study(pairs=6)
    for dataset in (*DATASETS, ANSWERABLE):
        of = items[items["dataset"] == dataset]
        disguised = (dataset == "chaotic") & (of["sub_scenario"] == "sub1").to_numpy(bool)
        shown = (of["side"] == "void").to_numpy(bool) & ~disguised
        states[dataset, 1] = np.where(shown[:, None], [[0.0, 1.0]], [[1.0, 0.0]]).astype(np.float32)
    found = pd.DataFrame(run_of(items, states, folds=2).layer_rows(1))
    rows = found.set_index(["analysis", "source", "target", "scope"])["value"].sort_index()
    caught = rows["centroid_void", "occlusion", "chaotic"]
    assert caught.to_dict() == {"all": 0.5, "sub_scenario:sub0": 1.0, "sub_scenario:sub1": 0.0}
    assert set(rows["centroid_control", "occlusion", "chaotic"]) == {0.0}


def test_a_layer_out_of_range_and_missing_states_are_told() -> None:
    items, states = study(pairs=4)
    with raises(TrapsError, "mechanism.probing.ProbeRun.__post_init__", "32"):
        replace(run_of(items, states), centroid_layer=32)
    with raises(TrapsError, "mechanism.probing.ProbeRun.__post_init__"):
        run_of(items.iloc[:0], states)
    with raises(TrapsError, "mechanism.probing.ProbeRun._split", "occlusion"):
        run_of(items, {place: of[:3] for place, of in states.items()}).layer_rows(0)


def test_confabulated_items_are_decided_voids_that_were_answered() -> None:
    verdicts = pd.DataFrame(
        [("a", "void", False), ("b", "void", True), ("c", "void", None), ("d", "control", False)],
        columns=["scenario_id", "side", "abstained"],
    )
    assert confabulated_scenarios(verdicts, "chaotic", "m") == {"a"}
    with raises(NothingConfabulated, "mechanism.probing.confabulated_scenarios", "chaotic"):
        confabulated_scenarios(verdicts[1:3], "chaotic", "m")


# --- paths ------------------------------------------------------------------------------------------------------------


def test_transfer_types_of_the_twelve_pairs_are_the_papers() -> None:
    rows = published("probe_transfer")
    derived = [transfer_type(LONG[s], LONG[t]) for s, t in zip(rows["source"], rows["target"], strict=True)]
    assert derived == rows["transfer_type"].tolist()


def test_there_are_fourteen_steering_paths() -> None:
    qwen = published("steering_alpha10_qwen")
    gemma = published("steering_dose_gemma")[["source", "target"]].drop_duplicates()
    printed = {(LONG[s], LONG[t]) for f in (qwen, gemma) for s, t in zip(f["source"], f["target"], strict=True)}
    assert set(STEERING_PATHS) == printed and len(STEERING_PATHS) == 14
