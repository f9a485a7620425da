"""Agreement of judges against tables worked out by hand, statsmodels and the krippendorff package."""

from __future__ import annotations

from itertools import product

import krippendorff
import numpy as np
import pandas as pd
import pytest
from sklearn.metrics import cohen_kappa_score
from statsmodels.stats.inter_rater import aggregate_raters
from statsmodels.stats.inter_rater import fleiss_kappa as reference_fleiss

from tests.judging.conftest import vote_rows
from traps_pipeline.judging.agreement import (
    agreement,
    cohen_kappa,
    fleiss_kappa,
    judge_bias,
    krippendorff_alpha,
    unanimous_share,
)
from traps_pipeline.judging.judging_rows import AGREEMENT, JUDGE_BIAS
from traps_pipeline.protocol.ratings import INVALID, NO, YES, majority, ratings
from traps_pipeline.storage.parquet import TableStore

VALUES = {"y": YES, "n": NO, "-": INVALID}


def matrix(*answers: str) -> np.ndarray:
    return np.array([[VALUES[word] for word in answer] for answer in answers], np.int8)


def random_votes(seed: int, n: int = 300, invalid: float = 0.0) -> np.ndarray:
    """Three judges who follow a hidden truth with different care."""
    rng = np.random.default_rng(seed)
    truth = rng.random(n) < 0.3
    votes = np.where(rng.random((n, 3)) < (0.05, 0.1, 0.25), ~truth[:, None], truth[:, None]).astype(np.int8)
    votes[rng.random((n, 3)) < invalid] = INVALID
    return votes


# --- the coefficients -------------------------------------------------------------------------------------------------


def test_fleiss_kappa_of_four_answers_worked_out_by_hand() -> None:
    # Yes 3, 2, 0, 0 of 3: pairs that agree 1, 1/3, 1, 1, mean 10/12. p = 5/12, chance 25/144 + 49/144 = 74/144.
    # (120 - 74) / (144 - 74) = 46/70.
    assert fleiss_kappa(matrix("yyy", "yyn", "nnn", "nnn")) == pytest.approx(46 / 70)


def test_cohen_kappa_of_the_textbook_table() -> None:
    # Both yes 20, both no 15, yes-no 5, no-yes 10: agreement 0.7, chance 0.5 x 0.6 + 0.5 x 0.4 = 0.5.
    one = np.repeat([YES, YES, NO, NO], [20, 5, 10, 15])
    other = np.repeat([YES, NO, YES, NO], [20, 5, 10, 15])
    assert cohen_kappa(one, other) == pytest.approx(0.4)


def test_krippendorffs_alpha_takes_missing_votes_and_leaves_lone_ones_out() -> None:
    # Pairable: yy-, ynn, nnn; --y stands alone. 8 votes, 3 yes, 5 no. Disagreement: 2 x 1 x 2 / (3 - 1) = 2 of 8;
    # expected 2 x 3 x 5 / (8 x 7) = 30/56. 1 - (2/8) / (30/56) = 8/15.
    assert krippendorff_alpha(matrix("yy-", "ynn", "nnn", "--y")) == pytest.approx(8 / 15)


@pytest.mark.parametrize("seed", range(3))
def test_complete_votes_give_what_statsmodels_and_scikit_learn_give(seed: int) -> None:
    votes = random_votes(seed)
    assert fleiss_kappa(votes) == pytest.approx(reference_fleiss(aggregate_raters(votes)[0], method="fleiss"))
    assert cohen_kappa(votes[:, 0], votes[:, 2]) == pytest.approx(cohen_kappa_score(votes[:, 0], votes[:, 2]))


@pytest.mark.parametrize(("seed", "invalid"), [(0, 0.0), (1, 0.1), (2, 0.6)])
def test_alpha_is_what_the_krippendorff_package_gives(seed: int, invalid: float) -> None:
    votes = random_votes(seed, invalid=invalid)
    data = np.where(votes == INVALID, np.nan, votes).T
    reference = krippendorff.alpha(reliability_data=data, level_of_measurement="nominal")
    assert krippendorff_alpha(votes) == pytest.approx(reference)


@pytest.mark.parametrize("votes", [matrix("yyy", "yyy"), matrix("nnn"), np.zeros((0, 3), np.int8)])
def test_one_class_or_no_vote_leaves_every_coefficient_undefined(votes: np.ndarray) -> None:
    assert np.isnan([fleiss_kappa(votes), krippendorff_alpha(votes), cohen_kappa(votes[:, 0], votes[:, 1])]).all()


# --- the majority -----------------------------------------------------------------------------------------------------


def test_a_majority_is_two_valid_votes_that_agree() -> None:
    every = ["".join(cast) for cast in product("yn-", repeat=3)]
    expected = [YES if cast.count("y") >= 2 else NO if cast.count("n") >= 2 else INVALID for cast in every]
    assert majority(matrix(*every)).tolist() == expected


def test_of_two_judges_one_alone_decides_nothing() -> None:
    assert majority(matrix("yy", "nn", "yn", "y-", "--")).tolist() == [YES, NO, INVALID, INVALID, INVALID]


# --- the tables -------------------------------------------------------------------------------------------------------


