"""An LLM provider that misbehaves on demand: OpenAI chat, OpenAI responses, Gemini and Anthropic over real HTTP.

Tests of asking run against it, so that client library, sockets, time-outs and retries are the real ones. It is a
process of its own (`python -m tests.providers.server`), so that it shares neither event loop nor CPU time with the
code under test. What it answers and how it fails follow from the request alone: a test can be run again.
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import hashlib
import json
import math
import os
import random
import re
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Self

from aiohttp import web

Api = Literal["chat", "responses", "gemini", "anthropic"]
Json = dict[str, Any]
Turn = tuple[str, list[Json]]  # role and parts

ROOT = Path(__file__).resolve().parents[2]
REASONING_TOKENS = 16
_MEDIA_TOKENS = 258  # what Gemini counts for a frame
_LONG = 256  # characters of what may be a clip in a body
_PARENT_LOOK_S = 0.5
HANG_S = 300.0  # when even the server gives up


# --- what goes wrong --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Failure:
    """An error status, as both families of APIs word it."""

    status: int
    kind: str  # OpenAI's `type`
    code: str | None  # OpenAI's `code`
    gemini_status: str
    message: str


_RATE_LIMITED = Failure(429, "requests", "rate_limit_exceeded", "RESOURCE_EXHAUSTED", "Rate limit reached.")
FAILURES: dict[str, Failure] = {
    "rate_limited": _RATE_LIMITED,
    "rate_limited_bare": _RATE_LIMITED,
    "server_error": Failure(500, "server_error", None, "INTERNAL", "The server had an error."),
    "overloaded": Failure(503, "server_error", "overloaded", "UNAVAILABLE", "The model is overloaded."),
    "timeout_status": Failure(408, "timeout", None, "DEADLINE_EXCEEDED", "The request timed out."),
    "conflict": Failure(409, "conflict", None, "ABORTED", "The request conflicts with another one."),
    "bad_request": Failure(400, "invalid_request_error", "invalid_value", "INVALID_ARGUMENT", "Invalid value."),
    "unauthorized": Failure(401, "invalid_request_error", "invalid_api_key", "UNAUTHENTICATED", "Incorrect API key."),
    "forbidden": Failure(403, "invalid_request_error", "forbidden", "PERMISSION_DENIED", "No access to this model."),
    "not_found": Failure(404, "invalid_request_error", "model_not_found", "NOT_FOUND", "The model does not exist."),
    "content_filter_error": Failure(
        400, "invalid_request_error", "content_policy_violation", "INVALID_ARGUMENT",
        "Your request was rejected by our safety system (content_policy_violation).",
    ),
}  # fmt: skip
ENDINGS = ("empty", "length", "thinking_exhausted", "content_filter", "refusal", "invalid_json")  # 200, but no answer
DISTURBANCES = ("hang", "cut", "wrong_content_type")
FAULTS = (*FAILURES, *ENDINGS, *DISTURBANCES)
_LASTING = {"bad_request", "unauthorized", "forbidden", "not_found", "content_filter_error"}
TRANSIENT = frozenset(FAULTS) - frozenset(ENDINGS) - _LASTING  # what `only_first_attempts` ends


@dataclass(frozen=True)
class Config:
    """How the provider behaves. `faults` gives shares of attempts; the rest of them is answered.

    fault_by_model always applies (null: that model never fails). only_first_attempts: transient faults of `faults`
    spare a body that was seen that often. scripts: by model, what it says to a request whose text holds a phrase (the
    first that fits), in the place of a good answer. Latency delays 200s only, error statuses come at once.
    raw_by_model: the very bytes (`content`), `status`, `type` and `headers` of what a model answers, and whether it is
    `billed`. fuzzed: answers of the chat
    API come with a few of their values, or their end, replaced. usd_a_token: what the server bills for prompt and
    completion; an attempt that its status does not refuse is billed, and one that is odd as the most that it may take.
    served_suffix goes behind the model's name, as real ones answer with a date.
    blind: models that leave images and videos out, as a server of text models may; the others name the colours of a
    clip that they are asked for. served: what the list of models holds, which comes with list_status. unstructured:
    models that refuse what asks for structured output. filtered: phrases; a request that holds one is refused in words
    that no list of content filters has.
    """

    latency_s: float = 0.0
    seed: int = 0
    faults: Mapping[str, float] = field(default_factory=dict)
    fault_by_model: Mapping[str, str | None] = field(default_factory=dict)
    only_first_attempts: int | None = None
    scripts: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    retry_after_s: float = 0.05
    served_suffix: str = ""
    raw_by_model: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    fuzzed: bool = False
    usd_a_token: tuple[float, float] = (0.0, 0.0)
    blind: Sequence[str] = ()
    served: Sequence[str] | None = None
    list_status: int = 200
    unstructured: Sequence[str] = ()
    filtered: Sequence[str] = ()

    def __post_init__(self) -> None:
        unknown = ({*self.faults} | {*self.fault_by_model.values()}) - {*FAULTS, None}
        if unknown:
            raise ValueError(f"no such fault: {', '.join(sorted(map(str, unknown)))}")
        if any(share < 0 for share in self.faults.values()) or sum(self.faults.values()) > 1 + 1e-9:
            raise ValueError(f"shares of faults must lie in [0, 1] and add up to at most 1: {dict(self.faults)}")

    def fault(self, model: str, body: bytes, seen: int) -> str | None:
        """What happens to the attempt number `seen` (from 0) of the body with this digest."""
        if model in self.fault_by_model:
            return self.fault_by_model[model]
        drawn = self._drawn(body, seen) if self.faults else None
        spared = self.only_first_attempts is not None and seen >= self.only_first_attempts and drawn in TRANSIENT
        return None if spared else drawn

    def _drawn(self, body: bytes, seen: int) -> str | None:
        number = hashlib.sha256(b"%d:%b:%d" % (self.seed, body, seen)).digest()[:8]
        left = int.from_bytes(number, "big") / 2**64
        for name, share in self.faults.items():
            left -= share
            if left < 0:
                return name
        return None


# --- what is asked ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Question:
    """What of a request decides its answer. Holds no media, so that a waiting request costs no memory."""

    api: Api
    model: str
    system: str
    text: str  # the last text part of the user
    structured: bool
    shows_reasoning: bool
    prompt_tokens: int
    colours: tuple[str, ...] = ()  # of the clip, where it is asked for them
    most_tokens: int = 0  # that the completion may take
    logprobs: int = 0  # alternatives of each token that are asked for


def api_of(path: str) -> tuple[Api, str] | None:
    """The API of a path, behind any prefix, and the model where the path names it."""
    if path.endswith("/chat/completions"):
        return "chat", ""
    if path.endswith("/responses"):
        return "responses", ""
    if path.endswith("/messages"):
        return "anthropic", ""
    found = re.search(r"/models/([^/]+):generateContent$", path)
    return ("gemini", found[1]) if found else None


def read_question(api: Api, model: str, body: Json, blind: Sequence[str] = ()) -> Question:
    """Read a body, without its media for a blind model. Raises KeyError, TypeError or AttributeError where it is not of
    that API, or asks for a stream."""
    turns = _TURNS[api](body)
    model = model or body["model"]
    if not isinstance(model, str) or body.get("stream"):
        raise TypeError
    texts = [(role, part["text"]) for role, parts in turns for part in parts if "text" in part]
    clips = [] if model in blind else [part for _, parts in turns for part in parts if "text" not in part]
    media = len(clips)
    asked = [text for role, text in texts if role == "user"]
    return Question(
        api=api,
        model=model,
        system="\n".join(text for role, text in texts if role in ("system", "developer")),
        text=asked[-1] if asked else "",
        structured=_is_structured(api, body),
        shows_reasoning=_shows_reasoning(api, body),
        prompt_tokens=sum(len(text) for _, text in texts) // 4 + 1 + media * _MEDIA_TOKENS,
        colours=_colours(clips) if asked and _ASKS_COLOURS in asked[-1] else (),
        most_tokens=int(body.get("max_tokens") or body.get("max_output_tokens") or 0),
        logprobs=int(body["top_logprobs"]) if body.get("logprobs") is True else 0,
    )


_ASKS_COLOURS = "which two colours does the clip show"


def _colours(clips: Sequence[Json]) -> tuple[str, ...]:
    """The strongest colour of the first and of the last frame of images or of a video."""
    import cv2
    import numpy as np

    frames = list[Any]()
    for clip in clips:
        inline = _either(clip, "inlineData") or {}  # Gemini's
        uri = (clip.get("image_url") or clip.get("video_url") or {}).get("url", "")
        data = base64.b64decode(inline.get("data") or uri.partition(",")[2])
        if "video" not in uri[:16] and "video" not in str(_either(inline, "mimeType")):
            frames.append(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))
            continue
        with tempfile.NamedTemporaryFile(suffix=".mp4") as file:
            file.write(data)
            file.flush()
            video = cv2.VideoCapture(file.name)
            while (read := video.read())[0]:
                frames.append(read[1])
    named = ("blue", "green", "red")
    return tuple(named[int(np.argmax(frame.mean(axis=(0, 1))))] for frame in (frames[0], frames[-1])) if frames else ()


def _parts(content: Any) -> list[Json]:
    """OpenAI's content: a text, parts or nothing."""
    return [{"text": content}] if isinstance(content, str) else content or []


