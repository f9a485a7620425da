"""Counts and shares in words."""

from __future__ import annotations

import pytest

from traps_pipeline.base.wording import count_noun, in_percent


@pytest.mark.parametrize(
    ("count", "text"), [(0, "0 families"), (1, "1 family"), (2, "2 families"), (12345, "12,345 families")]
)
def test_a_count_agrees_with_its_noun(count: int, text: str) -> None:
    assert count_noun(count, "family", "families") == text


def test_most_nouns_take_an_s_and_a_share_its_sign_after_a_blank() -> None:
    assert (count_noun(1, "scenario"), count_noun(2, "scenario")) == ("1 scenario", "2 scenarios")
    assert (in_percent(0.6), in_percent(1), in_percent(0.1234, 1)) == ("60 %", "100 %", "12.3 %")
