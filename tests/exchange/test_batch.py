"""Batches: media by reference, failures of every form, and what is no answer.

`integration/test_batches.py` asks a whole study through them."""

from __future__ import annotations

import base64
import datetime
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.build.errors import raises
from tests.conftest import KEY
from tests.providers.server import Provider
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.checks import loopback
from traps_pipeline.checks.live_check import requests_of
from traps_pipeline.checks.wire_body import Api
from traps_pipeline.exchange import provider_batch
from traps_pipeline.exchange.provider_batch import export_batches, failures, is_batch, outcomes_of, read_batch
from traps_pipeline.models.registry.accounts import Account, Prices
from traps_pipeline.models.registry.entries import PROTOCOL_PARAMS, Entry, ModelEntry
from traps_pipeline.models.request import Outcome, Request
from traps_pipeline.models.wire import api

PRICES = Prices(input=1, output=10, as_of=datetime.date(2026, 11, 1))
Entries = Callable[[str], Entry]


@pytest.fixture
def entry_at(provider: Provider, monkeypatch: pytest.MonkeyPatch) -> Entries:
    """A model at the provider, by the route of its API."""

    def made(kind: str) -> Entry:
        version = "v1beta" if kind == "gemini" else "v1"
        account = Account(key=KEY, base_url=f"{provider.url}/{version}")
        for module in (api, loopback):
            monkeypatch.setattr(module, "load_accounts", lambda: {"here": account})
        fields: dict[str, Any] = {"id": "m", "backend": "api", "account": "here", "prices": PRICES}
        fields |= {"provider_id": f"{kind}/m", "params": {name: value for name, (_, value) in PROTOCOL_PARAMS.items()}}
        fields |= {"media": {"profile": "images", "fps": 5, "most": 25}}
        return ModelEntry.model_validate(fields, context={"accounts": {"here": account}})

    return made


def by_key(entry: Entry) -> dict[str, Request]:
    return {request.key: request for request in requests_of(entry).values()}


def inlined(value: Any, folder: Path) -> Any:
    """A body with the media back in the place of their addresses, as whoever serves the folder would."""

    def data(address: str) -> str:
        assert address.startswith("https://here/media/")
        return base64.b64encode((folder / address.rsplit("/", 1)[1]).read_bytes()).decode()

    match value:
        case str() if value.startswith("https://here/"):
            return "data:image/jpeg;base64," + data(value)
        case {"type": "url", "url": str(url)}:
            return {"type": "base64", "media_type": "image/jpeg", "data": data(url)}
        case {"file_data": {"mime_type": kind, "file_uri": uri}, **rest}:
            return {"inline_data": {"mime_type": kind, "data": data(uri)}, **rest}
        case dict():
            return {key: inlined(each, folder) for key, each in value.items()}
        case list():
            return [inlined(each, folder) for each in value]
        case _:
            return value


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["openai", "openai/responses", "gemini", "anthropic"])
def test_media_by_reference_are_the_media_that_are_inline(kind: str, entry_at: Entries, tmp_path: Path) -> None:
    entry = entry_at(kind)
    wanted = {"m": (entry, [*by_key(entry).values()])}
    (inline,), _ = export_batches(wanted, tmp_path / "inline")
    (referring,), _ = export_batches(wanted, tmp_path / "referring", "https://here/media/")
    read = [json.loads(text) if kind == "anthropic" else [*map(json.loads, text.splitlines())]
            for text in (inline.read_text(), referring.read_text())]  # fmt: skip
    media = tmp_path / "referring" / "media"
    assert inlined(read[1], media) == read[0] != read[1]
    assert len([*media.iterdir()]) == 2  # the frames of two colours, each of them once
    assert referring.stat().st_size < inline.stat().st_size / 2 and "base64" not in referring.read_text()


