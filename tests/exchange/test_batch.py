"""Batches: media by reference, failures of every form, and what is no answer.

`integration/test_batches.py` asks a whole study through them."""

from __future__ import annotations

import base64
import datetime
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.build.errors import raises
from tests.conftest import KEY
from tests.providers.server import Provider
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.checks import loopback
from traps_pipeline.checks.live_check import requests_of
from traps_pipeline.exchange import provider_batch
from traps_pipeline.exchange.provider_batch import export_batches, failures, is_batch, outcomes_of, read_batch
from traps_pipeline.models import api
from traps_pipeline.models.registry import PROTOCOL, Account, Entry, ModelEntry, Prices
from traps_pipeline.models.request import Request

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
        fields |= {"provider_id": f"{kind}/m", "params": {name: value for name, (_, value) in PROTOCOL.items()}}
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


@pytest.mark.slow
def test_errors_and_expiries_are_typed_and_a_partial_batch_leaves_the_rest_missing(
    entry_at: Entries, tmp_path: Path
) -> None:
    entry = entry_at("openai")
    wanted = by_key(entry)
    first, second, _ = wanted
    results = tmp_path / "results.jsonl"
    refused = {"status_code": 400, "body": {"error": {"message": "no", "type": "invalid_request_error"}}}
    lines = [
        {"custom_id": first, "response": refused, "error": None},
        {"custom_id": second, "response": None, "error": {"code": "batch_expired", "message": "too late"}},
    ]
    results.write_text("".join(json.dumps(line) + "\n" for line in lines))
    found = [*outcomes_of({"m": entry}, wanted, read_batch(results, wanted))]
    assert [(request.key, outcome.kind, outcome.error) for request, outcome in found] == [
        (first, "error", "http_400"),
        (second, "error", "batch_expired"),
    ]
    assert failures([outcome for _, outcome in found]) == "1 batch_expired, 1 http_400"


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
        ("openai", chat_line(400, error={"error": BODY}), "http_400"),  # vLLM, and an earlier one
        ("openai", chat_line(400, error={"object": "error"} | BODY), "http_400"),
        ("gemini", {"key": "k", "error": {"code": 503, "status": "UNAVAILABLE", "message": "x"}}, "batch_503"),
        ("gemini", {"key": "k", "error": {"status": "CANCELLED", "message": "x"}}, "batch_cancelled"),
        ("anthropic", message_line("expired"), "batch_expired"),
        ("anthropic", message_line("errored", error={"type": "error"}), "batch_errored"),
    ],
)
def test_failures_of_every_form_are_outcomes_of_their_kind(
    route: str, line: dict[str, Any], error: str, entry_at: Entries, tmp_path: Path
) -> None:
    (tmp_path / "results.jsonl").write_text(json.dumps(line) + "\n")
    entry = entry_at(route)
    wanted = {"k": Request("m", f"{route}/m", dict(entry.params), "Look.", "What?", {})}
    assert is_batch(tmp_path / "results.jsonl")
    ((_, outcome),) = outcomes_of({"m": entry}, wanted, read_batch(tmp_path / "results.jsonl", wanted))
    assert (outcome.kind, outcome.error) == ("error", error)


def test_files_are_split_by_number_and_by_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(provider_batch, "LIMITS", {"chat": (3, 10_000), "anthropic": (2, 10_000)})
    part = provider_batch._Part(tmp_path, "m")
    for k in range(7):
        part.add("chat", {"custom_id": str(k), "body": {}})
    assert [len(file.read_text().splitlines()) for file in part.written()] == [3, 3, 1]
    monkeypatch.setattr(provider_batch, "LIMITS", {"chat": (100, 250)})
    part = provider_batch._Part(tmp_path, "n")
    for k in range(4):
        part.add("chat", {"custom_id": str(k), "body": "x" * 100})
    assert [len(file.read_text().splitlines()) for file in part.written()] == [1, 1, 1, 1]
    monkeypatch.setattr(provider_batch, "LIMITS", {"anthropic": (2, 10_000)})
    part = provider_batch._Part(tmp_path, "o")
    for k in range(3):
        part.add("anthropic", {"custom_id": str(k), "params": {}})
    first, second = (json.loads(file.read_text())["requests"] for file in part.written())
    assert [one["custom_id"] for one in (*first, *second)] == ["0", "1", "2"]
