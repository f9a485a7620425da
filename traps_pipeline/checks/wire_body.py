"""Parse request bodies into one form; list each API's fields for parameters."""

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

Api = Literal["chat", "responses", "gemini", "anthropic"]
ENDPOINTS: dict[str, Api] = {
    "/chat/completions": "chat",
    "/responses": "responses",
    ":generateContent": "gemini",
    "/v1/messages": "anthropic",
}
# A parameter's name in the body, if it differs from the name in the entry.
_NAMES: dict[Api, dict[str, str]] = {
    "chat": {},
    "responses": {"max_tokens": "max_output_tokens", "max_completion_tokens": "max_output_tokens"},
    "gemini": {"top_p": "topP", "top_k": "topK", "max_tokens": "maxOutputTokens"},
    "anthropic": {},
}
UNKNOWN_FORM = (ValueError, KeyError, TypeError, AttributeError)
SCHEMAS = ("response_format", "text.format", "generationConfig.responseJsonSchema", "output_format")  # kept whole


@dataclass(frozen=True)
class WireBody:
    """One HTTP request as a provider would receive it."""

    method: str
    path: str
    headers: Mapping[str, str]
    raw: bytes

    @cached_property
    def body(self) -> dict[str, Any]:
        """The JSON body of the request as it was sent, parsed."""
        return json.loads(self.raw)

    @property
    def api(self) -> Api | None:
        """The API that the path belongs to; None for an unknown one."""
        return next((api for ending, api in ENDPOINTS.items() if self.path.endswith(ending)), None)


@dataclass(frozen=True)
class ClipPart:
    """A video or an image in a body. fps: the rate in the body, if it has one."""

    mime: str
    data: bytes
    fps: float | None = None


@dataclass(frozen=True)
class ParsedBody:
    """A body in one form for all APIs.

    turns: role and parts, each a text, a clip, or None for anything else. fields: all other fields, by dotted name; a
    schema is one field.
    """

    model: str
    turns: list[tuple[str, list[str | ClipPart | None]]]
    fields: dict[str, Any]


def read_body(wire: WireBody) -> ParsedBody:
    """Return the parsed body. Raises one of `UNKNOWN_FORM` if its form is unknown."""
    body = _camel(wire.body) if wire.api == "gemini" else dict(wire.body)
    model = body.pop("model", None) or wire.path.rsplit("/", 1)[-1].removesuffix(":generateContent")
    match wire.api:
        case "gemini":
            turns = [{"role": "system", **body.pop("systemInstruction")}, *body.pop("contents")]
        case "responses":
            turns = [{"role": "system", "content": body.pop("instructions")}, *body.pop("input")]
        case "anthropic":
            turns = [{"role": "system", "content": body.pop("system")}, *body.pop("messages")]
        case _:
            turns = body.pop("messages")
    return ParsedBody(model, [_turn(turn) for turn in turns], flat(body))


def _turn(turn: Mapping[str, Any]) -> tuple[str, list[str | ClipPart | None]]:
    content = turn["parts"] if "parts" in turn else turn["content"]
    return turn["role"], [content] if isinstance(content, str) else [_part(part) for part in content]


def _part(part: Mapping[str, Any]) -> str | ClipPart | None:
    """Return a part of a turn in the one form, None for an unknown kind."""
    match part:
        case {"text": str(text), **rest} if rest.keys() <= {"type"}:
            return text
        case {"image_url": {"url": str(uri), **more}, **rest} if not more and rest.keys() <= {"type"}:
            return _clip(uri)
        case {"image_url": str(uri), **rest} if rest == {"type": "input_image", "detail": "auto"}:
            return _clip(uri)  # litellm adds the detail; auto is the provider's default
        case {"video_url": {"url": str(uri), **more}, **rest} if not more and rest.keys() <= {"type", "fps"}:
            return _clip(uri, rest.get("fps"))
        case {"inlineData": {"mimeType": str(mime), "data": str(data)}, **rest} if rest.keys() <= {"videoMetadata"}:
            return _clip(f"data:{mime};base64,{data}", **rest.get("videoMetadata", {}))
    return None


def _clip(uri: str, fps: float | None = None) -> ClipPart:
    head, data = uri.split(",", 1)
    return ClipPart(head.removeprefix("data:").removesuffix(";base64"), base64.b64decode(data, validate=True), fps)


def _camel(value: Any) -> Any:
    """Return Gemini's names in camelCase; snake_case is valid, and litellm mixes both."""
    if isinstance(value, list):
        return [_camel(element) for element in value]
    if not isinstance(value, dict):
        return value
    camel_fields = {_camel_name(name): element for name, element in value.items()}
    return {
        name: element if name == "responseJsonSchema" else _camel(element) for name, element in camel_fields.items()
    }


def _camel_name(name: str) -> str:
    head, *tail = name.split("_")
    return head + "".join(word.capitalize() for word in tail)


def flat(value: Any, name: str = "") -> dict[str, Any]:
    """Return the leaves of nested mappings by dotted name."""
    if not isinstance(value, dict) or not value or name in SCHEMAS:
        return {name: value}
    leaves: dict[str, Any] = {}
    for key, element in value.items():
        leaves |= flat(element, f"{name}.{key}" if name else key)
    return leaves


def declared_fields(api: Api, params: Mapping[str, Any]) -> dict[str, Any]:
    """Return the exact fields of an API's body for these parameters, by dotted name."""
    fields: dict[str, Any] = {}
    for name, value in params.items():
        if name == "response_format":
            fields |= _schema_fields(api, value)
        elif name == "extra_body":
            fields |= flat(value)
        elif name == "reasoning_effort" and api == "responses":
            fields |= flat(value if isinstance(value, dict) else {"effort": value}, "reasoning")
        else:
            place = "generationConfig." if api == "gemini" else ""
            fields |= flat(value, place + _NAMES[api].get(name, name))
    return fields


def _schema_fields(api: Api, response_format: Mapping[str, Any]) -> dict[str, Any]:
    schema = response_format["json_schema"]
    match api:
        case "chat":
            return {"response_format": response_format}
        case "responses":
            return {"text.format": {"type": "json_schema", **schema}}
        case "gemini":
            config = {"responseMimeType": "application/json", "responseJsonSchema": schema["schema"]}
            return {f"generationConfig.{name}": value for name, value in config.items()}
        case "anthropic":
            return {"output_format": {"type": "json_schema", "schema": schema["schema"]}}
