"""What a row of the ledger may hold, at the edges of each range, and what becomes of the rest."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from traps_pipeline.ledger.rows import MAX_TOKENS, MAX_USD, is_amount, is_cost, is_count, replace_impossible


@pytest.mark.parametrize(
    ("fits", "values", "others"),
    [
        (is_count, [0, 1, MAX_TOKENS], [-1, MAX_TOKENS + 1, 1.0, True, "1", None, math.nan]),
        (is_cost, [0, 0.0, 0.25, MAX_USD], [-1e-9, MAX_USD + 1, 10**400, math.inf, math.nan, True, "0.25", None]),
        (is_amount, [0, 0.5], [-0.5, 10**400, math.inf, math.nan, "1"]),
    ],
)
def test_counts_costs_and_times_are_what_a_call_can_take(
    fits: Callable[[Any], bool], values: list[Any], others: list[Any]
) -> None:
    assert [value for value in values if not fits(value)] == [value for value in others if fits(value)] == []


@pytest.mark.parametrize("outcome", ["answer", "truncated"])
def test_an_answer_whose_text_is_none_is_out_of_order(outcome: str) -> None:
    row: dict[str, Any] = {"outcome": outcome, "text": 5, "prompt_tokens": 3}
    assert replace_impossible(row) == ["text"]
    assert row == {"outcome": "malformed", "text": None, "prompt_tokens": 3}


def test_a_text_loses_what_cannot_be_stored_and_stays_an_answer() -> None:
    row: dict[str, Any] = {"outcome": "answer", "text": "left \ud800", "served_model": "m \udfff", "cost_usd": -1.0}
    assert replace_impossible(row) == ["text", "served_model", "cost_usd"]
    assert row == {"outcome": "answer", "text": "left ?", "served_model": None, "cost_usd": None}


def test_a_row_in_order_and_a_failure_without_text_are_left_alone() -> None:
    for row in ({"outcome": "answer", "text": "left", "cost_usd": 0}, {"outcome": "error", "text": None}):
        before = dict(row)
        assert replace_impossible(row) == []
        assert row == before
    failed: dict[str, Any] = {"outcome": "error", "text": None, "prompt_tokens": 2**63}
    assert (replace_impossible(failed), failed["outcome"]) == (["prompt_tokens"], "error")
