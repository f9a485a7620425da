"""Read answers from providers' own bytes, with one reader per dialect.

litellm builds and sends requests. Its view of a response is not used: it turns unknown finish reasons into `stop`, and
loses refusals and parts.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from traps_pipeline.base.terminal import plain
from traps_pipeline.models.reading import first_token
from traps_pipeline.models.reading.endings import Ending, ending_of

Dialect = Literal["chat", "responses", "anthropic", "gemini"]
Json = Mapping[str, Any]
ANSWER_FIELDS = ("choices", "content", "candidates", "output")  # fields that hold an answer, of all dialects
MAX_WORD = 200  # characters of a provider's short fields: served model, finish reason
_NAMES: Mapping[Dialect, str] = {
    "chat": "OpenAI's chat API",
    "responses": "OpenAI's Responses API",
    "anthropic": "Anthropic's messages API",
    "gemini": "Gemini's generateContent",
}
# Type of a content part to the field of `_Texts` that it belongs to, and to its own field that holds the text. Parts
# of other types (tool calls, references, images) are no text.
_PARTS: Mapping[str, tuple[str, str]] = {
    "text": ("text", "text"),
    "output_text": ("text", "text"),
    "refusal": ("refusal", "refusal"),
    "thinking": ("reasoning", "thinking"),
    "reasoning": ("reasoning", "text"),
    "reasoning_text": ("reasoning", "text"),
    "summary_text": ("reasoning", "text"),
}


class OddShapeError(ValueError):
    """Raised for a body that is not an answer of its dialect; the message describes it."""


@dataclass(frozen=True)
class Reply:
    """An answer as its provider sent it: text, raw finish reason and counts, and log-probabilities of first tokens."""

    text: str
    reasoning: str
    refusal: str
    finish: str
    ending: Ending
    served_model: str | None
    usage: Json
    first_token: Mapping[str, float] = field(default_factory=dict)


def dialect_of(provider_id: str) -> Dialect:
    """Return the dialect of a route, the prefix of litellm's name for a model."""
    route, _, model = provider_id.partition("/")
    if model.startswith("responses/"):
        return "responses"
    if route in ("vertex_ai", "azure_ai"):
        return "anthropic" if "claude" in model else "gemini" if "gemini" in model else "chat"
    return "anthropic" if route == "anthropic" else "gemini" if route == "gemini" else "chat"


def parse_body(content: bytes) -> Json:
    """Return the JSON object in a body, or the one that the parts of a stream make.

    Line breaks in texts, zero bytes around it, and UTF-16 are read as browsers read them. Raises OddShapeError for
    anything else.
    """
    text = content.decode(json.detect_encoding(content), "replace").strip("\0\ufeff \t\r\n")
    try:
        body = json.loads(text, strict=False)
    except (ValueError, RecursionError):
        body = _events(text)
        if (joined := _join(body)) is None:
            raise OddShapeError(f"it sent {shape_of(text)}") from None
        return joined
    if isinstance(body, list):  # Gemini's streams
        body = _join(body) or body
    if not isinstance(body, dict):
        raise OddShapeError(f"it sent a JSON {type(body).__name__} and no object")
    return body


def _events(text: str) -> list[Any]:
    """Return the JSON values of a stream of events or lines; empty if it is none."""
    lines = (line.removeprefix("data:").strip() for line in text.splitlines())
    try:
        return [json.loads(line, strict=False) for line in lines if line[:1] == "{"]
    except (ValueError, RecursionError):
        return []


def _join(parts: list[Any]) -> Json | None:
    """Return the answer that the parts of a stream make; None if they make none."""
    bodies = [part for part in parts if isinstance(part, dict)]
    whole = [body["response"] for body in bodies if isinstance(body.get("response"), dict)]  # OpenAI's Responses API
    whole += [body for body in bodies if body.get("error") or (len(bodies) == 1 and any(map(body.get, ANSWER_FIELDS)))]
    choices = [choice for body in bodies for choice in _listed(body, "choices") if choice.get("index", 0) == 0]
    deltas = [delta for choice in choices if isinstance(delta := choice.get("delta"), dict)]
    if whole or not deltas:
        return whole[-1] if whole else None
    names = ("content", "refusal", "reasoning_content", "reasoning")
    message = {name: "".join(text for delta in deltas if isinstance(text := delta.get(name), str)) for name in names}
    finish = next((choice["finish_reason"] for choice in choices if choice.get("finish_reason")), None)
    usage = next((body["usage"] for body in reversed(bodies) if body.get("usage")), None)
    return {**bodies[-1], "choices": [{"message": message, "finish_reason": finish}], "usage": usage}


def _listed(body: Json, name: str) -> list[dict[str, Any]]:
    values = body.get(name)
    return [value for value in values if isinstance(value, dict)] if isinstance(values, list) else []


def shape_of(text: str) -> str:
    """Return in words what a text is that is no JSON."""
    start = text.lstrip("\ufeff \t\r\n")
    if not start:
        return "an empty body"
    if start[0] == "<":
        return "a page of HTML (is `base_url` right, with its /v1, and does no sign-in page stand before it?)"
    if start.startswith(("data:", "event:", "id:", ":")):
        return "a stream of events, which was not asked for (switch streaming off in the server or proxy)"
    return "a text that breaks off or is no JSON"


