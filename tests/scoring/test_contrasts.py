"""Paired contrasts, Holm's correction, McNemar's test, Wilson's interval: by hand and against statsmodels."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from statsmodels.stats.contingency_tables import mcnemar
from statsmodels.stats.multitest import multipletests
from statsmodels.stats.proportion import proportion_confint

from tests.build.errors import raises
from tests.judging.conftest import item_row
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cli import main
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.scoring.bootstrap import (
    RESAMPLED_METRICS,
    draw_scenarios,
    interval,
    intervals,
    limits_of,
    metrics_of,
    resample,
    resampled_sums,
    with_unseen,
)
from traps_pipeline.scoring.contrasts import contrasts, holm, regime_tests, version_contrasts
from traps_pipeline.scoring.metrics import cell_metrics, wilson
from traps_pipeline.scoring.standings import leaderboard
from traps_pipeline.storage.benchmark_tables import ITEMS, ItemRow
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


def pairs_with(n, acc, false_abs, abs_rec):
    """n pairs of which exactly these numbers are correct, abstained on falsely, abstained on rightly."""
    return [(k < acc, k >= n - false_abs, k < abs_rec) for k in range(n)]


def scored(*parts, resamples=400):
    verdicts = pd.concat(parts, ignore_index=True)
    metrics = pd.concat([cell_metrics(rows) for _, rows in verdicts.groupby("dataset")], ignore_index=True)
    resampled = resample(verdicts, resamples=resamples)
    return metrics, resampled, contrasts(resampled, metrics, verdicts)


def only(table, **values):
    for column, value in values.items():
        table = table[table[column] == value]
    [row] = table.to_dict("records")
    return row


def test_a_paired_contrast_takes_out_what_the_scenarios_share(rows):
    # m and n are wrong on the same scenarios but for thirty: the difference hardly varies, however wide each one is.
    m, n = pairs_with(300, 180, 0, 300), pairs_with(300, 150, 0, 300)
    _, resampled, table = scored(rows(m, model="m"), rows(n, model="n"))
    row = only(table, kind="models", dataset="occlusion", metric="pecs")
    assert row["difference"] == pytest.approx(0.10)
    each = intervals(resampled).set_index(["dataset", "model"]).loc["occlusion"]
    assert (
        row["ci_low"]
        < 0.10
        < row["ci_high"]
        < row["ci_low"] + each.loc["m", "pecs_ci_high"] - each.loc["m", "pecs_ci_low"]
    )
    assert row["n_scenarios"] == 300


@pytest.mark.parametrize("n", [1, 2, 5, 6, 8])
def test_no_p_is_below_that_of_a_sign_flip_over_all_scenarios(n, rows):
    # The largest difference that there is, J 1 against -1, in both datasets of n scenarios: pairs go together.
    parts = [
        rows([pair] * n, dataset=d, model=m)
        for d in ("occlusion", "occlusion_ill_posed")
        for m, pair in (("m", (True, False, True)), ("n", (False, True, False)))
    ]
    table = scored(*parts, resamples=2000)[2].query("metric == 'j'")
    assert (table["p"] >= 2.0 ** (1 - n)).all()
    assert table["separable"].isna().all() == (2.0 ** (1 - n) >= 0.05)


def test_p_counts_the_resamples_on_the_other_side_and_adds_one(rows):
    # Of nine resamples k > 0 lie beyond 0: p is 2 (k + 1) / 10, and not 2 k / 9.
    better, worse = pairs_with(40, 20, 0, 40), pairs_with(40, 15, 0, 40)
    table = scored(rows(better, model="m"), rows(worse[::-1], model="n"), resamples=9)[2]
    p = only(table, kind="models", dataset="occlusion", metric="pecs")["p"]
    assert p < 1
    assert 5 * p == pytest.approx(round(5 * p))


def test_two_scenarios_are_too_few_and_their_ranks_stay_open(rows):
    right, wrong = [(True, False, True)] * 2, [(False, False, True)] * 2
    parts = [rows(pairs, dataset=d, model=m) for d in DATASETS for m, pairs in (("m", right), ("n", wrong))]
    metrics, resampled, table = scored(*parts)
    assert table["separable"].isna().all()
    assert only(table, dataset="overall", metric="pecs")["n_scenarios"] == 4
    board = leaderboard(metrics, intervals(resampled), table)
    assert board["rank_high"].eq(2).all() and board["rank_low"].eq(1).all()


def test_more_comparisons_need_more_scenarios(rows):
    # 2^(1 - 6) = .031 is below .05 for two models; of three models the smallest p after Holm is 3 x .031.
    parts = [rows([(True, False, True)] * 6, model=m) for m in "abc"]
    assert scored(*parts[:2])[2]["separable"].eq(False).all()
    assert scored(*parts)[2]["separable"].isna().all()


@pytest.mark.slow
def test_twenty_three_models_that_lie_well_apart_are_all_told_apart(rows):
    # 253 pairs: 2 / (resamples + 1), the least that counting can say, times 253 would be above 0.05 even for 10,000.
    parts = [rows(pairs_with(460, 20 * k, 0, 460), model=f"m{k:02d}") for k in range(23)]
    metrics, resampled, table = scored(*parts, resamples=200)
    pecs = table[(table["kind"] == "models") & (table["metric"] == "pecs")]
    assert (len(pecs), int(pecs["separable"].sum())) == (253, 253)
    assert not table.loc[table["metric"] == "j", "separable"].any()  # J is 1 of all of them
    board = leaderboard(metrics, intervals(resampled), table)
    assert (board["rank_low"] == board["rank_high"]).all()


def test_reference_rows_are_ranked_among_themselves(rows):
    named = (("oracle", 200), ("a", 100), ("always-abstain", 0))
    metrics, resampled, table = scored(*(rows(pairs_with(200, acc, 0, 200), model=m) for m, acc in named))
    board = leaderboard(metrics, intervals(resampled), table).set_index("model")
    assert board["rank"].to_dict() == {"oracle": 1, "always-abstain": 2, "a": 1}
    assert board.loc["a", ["rank_low", "rank_high"]].tolist() == [1, 1]
    assert board.loc["always-abstain", ["rank_low", "rank_high"]].tolist() == [2, 2]


def test_equal_models_are_not_separable_and_share_all_ranks(rows):
    same = pairs_with(40, 30, 2, 20)
    metrics, resampled, table = scored(rows(same, model="m"), rows(same, model="n"))
    assert only(table, dataset="occlusion", metric="pecs")["p"] == 1.0
    board = leaderboard(metrics, intervals(resampled), table)
    assert board[["rank", "rank_low", "rank_high"]].values.tolist() == [[1, 1, 2], [1, 1, 2]]


def test_ranks_are_apart_where_the_contrast_is_significant(rows):
    parts = [rows(pairs_with(200, acc, 0, 200), model=m) for m, acc in (("a", 190), ("b", 100), ("c", 98))]
    metrics, resampled, table = scored(*parts)
    board = leaderboard(metrics, intervals(resampled), table).set_index("model")
    assert board.loc["a", ["rank", "rank_low", "rank_high"]].tolist() == [1, 1, 1]
    assert board.loc["b", ["rank", "rank_low", "rank_high"]].tolist() == [2, 2, 3]
    assert board.loc["c", ["rank", "rank_low", "rank_high"]].tolist() == [3, 2, 3]


def test_regimes_of_a_model_are_contrasted_on_each_dataset_and_overall(rows):
    parts = [
        rows(pairs_with(20, 20, 0, k), dataset=d, regime=r)
        for d in DATASETS
        for r, k in (("standard", 5), ("guided", 15))
    ]
    table = scored(*parts)[2]
    regimes = table[(table["kind"] == "regimes") & (table["metric"] == "j")]
    assert list(regimes["dataset"]) == [*DATASETS, "overall"]
    assert regimes["difference"].tolist() == pytest.approx([-0.5] * 5)
    assert set(zip(regimes["left_regime"], regimes["right_regime"], strict=True)) == {("standard", "guided")}


def test_a_contrast_across_epochs_is_refused_with_the_reason_and_no_metric(rows):
    pairs = pairs_with(10, 5, 0, 5)
    parts = [
        rows(pairs, dataset=d, model=m, epoch="new" if (m, d) == ("n", "chaotic") else "old")
        for m in "mn"
        for d in DATASETS
    ]
    table = scored(*parts, resamples=20)[2]
    refused = table[table["refused"].notna()]
    assert set(refused["dataset"]) == {"chaotic", "overall"}
    assert refused[["difference", "p", "p_holm"]].isna().all(axis=None)
    assert not refused["separable"].any()
    assert names(refused["refused"].iloc[0]) == "chaotic chaotic:s0:control 19 old new"


def names(reason):
    """The dataset, the items and the epochs that a refusal names."""
    return " ".join(re.findall(r"^\w+(?=: )|\w+:s\d+:\w+|\b(?:e?\d+|old|new)\b", reason))


def swapped(rows, **other):
    """Eight pairs of either side in two epochs, each side the other way round: alike in number and names of epochs."""
    first, second = ({"epoch": e} for e in ("e1", "e2"))
    pairs = pairs_with(8, 5, 0, 5)

    def side(sets, **about):
        whole = [rows(pairs, **(about | epoch)) for epoch in sets]
        first_of_two = whole[0]["pair_id"] != "occlusion:s7"
        return pd.concat([whole[0][first_of_two], whole[1][~first_of_two]], ignore_index=True)

    return side((first, second)), side((second, first), **other)


def test_epochs_are_compared_item_by_item(rows):
    table = scored(*swapped(rows, model="n"), resamples=20)[2]
    assert {*map(names, table["refused"])} == {"occlusion occlusion:s0:control 15 e1 e2"}
    assert table["difference"].isna().all()
    tests = regime_tests(pd.concat(swapped(rows, regime="guided"), ignore_index=True))
    assert tests["refused"].notna().all() and tests["p"].isna().all()
    versions = version_contrasts(*swapped(rows), resamples=20)
    assert versions["refused"].notna().all() and versions["difference"].isna().all()


def test_items_mixed_alike_on_both_sides_are_compared(rows):
    one, _ = swapped(rows)
    table = scored(one, one.assign(model="n"), resamples=20)[2]
    assert table["refused"].isna().all()
    assert (table["difference"] == 0).all()


def test_a_contrast_of_different_items_is_refused_with_the_reason(rows):
    table = scored(rows(pairs_with(8, 5, 0, 5)), rows(pairs_with(3, 3, 0, 3), model="n"), resamples=20)[2]
    assert {*map(names, table["refused"])} == {"occlusion occlusion:s3:control 9"}
    assert table["p"].isna().all()


def test_an_entry_without_all_four_datasets_is_in_no_overall_contrast(rows):
    pairs = pairs_with(4, 2, 0, 2)
    parts = [rows(pairs, dataset=d, model=m) for m in "mn" for d in DATASETS]
    table = scored(*parts, rows(pairs, model="partial"), resamples=20)[2]
    assert table["refused"].isna().all()
    overall = table[table["dataset"] == "overall"]
    assert set(overall["left_model"]) | set(overall["right_model"]) == {"m", "n"}
    assert len(table[(table["dataset"] == "occlusion") & (table["metric"] == "j")]) == 3


def test_holms_correction_is_the_textbooks_and_statsmodels():
    p = np.array([0.01, 0.04, 0.03, np.nan, 0.005])
    assert holm(p)[[0, 1, 2, 4]] == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert np.isnan(holm(p)[3])
    drawn = np.random.default_rng(0).random(30) ** 3
    assert holm(drawn) == pytest.approx(multipletests(drawn, method="holm")[1])


def test_mcnemar_counts_discordant_items_and_equals_statsmodels(rows):
    standard, guided = pairs_with(12, 12, 0, 3), pairs_with(12, 12, 0, 11)
    verdicts = pd.concat([rows(standard), rows(guided, regime="guided")], ignore_index=True)
    table = regime_tests(verdicts)
    row = only(table, decision="void_abstention")
    assert (row["n"], row["only_left"], row["only_right"]) == (12, 0, 8)
    assert row["p"] == pytest.approx(2 * 0.5**8)
    assert row["p"] == pytest.approx(mcnemar([[3, 0], [8, 1]], exact=True).pvalue)
    assert only(table, decision="correctness")["p"] == 1.0


def test_mcnemar_of_control_abstentions_counts_the_controls_that_one_regime_abstains_on(rows):
    standard = rows([(False, True, False)] + [(True, False, False)] * 5)  # one control abstained on
    guided = rows([(True, False, False)] + [(False, True, False)] * 5, regime="guided")  # the five others
    table = regime_tests(pd.concat([standard, guided], ignore_index=True))
    row = only(table, decision="control_abstention")
    assert (row["dataset"], row["n"], row["only_left"], row["only_right"]) == ("occlusion", 6, 1, 5)
    assert row["p"] == pytest.approx(2 * (1 + 6) / 2**6)
    assert set(table["decision"]) == {"void_abstention", "control_abstention", "correctness"}


def test_holm_counts_the_pairs_of_regimes_of_all_models_together_and_models_within_a_regime(rows):
    sides = [(model, regime) for model in ("m", "n") for regime in ("standard", "guided", "json")]
    parts = [
        rows(pairs_with(90, 30 + 9 * k, 1, 60), model=model, regime=regime) for k, (model, regime) in enumerate(sides)
    ]
    table = scored(*parts)[2].query("dataset == 'occlusion' and metric == 'pecs'")
    for _, family in [
        ("", table.query("kind == 'regimes'")),  # three pairs of each of two models: six tests
        *table.query("kind == 'models'").groupby("left_regime"),
    ]:
        assert len(family) in (1, 6)
        assert family["p_holm"].to_numpy(float) == pytest.approx(holm(family["p"].to_numpy(float)))
    assert (table.query("kind == 'regimes'")["p"] < 1 / 6).any()  # so that six tests and three differ


def test_mcnemar_leaves_out_items_undecided_under_either_regime(rows):
    standard, guided = [(True, False, None), (True, False, True)], [(True, False, True), (True, False, False)]
    table = regime_tests(pd.concat([rows(standard), rows(guided, regime="guided")], ignore_index=True))
    row = only(table, decision="void_abstention")
    assert (row["n"], row["only_left"], row["only_right"]) == (1, 1, 0)


def test_wilsons_interval_equals_statsmodels_and_is_null_without_decisions():
    yes, of = np.array([0.0, 3, 10, 0]), np.array([10.0, 10, 10, 0])
    low, high = wilson(yes, of)
    expected = proportion_confint(yes[:3], of[:3], method="wilson")
    assert (low[:3], high[:3]) == (pytest.approx(expected[0], abs=1e-12), pytest.approx(expected[1]))
    assert np.isnan([low[3], high[3]]).all()


def coverage(acc, false_abs, abs_rec):
    """Shares of 450 simulated studies of 200 scenarios whose 95 % intervals hold the true J and PECS.

    Three runs a study; half of a scenario's answers are alike in all runs (easy or hard), the others independent.
    """
    studies, scenarios, runs, resamples = 450, 200, 3, 600
    rng = np.random.default_rng(11)
    shape = (scenarios, studies, runs, 3)
    luck = np.where(rng.random(shape) < 0.5, rng.random((scenarios, studies, 1, 3)), rng.random(shape))
    counts = np.ones((scenarios, studies, runs, 6))
    counts[..., 0::2] = luck < [acc, false_abs, abs_rec]
    names = pd.DataFrame({"scenario_id": [f"s{k:03d}" for k in range(scenarios)], "taxonomy": "occlusion"})
    drawn = draw_scenarios(names, resamples, 5)
    true_j = abs_rec - false_abs
    covered = {"j": [], "pecs": []}
    for first in range(0, studies, 50):
        own = counts[:, first : first + 50].reshape(scenarios, -1, 6)
        sums = resampled_sums(drawn.scenarios["occlusion"][1], own)
        sums = with_unseen(sums, np.full((len(sums), 3), scenarios), drawn.unseen("m", 3))
        ends = metrics_of(sums).reshape(2, 50, runs, len(RESAMPLED_METRICS), -1).mean(axis=2)
        for name, truth in (("j", true_j), ("pecs", acc * max(0.0, true_j))):
            of_metric = np.moveaxis(ends[:, :, RESAMPLED_METRICS.index(name)], 0, 1)
            bounds = interval(of_metric[..., 1:], of_metric[:, 1, 0], limits_of(name))
            covered[name].append((bounds[:, 0] - 1e-9 <= truth) & (truth <= bounds[:, 1] + 1e-9))
    return {name: float(np.concatenate(parts).mean()) for name, parts in covered.items()}


@pytest.mark.parametrize("shares", [(0.7, 0.1, 0.6), (0.9, 0.3, 0.3), (0.995, 0.005, 0.995)])
def test_intervals_hold_the_truth_in_93_percent_of_studies_also_at_j_0_and_near_1(shares):
    assert min(coverage(*shares).values()) >= 0.93


def test_versions_are_compared_on_what_both_hold(rows):
    pairs = pairs_with(40, 20, 0, 20)
    then = pd.concat([rows(pairs), rows(pairs, run=2)], ignore_index=True)
    now = rows([(True, False, True)] * 30, run=1)  # ten scenarios were discarded, one run was made again
    row = only(version_contrasts(then, now, resamples=200), dataset="occlusion", metric="pecs")
    assert (row["n_pairs"], row["now"]) == (30, 1.0)
    assert row["then"] == pytest.approx((20 / 30) ** 2)
    assert row["difference"] == pytest.approx(1 - (20 / 30) ** 2)


def test_the_interval_between_versions_is_that_of_the_difference_on_the_same_resamples(rows):
    pairs = pairs_with(40, 20, 0, 20)
    then = rows(pairs)
    same = only(version_contrasts(then, then, resamples=200), metric="pecs")
    assert same["difference"] == 0 and same["ci_low"] < 0 < same["ci_high"] and same["p"] == 1.0
    assert not same["separable"]
    with raises(TrapsError, "scoring.contrasts.version_contrasts"):
        version_contrasts(then, rows(pairs, model="other"))
    better = rows([(True, False, True)] * 40)
    table = version_contrasts(then, better, resamples=200)
    row = only(table, metric="pecs")
    assert 0 < row["ci_low"] <= row["difference"] <= row["ci_high"] <= 1
    assert (table["p_holm"] >= table["p"]).all()  # adjusted over the models of a metric: here there is one
    assert row["p_holm"] == row["p"]


def test_versions_of_different_epochs_are_refused_row_by_row(rows):
    pairs = pairs_with(10, 5, 0, 5)
    then = pd.concat([rows(pairs), rows(pairs, dataset="chaotic")], ignore_index=True)
    now = pd.concat([rows(pairs), rows(pairs, dataset="chaotic", epoch="e2")], ignore_index=True)
    table = version_contrasts(then, now.assign(benchmark_version="v2"), resamples=20)
    fine, refused = only(table, dataset="occlusion", metric="j"), only(table, dataset="chaotic", metric="j")
    assert fine["difference"] == 0
    assert pd.isna(fine["refused"])
    assert names(refused["refused"]) == "chaotic chaotic:s0:control 19 e1 e2"
    assert np.isnan([refused["difference"], refused["p"], refused["p_holm"]]).all()
    assert (refused["then"], refused["now"]) == (0.5, 0.5)
    assert (refused["epoch_then"], refused["epoch_now"]) == ("e1", "e2")
    assert (fine["benchmark_version_then"], fine["benchmark_version_now"]) == ("v1", "v2")


def test_versions_are_compared_on_whole_pairs_and_say_what_is_missing(rows):
    then = rows([(True, False, True)] * 4)
    now = rows([(True, False, True), (True, False, None), (True, False, True), (True, False, True)])
    now = now[now["item_id"] != "occlusion:s3:void"]
    row = only(version_contrasts(then, now, resamples=20), metric="j")
    assert (row["n_pairs"], row["n_missing_then"], row["n_missing_now"]) == (3, 0, 1)


def test_the_command_compares_what_both_benchmarks_still_hold(rows, tmp_path, capsys):
    studies = []
    for name, scenarios in (("then", 4), ("now", 3)):  # one was discarded since; its verdict is still there
        workspace = Workspace.create(tmp_path / name, Study(epoch="e1"))
        places = [(number, side) for number in range(scenarios) for side in ("control", "void")]
        named = [item_row("occlusion", *at) | {"item_id": f"occlusion:s{at[0]}:{at[1]}"} for at in places]
        items = [ItemRow(**item) for item in named]
        workspace.tables.write(ITEMS, {"dataset": "occlusion"}, items, {})
        verdicts = rows([(True, False, True)] * 4)
        cell = Cell("occlusion", Evaluation("m", "standard", 1))
        workspace.tables.write(VERDICTS, cell.partition, verdicts, {})
        studies.append(str(workspace.root))
    then, now = studies
    assert main(["results", "compare", then, "--workspace", now, "--csv", str(tmp_path / "out.csv")]) == 0
    written = pd.read_csv(tmp_path / "out.csv")
    assert written["n_pairs"].tolist() == [3, 3]
    assert written["difference"].tolist() == [0, 0]
    assert {"n_missing_now", "epoch_then", "benchmark_version_now", "refused"} <= set(written.columns)
    assert "occlusion" not in capsys.readouterr().out  # nothing differs
    then_rows = rows([(True, False, True), (True, False, False), (True, False, True)])
    Workspace.open(Path(then)).tables.write(VERDICTS, cell.partition, then_rows, {})
    assert main(["results", "compare", then, "--workspace", now]) == 0
    lines = capsys.readouterr().out.splitlines()
    # AbsRec was 2/3 with Acc 1 and FalseAbs 0, and is 1 now
    pecs, j = (line.split() for line in lines if line.startswith("occlusion"))
    assert pecs[:5] == ["occlusion", "pecs", "0.667", "1.000", "+0.333"] and j[1:5] == ["j", *pecs[2:5]]
    assert max(map(len, lines)) <= 100
