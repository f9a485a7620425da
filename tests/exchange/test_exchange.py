"""What an import takes for an answer, and what it stops at."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from pydantic import ValidationError

from tests.build.errors import raises
from tests.judging.conftest import item_row
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.exchange.answer_exchange import _ERROR_TEXT, Answer, ImportResult, checked_answers, import_answers
from traps_pipeline.models.asking.answers import wanted_questions
from traps_pipeline.models.request import Request
from traps_pipeline.pipeline.experiment import Experiment
from traps_pipeline.storage.benchmark_tables import ITEMS, ItemRow
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

ASKED = Experiment(name="small", models=["oracle"], regimes=["standard"], runs=[1], datasets=["occlusion"])
(CELL,) = ASKED.cells()


@pytest.fixture
def study(tmp_path: Path) -> Workspace:
    """A study of two items that nobody has answered."""
    workspace = Workspace.create(tmp_path / "study", Study(panel="rules"))
    items = [ItemRow(**item_row("occlusion", 0, side)) for side in ("control", "void")]
    workspace.tables.write(ITEMS, {"dataset": "occlusion"}, items, {})
    return workspace


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


def test_error_messages_among_answers_stop_an_import_until_somebody_says_what_they_are(
    study: Workspace, tmp_path: Path
) -> None:
    texts = ("Error: 429 Too Many Requests", "left")
    keys = [question.request.key for question in wanted_questions(study, CELL)]
    path = tmp_path / "answers.jsonl"
    path.write_text("".join(json.dumps({"key": k, "text": t}) + "\n" for k, t in zip(keys, texts, strict=True)))
    with raises(TrapsError, "exchange.answer_exchange.import_answers", "answers.jsonl", "--errors drop"):
        import_answers(study, ASKED, path)
    assert not study.answers.read(CELL.evaluation.key).settled
    assert import_answers(study, ASKED, path, errors="drop") == ImportResult(1, 0, dropped=1)
    assert import_answers(study, ASKED, path, errors="keep") == ImportResult(1, 1)


@pytest.mark.parametrize(
    "content", [b"", b"\n \n", b"\x89PNG\r\n\x1a\n\0\0", b"left\n", b'{"text": "left"}\n', b"{}\n"]
)
@pytest.mark.parametrize("name", ["answers.jsonl", "log.json", "log.eval"])
def test_a_file_without_answers_is_named_and_nothing_is_imported(
    study: Workspace, tmp_path: Path, name: str, content: bytes
) -> None:
    (tmp_path / name).write_bytes(content)
    with raises(TrapsError, "", name):
        import_answers(study, ASKED, tmp_path / name)
    assert not study.answers.read(CELL.evaluation.key).settled


@pytest.mark.parametrize(
    "line",
    [
        '{"key": "k", "text": "x", "mood": 1}',
        '{"key": "k", "outcome": "error"}',
        '{"key": "k", "outcome": "answer", "text": " "}',
        '{"key": "k", "outcome": "refused", "text": "no"}',
    ],
)
def test_a_line_that_is_no_answer_is_named(tmp_path: Path, line: str) -> None:
    (tmp_path / "answers.jsonl").write_text(line + "\n")
    with raises(TrapsError, "exchange.answer_exchange", "answers.jsonl:1"):
        checked_answers(tmp_path / "answers.jsonl", {"k": Request("m", "api", {}, "s", "u", {})})
