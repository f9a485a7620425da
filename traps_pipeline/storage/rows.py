"""What a row of the ledger may hold, so that no value that a provider sent can keep a table from being made, or be
counted as money that nobody can have spent."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

MOST_TOKENS = 10**9
MOST_USD = 10_000.0  # of one call with all its attempts


def is_cost(value: Any) -> bool:
    """Whether a call can have cost that much."""
    return type(value) in (int, float) and math.isfinite(value) and 0 <= value <= MOST_USD


def is_seconds(value: Any) -> bool:
    """Whether a call can have taken so long."""
    return type(value) in (int, float) and 0 <= value < math.inf


def _is_text(value: Any) -> bool:
    if not isinstance(value, str):
        return False
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True


def is_count(value: Any) -> bool:
    """Whether a call can have taken so many tokens."""
    return type(value) is int and 0 <= value <= MOST_TOKENS


# What a provider says; anything else is unknown.
_SAID: dict[str, Callable[[Any], bool]] = {
    **dict.fromkeys(("text", "finish_reason", "error", "served_model", "client"), _is_text),
    **dict.fromkeys(("prompt_tokens", "completion_tokens", "reasoning_tokens"), is_count),
    "cost_usd": is_cost,
}


def heal(row: dict[str, Any]) -> list[str]:
    """Make values that no table can hold unknown, in place; the names of these fields. A text loses what cannot be
    stored."""
    healed = []
    for name, fits in _SAID.items():
        value = row.get(name)
        if value is not None and not fits(value):
            row[name] = value.encode("utf-8", "replace").decode() if isinstance(value, str) and name == "text" else None
            healed.append(name)
    if healed and row.get("outcome") in ("answer", "truncated") and not isinstance(row.get("text"), str):
        row["outcome"] = "malformed"
    return healed
