"""Doses, effects among nulls, PECS under sign policies, degenerate texts: numbers worked out by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest

from traps_pipeline.mechanism.degeneracy import degeneracy
from traps_pipeline.mechanism.directions import Directions
from traps_pipeline.mechanism.nulls import null_rows, pecs_rows
from traps_pipeline.mechanism.steering import strengths
from traps_pipeline.storage.study import MechanismSettings


def effect(kind: str, side: str, dose: float, abstained: int, draw: int = 0, signs: str = "label") -> dict[str, Any]:
    about = {"model": "m", "directions": "standard", "regime": "guided", "source": "chaotic", "target": "chaotic"}
    counts = {"n": 10, "n_missing": 0, "abstained": abstained, "abstention": abstained / 10, "degenerate": 0}
    counts |= {"undecided": 0.0, "perplexity": None}
    right = {"correct": 10 - abstained, "n_correct": 10} if side == "control" else {"correct": 0, "n_correct": 0}
    dosed = {"unit": "gap", "dose": dose, "signs": signs, "draw": draw, "layer": 3, "kind": kind, "side": side}
    return about | dosed | counts | right | {"epoch": "e"}


def test_an_effect_is_ranked_among_the_draws_and_ties_count_against_it() -> None:
    rows = [effect("void", "control", 0, 1), effect("void", "control", 1, 6)]  # + 0.5
    for draw, abstained in enumerate([1, 2, 6, 3]):  # + 0, 0.1, 0.5 (a tie), 0.2
        rows += [effect("isotropic", "control", 0, 1, draw), effect("isotropic", "control", 1, abstained, draw)]
    (row, whole) = null_rows(pd.DataFrame(rows))
    assert (row.target, whole.target) == ("chaotic", "all")
    assert (row.effect, row.null_lowest, row.null_highest) == pytest.approx((0.5, 0.0, 0.5))
    assert row.null_mean == pytest.approx(0.2) and (row.n_at_least, row.draws) == (1, 4)
    assert row.p == pytest.approx(2 / 5) and whole.p == row.p


def test_a_draw_whose_answers_say_nothing_counts_as_one_that_moves_nothing() -> None:
    """Of ten answers along a draw none is decided: it lies below the direction, and is one of the two draws."""
    rows = [effect("void", "control", 0, 1), effect("void", "control", 1, 6)]
    for draw in range(2):
        rows += [effect("isotropic", "control", 0, 1, draw), effect("isotropic", "control", 1, 0, draw)]
    rows[-1] |= {"n": 0, "n_missing": 10, "undecided": 1.0, "perplexity": 40.0}
    (row, _) = null_rows(pd.DataFrame(rows))
    assert (row.draws, row.n_at_least, row.p) == (2, 0, pytest.approx(1 / 3))
    assert (row.undecided, row.null_undecided, row.null_perplexity) == (0.0, 0.5, 40.0)


def test_on_voids_an_effect_is_a_fall_of_abstention() -> None:
    rows = [effect("void", "void", 0, 9), effect("void", "void", 1, 2)]
    rows += [effect("shuffled", "void", 0, 9), effect("shuffled", "void", 1, 10)]
    (row, _) = null_rows(pd.DataFrame(rows))
    assert (row.effect, row.null_mean, row.p) == pytest.approx((0.7, -0.1, 0.5))


def test_pecs_of_a_steered_model_depends_on_the_sign_policy() -> None:
    rows = []
    for signs, control, void in (("label", 4, 1), ("minus", 0, 1), ("plus", 4, 10)):
        rows += [effect("void", "control", 1, control, signs=signs), effect("void", "void", 1, void, signs=signs)]
    found = {row.signs: (row.acc, row.false_abs, row.abs_rec, row.pecs) for row in pecs_rows(pd.DataFrame(rows))}
    assert found["label"] == pytest.approx((0.6, 0.4, 0.1, 0.0))
    assert found["minus"] == pytest.approx((1.0, 0.0, 0.1, 0.1))
    assert found["plus"] == pytest.approx((0.6, 0.4, 1.0, 0.36))


@pytest.mark.parametrize(
    ("text", "outcome", "why"),
    [
        ("The answer is: left.", "answer", None),
        ("left left left left", "answer", "repetition"),
        ("no, no, no", "answer", None),
        ("It is so it is so it is so it is so", "answer", "repetition"),
        ("The ball falls", "truncated", "truncated"),
        ("\u7403\u5728\u5de6\u8fb9", "answer", "script"),
        (None, "empty", "empty"),
        ("42", "answer", None),
        (".", "answer", "letters"),
        ("?!", "answer", "letters"),
        ("lalalalalala", "answer", "repetition"),
        ("an annotation", "answer", None),
    ],
)
def test_a_text_that_is_no_answer_is_told(text: str | None, outcome: str, why: str | None) -> None:
    assert degeneracy(text, outcome, "The ball ends up right.") == why


@pytest.mark.parametrize(
    ("gap", "doses"),
    [
        (1.0, [("alpha", 3), ("gap", 0.5), ("gap", 1), ("gap", 2), ("gap", 4)]),
        (4.0, [("alpha", 3), ("gap", 0.5), ("gap", 1), ("gap", 2), ("gap", 4)]),  # 16 is twice the states
        (5.0, [("alpha", 3), ("gap", 0.5), ("gap", 1), ("gap", 2)]),
        (99.0, [("alpha", 3)]),
    ],
)
def test_doses_in_gaps_end_at_the_cap_and_nulls_have_alphas_and_the_largest(
    gap: float, doses: list[tuple[str, float]]
) -> None:
    unit = np.eye(4, dtype=np.float32)[None, [0, 0, 0]]
    of = Directions({"void": unit, "isotropic": unit}, np.full(3, gap), np.full(3, 8.0))
    steering = {"alphas": [3], "signs": [], "nulls": {"kinds": ["isotropic"], "draws": 1}}
    settings = MechanismSettings.model_validate({"models": {"m": {"steering": 2, "centroid": 1}}, "steering": steering})
    given = strengths("chaotic", settings.models["m"], settings, {"chaotic": of})
    steered = {kind: [(s.unit, s.dose) for s, _ in given if s.kind == kind] for kind in ("void", "isotropic")}
    assert steered == {"void": doses, "isotropic": [("alpha", 3), *doses[1:][-1:]]}
    assert all(s.alpha == pytest.approx(s.dose * gap) for s, _ in given if s.unit == "gap")