@pytest.mark.parametrize(
    "line", [{"custom_id": "other", "response": {"status_code": 200, "body": {}}}, {"custom_id": "k"}, {"response": {}}]
)
def test_a_line_that_is_not_wanted_or_not_known_is_named_and_nothing_is_imported(
    line: dict[str, Any], tmp_path: Path
) -> None:
    path = tmp_path / "results.jsonl"
    path.write_text(json.dumps(line) + "\n")
    with raises(TrapsError, "exchange.provider_batch.read_batch", "results.jsonl:1"):
        read_batch(path, {"k": Request("m", "openai/m", {}, "", "", {})})


BODY = {"message": "too long", "type": "BadRequestError", "param": None, "code": 400}


def chat_line(status: int | None, body: Any = None, error: Any = None) -> dict[str, Any]:
    """A line of OpenAI's or vLLM's form."""
    return {"custom_id": "k", "response": status and {"status_code": status, "body": body}, "error": error}


def message_line(kind: str, **more: Any) -> dict[str, Any]:
    """A line of Anthropic's form."""
    return {"custom_id": "k", "result": {"type": kind, **more}}


@pytest.mark.parametrize(
    ("route", "line", "error"),
    [
        ("openai", chat_line(500, {"error": BODY}), "server_error"),
        ("openai", chat_line(400, {"error": BODY}), "http_400"),
        ("openai", chat_line(None, error={"code": "batch_expired", "message": "x"}), "batch_expired"),
        ("openai", chat_line(400, error={"error": BODY}), "http_400"),  # vLLM, and an earlier one
        ("openai", chat_line(400, error={"object": "error"} | BODY), "http_400"),
        ("gemini", {"key": "k", "error": {"code": 503, "status": "UNAVAILABLE", "message": "x"}}, "batch_503"),
        ("gemini", {"key": "k", "error": {"status": "CANCELLED", "message": "x"}}, "batch_cancelled"),
        ("anthropic", message_line("expired"), "batch_expired"),
        ("anthropic", message_line("errored", error={"type": "error"}), "batch_errored"),
    ],
)
def test_failures_of_every_form_are_outcomes_of_their_kind_and_a_partial_batch_leaves_the_rest_missing(
    route: str, line: dict[str, Any], error: str, entry_at: Entries, tmp_path: Path
) -> None:
    (tmp_path / "results.jsonl").write_text(json.dumps(line) + "\n")
    entry = entry_at(route)
    request = Request("m", f"{route}/m", dict(entry.params), "Look.", "What?", {})
    wanted = {"k": request, "missing": replace(request, user="Where?")}
    assert is_batch(tmp_path / "results.jsonl")
    ((found, outcome),) = outcomes_of({"m": entry}, wanted, read_batch(tmp_path / "results.jsonl", wanted))
    assert (found, outcome.kind, outcome.error) == (request, "error", error)


def test_failures_are_counted_by_their_kind() -> None:
    outcomes = [Outcome("error", error=error) for error in ("http_400", "batch_expired", "http_400")]
    assert failures([*outcomes, Outcome("answer", "left")]) == "1 batch_expired, 2 http_400"


def test_files_are_split_by_number_and_by_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def written(name: str, form: Api, limits: tuple[int, int], lines: int, **content: Any) -> list[str]:
        monkeypatch.setattr(provider_batch, "LIMITS", {form: limits})
        part = provider_batch._Part(tmp_path, name)
        for k in range(lines):
            part.add(form, {"custom_id": str(k)} | content)
        return [file.read_text() for file in part.written()]

    assert [len(text.splitlines()) for text in written("m", "chat", (3, 10_000), 7, body={})] == [3, 3, 1]
    assert [len(text.splitlines()) for text in written("n", "chat", (100, 250), 4, body="x" * 100)] == [1, 1, 1, 1]
    first, second = (json.loads(text)["requests"] for text in written("o", "anthropic", (2, 10_000), 3, params={}))
    assert [one["custom_id"] for one in (*first, *second)] == ["0", "1", "2"]
