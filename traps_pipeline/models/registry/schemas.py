"""Define JSON schemas of the objects asked of providers (structured output)."""

from collections.abc import Iterable, Mapping
from typing import Any


def structured_output(name: str, **properties: Any) -> dict[str, Any]:
    """Return a `response_format` that requires exactly these properties (schemas)."""
    return {"type": "json_schema", "json_schema": {"name": name, "strict": True, "schema": _object(**properties)}}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "required": [*properties], "additionalProperties": False}


_TYPES: Mapping[str, Any] = {
    "reason": {"type": "string"},
    "abstain": {"type": "boolean"},
    "final_answer": {"type": "string"},
    "probabilities": {"type": "array", "items": _object(answer={"type": "string"}, probability={"type": "number"})},
}


def answer_object(fields: Iterable[str]) -> dict[str, Any]:
    """Return the `response_format` of an answer with these fields (`regimes.FIELDS`)."""
    return structured_output("answer", **{name: _TYPES[name] for name in fields})
