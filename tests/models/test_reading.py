"""What a model sent is an answer, or an outcome of its own that no judge takes for modesty."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from tests.build.errors import raises
from traps_pipeline.models.reading.interpret import Reading, read_answer
from traps_pipeline.models.reading.thinking import COMMON_MARKS, declaration_line, marks_of, strip_fence, strip_tokens

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
    assert read(text).outcome == "degenerate"


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
    opened_by_the_template = read("It may be left.</think> right", thinks=True)
    assert (opened_by_the_template.text, opened_by_the_template.reasoning) == ("right", "It may be left.")
    endless = read("<think>I cannot tell", "truncated", thinks=True)
    assert (endless.outcome, endless.text, endless.reasoning) == ("truncated", None, "I cannot tell")
    assert read("<think>I cannot tell</think>", thinks=True).outcome == "empty"
    between = read("I see a ramp.<think>Or not?</think> left", thinks=True)
    assert (between.text, between.reasoning) == ("I see a ramp. left", "Or not?")


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


@pytest.mark.parametrize(
    "text",
    [
        '{"reason": "The answer: we need to see',
        '{"reason": "The answer is: left. Then", "final_ans',
        '{"reason": "r", "final_answer": "le',
        '{"final_answer": 1',  # perhaps of 12
        "We need to answer: does the ball go left or right? In frame 3 the",
    ],
)
def test_a_text_cut_off_inside_its_reasoning_is_truncated_whatever_it_contains(text: str) -> None:
    assert (read(text, "truncated", "json").outcome, read(text, "truncated").outcome) == ("truncated", "truncated")


@pytest.mark.parametrize(
    "text",
    [
        '{"reason": "r", "final_answer": "left"',
        '{"final_answer": 12, "reason": "I s',
        '```json\n{"final_answer": "left"}',
    ],
)
def test_a_whole_final_answer_stands_although_its_object_breaks_off(text: str) -> None:
    assert (read(text, "truncated", "json").outcome, read(text, "truncated", "json").text) == ("answer", text)


@pytest.mark.parametrize(("opens", "closes"), COMMON_MARKS)
def test_every_usual_mark_is_split_off_once_declared_and_named_before(opens: str, closes: str) -> None:
    marks = marks_of(opens)
    row = {"outcome": "answer", "text": f"{opens}It may be left.{closes} right"}
    undeclared = read_answer(row, None, "standard")
    assert undeclared.outcome == "degenerate" and declaration_line(opens) in str(undeclared.why)
    found = read_answer(row, None, "standard", thinking=marks)
    assert (found.outcome, found.text, found.reasoning) == ("answer", "right", "It may be left.")
    endless = {"outcome": "answer", "text": f"The answer is: left. {opens}I guess"}
    assert read_answer(endless, None, "standard", thinking=marks).outcome == "truncated"


def test_what_gpt_oss_writes_around_its_messages_is_no_answer() -> None:
    thought = "<|start|>assistant<|channel|>analysis<|message|>Left?<|end|>"
    text = f"{thought}<|start|>assistant<|channel|>final<|message|>right<|return|>"
    found = read_answer({"outcome": "answer", "text": text}, None, "standard", thinking=marks_of(COMMON_MARKS[-1][0]))
    assert (found.text, found.reasoning) == ("right", "Left?")


@pytest.mark.parametrize("declared", ["<ponder>", ["<a>"], ["<a>", "<a>"], ["<a>", ""], "", []])
def test_marks_are_both_declared_or_the_usual_ones(declared: Any) -> None:
    with raises(ValueError, "models.reading.thinking.marks_of", "<think>"):
        marks_of(declared)
    assert marks_of(["<ponder>", "</ponder>"]) == ("<ponder>", "</ponder>")


def test_an_answer_that_ended_for_an_unknown_reason_is_read_again_once_the_reason_is_known() -> None:
    row = {"outcome": "unfinished", "text": "The answer is: left.", "finish_reason": "of_the_weather"}
    found = read_answer(row, None, "standard")
    assert (found.outcome, found.text) == ("unfinished", None) and "'of_the_weather'" in str(found.why)
    assert read_answer(row | {"finish_reason": "stop"}, None, "standard").text == "The answer is: left."


def test_an_answer_that_was_cut_off_before_it_began_is_truncated_and_not_empty() -> None:
    row = {"outcome": "empty", "text": None}
    found = read_answer(row | {"finish_reason": "length"}, "The ball", "json")
    assert found.why and replace(found, why=None) == Reading("truncated", None, "The ball", is_json=False)
    assert read_answer(row | {"finish_reason": "stop"}, None, "json").outcome == "empty"


@pytest.mark.parametrize("around", ["{}<|im_end|>", "{}</s>\n", "{} <|eot_id|><|eot_id|>", "\ufeff{}", "{}\u200b"])
def test_end_tokens_and_invisible_characters_are_no_part_of_an_answer(around: str) -> None:
    assert read(around.format("left")).text == "left"
    assert read(around.format('{"reason": "r", "final_answer": "left"}'), regime="json").is_json is True


def test_an_end_token_within_an_answer_and_white_space_alone_stay() -> None:
    assert strip_tokens("</s> is a mark.\n") == "</s> is a mark.\n"
    assert read("</s>").outcome == "degenerate"


def test_json_is_taken_out_of_a_fence_that_holds_all_of_a_text() -> None:
    fenced = '```json\n{"a": 1}\n```', '```\n{"a": 1}\n```\n', '  ```json{"a": 1}```', '~~~JSON\n{"a": 1}\n~~~'
    for text in ('{"a": 1}', *fenced):
        assert strip_fence(text) == '{"a": 1}'
    assert strip_fence("```") == "```" and strip_fence("```a```.") == "```a```."


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


def test_a_text_that_is_longer_than_its_tokens_can_be_is_no_answer() -> None:
    row = {"outcome": "answer", "text": "The answer is: left." + "".join(f" w{n:03}" for n in range(1_000))}
    assert read_answer(row, None, "standard", max_tokens=40).outcome == "answer"  # 5,020 characters of at most 5,120
    assert read_answer(row, None, "standard").outcome == "answer"  # no limit is known
    found = read_answer(row, None, "standard", max_tokens=39)
    assert (found.outcome, found.text) == ("unfinished", None)
    assert found.why and "5,020 characters" in found.why


@pytest.mark.parametrize(
    ("text", "outcome", "fragment"),
    [
        ("The bucket in the bottom left-hand corner of", "truncated", "The bucket in the bottom left-hand corner of"),
        ("<think>I look.</think>The bucket in", "truncated", "The bucket in"),
        ("<think>I look at the", "truncated", None),  # the trace has it
        ("left " * 2_000, "answer", ("left " * 2_000)[:4_000]),
        (".....", "answer", "....."),
        ("The answer is: left. And", "truncated", None),  # an answer
    ],
)
def test_the_beginning_of_a_text_that_is_no_answer_is_kept_beside_it(
    text: str, outcome: str, fragment: str | None
) -> None:
    found = read(text, outcome, thinks=True)
    assert found.fragment == fragment
    assert found.text is None or found.outcome == "answer"
