"""What an import takes for an answer, and what it stops at."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from tests.build.errors import raises
from traps_pipeline.exchange.answer_exchange import _ERROR_TEXT, Answer


@pytest.mark.parametrize(
    "text",
    [
        "Error: 429 Too Many Requests", "ERROR 503", "error code: 500", "openai.RateLimitError: slow down",
        "litellm.exceptions.Timeout: x", "Traceback (most recent call last):\n  File", "HTTP 502 Bad Gateway",
        "[429 Client Error]", "Connection refused", "Request timed out", "An error occurred while asking",
    ],
)  # fmt: skip
def test_a_text_that_a_harness_put_in_the_place_of_an_answer_is_recognized(text: str) -> None:
    assert _ERROR_TEXT.match(text)


@pytest.mark.parametrize(
    "text", ["left", "The error is on the left.", "429", "Connections are lost, so 3.", "I erred: right"]
)
def test_an_answer_is_not_taken_for_an_error(text: str) -> None:
    assert not _ERROR_TEXT.match(text)


def test_a_line_without_an_outcome_has_the_one_of_its_finish_reason() -> None:
    assert Answer(key="k", text="left", finish_reason="STOP").outcome == "answer"
    assert Answer(key="k", text="left", finish_reason="length").outcome == "truncated"
    assert Answer(key="k", text="left", finish_reason="of_the_weather").outcome == "unfinished"
    assert Answer(key="k", text="left").outcome == "answer"
    with raises(ValidationError, "Answer"):
        Answer(key="k", text="left", finish_reason="abort")
