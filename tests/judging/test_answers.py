"""Correctness is decided by code: docs/spec.md 4.3."""

from __future__ import annotations

import json
from itertools import permutations
from pathlib import Path

import pytest

from traps_pipeline.models.reading.judged_answers import is_correct, normalise, to_label

RELEASED = Path(__file__).parents[2] / "scene_specs" / "released"
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
        ("the third", True),
        ("the third one", True),
        ("bucket 3 (the middle one)", True),
        ("bucket 2 (the middle one)", False),
        ("3 of the four", True),
        ("4 of 3", False),
        ("3 from the right", None),
        ("third from left to right", True),
        ("2 or 3", None),
        ("2 to 3", None),
        ("not 3", None),
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
def test_a_number_is_right_within_a_half(said: str | None, right: bool | None) -> None:
    assert is_correct(said, "3", "numeric", ["0", "1", "2", "3"], {}) is right


def test_an_alias_of_a_number_is_read_before_its_digits() -> None:
    assert is_correct("bucket 2 from the right", "4", "numeric", ["1", "4"], {"bucket 2 from the right": "4"})
    assert not is_correct("bucket 2 from the left", "4", "numeric", ["1", "4"], {"bucket 2 from the right": "4"})


@pytest.mark.parametrize(
    "said",
    [
        *("left", "Left", "LEFT.", " the left ", "left bin", "The red bin", "a left-bin", "'left'", "**Left**"),
        *("to the left", "on the left", "left side", "left (red bin)", "red bin, left", "the left one", "left left"),
    ],
)
def test_a_value_that_names_one_choice_and_no_other_is_that_choice(said: str) -> None:
    assert is_correct(said, "left", "direction", SIDES, ALIASES) is True
    assert is_correct(said, "right", "direction", SIDES, ALIASES) is False


@pytest.mark.parametrize("said", ["left or right", "left (blue bin)", "not left", "left, never right", "left/right"])
def test_a_value_that_names_two_choices_or_denies_one_is_unread(said: str) -> None:
    assert is_correct(said, "left", "direction", SIDES, ALIASES) is None
    assert to_label(said, SIDES, ALIASES) is None


@pytest.mark.parametrize(
    ("said", "label"),
    [
        *((yes, "yes") for yes in ("Yes.", "true", "it does", "They do", "it falls over", "yes, the tall one falls")),
        *(
            (no, "no")
            for no in ("no", "false", "it doesn't", "does not fall", "No, it does not", "no, it stays standing")
        ),
        *((both, None) for both in ("yes or no", "it does not get up", "not over", "no, it falls", "yes, it does not")),
    ],
)
def test_a_yes_or_no_is_read_in_other_words(said: str, label: str | None) -> None:
    aliases = {"it falls": "yes", "falls": "yes", "it does not fall": "no", "it stays standing": "no"}
    for truth in ("yes", "no"):
        assert is_correct(said, truth, "binary", ["yes", "no"], aliases) is (None if label is None else label == truth)


FAMILIES = sorted(RELEASED.glob("*.jsonl"))


@pytest.mark.parametrize("family", FAMILIES, ids=lambda path: path.stem)
def test_each_name_of_a_familys_choices_is_read_as_its_choice_and_two_of_them_as_none(family: Path) -> None:
    record = json.loads(family.read_text("utf-8").splitlines()[0])
    labels, answer_type, aliases = record["labels"], record["answer_type"], record["aliases"]
    for name, label in [*aliases.items(), *zip(labels, labels, strict=True)]:
        for said in (name, f"The {name.title()}.", f"**{name}**", f"the answer: {name}", f"{name} ({label})"):
            assert is_correct(said, label, answer_type, labels, aliases) is True, said
    for one, other in permutations(labels, 2):
        for said in (f"{one} or {other}", f"{one}, not {other}", f"not {one}"):
            assert is_correct(said, one, answer_type, labels, aliases) is None, said


@pytest.mark.parametrize("said", ["right", "blue bin", "to the right", "links", "", "leftmost", "in no bin", None])
def test_another_or_an_unmapped_value_is_wrong(said: str | None) -> None:
    assert is_correct(said, "left", "direction", SIDES, ALIASES) is False


@pytest.mark.parametrize(
    ("said", "right"),
    [
        ("3-4 dominoes", True),
        ("about 4", True),
        ("3 or 4", True),
        ("4 of 7", True),
        ("2", False),
        ("2 or 3", None),
        ("2-4", None),
    ],
)
def test_a_number_of_a_range_names_the_range(said: str, right: bool | None) -> None:
    aliases = {"1": "1-2", "2": "1-2", "3": "3-5", "4": "3-5", "5": "3-5", "6": "6-7", "7": "6-7"}
    assert is_correct(said, "3-5", "count_range", ["1-2", "3-5", "6-7"], aliases) is right


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
