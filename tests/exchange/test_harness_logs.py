"""What a log of inspect_ai amounts to: failed samples, epochs, tokens of the cache, reasoning, odd bytes."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.exchange import harness_logs
from traps_pipeline.exchange.answer_exchange import Answer, AnswerContext, _answers_by_item, checked_answers
from traps_pipeline.exchange.harness_logs import log_reader
from traps_pipeline.models.request import Request


def sample(text: str = "left", stop: str = "stop", **fields: Any) -> dict[str, Any]:
    choice = {"message": {"role": "assistant", "content": text}, "stop_reason": stop}
    output = {"model": "m", "choices": [choice], "completion": text}
    return {"metadata": {"item_id": "x", "regime": "json"}, "output": output, "epoch": 1} | fields


def tokens(prompt: int | None, completion: int, total: int | None, **others: int) -> dict[str, int | None]:
    return {"input_tokens": prompt, "output_tokens": completion, "total_tokens": total, **others}


def wanted(*runs: int) -> Mapping[str, Request]:
    about = [{"item_id": item, "model": "m", "regime": "json", "run": run} for item in "xy" for run in runs]
    return {f"{at['item_id']}{at['run']}": Request("m", "openai/m", {}, "s", "u", at) for at in about}


def imported(folder: Path, *samples: Mapping[str, Any], run: int = 1) -> tuple[dict[str, Answer], int]:
    log = folder / "log.json"
    log.write_text(json.dumps({"samples": samples}))
    reader = log_reader(log)
    assert reader is not None
    return _answers_by_item(reader(log), wanted(1, 2, 3), AnswerContext("m", run))


def test_failed_samples_are_counted_and_stay_missing_while_the_others_are_imported(tmp_path: Path) -> None:
    never_asked = {"model": "m", "choices": [], "completion": ""}  # a limit of the sample came first
    failed = sample("", error={"message": "429"}), sample(epoch=2, output=never_asked)
    answers, n_failed = imported(tmp_path, sample(metadata={"item_id": "y", "regime": "json"}), *failed)
    assert ({key: answer.text for key, answer in answers.items()}, n_failed) == ({"y1": "left"}, 2)
    retried, n_failed = imported(tmp_path, failed[0], sample("right"))  # a retry that answered
    assert (retried["x1"].text, n_failed) == ("right", 0)


def test_epochs_are_runs_from_the_one_that_is_named(tmp_path: Path) -> None:
    answers, _ = imported(tmp_path, sample("a"), sample("b", epoch=2), run=2)
    assert {key: answer.text for key, answer in answers.items()} == {"x2": "a", "x3": "b"}
    with raises(TrapsError, "exchange.answer_exchange._answers_by_item"):
        imported(tmp_path, sample(epoch=2), run=3)


@pytest.mark.parametrize(
    ("usage", "prompt", "completion"),
    [
        (tokens(3, 550, 12857, input_tokens_cache_write=12304), 12307, 550),
        (tokens(2006, 300, 2306, input_tokens_cache_read=1920), 2006, 300),
        (tokens(14, 1, 401, reasoning_tokens=386), 14, 387),
        (tokens(20, 21, None), 20, 21),
        (tokens(None, 21, 41), None, None),
        ({}, None, None),
    ],
)
def test_cached_and_reasoning_tokens_are_counted_once(
    tmp_path: Path, usage: dict[str, Any], prompt: int | None, completion: int | None
) -> None:
    told = sample()
    told["output"]["usage"] = usage
    answers, _ = imported(tmp_path, told)
    assert (answers["x1"].prompt_tokens, answers["x1"].completion_tokens) == (prompt, completion)


def test_reasoning_in_the_parts_of_a_message_is_the_trace(tmp_path: Path) -> None:
    parts = [{"type": "reasoning", "reasoning": "It falls."}, {"type": "text", "text": "left"}]
    told = sample()
    told["output"]["choices"][0]["message"]["content"] = parts
    answers, _ = imported(tmp_path, told)
    assert (answers["x1"].text, answers["x1"].reasoning) == ("left", "It falls.")


def test_scores_that_are_no_numbers_and_twice_written_samples_hinder_no_import(tmp_path: Path) -> None:
    log = tmp_path / "log.eval"
    scored = sample(scores={"s": {"value": float("nan")}})
    with zipfile.ZipFile(log, "w") as archive:
        archive.writestr("samples/x_epoch_1.json", json.dumps(scored))
        with pytest.warns(UserWarning, match="Duplicate name"):
            archive.writestr("samples/x_epoch_1.json", json.dumps(scored))
    reader = log_reader(log)
    assert reader is not None and _answers_by_item(reader(log), wanted(1), AnswerContext("m"))[0]["x1"].text == "left"


def test_a_byte_order_mark_before_the_first_line_is_no_part_of_it(tmp_path: Path) -> None:
    path = tmp_path / "answers.jsonl"
    path.write_text('{"key": "x1", "text": "left"}\n', encoding="utf-8-sig")
    assert checked_answers(path, wanted(1))["x1"].text == "left"
    path.write_text('{"item": "x", "regime": "json", "text": "left"}\n', encoding="utf-8-sig")
    reader = log_reader(path)
    assert reader is not None and _answers_by_item(reader(path), wanted(1), AnswerContext("m"))[0]["x1"].text == "left"


def test_samples_that_together_are_larger_than_a_log_may_be_are_refused_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where a thousand entries of a small archive share one that unpacks to 256 MB."""
    log, text = tmp_path / "log.eval", json.dumps(sample())
    with zipfile.ZipFile(log, "w") as archive:
        for number in range(3):
            archive.writestr(f"samples/{number}_epoch_1.json", text)
    reader = log_reader(log)
    assert reader is not None
    monkeypatch.setattr(harness_logs, "MAX_LOG_BYTES", 3 * len(text))
    assert len([*reader(log)]) == 3
    monkeypatch.setattr(harness_logs, "MAX_LOG_BYTES", 3 * len(text) - 1)
    with raises(TrapsError, "exchange.harness_logs._eval_log", str(log)):
        next(reader(log))
