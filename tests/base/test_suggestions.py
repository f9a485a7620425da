"""The nearest known word to a misspelt one."""

from __future__ import annotations

import pytest

from traps_pipeline.base.suggestions import did_you_mean, nearest_name

KNOWN = ("gpt-5-mini", "oracle", "always-abstain")


@pytest.mark.parametrize(
    ("word", "near"), [("orcale", "oracle"), ("GPT5-mini", "gpt-5-mini"), ("abstain", "always-abstain"), ("zzz", None)]
)
def test_a_word_is_like_one_of_the_known_or_like_none(word: str, near: str | None) -> None:
    assert nearest_name(word, KNOWN) == near
    told = did_you_mean(word, KNOWN)
    assert near in told if near else told == ""


def test_a_word_of_any_length_is_compared_at_once() -> None:
    assert nearest_name("o" * 1_000_000, KNOWN) is None
