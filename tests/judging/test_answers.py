"""Correctness is decided by code: docs/spec.md 4.3."""

from __future__ import annotations

import pytest

from traps_pipeline.models.reading.judged_answers import is_correct, normalise

SIDES = ["left", "right", "elsewhere"]
BINS = {"left bin": "left", "red bin": "left", "right bin": "right", "blue bin": "right"}
ALIASES = BINS | {"somewhere else": "elsewhere"}


@pytest.mark.parametrize(
    ("said", "right"),
    [
        ("3", True),
        ("3.0", True),
        ("2.5", True),  # within 0.5, edges included
        ("3.5", True),
        ("2.49", False),
        ("3.51", False),
        ("2", False),
        ("4", False),
        ("three", True),
        ("Three.", True),
        ("two", False),
        ("twelve", False),
        ("3 balls", True),
        ("bucket 3", True),
        ("the third", False),
        ("2 or 3", False),
        ("", False),
        ("-3", False),
        ("−3 balls", False),  # a true minus sign
        (".3", False),
        ("bucket-3", True),
        ("no.3", True),
        ("- 3", True),  # an item of a list
        ("none", False),
        (None, False),
    ],
)
def test_a_number_is_right_within_a_half(said: str | None, right: bool) -> None:
    assert is_correct(said, "3", "numeric", ["0", "1", "2", "3"], {}) is right


def test_an_alias_of_a_number_is_read_before_its_digits() -> None:
    assert is_correct("bucket 2 from the right", "4", "numeric", ["1", "4"], {"bucket 2 from the right": "4"})
    assert not is_correct("bucket 2 from the left", "4", "numeric", ["1", "4"], {"bucket 2 from the right": "4"})


@pytest.mark.parametrize(
    "said", ["left", "Left", "LEFT.", " the left ", "left bin", "The red bin", "a left-bin", "'left'", "**Left**"]
)
def test_case_articles_punctuation_and_aliases_do_not_matter(said: str) -> None:
    assert is_correct(said, "left", "direction", SIDES, ALIASES)


@pytest.mark.parametrize("said", ["right", "blue bin", "to the left", "left or right", "links", "", "leftmost", None])
def test_another_or_an_unmapped_value_is_wrong(said: str | None) -> None:
    assert not is_correct(said, "left", "direction", SIDES, ALIASES)


@pytest.mark.parametrize("said", ["0-2", "0 to 2", "0 - 2", "0–2", "0—2", "0 – 2."])
def test_a_range_is_a_label_however_it_is_written(said: str) -> None:
    assert is_correct(said, "0-2", "count_range", ["0-2", "3-5"], {})
    assert not is_correct(said, "3-5", "count_range", ["0-2", "3-5"], {})


@pytest.mark.parametrize("said", ["1", "2", "0-1", "0", "02"])
def test_a_number_inside_a_range_is_not_the_range(said: str) -> None:
    assert not is_correct(said, "0-2", "count_range", ["0-2", "3-5"], {})


@pytest.mark.parametrize(
    ("text", "normal"),
    [
        ("The Left-hand Bin!", "left hand bin"),
        ("3.5", "3.5"),
        ("3.", "3"),
        ("an  answer\n(a)", "answer"),
        ("it’s", "it s"),
        ("3 to 5 to 7", "3-5-7"),
        ("(-1.50)", "-1.50"),
        ("-.5 or .5", "-.5 or .5"),
        ("$12,345,678.5, or 1,000-2,000", "12345678.5 or 1000-2000"),
        ("1,2 or 0,5 or 1,23456", "1 2 or 0 5 or 1 23456"),
    ],
)
def test_normal_form(text: str, normal: str) -> None:
    assert normalise(text) == normal
