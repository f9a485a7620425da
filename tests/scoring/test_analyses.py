"""The analyses on hand-worked cells, and on the paper's published ones."""

import numpy as np
import pandas as pd
import pytest

from tests.build.errors import raises
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.scoring.analyses import (
    accuracy_by_label,
    frontier,
    hidden_against_others,
    naive_gap,
    overall,
    pair_differences,
    scoped_cells,
    spread,
    study_cells,
    sub_scenarios,
    uplift,
    visual_textual_gap,
    zero_boundary,
)
from traps_pipeline.scoring.epochs import EpochMismatch
from traps_pipeline.scoring.published import published


def cell(model="m", dataset="occlusion", regime="standard", acc=0.5, abs_rec=0.4, false_abs=0.1, pecs=0.15, epoch="e1"):
    return {
        "model": model, "dataset": dataset, "regime": regime, "acc": acc, "abs_rec": abs_rec, "false_abs": false_abs,
        "pecs": pecs, "epoch": epoch,
    }  # fmt: skip


def cells(*rows):
    return pd.DataFrame(list(rows))


def test_overall_is_the_equal_weight_mean_and_averages_pecs_itself():
    frame = cells(
        *(cell(dataset=d, acc=a, pecs=p) for d, a, p in zip(DATASETS, (1, 0, 0.5, 0.5), (0.4, 0, 0, 0), strict=True))
    )
    row = overall(frame).iloc[0]
    assert (row["acc"], row["pecs"]) == (0.5, 0.1)


def test_a_model_that_lacks_a_dataset_has_no_overall_row():
    frame = cells(*(cell(dataset=d) for d in DATASETS), cell(model="partial"))
    assert list(overall(frame)["model"]) == ["m"]


def test_uplift_is_the_ratio_of_means_not_the_mean_of_ratios():
    frame = cells(
        cell(abs_rec=0.1), cell(dataset="chaotic", abs_rec=0.3),
        cell(regime="guided", abs_rec=0.5), cell(dataset="chaotic", regime="guided", abs_rec=0.3),
    )  # fmt: skip
    assert uplift(frame)["ratio"].tolist() == pytest.approx([0.4 / 0.2])
    from_nothing = cells(cell(abs_rec=0.0), cell(regime="guided", abs_rec=0.5))
    assert uplift(from_nothing)["ratio"].tolist() == [np.inf]


def test_a_mean_of_which_a_dataset_has_no_metric_is_null_and_so_is_what_is_made_of_it():
    # In one dataset every void of the standard regime went unanswered: the other three are no mean over the four.
    rates = {"standard": (0.2, 0.2, np.nan, 0.9), "guided": (0.4, 0.4, 0.4, 0.9)}
    frame = cells(
        *(cell(dataset=d, regime=r, abs_rec=x) for r in rates for d, x in zip(DATASETS, rates[r], strict=True))
    )
    means = overall(frame).set_index("regime")["abs_rec"]
    assert np.isnan(means["standard"])
    assert means["guided"] == pytest.approx(0.525)
    table = uplift(frame)
    assert table["model"].tolist() == ["m"]
    assert table["ratio"].isna().all()


def test_a_ratio_across_epochs_is_refused_and_names_model_dataset_and_epochs():
    frame = cells(cell(), cell(regime="guided", epoch="e2"))
    with raises(EpochMismatch, "scoring.epochs.require_one_epoch", "uplift", "m/occlusion"):
        uplift(frame)


def test_a_mean_may_mix_epochs_where_both_sides_mix_them_alike():
    frame = cells(*(cell(dataset=d, regime=r, epoch=f"e-{d}") for d in DATASETS for r in ("standard", "guided")))
    assert uplift(frame)["ratio"].tolist() == [1.0]


def test_the_pooled_gap_is_a_ratio_of_means_and_a_gap_over_zero_is_infinite():
    rates = dict(zip(DATASETS, (0.1, 0.2, 0.0, 0.5), strict=True))
    gaps = visual_textual_gap(cells(*(cell(dataset=d, abs_rec=r) for d, r in rates.items()))).set_index("taxonomy")
    assert gaps["gap"].to_dict() == pytest.approx({"occlusion": 2.0, "chaotic": np.inf, "pooled": 0.35 / 0.05})


def test_the_frontier_keeps_equals_and_drops_whoever_is_beaten_in_one_and_not_better_in_the_other():
    frame = cells(
        cell("a", acc=0.9, abs_rec=0.5), cell("b", acc=0.9, abs_rec=0.4), cell("c", acc=0.5, abs_rec=0.9),
        cell("twin", acc=0.5, abs_rec=0.9), cell("d", acc=0.4, abs_rec=0.8),
    )  # fmt: skip
    means = overall(frame)
    assert list(frontier(means.assign(j=means["abs_rec"] - means["false_abs"]))["model"]) == ["a", "c", "twin"]


def test_the_naive_gap_counts_cells_strictly_above_the_threshold():
    frame = cells(cell("at", acc=0.5, abs_rec=0.4, pecs=0.17), cell("above", acc=0.5, abs_rec=0.4, pecs=0.169))
    assert list(naive_gap(frame, 0.03)["model"]) == ["above"]


