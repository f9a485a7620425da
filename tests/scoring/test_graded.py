"""Graded cuts: what decisions and stated probabilities come to, against metrics worked out by hand."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.build.cells import row
from traps_pipeline.judging.judging_rows import VERDICTS, VOTES
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.registry.prompts import load_prompt
from traps_pipeline.protocol.regimes import ANSWER_FROM, WRONG_COSTS
from traps_pipeline.scoring.graded import GradedItem, answer_points, brier, graded, wrong_rows

LABELS = ("left", "right", "elsewhere")
# An answer is worth .9 - 3 x .1 = .6 in the first, .5 - 3 x .5 = -1 in the second. Of the family "right" is commonest.
SURE = GradedItem(LABELS, {"red bin": "left"}, "direction", "right", {"left": 0.9, "right": 0.1})
OPEN = GradedItem(LABELS, {}, "direction", "right", {"left": 0.5, "right": 0.3, "elsewhere": 0.2})
ASKED = {"graded:plinko-0001:control": SURE, "graded:plinko-0002:control": OPEN}
# The answer that two of three judges extract, or what each of them does; None for an abstention.
Said = str | tuple[str, ...] | None


def test_the_prompt_states_the_price_that_is_scored() -> None:
    assert f"a wrong answer costs {WRONG_COSTS} points" in load_prompt("priced_suffix")
    assert ANSWER_FROM == 0.75  # p - 3 (1 - p) = 0


@pytest.mark.parametrize(
    ("item", "answer", "points", "by_answer", "rash", "shy"),
    [
        (SURE, "left", 0.6, 0, 0, 0),
        (SURE, "right", 0.1 - 3 * 0.9, 4 * 0.8, 0, 0),  # .8 less likely to be right, of which each costs 4
        (SURE, "", -3, 4 * 0.9, 0, 0),  # an answer that is none of the question's
        (SURE, None, 0, 0, 0, 0.6),
        (OPEN, "left", -1, 0, 1, 0),
        (OPEN, "right", 0.3 - 3 * 0.7, 4 * 0.2, 1, 0),
        (OPEN, None, 0, 0, 0, 0),
    ],
)
def test_regret_is_what_the_ideal_observer_earns_more_and_falls_into_three(
    item: GradedItem, answer: str | None, points: float, by_answer: float, rash: float, shy: float
) -> None:
    of = answer_points(item, answer)
    assert of["points"] == pytest.approx(points)
    assert [of[f"regret_{part}"] for part in ("label", "rash", "shy")] == pytest.approx([by_answer, rash, shy])
    assert of["regret"] == pytest.approx(by_answer + rash + shy) == pytest.approx(of["points_ideal"] - points)


def test_the_brier_score_is_expected_over_the_posterior() -> None:
    # Certain of left: 0 where it is left (.5), 1 + 1 where it is another (.5). Even thirds: 4/9 + 1/9 + 1/9 always.
    assert brier(OPEN.posterior, {"left": 1.0}) == pytest.approx(0.5 * 2)
    assert brier(OPEN.posterior, dict.fromkeys(LABELS, 1 / 3)) == pytest.approx(2 / 3)
    # The posterior itself: .5 x (.25 + .09 + .04) + .3 x (.25 + .49 + .04) + .2 x (.25 + .09 + .64) = .62.
    assert brier(OPEN.posterior, OPEN.posterior) == pytest.approx(0.62)


@pytest.mark.parametrize(
    ("entries", "expected"),
    [
        ([("left", 0.7), ("Right", 0.2), ("elsewhere", 0.1)], (0.7, 0.2, 0.1)),
        ([("the red bin", 0.6)], (0.6, 0.2, 0.2)),  # what is left to 1 goes evenly to answers that are not named
        ([], (1 / 3, 1 / 3, 1 / 3)),
        ([("left", 0.52), ("right", 0.5)], (0.52 / 1.02, 0.5 / 1.02, 0)),
        ([("left", 0.8), ("right", 0.5)], None),
        ([("left", 0.3), ("right", 0.3), ("elsewhere", 0.1)], None),
        ([("left", 1.2), ("right", -0.2)], None),
        ([("left", 0.5), ("red bin", 0.5)], None),
        ([("up", 1.0)], None),
        ([("left", True)], None),
        ([("left", "0.9")], None),
    ],
)
def test_stated_probabilities_are_read_or_refused(entries: list[Any], expected: tuple[float, ...] | None) -> None:
    text = json.dumps({"probabilities": [{"answer": a, "probability": p} for a, p in entries], "final_answer": "left"})
    read = SURE.read_probabilities(text)
    assert read is None if expected is None else list((read or {}).values()) == pytest.approx(list(expected))
    assert SURE.read_probabilities("left, I am sure") is None
    assert SURE.read_probabilities('{"probabilities": {"left": 0.9}}') is None


@pytest.mark.parametrize(
    ("tokens", "expected"),
    [
        ({"left": 0.7, " right": 0.2, "else": 0.1}, (0.7, 0.2, 0.1)),
        ({"Red": 0.6, "**r": 0.2, "the": 0.1}, (0.6 + 0.4 / 3, 0.4 / 3, 0.4 / 3)),  # red bin or right; no answer
        ({"I": 0.9, "left": 0.1}, (0.1 + 0.3, 0.3, 0.3)),  # what begins an abstention is shared evenly
        ({'"': 1.0}, (1 / 3, 1 / 3, 1 / 3)),
        ({"left": 0.8, "LEFT": 0.3}, (1, 0, 0)),  # rounded up
    ],
)
def test_a_first_token_counts_for_the_answer_that_it_begins(tokens: dict[str, float], expected: Any) -> None:
    read = SURE.read_first_token(json.dumps({token: math.log(p) for token, p in tokens.items()}))
    assert list((read or {}).values()) == pytest.approx(list(expected))
    assert SURE.read_first_token(None) is None


def answers(
    model: str,
    sure: Said,
    open_: Said,
    regime: str = "priced",
    texts: Mapping[str, str] = {},
    tokens: Mapping[str, str] = {},
) -> Any:
    """VERDICTS, VOTES and RESPONSES rows of a model's answers to both cuts, each judged by three."""
    parts: tuple[list[Any], list[Any], list[Any]] = ([], [], [])
    for id_, said in zip(ASKED, (sure, open_), strict=True):
        its = {"dataset": "graded", "model": model, "regime": regime, "run": 1, "item_id": id_, "side": "control"}
        parts[0].append(row(VERDICTS, scenario_id=id_.split(":")[1], abstained=said is None, **its))
        for judge, value in enumerate(said if isinstance(said, tuple) else (said, said, "elsewhere")):
            vote = {"task": "correctness", "judge": f"rule-{judge}", "valid": True, "extracted_value": value}
            parts[1].append(row(VOTES, **vote, **its))
        parts[2].append(row(RESPONSES, outcome="answer", text=texts.get(id_), first_token=tokens.get(id_), **its))
    return parts


