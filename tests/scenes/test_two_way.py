"""Figures of two events, by hand."""

from __future__ import annotations

from itertools import product

import pandas as pd
import pytest

from bench.two_events.figures import two_way


def items(rule: str, scenarios: int = 20) -> pd.DataFrame:
    """All items, of which a rule abstains on some and answers the others rightly."""
    rows = [
        {"scenario_id": f"slide-{n}", "asked_hidden": asked, "other_hidden": other}
        for n, asked, other, _ in product(range(scenarios), (False, True), (False, True), range(2))
    ]
    frame = pd.DataFrame(rows)
    return frame.assign(abstained=frame.eval(rule), correct=True)


def test_a_reader_who_looks_where_it_is_asked_has_all():
    figures = two_way(items("asked_hidden"))
    assert (figures.all_right[0], figures.own[0], figures.other[0], figures.specific[0]) == (1, 1, 0, 1)
    assert figures.abstained == {"neither": 0, "other": 0, "asked": 1, "both": 1}
    assert figures.all_right[1] == pytest.approx(0.025 ** (1 / 20), abs=0.01)  # Clopper and Pearson, 20 of 20


def test_what_the_clip_alone_tells_is_not_specific():
    figures = two_way(items("asked_hidden | other_hidden"))
    assert (figures.own[0], figures.other[0], figures.specific[0], figures.all_right[0]) == (1, 1, 0, 0)


def test_a_wrong_answer_and_a_missing_item_cost_their_scenario():
    frame = items("asked_hidden")
    frame.loc[0, "correct"] = False  # of slide-0, where neither lane is hidden
    figures = two_way(frame)
    assert figures.all_right[0] == 19 / 20 and figures.own[0] == 1
    assert two_way(frame.drop(index=8)).scenarios == 19