def test_zero_boundary_lists_the_cells_with_pecs_0():
    assert list(zero_boundary(cells(cell("none", pecs=0.0), cell("some")))["model"]) == ["none"]


def test_reasoning_pairs_subtract_the_other_from_the_thinking_member():
    frame = cells(
        *(cell("qwen3-vl-think", d, abs_rec=0.6) for d in DATASETS),
        *(cell("qwen3-vl-instruct", d, abs_rec=r) for d, r in zip(DATASETS, (0.5, 0.6, 0.7, 0.8), strict=True)),
    )
    change = pair_differences(frame).set_index("dataset")["abs_rec"]
    assert change.to_dict() == pytest.approx(
        {"occlusion": 0.1, "occlusion_ill_posed": 0.0, "chaotic": -0.1, "chaotic_ill_posed": -0.2}
    )


def test_a_metric_that_one_member_lacks_has_no_difference():
    frame = cells(
        *(cell(m, d, acc=np.nan if (m, d) == ("qwen3-vl-think", "chaotic") else 0.5)
          for m in ("qwen3-vl-think", "qwen3-vl-instruct") for d in DATASETS)
    )  # fmt: skip
    change = pair_differences(frame).set_index("dataset")
    assert change["acc"].isna().to_dict() == {dataset: dataset == "chaotic" for dataset in DATASETS}
    assert change.loc["chaotic", "abs_rec"] == 0.0


def test_a_single_run_has_no_deviation_rather_than_one_of_0():
    runs = {"n_pairs": 9, "n_missing": 0, "incomplete": False, **dict.fromkeys(("acc_std", "abs_rec_std"), 0.1)}
    board = cells(
        cell("one") | runs | {"n_runs": 1, "false_abs_std": 0.0, "pecs_std": 0.0},
        cell("three") | runs | {"n_runs": 3, "false_abs_std": 0.2, "pecs_std": 0.04},
    )
    assert spread(study_cells(board)).iloc[0].tolist() == pytest.approx([0.04, 0.04, 0.04, 1])


def scoped(scope, regime, dataset, abs_rec, run=1, **other):
    return {
        **cell(dataset=dataset, regime=regime, abs_rec=abs_rec), "run": run, "scope": scope,
        "n_pairs": 10, "n_missing": 0, **other,
    }  # fmt: skip


def test_sub_scenarios_average_runs_and_compare_regimes_and_datasets():
    metrics = pd.DataFrame(
        [
            scoped("sub_scenario:dice", "standard", "chaotic", 0.1),
            scoped("sub_scenario:dice", "standard", "chaotic", 0.3, run=2),
            scoped("sub_scenario:dice", "guided", "chaotic", 0.5),
            scoped("sub_scenario:dice", "standard", "chaotic_ill_posed", 0.8),
            scoped("label:dice/red", "standard", "chaotic", 0.4),
            scoped("label:plinko/red", "standard", "chaotic", 0.4, acc=0.9),
            scoped("all", "standard", "chaotic", 0.4),
        ]
    )
    row = sub_scenarios(scoped_cells(metrics, "sub_scenario")).iloc[0]
    assert row[["abs_rec", "guided_abs_rec", "abs_rec_uplift", "textual_over_visual"]].tolist() == pytest.approx(
        [0.2, 0.5, 0.3, 4.0]
    )
    table = accuracy_by_label(scoped_cells(metrics, "label"))
    assert table[["sub_scenario", "label", "acc"]].values.tolist() == [["dice", "red", 0.5], ["plinko", "red", 0.9]]


def test_both_sides_of_a_sub_scenarios_ratio_are_of_the_same_models():
    part, dice = "sub_scenario:dice", {"standard": "chaotic", "textual": "chaotic_ill_posed"}
    metrics = pd.DataFrame(
        [
            scoped(part, "standard", dice["standard"], 0.1, model="a"),
            scoped(part, "standard", dice["textual"], 0.2, model="a", n_missing=3),
            scoped(part, "standard", dice["standard"], np.nan, model="b", n_missing=10),
            scoped(part, "standard", dice["textual"], 0.8, model="b"),
        ]
    )
    row = sub_scenarios(scoped_cells(metrics, "sub_scenario")).iloc[0]
    assert row["textual_over_visual"] == pytest.approx(2.0)  # 0.5 / 0.1 is of two models over one
    assert row[["n_models", "ill_posed_n_models", "guided_n_models", "n_missing"]].tolist() == [1, 1, 0, 3]
    labels = [
        scoped("label:dice/red", "standard", "chaotic", 0.1, model=m, acc=a) for m, a in (("a", 0.4), ("b", np.nan))
    ]
    table = accuracy_by_label(scoped_cells(pd.DataFrame(labels), "label"))
    assert table[["acc", "n_models"]].values.tolist() == [[0.4, 1]]


def test_hidden_sub_scenarios_against_the_others_as_published():
    means = hidden_against_others(published("occlusion_subscenarios"), ["abs_rec_pct"]).set_index("kind")
    assert means["n"].to_dict() == {"hidden": 3, "other": 12}
    assert means["abs_rec_pct"].round(1).to_dict() == {"hidden": 27.0, "other": 4.9}


def test_a_cell_given_twice_is_an_error():
    with raises(ValueError, "scoring.analyses._check", "occlusion", "standard"):
        overall(cells(cell(), cell()))