def _messages(messages: Sequence[Json]) -> list[Turn]:
    return [(message.get("role", ""), _parts(message.get("content"))) for message in messages]


def _responses_turns(body: Json) -> list[Turn]:
    given = body["input"]
    turns = [("user", _parts(given))] if isinstance(given, str) else _messages(given)
    return [("system", _parts(body.get("instructions"))), *turns]


def _gemini_turns(body: Json) -> list[Turn]:
    system = _either(body, "systemInstruction") or {}
    turns = [(content.get("role", "user"), content["parts"]) for content in body["contents"]]
    return [("system", system.get("parts", [])), *turns]


def _anthropic_turns(body: Json) -> list[Turn]:
    return [("system", _parts(body.get("system"))), *_messages(body["messages"])]


_TURNS: dict[Api, Callable[[Json], list[Turn]]] = {
    "anthropic": _anthropic_turns,
    "chat": lambda body: _messages(body["messages"]),
    "responses": _responses_turns,
    "gemini": _gemini_turns,
}


def _either(value: Json, name: str) -> Any:
    """A field of Gemini's JSON, which comes in camel case or in snake case."""
    return value.get(name, value.get(re.sub(r"[A-Z]", lambda found: "_" + found[0].lower(), name)))


def _generation(body: Json) -> Json:
    return _either(body, "generationConfig") or {}


