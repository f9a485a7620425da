"""Rows of the ledger: which values they may hold, what settles a key, and what rows add up to.

A value that no table can hold, or that no call can have cost, is unknown. A provider's slip can thus neither keep a
table from being made nor end a study.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any

FAILED = ("error", "malformed")  # outcomes that settle nothing
ASIDES = ("reasoning", "raw")  # texts kept beside rows, so that reading answers stays quick
NOT_WHOLE = "not what was written"
Stored = tuple[Mapping[str, Any], Mapping[str, str]]  # a row, and what is kept beside it by name in ASIDES

MOST_TOKENS = 10**9
MOST_USD = 10_000.0  # of one call with all its attempts


def is_cost(value: Any) -> bool:
    """Return whether a call can have cost that much."""
    return type(value) in (int, float) and math.isfinite(value) and 0 <= value <= MOST_USD


def is_seconds(value: Any) -> bool:
    """Return whether a call can have taken so long."""
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
    """Return whether a call can have taken so many tokens."""
    return type(value) is int and 0 <= value <= MOST_TOKENS


# What a provider says; anything else is unknown.
_SAID: dict[str, Callable[[Any], bool]] = {
    **dict.fromkeys(("text", "finish_reason", "error", "served_model", "client", "first_token"), _is_text),
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


# Columns whose means forecast what a call takes, and what is a possible value of each.
AVERAGED: dict[str, Callable[[Any], bool]] = {
    "prompt_tokens": is_count,
    "completion_tokens": is_count,
    "latency_s": is_seconds,
}


def settles(row: Mapping[str, Any]) -> bool:
    """Return whether a row settles its key: a failed call is kept for the record, and asked again."""
    return row["outcome"] not in FAILED


def participant_of(row: Mapping[str, Any]) -> str:
    """Return the model or judge that a row's call went to; `unknown` where the row does not say."""
    components = row.get("components")
    participant = components.get("participant") if isinstance(components, Mapping) else None
    return participant if isinstance(participant, str) else "unknown"


def encoded(row: Mapping[str, Any]) -> bytes:
    """Return a row as JSON. Raises ValueError for NaN, which JSON does not have."""
    return json.dumps(row, ensure_ascii=False, allow_nan=False).encode()


def digest_of(key: str, content: bytes, reasoning: bytes | None, raw: bytes | None) -> bytes:
    """Return the digest (16 bytes) that is stored with a row and held against it when it is read."""
    digest = blake2b(key.encode(), digest_size=16)
    for aside in (content, reasoning, raw):
        digest.update(b"\0" if aside is None else b"\1" + aside)
    return digest.digest()


@dataclass
class Known:
    """What a ledger holds for one evaluation.

    rows: the newest row of each key; a failure never takes the place of an answer. notes: by place, what a person
    should know of rows that are not believed, or not all of them.
    """

    rows: dict[str, dict[str, Any]] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)

    @property
    def settled(self) -> dict[str, dict[str, Any]]:
        """The rows that need not be asked again."""
        return {key: row for key, row in self.rows.items() if settles(row)}

    def add(self, row: dict[str, Any]) -> None:
        """Add a row that is newer than those before it."""
        earlier = self.rows.get(row["key"])
        if earlier is None or settles(row) or not settles(earlier):
            self.rows[row["key"]] = row


@dataclass
class Totals:
    """What rows of one participant add up to.

    dollars: paid; failed: of these, by rows that settle nothing; dearest: by one row; unknown: rows whose cost cannot
    be; means: of the settled rows, sum and number of the values of each column of `AVERAGED`.
    """

    dollars: float = 0.0
    failed: float = 0.0
    dearest: float = 0.0
    unknown: int = 0
    means: dict[str, tuple[float, int]] = field(default_factory=dict)

    def add(self, row: Mapping[str, Any]) -> None:
        """Count a row."""
        cost = row.get("cost_usd") or 0.0
        if not is_cost(cost):
            self.unknown += 1
            return
        self.dollars, self.dearest = self.dollars + cost, max(self.dearest, cost)
        if row.get("outcome") in FAILED:
            self.failed += cost
            return
        for column, is_possible in AVERAGED.items():
            if is_possible(row.get(column)):
                self._add_to_mean(column, row[column], 1)

    def join(self, other: Totals) -> None:
        """Count what other rows of the participant add up to."""
        self.dollars, self.dearest = self.dollars + other.dollars, max(self.dearest, other.dearest)
        self.failed, self.unknown = self.failed + other.failed, self.unknown + other.unknown
        for column, (total, count) in other.means.items():
            self._add_to_mean(column, total, count)

    def mean(self, column: str) -> float | None:
        """Return the mean of a column; None where no row has a value."""
        total, count = self.means.get(column, (0.0, 0))
        return total / count if count else None

    def _add_to_mean(self, column: str, total: float, count: int) -> None:
        before = self.means.get(column, (0.0, 0))
        self.means[column] = (before[0] + total, before[1] + count)
