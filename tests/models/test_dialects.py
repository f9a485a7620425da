"""What a provider's own bytes say of an answer, in each of four dialects, as their documentation has it."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.build.errors import raises
from traps_pipeline.models.wire.dialects import OddShapeError, Reply, parse_body, read_reply, shape_of

LEFT = "The ball rolls to the left."
ROUTES = {
    "chat": "openai/m",
    "responses": "openai/responses/m",
    "anthropic": "anthropic/m",
    "gemini": "gemini/gemini-2.5-pro",
}


def chat(finish: Any = "stop", **message: Any) -> dict[str, Any]:
    choice = {"index": 0, "message": {"role": "assistant", "content": LEFT} | message, "finish_reason": finish}
    return {"object": "chat.completion", "model": "m-1", "choices": [choice], "usage": {"prompt_tokens": 9}}


def responses(status: str = "completed", reason: str | None = None, *content: dict[str, Any]) -> dict[str, Any]:
    parts = list(content) or [{"type": "output_text", "text": LEFT, "annotations": []}]
    thought = {"type": "reasoning", "summary": [{"type": "summary_text", "text": "I look."}]}
    output = [thought, {"type": "message", "role": "assistant", "content": parts}]
    why = {"reason": reason} if reason else None
    body = {"object": "response", "status": status, "incomplete_details": why, "model": "m-1", "output": output}
    return body | {"usage": {"input_tokens": 9}}


def anthropic(finish: Any = "end_turn", *content: dict[str, Any]) -> dict[str, Any]:
    parts = list(content) or [{"type": "text", "text": LEFT}]
    return {"type": "message", "model": "m-1", "content": parts, "stop_reason": finish, "usage": {"input_tokens": 9}}


def gemini(finish: Any = "STOP", *parts: dict[str, Any]) -> dict[str, Any]:
    content = {"role": "model", "parts": list(parts) or [{"text": LEFT}]}
    candidate = {"content": content, "finishReason": finish, "index": 0}
    return {"candidates": [candidate], "modelVersion": "m-1", "usageMetadata": {"promptTokenCount": 9}}


MAKERS = {"chat": chat, "responses": responses, "anthropic": anthropic, "gemini": gemini}


def read(dialect: str, body: dict[str, Any]) -> Reply:
    return read_reply(parse_body(json.dumps(body).encode()), ROUTES[dialect])


@pytest.mark.parametrize(
    ("dialect", "finish", "ending"),
    [
        ("chat", "stop", "complete"), ("chat", "length", "truncated"), ("chat", "MAX_TOKENS", "truncated"),
        ("chat", "content_filter", "refused"), ("chat", "abort", "transient"), ("chat", "tool_calls", "unknown"),
        ("responses", "completed", "complete"), ("responses", "incomplete", "unknown"),
        ("responses", "failed", "transient"),
        ("anthropic", "end_turn", "complete"), ("anthropic", "pause_turn", "truncated"),
        ("anthropic", "refusal", "refused"), ("anthropic", "tool_use", "unknown"),
        ("gemini", "STOP", "complete"), ("gemini", "MAX_TOKENS", "truncated"), ("gemini", "SAFETY", "refused"),
        ("gemini", "MALFORMED_RESPONSE", "transient"), ("gemini", "OTHER", "unknown"),
    ],
)  # fmt: skip
def test_a_finish_reason_is_kept_as_it_came_and_has_its_documented_meaning(
    dialect: str, finish: str, ending: str
) -> None:
    reply = read(dialect, MAKERS[dialect](finish))
    assert (reply.finish, reply.ending, reply.text, reply.served_model) == (finish, ending, LEFT, "m-1")
    assert [*reply.usage.values()] == [9]


def test_the_first_token_that_holds_a_letter_is_the_answers() -> None:
    def token(text: str, logprob: float, *others: Any) -> dict[str, Any]:
        return {"token": text, "logprob": logprob, "top_logprobs": list(others)}

    content = [token("**", -0.1), token("left", -0.2, token("left", -0.2), token(" right", -1.7)), token("No", 0.0)]
    body = chat()
    body["choices"][0]["logprobs"] = {"content": content}
    assert read("chat", body).first_token == {"left": -0.2, " right": -1.7}


@pytest.mark.parametrize(
    "odd",
    [
        None, [], {"content": None}, {"content": ["left"]}, {"content": [{"token": "left"}]},
        {"content": [{"token": "left", "logprob": True}]}, {"content": [{"token": "left", "logprob": 0.5}]},
        {"content": [{"token": 3, "logprob": -1.0}]}, {"content": [{"token": "left", "logprob": "-1"}]},
    ],
)  # fmt: skip
def test_odd_log_probabilities_are_none_and_the_answer_stays(odd: Any) -> None:
    body = chat()
    body["choices"][0]["logprobs"] = odd
    reply = read("chat", body)
    assert (reply.text, reply.first_token) == (LEFT, {})


def test_an_incomplete_response_says_why() -> None:
    cut_off = read("responses", responses("incomplete", "max_output_tokens"))
    assert (cut_off.finish, cut_off.ending, cut_off.reasoning) == ("max_output_tokens", "truncated", "I look.")
    assert read("responses", responses("incomplete", "content_filter")).ending == "refused"
    assert read("responses", responses("incomplete", "of_the_weather")).ending == "unknown"


@pytest.mark.parametrize("dialect", ["chat", "anthropic", "gemini"])
@pytest.mark.parametrize("finish", [None, "", 7, ["stop"]])
def test_an_answer_that_does_not_say_why_it_ended_is_no_complete_answer(dialect: str, finish: Any) -> None:
    with raises(OddShapeError, "models.wire.dialects.read_reply"):
        read(dialect, MAKERS[dialect](finish))


THINKING_PARTS = [
    {"type": "thinking", "thinking": [{"type": "text", "text": "maybe right"}]},
    {"type": "text", "text": LEFT},
]


CLAUDE_PARTS = [
    {"type": "thinking", "thinking": "maybe right", "signature": "s"},
    {"type": "redacted_thinking", "data": "x"},
    {"type": "text", "text": LEFT},
]


@pytest.mark.parametrize(
    ("dialect", "body", "reasoning"),
    [
        ("chat", chat(content=[{"type": "text", "text": LEFT}]), ""),
        ("chat", chat(content=[{"type": "text", "text": LEFT[:9]}, {"type": "text", "text": LEFT[9:]}]), ""),
        ("chat", chat(content=THINKING_PARTS), "maybe right"),
        ("chat", chat(content=[{"type": "reference", "reference_ids": [1]}, {"type": "text", "text": LEFT}]), ""),
        ("chat", chat(reasoning_content="maybe right"), "maybe right"),
        ("chat", chat(reasoning="maybe right", reasoning_details=[{"text": "maybe right"}]), "maybe right"),
        ("anthropic", anthropic("end_turn", *CLAUDE_PARTS), "maybe right"),
        ("gemini", gemini("STOP", {"text": "maybe right", "thought": True}, {"text": LEFT}), "maybe right"),
    ],
)  # fmt: skip
def test_text_and_trace_are_told_apart_by_the_parts(dialect: str, body: dict[str, Any], reasoning: str) -> None:
    reply = read(dialect, body)
    assert (reply.text, reply.reasoning) == (LEFT, reasoning)


def test_a_refusal_has_words_of_its_own() -> None:
    assert read("chat", chat(content=None, refusal="I can't help.")).refusal == "I can't help."
    assert read("chat", chat(refusal="")).refusal == ""
    refused = read("responses", responses("completed", None, {"type": "refusal", "refusal": "I can't help."}))
    assert (refused.refusal, refused.text) == ("I can't help.", "")
    blocked = read("gemini", {"promptFeedback": {"blockReason": "OTHER"}, "usageMetadata": {"promptTokenCount": 9}})
    assert (blocked.ending, blocked.finish, blocked.text) == ("refused", "OTHER", "")


def test_what_a_model_says_on_the_way_is_no_answer() -> None:
    body = responses()
    said = {"type": "message", "phase": "commentary", "content": [{"type": "output_text", "text": "Let me see."}]}
    body["output"].insert(1, said)
    assert (read("responses", body).text, read("responses", body).reasoning) == (LEFT, "I look.\n\nLet me see.")


def test_the_first_choice_is_the_one_that_says_so() -> None:
    body = chat()
    body["choices"].insert(0, {"index": 1, "message": {"content": "right"}, "finish_reason": "stop"})
    assert read("chat", body).text == LEFT


def test_a_response_is_read_as_one_where_the_route_says_chat() -> None:
    assert read_reply(responses(), "openai/gpt-5-pro").text == LEFT
    assert read_reply(anthropic(), "vertex_ai/claude-opus-4-6").text == LEFT


@pytest.mark.parametrize(
    ("content", "names"),
    [
        (b"{}", ["OpenAI's chat API", "`choices`"]),
        (b'{"model": "m", "message": {"content": "left"}, "done": true}', ["`choices`", "model, message, done"]),
        (json.dumps(chat(content={"text": "left"})).encode(), [" dict "]),
        (json.dumps(chat(content=["left"])).encode(), [" str "]),
    ],
)
def test_an_object_of_an_odd_shape_is_named_in_one_sentence(content: bytes, names: list[str]) -> None:
    with raises(OddShapeError, "models.wire.dialects.read_reply", *names) as raised:
        read_reply(parse_body(content), "openai/m")
    assert "\n" not in str(raised.value)


def test_what_is_no_object_is_told_apart() -> None:
    page, stream, cut = "\n<!doctype html><h1>Sign in</h1>", 'data: {"choices": []}\n\n', '{"choices": [{"ind'
    shapes = {text: shape_of(text) for text in ("", page, stream, cut)}
    assert len({*shapes.values()}) == 4 and "`base_url`" in shapes[page] and "/v1" in shapes[page]
    for content, shape in (shapes | {"[" * 100_000: shapes[cut], "[1]": " list "}).items():
        with raises(OddShapeError, "models.wire.dialects.parse_body", shape):
            parse_body(content.encode())


def test_bytes_that_are_no_text_lose_no_answer() -> None:
    content = json.dumps(chat(content="left @@")).encode().replace(b"@@", b"\xff\xfe")
    assert read_reply(parse_body(b"\xef\xbb\xbf\n  " + content), "openai/m").text == "left ��"