def table(*models: Any) -> pd.DataFrame:
    verdicts, votes, responses = (pd.DataFrame([one for m in models for one in m[k]]) for k in range(3))
    made = graded(verdicts, votes, responses, ASKED, resamples=200)
    assert wrong_rows(made) == 0
    return made


def test_a_threshold_is_told_from_worse_knowledge() -> None:
    made = table(
        answers("ideal", "the red bin", None),
        answers("shy", None, None),
        answers("rash", "left", "left"),
        answers("mistaken", "right", "left"),
    ).set_index(["model", "scope"])
    of = made.xs("all", level="scope")
    assert of["points"].to_dict() == pytest.approx({"ideal": 0.3, "shy": 0, "rash": -0.2, "mistaken": (-2.6 - 1) / 2})
    assert of["regret_shy"].to_dict() == pytest.approx({"ideal": 0, "shy": 0.3, "rash": 0, "mistaken": 0})
    assert of["regret_rash"].to_dict() == pytest.approx({"ideal": 0, "shy": 0, "rash": 0.5, "mistaken": 0.5})
    assert of["regret_label"].to_dict() == pytest.approx({"ideal": 0, "shy": 0, "rash": 0, "mistaken": 1.6})
    assert of["coverage"].to_dict() == {"ideal": 0.5, "shy": 0, "rash": 1, "mistaken": 1}
    assert of["risk"].drop("shy").to_dict() == pytest.approx({"ideal": 0.1, "rash": 0.3, "mistaken": (0.9 + 0.5) / 2})
    assert np.isnan(of["risk"]["shy"])
    assert of["abstains_right"].to_dict() == {"ideal": 1, "shy": 1, "rash": 0, "mistaken": 0}
    assert of["abstains_wrong"].to_dict() == {"ideal": 0, "shy": 1, "rash": 0, "mistaken": 0}
    assert np.isnan(of["brier"]).all()
    trivial = of.loc["shy", ["points_ideal", "points_best", "points_prior"]].astype(float)
    assert trivial.tolist() == pytest.approx([0.3, (0.6 - 1) / 2, (0.1 - 2.7 + 0.3 - 2.1) / 2])
    ends = of.loc[["ideal"], ["points_ci_low", "points", "points_ci_high"]].to_numpy(float)[0]
    assert -3 <= ends[0] < ends[1] < ends[2] <= 1
    ranges = made.loc["shy"]
    assert ranges["n_items"].to_dict() == {"all": 2, "0.45 to 0.6": 1, "0.9 to 1": 1}
    assert ranges["points_ideal"].to_dict() == pytest.approx({"all": 0.3, "0.45 to 0.6": 0, "0.9 to 1": 0.6})


