"""JSON schemas of the objects that providers are asked for (structured output)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any


def structured(name: str, **properties: Any) -> dict[str, Any]:
    """Return the `response_format` of an object with exactly these properties (JSON schema of each), all of them
    required."""
    schema = {"type": "object", "properties": properties, "required": [*properties], "additionalProperties": False}
    return {"type": "json_schema", "json_schema": {"name": name, "strict": True, "schema": schema}}


_TYPES = {"reason": "string", "abstain": "boolean", "final_answer": "string"}


def answer_object(fields: Iterable[str]) -> dict[str, Any]:
    """Return the `response_format` of an answer with these fields (`regimes.FIELDS`)."""
    return structured("answer", **{name: {"type": _TYPES[name]} for name in fields})
