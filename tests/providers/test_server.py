"""The provider that tests ask: what it answers, how it fails, what it keeps. All over real HTTP."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import http.client
import json
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.parse
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import pytest

from tests.providers.server import (
    ENDINGS,
    FAILURES,
    FAULTS,
    REASONING_TOKENS,
    ROOT,
    Api,
    Provider,
    answer_to,
    fingerprint,
)
from traps_pipeline.judging.panel import AbstentionVote, CorrectnessVote, render
from traps_pipeline.models.prompts import prompt

APIS: tuple[Api, ...] = ("chat", "responses", "gemini")
KEY = "sk-very-secret"
CLIP = b"\x00\x01clip" * 100
CODED = base64.b64encode(CLIP).decode()
CLIP_RECORD = {"sha256": hashlib.sha256(CLIP).hexdigest(), "bytes": len(CLIP)}
QUESTION = "Which side does the ball reach?"


@pytest.fixture(scope="module")
def shared() -> Iterator[Provider]:
    with Provider.start() as provider:
        yield provider


@pytest.fixture
def provider(shared: Provider) -> Provider:
    return shared.afresh()


@dataclass(frozen=True)
class Answer:
    """What came back."""

    status: int
    headers: dict[str, str]
    content: bytes

    @property
    def body(self) -> Any:
        return json.loads(self.content)


def post(
    provider: Provider, path: str, body: Any, headers: dict[str, str] | None = None, timeout: float = 30
) -> Answer:
    connection = http.client.HTTPConnection(urllib.parse.urlsplit(provider.url).netloc, timeout=timeout)
    try:
        content = body if isinstance(body, bytes) else json.dumps(body).encode()
        connection.request("POST", path, content, {"Content-Type": "application/json", **(headers or {})})
        response = connection.getresponse()
        named = {name.lower(): value for name, value in response.getheaders()}
        return Answer(response.status, named, response.read())
    finally:
        connection.close()


PATHS: dict[Api, str] = {
    "chat": "/v1/chat/completions",
    "responses": "/v1/responses",
    "gemini": "/v1beta/models/m:generateContent",
}


def a_body(api: Api, question: str = QUESTION, system: str = "Look.", structured: bool = False) -> dict[str, Any]:
    """A request with a clip, as each API writes it."""
    uri = f"data:video/mp4;base64,{CODED}"
    if api == "chat":
        parts = [{"type": "file", "file": {"file_data": uri}}, {"type": "text", "text": question}]
        messages = [{"role": "system", "content": system}, {"role": "user", "content": parts}]
        return {"model": "m", "messages": messages} | (
            {"response_format": {"type": "json_object"}} if structured else {}
        )
    if api == "responses":
        parts = [{"type": "input_file", "file_data": uri}, {"type": "input_text", "text": question}]
        body = {"model": "m", "instructions": system, "input": [{"role": "user", "content": parts}]}
        return body | ({"text": {"format": {"type": "json_schema", "name": "n", "schema": {}}}} if structured else {})
    parts = [{"inlineData": {"mimeType": "video/mp4", "data": CODED}}, {"text": question}]
    body = {"systemInstruction": {"parts": [{"text": system}]}, "contents": [{"role": "user", "parts": parts}]}
    return body | ({"generationConfig": {"responseMimeType": "application/json"}} if structured else {})


def ask(provider: Provider, api: Api, timeout: float = 30, **body: Any) -> Answer:
    return post(provider, PATHS[api], a_body(api, **body), timeout=timeout)


@dataclass(frozen=True)
class Said:
    """What an answer says, read as a client of its API reads it."""

    text: str
    finish: str
    reasoning: str = ""
    refusal: str | None = None
    model: str = ""
    tokens: tuple[int, int, int] = (0, 0, 0)  # prompt, completion with reasoning, reasoning


def _said_by_chat(body: dict[str, Any]) -> Said:
    choice, usage = body["choices"][0], body["usage"]
    message = choice["message"]
    return Said(
        message["content"] or "",
        choice["finish_reason"],
        message["reasoning_content"],
        message["refusal"],
        body["model"],
        (
            usage["prompt_tokens"],
            usage["completion_tokens"],
            usage["completion_tokens_details"]["reasoning_tokens"],
        ),
    )


def _said_by_responses(body: dict[str, Any]) -> Said:
    parts = [part for item in body["output"] if item["type"] == "message" for part in item["content"]]
    summary = [part for item in body["output"] if item["type"] == "reasoning" for part in item["summary"]]
    usage = body["usage"]
    return Said(
        "".join(part["text"] for part in parts if part["type"] == "output_text"),
        (body["incomplete_details"] or {"reason": body["status"]})["reason"],
        "".join(part["text"] for part in summary),
        "".join(part["refusal"] for part in parts if part["type"] == "refusal") or None,
        body["model"],
        (usage["input_tokens"], usage["output_tokens"], usage["output_tokens_details"]["reasoning_tokens"]),
    )


def _said_by_gemini(body: dict[str, Any]) -> Said:
    usage, blocked = body["usageMetadata"], body.get("promptFeedback", {}).get("blockReason")
    candidate = body["candidates"][0] if "candidates" in body else {"finishReason": blocked}
    parts = candidate.get("content", {}).get("parts", [])
    thoughts = usage.get("thoughtsTokenCount", 0)
    return Said(
        "".join(part["text"] for part in parts if not part.get("thought")),
        candidate["finishReason"],
        "".join(part["text"] for part in parts if part.get("thought")),
        blocked,
        body["modelVersion"],
        (usage["promptTokenCount"], usage.get("candidatesTokenCount", 0) + thoughts, thoughts),
    )


READ: dict[Api, Callable[[dict[str, Any]], Said]] = {
    "chat": _said_by_chat,
    "responses": _said_by_responses,
    "gemini": _said_by_gemini,
}


def said(provider: Provider, api: Api, **body: Any) -> Said:
    answer = ask(provider, api, **body)
    assert answer.status == 200 and answer.headers["content-type"].startswith("application/json")
    return READ[api](answer.body)


# --- answers ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("api", APIS)
def test_an_answer_follows_from_the_question_and_counts_its_tokens(provider: Provider, api: Api) -> None:
    provider.configure(served_suffix="-2026")
    answer = said(provider, api)
    assert answer.text == f"The answer is: {answer_to(QUESTION)}." == said(provider, api).text
    assert answer.finish in ("stop", "completed", "STOP") and answer.model == "m-2026" and answer.refusal is None
    prompt_tokens, completion, reasoning = answer.tokens
    assert prompt_tokens > 258 and completion > reasoning == REASONING_TOKENS  # a clip counts 258
    assert len({said(provider, api, question=f"{QUESTION} {n}").text for n in range(20)}) > 3


def test_a_script_says_what_a_model_answers_to_a_phrase(provider: Provider) -> None:
    provider.configure(scripts={"m": {"seesaw": "It tips.", "ball": "It rolls."}})
    first = said(provider, "chat", question="A ball on a seesaw?").text  # the first phrase of the script that fits
    assert (first, said(provider, "gemini", question="A ball?").text) == ("It tips.", "It rolls.")
    assert said(provider, "chat", question="A die?").text == f"The answer is: {answer_to('A die?')}."


def test_reasoning_is_shown_to_whoever_asks_for_it(provider: Provider) -> None:
    assert said(provider, "chat").reasoning
    asks: dict[Api, dict[str, Any]] = {
        "responses": {"reasoning": {"effort": "low", "summary": "auto"}},
        "gemini": {"generationConfig": {"thinkingConfig": {"includeThoughts": True}}},
    }
    for api, asked in asks.items():
        assert not said(provider, api).reasoning
        assert READ[api](post(provider, PATHS[api], a_body(api) | asked).body).reasoning


@pytest.mark.parametrize("api", APIS)
def test_json_where_the_body_asks_for_it(provider: Provider, api: Api) -> None:
    answer = json.loads(said(provider, api, structured=True).text)
    assert set(answer) == {"reason", "final_answer"} and answer["final_answer"] == answer_to(QUESTION)
    provider.configure(faults={"invalid_json": 1})
    with pytest.raises(ValueError, match="Expecting"):
        json.loads(said(provider, api, structured=True).text)


@pytest.mark.parametrize("api", APIS)
def test_a_judge_votes_in_the_json_of_its_task(provider: Provider, api: Api) -> None:
    def vote(task: Any, answer: str, truth: str | None = None) -> str:
        return said(provider, api, question=render(task, "Which?", answer, truth), system=prompt(f"judge_{task}")).text

    for answer, abstained in (("The answer is: left.", False), ("The answer is: I don't know.", True)):
        assert AbstentionVote.model_validate_json(vote("abstention", answer)).abstained is abstained
    for truth, correct, extracted in (("left", True, "left"), ("right", False, "It goes left, after 3 bounces.")):
        cast = CorrectnessVote.model_validate_json(vote("correctness", "It goes left, after 3 bounces.", truth))
        assert (cast.correct, cast.extracted_value) == (correct, extracted)
    assert CorrectnessVote.model_validate_json(vote("correctness", "I see 12.5 cm", "12.5")).extracted_value == 12.5


@pytest.mark.parametrize(
    "path",
    [
        "/models/m:generateContent",
        "/v1/models/m:generateContent",
        "/any/v1beta/models/m%3AgenerateContent?key=abc",
        "/openai/v9/chat/completions",
        "/chat/completions",
        "/responses",
    ],
)
def test_paths_behind_any_prefix(provider: Provider, path: str) -> None:
    api: Api = "gemini" if "models" in path else "chat" if "chat" in path else "responses"
    assert READ[api](post(provider, path, a_body(api)).body).model == "m"


def test_what_is_no_request_is_refused(provider: Provider) -> None:
    assert post(provider, "/v1/embeddings", {}).status == 404
    bad: list[Any] = [b"{", b"[]", {}, {"model": "m"}, a_body("chat") | {"stream": True}, a_body("chat") | {"model": 1}]
    assert [post(provider, PATHS["chat"], body).status for body in bad] == [400] * len(bad)
    assert post(provider, PATHS["gemini"], {"contents": "x"}).status == 400
    assert provider.stats()["by_status"] == {"404": 1, "400": len(bad) + 1}


# --- faults -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", FAILURES)
def test_error_statuses_come_at_once_in_each_apis_words(provider: Provider, fault: str) -> None:
    provider.configure(faults={fault: 1}, latency_s=60)
    for api in APIS:
        answer = ask(provider, api, timeout=10)
        error = answer.body["error"]
        assert answer.status == FAILURES[fault].status and error["message"]
        assert (error["status"].isupper() and error["code"] == answer.status) if api == "gemini" else error["type"]
        assert answer.headers.get("retry-after") == ("0.05" if fault == "rate_limited" else None)
    if fault == "content_filter_error":
        assert ask(provider, "chat").body["error"]["code"] == "content_policy_violation"
    assert provider.stats()["answered_in_full"] == 0


FINISHES: dict[str, dict[Api, str]] = {
    "empty": {"chat": "stop", "responses": "completed", "gemini": "STOP"},
    "length": {"chat": "length", "responses": "max_output_tokens", "gemini": "MAX_TOKENS"},
    "thinking_exhausted": {"chat": "length", "responses": "max_output_tokens", "gemini": "MAX_TOKENS"},
    "content_filter": {"chat": "content_filter", "responses": "content_filter", "gemini": "SAFETY"},
    "refusal": {"chat": "stop", "responses": "completed", "gemini": "PROHIBITED_CONTENT"},
    "invalid_json": {"chat": "stop", "responses": "completed", "gemini": "STOP"},
}


@pytest.mark.parametrize("api", APIS)
@pytest.mark.parametrize("fault", ENDINGS)
def test_endings_that_are_no_good_answer(provider: Provider, fault: str, api: Api) -> None:
    whole = said(provider, api).text
    provider.configure(faults={fault: 1})
    answer = said(provider, api)
    assert answer.finish == FINISHES[fault][api]
    if fault == "length":
        assert 0 < len(answer.text) < len(whole) and whole.startswith(answer.text)
    elif fault == "invalid_json":
        assert answer.text
    else:
        assert answer.text == ""
    assert (answer.refusal is not None) == (fault == "refusal")
    stats = provider.stats()
    assert stats["answered_in_full"] == 2 and stats["by_fault"] == stats["answered_by_fault"] == {"none": 1, fault: 1}


def test_a_gemini_filter_leaves_no_content(provider: Provider) -> None:
    provider.configure(faults={"content_filter": 1})
    assert "content" not in ask(provider, "gemini").body["candidates"][0]
    provider.configure(faults={"thinking_exhausted": 1})
    assert "parts" not in ask(provider, "gemini").body["candidates"][0]["content"]


def test_a_refusal_of_chat_has_no_content(provider: Provider) -> None:
    provider.configure(faults={"refusal": 1})
    message = ask(provider, "chat").body["choices"][0]["message"]
    assert message["content"] is None and message["refusal"]


def until(true: Callable[[], bool]) -> None:
    """Wait for what the server learns a little later than its client."""
    end = time.monotonic() + 90
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_hanging_request_ends_when_its_client_leaves(provider: Provider) -> None:
    provider.configure(faults={"hang": 1})
    with pytest.raises(TimeoutError):
        ask(provider, "chat", timeout=0.3)
    until(lambda: provider.stats()["in_flight"] == 0)
    assert provider.stats()["by_status"] == {} and provider.stats()["by_fault"] == {"hang": 1}
    (record,) = provider.requests()
    assert (record["fault"], record["status"], record["answered_in_full"]) == ("hang", None, False)


@pytest.mark.parametrize("api", APIS)
def test_a_cut_answer_ends_in_the_middle(provider: Provider, api: Api) -> None:
    provider.configure(faults={"cut": 1})
    with pytest.raises(http.client.IncompleteRead) as caught:
        ask(provider, api)
    assert abs(len(caught.value.partial) - (caught.value.expected or 0)) <= 1
    until(lambda: provider.requests()[0]["status"] == 200)
    assert provider.stats()["answered_in_full"] == 0 and not provider.requests()[0]["answered_in_full"]


def test_slow_and_latency_delay_answers(provider: Provider) -> None:
    for config in ({"latency_s": 0.2}, {"faults": {"slow": 1}, "slow_s": 0.2}):
        provider.afresh(**config)
        began = time.monotonic()
        assert said(provider, "chat").text and time.monotonic() - began >= 0.2


def test_a_page_instead_of_an_answer(provider: Provider) -> None:
    provider.configure(faults={"wrong_content_type": 1})
    answer = ask(provider, "chat")
    assert (answer.status, answer.headers["content-type"]) == (200, "text/html") and b"<h1>" in answer.content
    assert provider.stats()["answered_in_full"] == 0


def faults_met(provider: Provider, **config: Any) -> list[str | None]:
    """The faults of three attempts of each of 40 bodies."""
    provider.afresh(**config)
    for _attempt in range(3):
        for number in range(40):
            ask(provider, "chat", question=f"question {number}")
    return [record["fault"] for record in provider.requests()]


def test_a_seed_decides_which_attempts_fail(provider: Provider) -> None:
    shares = {"faults": {"server_error": 0.2, "empty": 0.3}}
    first = faults_met(provider, seed=1, **shares)
    assert first == faults_met(provider, seed=1, **shares) != faults_met(provider, seed=2, **shares)
    assert 12 <= first.count("server_error") <= 36 and 22 <= first.count("empty") <= 50
    assert first[:40] != first[40:80], "an attempt after a failure draws again"


def test_transient_faults_can_end_after_some_attempts(provider: Provider) -> None:
    met = faults_met(provider, faults={"server_error": 0.5, "empty": 0.5}, only_first_attempts=1)
    assert {*met[:40]} == {"server_error", "empty"} and {*met[40:]} == {None, "empty"}
    stats = provider.stats()
    assert stats["requests"] == 120 and stats["distinct_bodies"] == 40
    assert stats["by_fault"] == {"server_error": met.count("server_error"), "empty": met.count("empty")} | {
        "none": met.count(None)
    }


def test_one_model_can_fail_always_or_never(provider: Provider) -> None:
    provider.configure(faults={"server_error": 1}, fault_by_model={"m": "forbidden", "good": None})
    assert [ask(provider, api).status for api in APIS] == [403, 403, 403]
    assert post(provider, PATHS["chat"], a_body("chat") | {"model": "good"}).status == 200
    assert post(provider, PATHS["gemini"].replace("/m:", "/other:"), a_body("gemini")).status == 500


@pytest.mark.parametrize(
    "config",
    [{"faults": {"oops": 1}}, {"faults": {"empty": 0.6, "cut": 0.6}}, {"fault_by_model": {"m": "oops"}}, {"speed": 1}],
)
def test_a_wrong_config_is_refused_and_changes_nothing(provider: Provider, config: dict[str, Any]) -> None:
    before = provider.configure()
    with pytest.raises(urllib.error.HTTPError, match="400"):
        provider.configure(**config)
    assert provider.configure() == before


def test_every_fault_is_known_once() -> None:
    assert len(FAULTS) == len(set(FAULTS)) and set(FINISHES) == set(ENDINGS)


# --- records ----------------------------------------------------------------------------------------------------------


def test_records_hold_neither_keys_nor_clips(provider: Provider) -> None:
    headers = {"Authorization": f"Bearer {KEY}", "x-goog-api-key": KEY, "api-key": KEY}
    for api in APIS:
        post(provider, f"{PATHS[api]}?key={KEY}&alt=json", a_body(api), headers)
    records = provider.requests()
    kept = json.dumps(records)
    assert KEY not in kept and CODED[:40] not in kept
    for api, record in zip(APIS, records, strict=True):
        assert (record["method"], record["path"], record["status"]) == ("POST", PATHS[api], 200)
        assert record["answered_in_full"] and record["fault"] is None
        assert record["query"] == {"key": fingerprint(KEY), "alt": "json"}
        assert record["headers"]["authorization"] == f"Bearer {fingerprint(KEY)}"
        assert record["headers"]["x-goog-api-key"] == record["headers"]["api-key"] == fingerprint(KEY)
    of_uri = CLIP_RECORD | {"mime": "video/mp4"}
    assert records[0]["body"]["messages"][1]["content"][0]["file"]["file_data"] == of_uri
    assert records[0]["body"]["messages"][1]["content"][1]["text"] == QUESTION
    assert records[1]["body"]["input"][0]["content"][0]["file_data"] == of_uri
    assert records[2]["body"]["contents"][0]["parts"][0]["inlineData"]["data"] == CLIP_RECORD


def test_records_keep_long_texts_and_the_newest_come_last(provider: Provider) -> None:
    long = "Is it left or right? " * 100
    for question in ("first", long):
        ask(provider, "responses", question=question)
    assert [r["body"]["input"][0]["content"][1]["text"] for r in provider.requests()] == ["first", long]
    (last,) = provider.requests(limit=1)
    assert last["body"]["input"][0]["content"][1]["text"] == long
    provider.reset()
    assert provider.requests() == [] and provider.stats()["requests"] == 0


def test_how_many_are_in_flight_at_once(provider: Provider) -> None:
    provider.configure(latency_s=0.3)
    with ThreadPoolExecutor(8) as pool:
        assert {answer.status for answer in pool.map(lambda _: ask(provider, "chat"), range(8))} == {200}
    assert 2 <= provider.stats()["max_in_flight"] <= 8 and provider.stats()["in_flight"] == 0


# --- the process ------------------------------------------------------------------------------------------------------


def test_without_records_it_counts_and_ends_when_told() -> None:
    provider = Provider.start({"fault_by_model": {"m": "empty"}}, keeps_records=False)
    assert said(provider, "chat").text == ""
    stats = provider.stats()
    assert stats["requests"] == stats["by_fault"]["empty"] == 1 and provider.requests() == []
    provider.stop()
    assert provider.process.returncode is not None
    with pytest.raises(ConnectionRefusedError):
        ask(provider, "chat")


def test_it_ends_with_its_parent() -> None:
    script = """