def _is_structured(api: Api, body: Json) -> bool:
    if api == "gemini":
        return _either(_generation(body), "responseMimeType") == "application/json"
    if api == "anthropic":
        return bool(body.get("output_format"))
    asked = body.get("response_format") if api == "chat" else (body.get("text") or {}).get("format")
    return bool(asked) and asked["type"] in ("json_object", "json_schema")


def _shows_reasoning(api: Api, body: Json) -> bool:
    """As the real ones: responses and Gemini show it when asked to, what serves `reasoning_content` always does."""
    if api == "chat":
        return True
    if api == "responses":
        return bool((body.get("reasoning") or {}).get("summary"))
    if api == "anthropic":
        return False
    return bool(_either(_either(_generation(body), "thinkingConfig") or {}, "includeThoughts"))


# --- what is answered -------------------------------------------------------------------------------------------------

ANSWERS = ("left", "right", "red", "blue", "3", "12.5", "I don't know")
_NUMBER = r"-?\d+(?:\.\d+)?"
_ABSTAINS = re.compile(r"don't know|cannot|can't|undetermin|insufficient|unanswerable|neither", re.IGNORECASE)


def answer_to(question: str) -> str:
    """The final answer to a question, so that a test can say what it expects."""
    return ANSWERS[hashlib.sha256(question.encode()).digest()[0] % len(ANSWERS)]


def text_for(question: Question) -> str:
    """The text of a good answer: a judge's JSON, the benchmark's JSON or a sentence."""
    if '{"abstained"' in question.system:
        asked = {"rejects_premise": False} if '"rejects_premise"' in question.system else {}
        return json.dumps(_abstention(question.text) | asked)
    if '{"correct"' in question.system:
        return json.dumps(_correctness(question.text))
    answer = " and then ".join(question.colours) or answer_to(question.text)
    if question.structured:
        return json.dumps({"reason": f"It looks like {answer}.", "final_answer": answer})
    return f"The answer is: {answer}."