def test_stated_probabilities_are_acted_on_at_the_price_and_an_undecided_answer_is_missing() -> None:
    def stating(left: float) -> str:
        return json.dumps({"probabilities": [{"answer": "left", "probability": left}], "final_answer": "left"})

    texts = dict(zip(ASKED, (stating(0.75), stating(0.74)), strict=True))
    unread = dict(zip(ASKED, (stating(0.75), "left"), strict=True))
    made = table(
        answers("careful", "left", "left", "probabilities", texts),
        answers("sloppy", "left", "left", "probabilities", unread),
        answers("split", "left", ("left", "right", "elsewhere")),
    )
    of = made.loc[made["scope"] == "all"].set_index("model")
    careful = of.loc["careful"]
    # (.75, .125, .125) where (.9, .1, 0) is true, and (.74, .13, .13) where (.5, .3, .2) is.
    off = (0.15**2 + 0.025**2 + 0.125**2, 0.24**2 + 0.17**2 + 0.07**2)
    assert careful["brier"] == pytest.approx((off[0] + 0.18 + off[1] + 0.62) / 2)
    assert careful["brier_ideal"] == pytest.approx((0.18 + 0.62) / 2)
    assert (careful["points"], careful["coverage"]) == (pytest.approx(0.3), 0.5)
    assert careful["stated"] == pytest.approx(0.745)
    assert of.loc[["sloppy", "split"], ["n_items", "n_missing"]].to_numpy().tolist() == [[1, 1], [1, 1]]


def test_log_probabilities_are_scored_as_stated_probabilities_are() -> None:
    tokens = ({"left": 0.75, "right": 0.25}, {"left": 0.5, "I": 0.5})
    stored = [json.dumps({token: math.log(p) for token, p in its.items()}) for its in tokens]
    parts = answers("model", "left", "left", "logprobs", tokens=dict(zip(ASKED, stored, strict=True)))
    silent = answers("silent", "left", None, "logprobs")  # its provider gives none
    (own,) = table(parts, silent).query("scope == 'all'").to_dict("records")
    # (.75, .25, 0) where (.9, .1, 0) is true, and (4/6, 1/6, 1/6) where (.5, .3, .2) is.
    off = (2 * 0.15**2, (4 / 6 - 0.5) ** 2 + (0.3 - 1 / 6) ** 2 + (0.2 - 1 / 6) ** 2)
    assert own["brier"] == pytest.approx((off[0] + 0.18 + off[1] + 0.62) / 2)
    assert (own["model"], own["points"], own["coverage"]) == ("model", pytest.approx(0.3), 0.5)


def test_without_graded_cuts_there_is_no_row() -> None:
    verdicts, votes, responses = (pd.DataFrame(columns=pd.Index(one.names)) for one in (VERDICTS, VOTES, RESPONSES))
    made = graded(verdicts, votes, responses, {}, resamples=10)
    assert made.empty and wrong_rows(made) == 0
