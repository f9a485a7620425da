"""What a model sent is an answer, or an outcome of its own that no judge takes for modesty."""

from __future__ import annotations

import pytest

from traps_pipeline.models.reading import Reading, degenerate, read_answer

THINK = ("<think>", "</think>")


def read(text: str | None, outcome: str = "answer", regime: str = "standard", *, thinks: bool = False) -> Reading:
    return read_answer({"outcome": outcome, "text": text}, None, regime, thinking=THINK if thinks else None)


@pytest.mark.parametrize("text", [".....", "...", "!!!", "\n\n. . .", "–", "🤖🤖"])
def test_punctuation_alone_is_degenerate_and_is_shown_to_no_judge(text: str) -> None:
    assert (read(text).outcome, read(text).text) == ("degenerate", None)


@pytest.mark.parametrize(
    "text",
    [
        "left " * 40,
        "The ball rolls. " * 12,
        "aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa",
        "The chain starts. " + "And then it falls over and then the next one leans on it. " * 8,
    ],
)
def test_a_text_that_repeats_itself_to_its_end_is_degenerate(text: str) -> None:
    assert degenerate(text) in ("repeats itself", "repeats a character")


@pytest.mark.parametrize(
    "text",
    [
        "left",
        "3",
        "?! No.",
        "no, no, no, no, no, no",
        "Yes. " * 3 + "The domino falls.",
        "The ball bounces, bounces, bounces, bounces, bounces, bounces and then lands in the left bin of the two.",
        "I don't know.",
    ],
)
def test_a_short_or_lively_text_says_something(text: str) -> None:
    assert degenerate(text) is None
    assert read(text).outcome == "answer"


def test_a_text_cut_off_before_a_final_answer_is_truncated_and_one_cut_off_after_it_is_an_answer() -> None:
    assert read("The ball rolls down and I look at", "truncated").outcome == "truncated"
    assert read("The ball rolls down and I look at", "truncated").text is None
    assert read("The answer is: left. Moreover, the", "truncated").outcome == "answer"
    assert read("**Answer:** left\nI saw that the", "truncated").outcome == "answer"
    assert read("It is a ramp. My final answer is **left**. The", "truncated").outcome == "answer"
    for announced in ("The answer is:", "The answer is", "**Answer:**", "Final answer = ", "The answer is le"):
        assert read(announced, "truncated").outcome == "truncated"


def test_thoughts_between_tags_are_split_off_where_the_entry_declares_them() -> None:
    found = read("<think>It may be left.</think>\nright", thinks=True)
    assert (found.outcome, found.text, found.reasoning) == ("answer", "right", "It may be left.")
    opened_by_the_template = read("It may be left.</think> right", thinks=True)
    assert (opened_by_the_template.text, opened_by_the_template.reasoning) == ("right", "It may be left.")
    endless = read("<think>I cannot tell", "truncated", thinks=True)
    assert (endless.outcome, endless.text, endless.reasoning) == ("truncated", None, "I cannot tell")
    assert read("<think>I cannot tell</think>", thinks=True).outcome == "empty"


def test_undeclared_thoughts_are_never_judged_as_the_answer() -> None:
    found = read("<think>I cannot tell, so perhaps left.</think> left")
    assert (found.outcome, found.text) == ("degenerate", None)
    assert found.why is not None and 'say `thinking: "<think>"`' in found.why


@pytest.mark.parametrize(
    ("text", "is_json"),
    [
        ('{"reason": "r", "final_answer": "left"}', True),
        ('```json\n{"reason": "r", "final_answer": "left"}\n```', True),
        ("left", False),
        ('{"reason": "r"}', False),
        ('["left"]', False),
    ],
)
def test_in_the_json_regime_alone_it_is_noted_whether_an_answer_is_the_object_asked_for(
    text: str, is_json: bool
) -> None:
    assert read(text, regime="json").is_json is is_json
    assert read(text).is_json is None
    assert read(text, regime="json").outcome == "answer"


def test_an_answer_that_never_came_stays_what_it_was() -> None:
    assert read(None, "refused") == Reading("refused", None, None)


@pytest.mark.parametrize(
    ("dataset", "text", "is_json"),
    [
        ("schema_answer", '{"final_answer": "left"}', True),
        ("schema_abstain", '{"final_answer": "left"}', False),  # the field that is asked for is missing
        ("schema_abstain", '{"abstain": false, "final_answer": "left"}', True),
        ("schema_abstain", "left", False),
        ("labels_two", "left", None),
    ],
)
def test_a_text_is_the_object_that_its_dataset_asks_for_or_it_is_not(
    dataset: str, text: str, is_json: bool | None
) -> None:
    row = {"outcome": "answer", "text": text}
    found = read_answer(row, None, "standard", dataset=dataset)
    assert (found.outcome, found.text, found.is_json) == ("answer", text, is_json)
