"""The layer at which a dataset is read without its labels: saturated figures within a dataset, ties, few datasets."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.layer_choice import layer_choice, pair_curves
from traps_pipeline.mechanism.probing import ProbeRun
from traps_pipeline.protocol.datasets import ANSWERABLE, DATASETS
from traps_pipeline.storage.study import ProbeSettings

LAYERS, PEAK, PAIRS = 6, 4, 10


@pytest.fixture(scope="module")
def saturated() -> pd.DataFrame:
    """Probes of four datasets, each with a cue of its own from layer 1 on and a common one at layer 4 alone."""
    rng, items, states = np.random.default_rng(0), [], {}
    for number, dataset in enumerate(DATASETS):
        taxonomy = dataset.split("_")[0]
        items += [
            (dataset, f"{taxonomy}-{n:02d}", side, taxonomy) for n in range(PAIRS) for side in ("control", "void")
        ]
        void = np.arange(2 * PAIRS) % 2 == 1
        for layer in range(LAYERS):
            states[dataset, layer] = rng.normal(size=(2 * PAIRS, 24))
            states[dataset, layer][np.ix_(void, [*range(number, 16, 4)])] += 12 * (layer > 0)
            states[dataset, layer][void, 16:] += 5 * (layer == PEAK)
    table = pd.DataFrame(items, columns=["dataset", "scenario_id", "side", "sub_scenario"])
    settings = ProbeSettings(folds=5, shuffles=20, resamples=100)
    rows = ProbeRun(table, lambda d, n: states[d, n], LAYERS, 1, settings, 7).rows()
    return pd.DataFrame(rows).assign(model="m")


@pytest.mark.slow
@pytest.mark.promise
def test_a_layer_is_chosen_where_probes_carry_over_although_all_layers_separate_within_a_dataset(
    saturated: pd.DataFrame,
) -> None:
    within = saturated[(saturated["analysis"] == "within") & (saturated["layer"] > 0)]
    assert (within["value"] == 1).all()
    transfer = saturated[saturated["analysis"] == "transfer"]
    assert transfer[transfer["chosen"]]["layer"].tolist() == [PEAK] * 12
    assert transfer[transfer["chosen"]]["value"].min() > 0.95
    assert transfer[transfer["layer"] == 1]["value"].mean() < 0.7  # where the maximum within a dataset is first reached


def row(analysis: str, source: str, target: str, *values: float) -> list[dict[str, object]]:
    return [
        {"analysis": analysis, "source": source, "target": target, "layer": layer, "value": value}
        for layer, value in enumerate(values)
    ]


def test_pairs_with_the_target_do_not_count_and_pairs_of_one_taxonomy_count_as_held_out() -> None:
    rows = row("transfer", "chaotic", "chaotic_ill_posed", 0.5, 1.0, 0.5)  # shares controls: not this figure
    rows += row("held_out", "chaotic", "chaotic_ill_posed", 0.5, 0.6, 0.8)
    rows += row("held_out", "chaotic", "chaotic", 1.0, 1.0, 1.0)  # itself: not a pair
    rows += row("transfer", "occlusion", "chaotic", 0.9, 0.5, 0.5)
    curves = pair_curves(rows)
    assert layer_choice(curves, "occlusion").layer == 2 == layer_choice(curves, ANSWERABLE).layer
    assert layer_choice(curves, "chaotic_ill_posed").layer == 0
    both = layer_choice(curves)
    assert both.curve == pytest.approx({0: 0.7, 1: 0.55, 2: 0.65}) and both.layer == 0


def test_a_layer_of_states_that_are_one_for_all_items_is_never_chosen_where_another_one_varies() -> None:
    constant = row("transfer", "chaotic", "occlusion", 0.5, 0.4, 0.3)  # of random weights: the embedding is the best
    assert layer_choice(pair_curves(constant), "chaotic_ill_posed").layer == 1
    assert layer_choice(pair_curves(row("transfer", "chaotic", "occlusion", 0.5, 0.5))).layer == 0


def test_of_a_plateau_the_middle_is_taken_and_two_datasets_fall_back_on_the_other_one() -> None:
    flat = row("held_out", "chaotic", "chaotic", 0.5, 1.0, 1.0, 1.0, 0.9)
    flat += row("transfer", "chaotic", "occlusion", 0.1, 0.2, 0.3, 0.4, 0.5)
    choice = layer_choice(pair_curves(flat), "occlusion")
    assert (choice.tied, choice.layer) == ([1, 2, 3], 2)
    with raises(TrapsError, "mechanism.layer_choice.layer_choice"):
        layer_choice({}, "occlusion")