def _judged(text: str) -> str:
    """The response that a judge is shown (`judging.panel.vote_text`), or all of the text."""
    found = re.search(r"^(RESPONSE-\w+)\n(.*)\n\1$", text, re.DOTALL | re.MULTILINE)
    return found[2] if found else text


def _abstention(text: str) -> Json:
    abstained = bool(_ABSTAINS.search(_judged(text)))
    return {"abstained": abstained, "confidence": "high", "reasoning": "It says so."}


def _correctness(text: str) -> Json:
    found = re.search(r"^Ground truth: (.*)$", text, re.MULTILINE)
    truth, response = (found[1].strip() if found else ""), _judged(text)
    if re.fullmatch(_NUMBER, truth):
        number = re.search(_NUMBER, response)
        said: str | float = float(number[0]) if number else response[:40]
        correct = said == float(truth)
    else:
        correct = bool(truth) and truth.lower() in response.lower()
        said = truth if correct else response[:40]
    return {"correct": correct, "extracted_value": said, "reasoning": "It says so."}


@dataclass(frozen=True)
class Ending:
    """How a 200 ends, whatever the API. text None: there is no message at all."""

    text: str | None
    finish: Literal["stop", "length", "content_filter"] = "stop"
    refusal: str | None = None


def ending_of(question: Question, fault: str | None, script: Mapping[str, str]) -> Ending:
    """What the model says, given what goes wrong."""
    scripted = (said for phrase, said in script.items() if phrase in question.text)
    text = next(scripted, None) or text_for(question)
    endings = {
        "empty": Ending(""),
        "length": Ending(text[: max(1, len(text) // 2)], "length"),
        "thinking_exhausted": Ending(None, "length"),
        "content_filter": Ending(None, "content_filter"),
        "refusal": Ending(None, refusal="I'm sorry, but I can't help with that."),
        "invalid_json": Ending(f"Sure! Here is what I think: {answer_to(question.text)}"),
    }
    return endings.get(fault or "", Ending(text))


def body_of(question: Question, ending: Ending, served_model: str) -> Json:
    """The body of a 200."""
    return _BODIES[question.api](question, ending, served_model)


def _reasoning(question: Question) -> str:
    return f"Looking at the clip for {answer_to(question.text)}."


def _usage(question: Question, ending: Ending) -> tuple[int, int]:
    """Prompt tokens, and those of the visible text."""
    said = ending.text or ending.refusal or ""
    return question.prompt_tokens, len(said) // 4 + bool(said)


def _logprobs(question: Question, ending: Ending) -> list[Json]:
    """Each word as a token, which something else might have been with a probability of a quarter."""
    given, other = math.log(0.75), {"token": "No", "logprob": math.log(0.25)}
    tokens = [{"token": word, "logprob": given} for word in ['"', *re.findall(r"\s*\S+", ending.text or "")]]
    return [token | {"top_logprobs": [token, other][: question.logprobs]} for token in tokens]  # a quote comes first


def _chat_body(question: Question, ending: Ending, served_model: str) -> Json:
    prompt, visible = _usage(question, ending)
    content = None if ending.refusal else ending.text or ""
    message: Json = {"role": "assistant", "content": content, "refusal": ending.refusal}
    message |= {"reasoning_content": _reasoning(question)}
    logprobs = {"content": _logprobs(question, ending)} if question.logprobs else None
    choice = {"index": 0, "message": message, "logprobs": logprobs, "finish_reason": ending.finish}
    completion = visible + REASONING_TOKENS
    usage: Json = {"prompt_tokens": prompt, "completion_tokens": completion, "total_tokens": prompt + completion}
    usage |= {"prompt_tokens_details": {"cached_tokens": 0}}
    usage |= {"completion_tokens_details": {"reasoning_tokens": REASONING_TOKENS}}
    head: Json = {
        "id": "chatcmpl-test",
        "object": "chat.completion",
        "created": int(time.time()),
        "model": served_model,
    }
    return head | {"choices": [choice], "usage": usage}


def _responses_output(question: Question, ending: Ending) -> list[Json]:
    summary = [{"type": "summary_text", "text": _reasoning(question)}] if question.shows_reasoning else []
    thought = {"id": "rs_test", "type": "reasoning", "summary": summary}
    if ending.refusal:
        part: Json = {"type": "refusal", "refusal": ending.refusal}
    elif ending.text is not None:
        part = {"type": "output_text", "text": ending.text, "annotations": [], "logprobs": []}
    else:
        return [thought]
    status = "completed" if ending.finish == "stop" else "incomplete"
    return [thought, {"id": "msg_test", "type": "message", "status": status, "role": "assistant", "content": [part]}]


def _responses_body(question: Question, ending: Ending, served_model: str) -> Json:
    prompt, visible = _usage(question, ending)
    reasons = {"length": "max_output_tokens", "content_filter": "content_filter"}
    reason = reasons.get(ending.finish)
    completion = visible + REASONING_TOKENS
    usage: Json = {"input_tokens": prompt, "output_tokens": completion, "total_tokens": prompt + completion}
    usage |= {"input_tokens_details": {"cached_tokens": 0}}
    usage |= {"output_tokens_details": {"reasoning_tokens": REASONING_TOKENS}}
    head: Json = {"id": "resp_test", "object": "response", "created_at": int(time.time()), "model": served_model}
    asked: Json = {
        "instructions": None,
        "metadata": {},
        "tools": [],
        "tool_choice": "auto",
        "parallel_tool_calls": True,
    }
    asked |= {"temperature": 1.0, "top_p": 1.0}
    ends: Json = {"status": "incomplete" if reason else "completed", "error": None}
    ends |= {"incomplete_details": {"reason": reason} if reason else None}
    return head | asked | ends | {"output": _responses_output(question, ending), "usage": usage}


def _gemini_candidate(question: Question, ending: Ending) -> Json:
    finish = {"stop": "STOP", "length": "MAX_TOKENS", "content_filter": "SAFETY"}[ending.finish]
    if ending.finish == "content_filter":
        rating = {"category": "HARM_CATEGORY_DANGEROUS_CONTENT", "probability": "HIGH", "blocked": True}
        return {"finishReason": finish, "index": 0, "safetyRatings": [rating]}
    thoughts = [{"text": _reasoning(question), "thought": True}] if question.shows_reasoning else []
    parts = thoughts + ([{"text": ending.text}] if ending.text is not None else [])
    content = {"parts": parts, "role": "model"} if parts else {"role": "model"}
    return {"content": content, "finishReason": finish, "index": 0}


def _gemini_body(question: Question, ending: Ending, served_model: str) -> Json:
    """Gemini has no refusal of its own: it blocks the prompt, and there is no candidate."""
    prompt, visible = _usage(question, ending)
    usage = {"promptTokenCount": prompt, "candidatesTokenCount": visible, "thoughtsTokenCount": REASONING_TOKENS}
    said: Json = {"candidates": [_gemini_candidate(question, ending)]}
    if ending.refusal:
        said = {"promptFeedback": {"blockReason": "PROHIBITED_CONTENT"}}
        usage = {"promptTokenCount": prompt}
    usage["totalTokenCount"] = sum(usage.values())
    return {**said, "usageMetadata": usage, "modelVersion": served_model, "responseId": "test"}


def _anthropic_body(question: Question, ending: Ending, served_model: str) -> Json:
    prompt, visible = _usage(question, ending)
    stops = {"stop": "end_turn", "length": "max_tokens", "content_filter": "refusal"}
    head: Json = {"id": "msg_test", "type": "message", "role": "assistant", "model": served_model}
    stop = {"stop_reason": "refusal" if ending.refusal else stops[ending.finish], "stop_sequence": None}
    content = [{"type": "text", "text": ending.text}] if ending.text else []
    return head | stop | {"content": content, "usage": {"input_tokens": prompt, "output_tokens": visible}}


_BODIES: dict[Api, Callable[[Question, Ending, str], Json]] = {
    "anthropic": _anthropic_body,
    "chat": _chat_body,
    "responses": _responses_body,
    "gemini": _gemini_body,
}


def error_body(api: Api, failure: Failure) -> Json:
    """The body of an error status."""
    if api == "gemini":
        return {"error": {"code": failure.status, "message": failure.message, "status": failure.gemini_status}}
    if api == "anthropic":
        return {"type": "error", "error": {"type": failure.kind, "message": failure.message}}
    error = {"message": failure.message, "type": failure.kind, "param": None, "code": failure.code}
    return {"error": error}


_NUMBERS = (-1, 0, 1.5, 2**63, -(10**30), 1e300)
_ODD: tuple[Any, ...] = (*_NUMBERS, None, True, "12", "\ud800", [], {}, [None], {"a": {"b": 5}})


def fuzz(body: Json, number: int) -> bytes:
    """A body with a few of its values replaced by odd ones, left out or doubled, or cut anywhere."""
    draw = random.Random(number)
    for _ in range(draw.randint(1, 3)):
        places = [*_places(body)]
        holder, key = draw.choice(places)
        if draw.random() < 0.2:
            del holder[key]
        else:
            holder[key] = draw.choice(_ODD)
    content = json.dumps(body).encode()
    return content[: draw.randrange(len(content))] if draw.random() < 0.2 else content


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    keys = [*value] if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    for key in keys:
        yield value, key
        yield from _places(value[key])


# --- what is kept -----------------------------------------------------------------------------------------------------


def without_media(value: Any) -> Any:
    """A body in which the size of a clip, as of any long text of one word, stands for it."""
    if isinstance(value, dict):
        return {name: without_media(each) for name, each in value.items()}
    if isinstance(value, list):
        return [without_media(each) for each in value]
    is_media = isinstance(value, str) and len(value) > _LONG and " " not in value
    return f"{len(value)} characters" if is_media else value


@dataclass
class Tallies:
    """What was seen since the start or the last reset. Counts only, unless records are kept."""

    requests: int = 0
    billed_usd: float = 0.0
    by_status: Counter[str] = field(default_factory=Counter)
    answered_by_fault: Counter[str] = field(default_factory=Counter)
    attempts: Counter[bytes] = field(default_factory=Counter)  # by digest of path and body
    records: list[Json] = field(default_factory=list)

    def seen(self, body: bytes) -> int:
        """How often this very body came before."""
        before = self.attempts[body]
        self.attempts[body] = before + 1
        return before

    def report(self) -> Json:
        """The answer of `/_stats`."""
        return {
            "requests": self.requests,
            "billed_usd": self.billed_usd,
            "answered_in_full": self.answered_by_fault.total(),
            "by_status": dict(self.by_status),
            "answered_by_fault": dict(self.answered_by_fault),
        }


# --- the server -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reply:
    """What is sent for a request, and how."""

    status: int
    content: bytes
    content_type: str = "application/json"
    headers: Mapping[str, str] = field(default_factory=dict)
    delay_s: float = 0.0
    cut: bool = False
    tokens: tuple[int, int] = (0, 0)  # that are billed


def json_reply(value: Any, status: int = 200, **how: Any) -> Reply:
    """A reply of JSON."""
    return Reply(status, json.dumps(value).encode(), **how)


_PAGE = b"<!doctype html><title>Bad gateway</title><h1>It works, but it is not an API.</h1>"
_MALFORMED = Failure(400, "invalid_request_error", None, "INVALID_ARGUMENT", "Not a request of this API, or a stream.")
_UNKNOWN_PATH = Failure(404, "invalid_request_error", "unknown_url", "NOT_FOUND", "Unknown request URL.")


def reply_to(question: Question, fault: str | None, config: Config) -> Reply:
    """What one attempt gets."""
    most = (question.prompt_tokens, question.most_tokens)
    if raw := config.raw_by_model.get(question.model):
        status = int(raw.get("status", 200))
        content = raw["content"].encode("utf-8", "surrogatepass")
        refused = (400 <= status < 500 and status != 408) or status == 503 or not raw.get("billed", True)
        kind, headers = raw.get("type", "application/json"), raw.get("headers", {})
        return Reply(status, content, kind, headers, config.latency_s, tokens=(0, 0) if refused else most)
    if any(phrase in question.text for phrase in config.filtered):
        return json_reply({"error": {"message": "Not at this table, please.", "type": "house_rule", "code": "h7"}}, 400)
    if question.structured and question.model in config.unstructured:
        return json_reply(error_body(question.api, FAILURES["bad_request"]), 400)
    if fault in FAILURES:
        failure = FAILURES[fault]
        headers = {"Retry-After": f"{config.retry_after_s:g}"} if fault == "rate_limited" else {}
        return json_reply(error_body(question.api, failure), failure.status, headers=headers)
    if fault == "wrong_content_type":
        return Reply(200, _PAGE, "text/html", delay_s=config.latency_s)
    served = question.model + config.served_suffix
    ending = ending_of(question, fault, config.scripts.get(question.model, {}))
    body = body_of(question, ending, served)
    if config.fuzzed:
        number = int.from_bytes(hashlib.sha256(question.text.encode()).digest()[:8], "big")
        tokens = body["usage"]["prompt_tokens"], body["usage"]["completion_tokens"]
        return Reply(200, fuzz(body, number), delay_s=config.latency_s, tokens=tokens)
    return json_reply(
        body,
        delay_s=HANG_S if fault == "hang" else config.latency_s,
        cut=fault in ("cut", "hang"),
        tokens=(question.prompt_tokens, sum(_usage(question, ending)[1:]) + REASONING_TOKENS),
    )


class Server:
    """Answers requests, counts them and, unless told otherwise, keeps a record of each."""

    def __init__(self, config: Config, keeps_records: bool = True) -> None:
        self._config, self._keeps_records = config, keeps_records
        self._tallies, self._in_flight = Tallies(), 0

    async def handle(self, request: web.BaseRequest) -> web.StreamResponse:
        """Any request: a control path, or one to be answered as a provider."""
        if request.path.startswith("/_"):
            return await _sent(request, await self._control(request))
        tallies = self._tallies  # a reset meanwhile starts others
        self._in_flight += 1
        tallies.requests += 1
        try:
            return await self._provide(request, tallies)
        finally:
            self._in_flight -= 1

    async def _provide(self, request: web.BaseRequest, tallies: Tallies) -> web.StreamResponse:
        record: Json = {"fault": None, "status": None, "answered_in_full": False, "body": None}
        reply = await self._decide(request, tallies, record)
        tallies.billed_usd += sum(n * usd for n, usd in zip(reply.tokens, self._config.usd_a_token, strict=True))
        await asyncio.sleep(reply.delay_s)
        tallies.by_status[str(reply.status)] += 1
        record["status"] = reply.status
        response = await _sent(request, reply)
        whole = not reply.cut and request.transport is not None and not request.transport.is_closing()
        record["answered_in_full"] = whole and reply.status == 200 and reply.content_type == "application/json"
        if record["answered_in_full"]:
            tallies.answered_by_fault[record["fault"] or "none"] += 1
        return response

    async def _decide(self, request: web.BaseRequest, tallies: Tallies, record: Json) -> Reply:
        """Read a request and choose its reply; the body, which may be large, is not kept while the reply waits."""
        content = await request.content.read()
        if self._keeps_records:
            tallies.records.append(record)
        if request.method == "GET" and request.path.endswith("/models") and self._config.served is not None:
            listed = {"object": "list", "data": [{"id": name} for name in self._config.served]}
            return json_reply(listed, self._config.list_status)
        known = api_of(request.path) if request.method == "POST" else None
        if known is None:
            return json_reply(error_body("chat", _UNKNOWN_PATH), 404)
        try:
            body = json.loads(content)
            question = read_question(*known, body, blind=self._config.blind)
        except (ValueError, KeyError, TypeError, AttributeError):
            return json_reply(error_body(known[0], _MALFORMED), 400)
        if self._keeps_records:
            record["body"] = without_media(body)
        digest = hashlib.sha256(request.path.encode() + b"\n" + content).digest()[:8]
        record["fault"] = fault = self._config.fault(question.model, digest, tallies.seen(digest))
        return reply_to(question, fault, self._config)

    async def _control(self, request: web.BaseRequest) -> Reply:
        match request.method, request.path:
            case "GET", "/_requests":
                limit = int(request.query.get("limit", 0))
                return json_reply(self._tallies.records[-limit:])
            case "GET", "/_stats":
                return json_reply(self._tallies.report() | {"in_flight": self._in_flight})
            case "POST", "/_reset":
                self._tallies = Tallies()
                return json_reply({})
            case "POST", "/_config":
                return self._configure(await request.content.read())
        return json_reply({"error": f"no {request.method} {request.path}"}, 404)

    def _configure(self, content: bytes) -> Reply:
        try:
            self._config = replace(self._config, **json.loads(content))
        except (ValueError, TypeError) as error:
            return json_reply({"error": str(error)}, 400)
        return json_reply(asdict(self._config))


async def _sent(request: web.BaseRequest, reply: Reply) -> web.StreamResponse:
    """Send a reply to its last byte, or half of it and close."""
    headers = {"Content-Type": reply.content_type, "Content-Length": str(len(reply.content)), **reply.headers}
    if not reply.cut:
        response: web.StreamResponse = web.Response(status=reply.status, headers=headers, body=reply.content)
        await response.prepare(request)
        await response.write_eof()
        return response
    response = web.StreamResponse(status=reply.status, headers=headers)
    await response.prepare(request)
    await response.write(reply.content[: len(reply.content) // 2])
    if request.transport:
        request.transport.close()
    return response


async def _end_with(parent: int) -> None:
    """Return when the parent is gone: a killed test run leaves no server behind."""
    while os.getppid() == parent:
        await asyncio.sleep(_PARENT_LOOK_S)


async def _serve(server: Server, parent: int) -> None:
    handler = web.Server(server.handle, handler_cancellation=True, access_log=None)  # a closed client ends its wait
    runner = web.ServerRunner(handler, shutdown_timeout=0.1)
    await runner.setup()
    site = web.TCPSite(runner, "127.0.0.1", 0, backlog=4096)
    await site.start()
    print(f"listening on http://127.0.0.1:{runner.addresses[0][1]}", flush=True)
    await _end_with(parent)
    os._exit(0)  # nobody is left to be answered


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--config", type=json.loads, default={}, help="JSON, see Config")
    parser.add_argument("--no-bodies", action="store_true", help="keep counts only, for load")
    parser.add_argument("--parent", type=int, default=os.getppid(), help="the process whose end ends this one")
    arguments = parser.parse_args()
    server = Server(Config(**arguments.config), not arguments.no_bodies)
    with suppress(KeyboardInterrupt):
        asyncio.run(_serve(server, arguments.parent))


# --- for tests --------------------------------------------------------------------------------------------------------

_OPENER = urllib.request.build_opener(urllib.request.ProxyHandler({}))


@dataclass(frozen=True)
class Provider:
    """A running server, from a test's side. Use it as a context manager, or call `stop`."""

    url: str
    process: subprocess.Popen[str]

    @classmethod
    def start(cls, config: Mapping[str, Any] | None = None, keeps_records: bool = True) -> Self:
        """Start a server. Returns when it listens."""
        command = [sys.executable, "-m", "tests.providers.server", "--parent", str(os.getpid())]
        command += ["--config", json.dumps(dict(config or {}))] + ([] if keeps_records else ["--no-bodies"])
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, start_new_session=True)
        assert process.stdout
        line = process.stdout.readline()
        if not line.startswith("listening on "):
            process.kill()
            raise RuntimeError(f"the provider did not start (exit code {process.wait()}): {line}")
        return cls(line.split()[-1], process)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def configure(self, **config: Any) -> Json:
        """Change some settings; the others stay. Returns all of them."""
        return self._call("POST", "/_config", config)

    def stats(self) -> Json:
        """Counts since the start or the last reset."""
        return self._call("GET", "/_stats")

    def requests(self, limit: int = 0) -> list[Json]:
        """Records of requests, newest last; with a limit, the newest ones."""
        return self._call("GET", f"/_requests?limit={limit}")

    def reset(self) -> None:
        """Forget all requests; the settings stay."""
        self._call("POST", "/_reset", {})

    def afresh(self, **config: Any) -> Self:
        """As if just started with this config: what a test of a shared server begins with."""
        self.reset()
        self.configure(**asdict(Config()) | config)
        return self

    def stop(self) -> None:
        """End the process."""
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        if self.process.stdout:
            self.process.stdout.close()

    def _call(self, method: str, path: str, body: Json | None = None) -> Any:
        content = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.url + path, content, method=method)
        with _OPENER.open(request, timeout=60) as response:
            return json.load(response)


if __name__ == "__main__":
    main()