def test_the_table_has_a_row_for_the_panel_and_each_two_judges_and_holds_its_contract(tmp_path) -> None:
    votes = vote_rows(["yyy", "yyn", "nnn", "nnn", "yn-"])
    rows = agreement(votes).set_index("judges")
    assert list(rows.index) == ["panel", "a+b", "a+c", "b+c"]
    panel = rows.loc["panel"]
    assert (panel.n_items, panel.n_complete, panel.n_undecided) == (5, 4, 1)
    # 14 valid votes of 15, 6 of them yes; three of the four complete answers are unanimous.
    assert (panel.invalid, panel.prevalence, panel.agreement) == pytest.approx((1 / 15, 6 / 14, 3 / 4))
    assert panel.fleiss_kappa == pytest.approx(46 / 70)
    pair = rows.loc["a+b"]
    assert (pair.n_complete, pair.agreement) == (5, pytest.approx(4 / 5))
    # a: 3 yes of 5, b: 2 of 5. Agreement 0.8, chance 0.6 x 0.4 + 0.4 x 0.6 = 0.48.
    assert pair.cohen_kappa == pytest.approx((0.8 - 0.48) / 0.52)
    assert rows.loc["b+c", "n_complete"] == 4
    TableStore(tmp_path).write(AGREEMENT, {}, agreement(votes), {})
    TableStore(tmp_path).write(JUDGE_BIAS, {}, judge_bias(votes), {})


def test_datasets_and_tasks_are_counted_apart_and_models_regimes_and_runs_together() -> None:
    votes = pd.concat(
        [
            vote_rows(["yyy", "nnn"]),
            vote_rows(["yyn"], model="other", run=2, epoch="e2"),
            vote_rows(["nnn"], "control_abstention"),
            vote_rows(["yny"], "correctness"),
            vote_rows(["yyy"], dataset="chaotic"),
        ],
        ignore_index=True,
    )
    rows = agreement(votes)
    panel = rows.loc[rows["judges"] == "panel"].set_index(["dataset", "task"])
    assert panel["n_items"].to_dict() == {
        ("occlusion", "void_abstention"): 3,
        ("occlusion", "control_abstention"): 1,
        ("occlusion", "correctness"): 1,
        ("chaotic", "void_abstention"): 1,
    }
    assert panel.loc[("occlusion", "void_abstention"), "epoch"] == "e1+e2"


def test_an_undefined_kappa_is_null_with_the_reason() -> None:
    reasons = list[str]()
    for judges, answers in (("abc", ["yyy", "yyy"]), ("abc", ["nnn"]), ("abc", ["y-n"]), ("a", ["y", "n"])):
        panel = agreement(vote_rows(answers, judges=judges)).set_index("judges").loc["panel"]
        assert np.isnan(panel.fleiss_kappa) and np.isnan(panel.agreement) == (judges == "a" or answers == ["y-n"])
        reasons.append(panel.undefined)
    assert all(reasons) and len({*reasons}) == 4 and "yes" in reasons[0]


def test_votes_of_a_former_panel_are_left_out() -> None:
    votes = pd.concat([vote_rows(["yyy", "nnn"]), vote_rows(["yyn"], judges=("a", "b", "d"))], ignore_index=True)
    assert ratings(votes, ["a", "b", "c"]).values.tolist() == [[1, 1, 1], [0, 0, 0]]
    assert ratings(votes, ["a", "b"]).values.shape == (2, 2)


def test_the_bias_of_a_judge_is_its_rate_of_yes_against_the_majority_on_the_same_answers() -> None:
    rows = judge_bias(vote_rows(["yyn", "nnn", "yyn", "ynn", "y-n", "-yy"])).set_index("judge")
    # Majorities: yes, no, yes, no, undecided, yes. c votes on five decided ones: n n n n y against y n y n y.
    c = rows.loc["c"]
    assert (c.n_votes, c.n_invalid, c.n_decided) == (6, 0, 5)
    assert (c.yes, c.panel_yes, c.bias) == pytest.approx((1 / 5, 3 / 5, -2 / 5))
    assert (c.dissent_yes, c.dissent_no) == pytest.approx((0, 2 / 5))
    a = rows.loc["a"]  # y n y y against y n y n
    assert (a.n_invalid, a.n_decided, a.bias, a.dissent_yes) == (1, 4, pytest.approx(1 / 4), pytest.approx(1 / 4))


def test_two_judges_have_a_kappa_and_one_agrees_with_nobody() -> None:
    # Yes 2, 1, 0, 0 of 2: pairs that agree 1, 0, 1, 1, mean 3/4. p = 3/8, chance 9/64 + 25/64. (48 - 34) / (64 - 34).
    assert fleiss_kappa(matrix("yy", "yn", "nn", "nn")) == pytest.approx(14 / 30)
    assert agreement(vote_rows(["yy", "nn"], judges=("a", "b")))["undefined"].isna().all()
    assert np.isnan([fleiss_kappa(matrix("y", "n")), unanimous_share(matrix("y", "n"))]).all()


def test_bias_is_counted_by_dataset_and_of_the_panel_s_own_judges() -> None:
    votes = pd.concat(
        [
            vote_rows(["yyn"]),
            vote_rows(["nnn", "nnn"], dataset="chaotic"),
            vote_rows(["yyn"], judges=("a", "b", "d"), run=2),
        ],
        ignore_index=True,
    )
    rows = judge_bias(votes, ["a", "b", "c"])
    assert rows.set_index(["dataset", "judge"])["n_votes"].to_dict() == {
        ("occlusion", "a"): 1, ("occlusion", "b"): 1, ("occlusion", "c"): 1,
        ("chaotic", "a"): 2, ("chaotic", "b"): 2, ("chaotic", "c"): 2,
    }  # fmt: skip
    assert rows.set_index(["dataset", "judge"]).loc[("occlusion", "c"), "bias"] == -1


def test_a_judge_without_a_valid_vote_has_no_rates() -> None:
    rows = agreement(vote_rows(["---"])).set_index("judges")
    assert (rows.loc["panel", "invalid"], np.isnan(rows.loc["panel", "prevalence"])) == (1.0, True)
    bias = judge_bias(vote_rows(["yy-"])).set_index("judge").loc["c"]
    assert np.isnan([bias.yes, bias.panel_yes, bias.bias, bias.dissent_yes, bias.dissent_no]).all()
