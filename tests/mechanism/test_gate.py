"""The gate: thresholds and figures worked out by hand, and what a gate may not have seen."""

from __future__ import annotations

from itertools import product

import numpy as np
import pandas as pd
import pytest

from traps_pipeline.mechanism import gating
from traps_pipeline.mechanism.gate import (
    NO_THRESHOLD,
    OTHER_DATASETS,
    OTHER_FAMILIES,
    GateItems,
    Outcomes,
    gate_answers,
    thresholds,
)
from traps_pipeline.protocol.datasets import DATASETS, taxonomy_of
from traps_pipeline.scoring.bootstrap import interval, metrics_of


def test_thresholds_are_the_ones_worked_out() -> None:
    score = np.array([0.0, 1.0, 2.0, 3.0, 6.0, 8.0])
    void = np.array([False, False, False, True, True, True])
    found = thresholds(score, void, 0.05)
    assert found["mid"] == pytest.approx((17 / 3 + 1) / 2)
    assert found["J"] == pytest.approx(2.5)
    assert found["conformal"] == NO_THRESHOLD  # three controls cannot promise 5 %
    assert thresholds(score, void, 0.25)["conformal"] == 2.0  # rank ceil(4 x 0.75) = 3 of 3
    many = np.arange(19.0)
    found = thresholds(np.append(many, 50.0), np.arange(20) == 19, 0.05)
    assert found["conformal"] == 18.0  # 19 controls are the fewest: rank ceil(20 x 0.95) = 19


def test_gating_turns_answers_into_abstentions_and_nothing_else() -> None:
    nan = np.nan
    outcomes = Outcomes(
        void=np.array([False] * 4 + [True] * 4),
        correct=np.array([1, 1, 0, nan, nan, nan, nan, nan]),
        abstained=np.array([0, 0, 0, 0, 1, 0, 0, 0.0]),
    )
    assert outcomes.metrics() == pytest.approx({"acc": 2 / 3, "false_abs": 0, "abs_rec": 0.25, "pecs": 2 / 3 * 0.25})
    gate = np.array([True, False, False, False, False, True, True, False])
    gated = outcomes.gated(gate).metrics()
    assert gated == pytest.approx({"acc": 1 / 3, "false_abs": 0.25, "abs_rec": 0.75, "pecs": 1 / 3 * 0.5})


@pytest.mark.parametrize("right", [0.0, 1.0])
def test_the_interval_of_a_gate_has_a_width_where_all_items_agree(right: float) -> None:
    n = 12
    void = np.tile([False, True], n)
    outcomes = Outcomes(void, np.where(void, np.nan, right), np.where(void, right, 0.0))
    names = np.repeat([f"occlusion-{number:03d}" for number in range(n)], 2)
    figures = metrics_of(gating._resample(outcomes, "occlusion", names, 2000, 1))
    low, high = interval(figures[:, gating._PECS, 1:], right, (0.0, 1.0))
    outermost = 0.025 ** (1 / n)  # Clopper and Pearson's lower end of n of n; .74 for 12
    assert low <= outermost + 0.02 and high == 1.0 if right else low == 0.0 < high


def study(pairs: int = 12, families: int = 3) -> tuple[GateItems, np.ndarray]:
    """Items of all datasets. Column 0 is the side everywhere; column 1 names the scenario so loudly that a gate which
    has seen it would know it."""
    rows, rng = [], np.random.default_rng(0)
    for dataset, number, void in product(DATASETS, range(pairs), (False, True)):
        taxonomy = taxonomy_of(dataset)
        name, family = f"{taxonomy}-{number:02d}", f"{taxonomy}:{number % families}"
        rows.append((dataset, name, family, f"{name}{dataset if void else ''}", void))
    table = pd.DataFrame(rows, columns=["dataset", "scenario_id", "family", "prompt", "void"])
    features = rng.normal(size=(len(table), 10))
    features[:, 0] += 4 * table["void"]
    return GateItems(table, features), rng.integers(0, 2, len(table)).astype(bool)


SETTINGS = {"folds": 3, "seed": 1, "false_abs": 0.05}


@pytest.mark.parametrize("source", ["one:chaotic", "one:occlusion", OTHER_DATASETS, OTHER_FAMILIES])
def test_a_gate_depends_on_no_label_of_a_scenario_that_it_decides_about(source: str) -> None:
    """Changing the sides of one scenario in every dataset leaves its own scores as they are, bit for bit."""
    items, _ = study()
    before = gate_answers(items, source, "chaotic", **SETTINGS)
    mine = (items.table["scenario_id"] == "chaotic-04").to_numpy()
    changed = items.table.assign(void=np.where(mine, ~items.void, items.void))
    after = gate_answers(GateItems(changed, items.features), source, "chaotic", **SETTINGS)
    own = mine[before.place]
    assert own.sum() == 2 and (before.score[own] == after.score[own]).all()
    assert all((before.threshold[name][own] == after.threshold[name][own]).all() for name in before.threshold)
    if source != "one:occlusion":
        assert (before.score[~own] != after.score[~own]).any()


def test_a_gate_that_leaves_families_out_sees_no_label_of_the_family() -> None:
    items, _ = study()
    before = gate_answers(items, OTHER_FAMILIES, "occlusion", **SETTINGS)
    family = (items.table["family"] == "occlusion:1").to_numpy()
    changed = GateItems(items.table.assign(void=np.where(family, ~items.void, items.void)), items.features)
    after = gate_answers(changed, OTHER_FAMILIES, "occlusion", **SETTINGS)
    own = family[before.place]
    assert own.sum() == 8 and (before.score[own] == after.score[own]).all()


def test_a_planted_signal_is_gated_and_shuffled_labels_are_not() -> None:
    items, coins = study()
    found = gate_answers(items, OTHER_DATASETS, "chaotic", **SETTINGS)
    void = items.void[found.place]
    gate = found.score > found.threshold["J"]
    assert gate[void].mean() > 0.9 and gate[~void].mean() < 0.25
    conformal = found.score > found.threshold["conformal"]
    assert conformal[~void].mean() < 0.35 and np.isfinite(found.threshold["conformal"]).all()
    noise = gate_answers(
        GateItems(items.table.assign(void=coins), items.features), OTHER_DATASETS, "chaotic", **SETTINGS
    )
    loose = noise.score > noise.threshold["mid"]
    assert abs(loose[void].mean() - loose[~void].mean()) < 0.6
