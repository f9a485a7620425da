"""Abstention over many paths: an answer in several paths counts once as an answer, and intervals resample scenarios."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from traps_pipeline.mechanism.shares import effect_rows, share_rows
from traps_pipeline.mechanism.steering import UNSTEERED, ledger_item_id
from traps_pipeline.mechanism.transfer_paths import STEERING_PATHS
from traps_pipeline.protocol.datasets import DATASETS, taxonomy_of
from traps_pipeline.scoring.bootstrap import resampled_sums

ABSTAINS = "s0"  # of two scenarios the one on whose void the model always abstains


def study(scenarios: tuple[str, ...] = ("s0", "s1")) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Answers and the votes of three judges, who agree, of all 14 paths at alpha 0 and 10, one regime."""
    asked = [(target, UNSTEERED, UNSTEERED, 0, 0.0) for target in DATASETS]
    asked += [(target, source, "void", 3, 10.0) for source, target in STEERING_PATHS]
    rows = []
    for target, source, kind, layer, alpha in asked:
        for scenario in (f"{taxonomy_of(target)}-{name}" for name in scenarios):
            for side in ("control", "void"):
                item = {"dataset": target, "scenario_id": scenario, "side": side}
                rows.append(
                    item
                    | {"item_id": f"{target}:{scenario}:{side}", "source": source, "kind": kind, "layer": layer}
                    | {"alpha": alpha, "request_key": f"{ledger_item_id(item)} {source} {alpha}"}
                    | {"abstained": side == "void" and scenario.endswith(ABSTAINS)}
                )
    frame = pd.DataFrame(rows).assign(model="m", directions="guided", regime="guided", epoch="e", alpha_relative=0.1)
    frame = frame.assign(draw=0, unit="alpha", dose=frame["alpha"], signs="label", degenerate=None)
    votes = frame.assign(task="abstention", valid=True, benchmark_version="v1", correct=None)
    return frame.drop(columns="abstained"), votes.merge(pd.DataFrame({"judge": ["a", "b", "c"]}), how="cross")


def whole(rows: list[dict[str, object]]) -> pd.DataFrame:
    frame = pd.DataFrame(rows).query("path_set == 'all' and directions == 'all' and regime == 'all'")
    return frame.set_index(["side", "alpha"])


def test_an_answer_that_stands_in_several_paths_is_one_answer_about_one_scenario() -> None:
    shares = whole(share_rows(*study(), resamples=200))
    assert (shares["n_paths"] == 14).all() and (shares["n"] == 28).all()
    # 2 scenarios: 4 targets' voids as they are; 4 sources' directions on the controls of 2 taxonomies; 14 paths' voids
    assert shares["n_answers"].to_dict() == {
        ("control", 0.0): 4, ("control", 10.0): 16, ("void", 0.0): 8, ("void", 10.0): 28,
    }  # fmt: skip
    assert set(shares["n_scenarios"]) == {4}
    assert shares["abstention"].to_dict() == {
        ("control", 0.0): 0, ("control", 10.0): 0, ("void", 0.0): 0.5, ("void", 10.0): 0.5,
    }  # fmt: skip


@pytest.mark.slow
def test_its_interval_is_as_wide_as_the_scenarios_are_few() -> None:
    # One scenario of two abstains throughout, in each taxonomy, whatever the number of paths: about what 2 of 4 answers
    # say (0.07 to 0.93); 28 independent answers would have given 0.33 to 0.67.
    void = whole(share_rows(*study(), resamples=2000)).loc[("void", 10.0)]
    assert void["low"] < 0.15 and void["high"] > 0.85
    control = whole(share_rows(*study(), resamples=2000)).loc[("control", 10.0)]
    assert control["low"] == 0.0 and 0.4 < control["high"] < 0.9


@pytest.mark.slow
def test_of_64_answers_without_an_abstention_the_interval_keeps_a_width() -> None:
    scenarios = tuple(f"s{k}" for k in range(1, 65))  # none of them is s0, which abstains
    rows = pd.DataFrame(share_rows(*study(scenarios), resamples=2000))
    one = rows.query("path_set == 'within_domain' and regime == 'all' and directions == 'all' and side == 'control'")
    assert (one["low"] == 0.0).all()
    assert one["high"].between(0.03, 0.06).all()  # two taxonomies of 64: less than 1 - 0.025^(1/64) = 0.056 of one


@pytest.mark.slow
def test_undecided_answers_are_a_share_of_their_own_and_the_sweep_is_left_out() -> None:
    answers, votes = study()
    votes["abstained"] = votes["abstained"].astype(object)
    broken = (votes["scenario_id"] == "chaotic-s1") & (votes["judge"] != "a")  # one vote of three decides nothing
    votes.loc[broken, ["valid", "abstained"]] = [False, None]
    shares = whole(share_rows(answers, votes, resamples=50))
    assert set(shares["n_scenarios"]) == {4}
    assert shares["abstention"]["void", 10.0] == pytest.approx(0.5)  # s0 of two, in each of 14 paths
    assert shares["undecided"]["void", 10.0] == pytest.approx(7 * 0.5 / 14)
    deep = [frame.assign(layer=5, kind="void") for frame in study() if frame is not None]
    sweep = [frame.loc[(frame["alpha"] == 10) & (frame["side"] == "control")] for frame in deep]
    both = [pd.concat(pair, ignore_index=True) for pair in zip(study(), sweep, strict=True)]
    assert set(whole(share_rows(*both, resamples=50))["layer"]) == {3}


def test_the_majority_of_the_panel_that_voted_on_a_cell_decides_its_answers() -> None:
    """Two of three decide; a cell on which another panel sat keeps that panel's verdicts."""
    answers, votes = study()
    outvoted = (votes["judge"] == "c") & (votes["dataset"] == "occlusion")
    votes.loc[outvoted, "abstained"] = ~votes.loc[outvoted, "abstained"].to_numpy(bool)
    elsewhere = votes["dataset"] == "chaotic"
    votes.loc[elsewhere, "judge"] = votes.loc[elsewhere, "judge"].map({"a": "d", "b": "e", "c": "f"})
    unanimous = pd.DataFrame(effect_rows(*study()))
    pd.testing.assert_frame_equal(pd.DataFrame(effect_rows(answers, votes)), unanimous)
    assert (unanimous["n_missing"] == 0).all() and unanimous["abstained"].any()


def test_resampled_sums_of_no_cells_are_none() -> None:
    """A study that steers one taxonomy alone has no paths of the other."""
    assert resampled_sums(np.ones((5, 3)), np.zeros((3, 0, 2))).shape == (0, 2, 5)
