"""Interpret rows of the ledger: possible values, settled keys, and totals.

A value that no table can hold, or that no call can have cost, is unknown. A provider's slip can thus neither keep a
table from being built nor end a study.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any

FAILED = ("error", "malformed")  # outcomes that settle no key
SIDE_TEXTS = ("reasoning", "raw")  # texts kept beside rows, so that reading answers stays quick
NOT_WHOLE = "not what was written"
Stored = tuple[Mapping[str, Any], Mapping[str, str]]  # a row, and its side texts by name in SIDE_TEXTS

_ENCODER = json.JSONEncoder(ensure_ascii=False, allow_nan=False)
MAX_TOKENS = 10**9
MAX_USD = 10_000.0  # limit for one call with all its attempts


def is_cost(value: Any) -> bool:
    """Return whether a value is a possible cost of one call, in dollars."""
    return type(value) in (int, float) and 0 <= value <= MAX_USD  # integers have any length, and NaN no order


def is_amount(value: Any) -> bool:
    """Return whether a value is a possible sum of dollars, of tokens, or of seconds."""
    return type(value) in (int, float) and 0 <= value <= sys.float_info.max


def _is_text(value: Any) -> bool:
    if not isinstance(value, str):
        return False
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True


def is_count(value: Any) -> bool:
    """Return whether a value is a possible number of tokens of one call."""
    return type(value) is int and 0 <= value <= MAX_TOKENS


# A provider's fields, with a test for possible values; anything else is unknown.
_CHECKS: dict[str, Callable[[Any], bool]] = {
    **dict.fromkeys(("text", "finish_reason", "error", "served_model", "client", "first_token"), _is_text),
    **dict.fromkeys(("prompt_tokens", "completion_tokens", "reasoning_tokens"), is_count),
    "cost_usd": is_cost,
}


def replace_impossible(row: dict[str, Any]) -> list[str]:
    """Replace impossible values by None, in place; return the names of these fields."""
    fields = []
    for name, is_possible in _CHECKS.items():
        value = row.get(name)
        if value is not None and not is_possible(value):
            row[name] = value.encode("utf-8", "replace").decode() if isinstance(value, str) and name == "text" else None
            fields.append(name)
    if fields and row.get("outcome") in ("answer", "truncated") and not isinstance(row.get("text"), str):
        row["outcome"] = "malformed"
    return fields


# Columns whose means forecast a call, each with a test for possible values.
AVERAGED_COLUMNS: dict[str, Callable[[Any], bool]] = {
    "prompt_tokens": is_count,
    "completion_tokens": is_count,
    "latency_s": is_amount,
}


def is_settled(row: Mapping[str, Any]) -> bool:
    """Return whether a row settles its key: a failed call is asked again."""
    return row["outcome"] not in FAILED


def participant_of(row: Mapping[str, Any]) -> str:
    """Return the model or judge of a row's call, or `unknown`."""
    components = row.get("components")
    participant = components.get("participant") if isinstance(components, dict) else None
    return participant if isinstance(participant, str) else "unknown"


def encode_row(row: Mapping[str, Any]) -> bytes:
    """Return a row as JSON. Raises ValueError for NaN, which JSON lacks."""
    return _ENCODER.encode(row).encode()


def digest_of(
    key: str, content: bytes, reasoning: bytes | None, raw: bytes | None, evaluation: str | None = None
) -> bytes:
    """Return the digest that is stored with a row and verified on reading.

    It has 17 bytes and binds the evaluation, KIND/NAME; rows of versions before 0.4 have 16 bytes (None), which do not.
    """
    digest = blake2b(key.encode(), digest_size=16 if evaluation is None else 17)
    for part in (*(() if evaluation is None else (evaluation.encode(),)), content, reasoning, raw):
        digest.update(b"\0" if part is None else b"\1" + part)
    return digest.digest()


def is_whole(row: Any, evaluation: str) -> bool:
    """Return whether a ledger row is unaltered, by its digest. KIND/NAME names its evaluation."""
    try:
        bound = evaluation if len(row.digest) == 17 else None
        return digest_of(row.key, row.content, row.reasoning, row.raw, bound) == row.digest
    except (TypeError, AttributeError):  # a flipped bit can make another kind of value of a column
        return False


@dataclass
class EvaluationRows:
    """The readable rows of one evaluation.

    rows: the newest row of each key; a failure never replaces an answer. notes: by place, warnings about rows that are
    ignored in full or in part.
    """

    rows: dict[str, dict[str, Any]] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)

    @property
    def settled(self) -> dict[str, dict[str, Any]]:
        """The rows whose calls need no repetition."""
        return {key: row for key, row in self.rows.items() if is_settled(row)}

    def add(self, row: dict[str, Any]) -> None:
        """Add a row that is newer than all rows so far."""
        previous_row = self.rows.get(row["key"])
        if previous_row is None or is_settled(row) or not is_settled(previous_row):
            self.rows[row["key"]] = row


@dataclass
class Totals:
    """Totals of one participant's rows.

    dollars: paid; failed: the part paid by rows that settle nothing; dearest: the highest cost of a row; unknown: rows
    whose cost is impossible; means: sum and number of the values of each column of `AVERAGED_COLUMNS`, over settled
    rows.
    """

    dollars: float = 0.0
    failed: float = 0.0
    dearest: float = 0.0
    unknown: int = 0
    means: dict[str, tuple[float, int]] = field(default_factory=dict)

    def add(self, row: Mapping[str, Any]) -> None:
        """Count a row's cost, and its tokens in the means."""
        cost = row.get("cost_usd") or 0.0
        if not is_cost(cost):
            self.unknown += 1
            return
        self.dollars, self.dearest = self.dollars + cost, max(self.dearest, cost)
        if row.get("outcome") in FAILED:
            self.failed += cost
            return
        for column, is_possible in AVERAGED_COLUMNS.items():
            if is_possible(row.get(column)):
                self._add_to_mean(column, row[column], 1)

    def join(self, other: Totals) -> None:
        """Add the counts and costs of another total of the same participant."""
        self.dollars, self.dearest = self.dollars + other.dollars, max(self.dearest, other.dearest)
        self.failed, self.unknown = self.failed + other.failed, self.unknown + other.unknown
        for column, (total, count) in other.means.items():
            self._add_to_mean(column, total, count)

    def mean(self, column: str) -> float | None:
        """Return the mean of a column; None without values."""
        total, count = self.means.get(column, (0.0, 0))
        return total / count if count else None

    def _add_to_mean(self, column: str, total: float, count: int) -> None:
        sum_and_count = self.means.get(column, (0.0, 0))
        self.means[column] = (sum_and_count[0] + total, sum_and_count[1] + count)