def read_reply(body: Json, provider_id: str) -> Reply:
    """Return the answer in a body of status 200. Raises OddShapeError."""
    # litellm asks some OpenAI models over the Responses API whatever their route says.
    dialect = "responses" if body.get("object") == "response" else dialect_of(provider_id)
    try:
        return _READERS[dialect](body)
    except (OddShapeError, RecursionError) as error:
        fields = plain(", ".join(map(str, body)))[:MAX_WORD] or "nothing"
        raise OddShapeError(f"it sent no answer of {_NAMES[dialect]}: {plain(error)} (it holds {fields})") from None


# --- the dialects -----------------------------------------------------------------------------------------------------


@dataclass
class _Texts:
    """The texts of an answer's parts, in order, by kind."""

    text: list[str] = field(default_factory=list)
    reasoning: list[str] = field(default_factory=list)
    refusal: list[str] = field(default_factory=list)

    def add(self, parts: Any, into: str | None = None) -> None:
        """Add a content, a text or a list of parts; `into` names one field for all of it."""
        if isinstance(parts, str):
            getattr(self, into or "text").append(parts)
            return
        if not isinstance(parts, list | None):
            raise OddShapeError(f"its content is neither a text nor a list of parts but {type(parts).__name__}")
        for part in parts or ():
            if not isinstance(part, dict):
                raise OddShapeError(f"a part of its content is no object but {type(part).__name__}")
            kind, name = _PARTS.get(str(part.get("type")), ("", ""))
            if kind and part.get(name) is not None:
                self.add(part[name], into or kind)

    def reply(self, finish: Any, served_model: Any, usage: Any) -> Reply:
        """Return the answer. Raises OddShapeError if it lacks a finish reason."""
        if not finish or not isinstance(finish, str):
            raise OddShapeError("it gives no finish reason, which each complete answer has")
        return Reply(
            text=storable("".join(self.text)).strip(),
            reasoning=storable("\n\n".join(self.reasoning)).strip(),
            refusal=storable("".join(self.refusal)).strip(),
            finish=storable(finish)[:MAX_WORD],
            ending=ending_of(finish),
            served_model=storable(served_model)[:MAX_WORD] if isinstance(served_model, str) else None,
            usage=usage if isinstance(usage, dict) else {},
        )


def _chat(body: Json) -> Reply:
    choices = _objects(body, "choices")
    choice = next((candidate for candidate in choices if candidate.get("index") == 0), choices[0])
    message, texts = _object(choice, "message"), _Texts()
    texts.add(message.get("content"))
    texts.add(_text_of(message, "refusal"), "refusal")
    if not texts.reasoning:
        texts.add(_text_of(message, "reasoning_content") or _text_of(message, "reasoning"), "reasoning")
    reply = texts.reply(choice.get("finish_reason"), body.get("model"), body.get("usage"))
    return replace(reply, first_token=first_token.first_token_logprobs(choice.get("logprobs")))


def _responses(body: Json) -> Reply:
    texts = _Texts()
    for item in _objects(body, "output", least=0):
        if item.get("type") == "message":
            texts.add(item.get("content"), "reasoning" if item.get("phase") == "commentary" else None)
        elif item.get("type") == "reasoning":
            texts.add(item.get("summary") or item.get("content"), "reasoning")
    details = body.get("incomplete_details")
    reason = details.get("reason") if isinstance(details, dict) else None
    return texts.reply(reason or body.get("status"), body.get("model"), body.get("usage"))


def _anthropic(body: Json) -> Reply:
    texts = _Texts()
    if not isinstance(body.get("content"), list):
        raise OddShapeError("it has no list `content`")
    texts.add(body["content"])
    return texts.reply(body.get("stop_reason"), body.get("model"), body.get("usage"))


def _gemini(body: Json) -> Reply:
    texts, feedback = _Texts(), body.get("promptFeedback")
    block_reason = feedback.get("blockReason") if isinstance(feedback, dict) else None
    candidate = {} if block_reason else _objects(body, "candidates")[0]
    content = candidate.get("content")
    parts = content.get("parts") if isinstance(content, dict) else None
    for part in parts if isinstance(parts, list) else ():
        if isinstance(part, dict) and isinstance(part.get("text"), str):
            texts.add(part["text"], "reasoning" if part.get("thought") is True else "text")
    reply = texts.reply(
        block_reason or candidate.get("finishReason"), body.get("modelVersion"), body.get("usageMetadata")
    )
    return reply if not block_reason else replace(reply, ending="refused")  # nothing was generated, for any reason


_READERS: Mapping[Dialect, Callable[[Json], Reply]] = {
    "chat": _chat,
    "responses": _responses,
    "anthropic": _anthropic,
    "gemini": _gemini,
}


def _objects(body: Json, name: str, least: int = 1) -> list[dict[str, Any]]:
    values = body.get(name)
    if not isinstance(values, list) or len(values) < least or not all(isinstance(value, dict) for value in values):
        raise OddShapeError(f"it has no list `{name}`")
    return values


def _object(holder: Json, name: str) -> dict[str, Any]:
    value = holder.get(name)
    if not isinstance(value, dict):
        raise OddShapeError(f"it has no `{name}`")
    return value


def _text_of(holder: Json, name: str) -> str:
    value = holder.get(name)
    return value if isinstance(value, str) else ""


def storable(text: str) -> str:
    """Return a text without unpaired surrogates, which no file can store."""
    return text.encode("utf-8", "replace").decode("utf-8")