import os
from tests.providers.server import Provider
print(Provider.start().url, flush=True)
os.kill(os.getpid(), 9)
"""
    parent = subprocess.run([sys.executable, "-c", script], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    address = urllib.parse.urlsplit(parent.stdout.strip())

    def gone() -> bool:
        with socket.socket() as client:
            return client.connect_ex((address.hostname, address.port)) != 0

    assert parent.returncode == -9 and address.port
    until(gone)


# --- what litellm makes of it -----------------------------------------------------------------------------------------


def through_litellm(model: str, api_base: str, monkeypatch: pytest.MonkeyPatch, **parameters: Any) -> Any:
    monkeypatch.setenv("LITELLM_LOCAL_MODEL_COST_MAP", "True")
    import litellm

    uri = f"data:image/png;base64,{CODED}"
    parts = [{"type": "image_url", "image_url": {"url": uri}}, {"type": "text", "text": QUESTION}]
    messages = [{"role": "system", "content": "Look."}, {"role": "user", "content": parts}]
    call = litellm.acompletion(
        model=model, api_base=api_base, api_key=KEY, messages=messages, timeout=30, max_retries=0, **parameters
    )
    return asyncio.run(call)


@pytest.mark.slow  # the import of litellm takes long on a busy machine
@pytest.mark.parametrize("api", APIS)
def test_litellm_reads_the_answers(provider: Provider, api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    thinking = {"chat": {}, "gemini": {"reasoning_effort": "low"}}
    model, base = {
        "chat": ("openai/x", "/v1"),
        "gemini": ("gemini/gemini-2.5-pro", "/v1beta"),
        "responses": ("openai/responses/gpt-5-pro", "/v1"),
    }[api]
    asked = thinking.get(api, {"reasoning_effort": {"effort": "high", "summary": "auto"}})
    answer = through_litellm(model, provider.url + base, monkeypatch, **asked)
    choice = answer.choices[0]
    assert choice.message.content == f"The answer is: {answer_to(QUESTION)}." and choice.finish_reason == "stop"
    assert answer.model == model.rsplit("/", 1)[1] and choice.message.reasoning_content.startswith("Looking at")
    assert answer.usage.prompt_tokens > 1 and answer.usage.completion_tokens > REASONING_TOKENS
    assert answer.usage.completion_tokens_details.reasoning_tokens == REASONING_TOKENS
    (record,) = provider.requests()
    assert fingerprint(KEY) in json.dumps(record["headers"]) and CLIP_RECORD["sha256"] in json.dumps(record["body"])
