"""The ledger: a call is paid for once.

Answers (and votes) are appended as they come back, before anything counts them as done. One interface has two
implementations, which nothing above this room tells apart: files of one machine (`storage/segments.py`), and a
PostgreSQL database that several hosts share (`storage/shared_ledger.py`).
"""

from __future__ import annotations

import json
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from typing import Any

from traps_pipeline.storage.rows import heal, is_cost, is_count, is_seconds

SYNC_ROWS, SYNC_SECONDS = 100, 0.5
FAILED = ("error", "malformed")  # outcomes that settle nothing
ASIDES = ("reasoning", "raw")  # texts kept beside rows, so that reading answers stays quick
# Columns whose means forecast what a call takes, and what is a possible value of each.
AVERAGED = {"prompt_tokens": is_count, "completion_tokens": is_count, "latency_s": is_seconds}
# Found without parsing the row, which may be damaged. Inside a string the quote before the colon has a backslash before
# it, so that no text of a model can look like this; what is counted is read from the parsed row.
_PARTICIPANT = re.compile(rb'"participant": "([a-z0-9.-]+)"')

Stored = tuple[Mapping[str, Any], Mapping[str, str]]  # a row, and what is kept beside it by name in ASIDES
Waiting = Callable[[str], None]  # is told once who is waited for
GiveUp = Callable[[], bool]  # whether to wait no longer


def never() -> bool:
    """Wait for ever."""
    return False


class LockGivenUp(Exception):
    """Waiting for a lock was stopped."""


def settles(row: Mapping[str, Any]) -> bool:
    """Whether a row settles its key: a failed call is kept for the record, and asked again."""
    return row["outcome"] not in FAILED


@dataclass
class Known:
    """What a ledger holds for one evaluation: the newest row of each key (a failure never takes the place of an
    answer), and what a person should know of rows that are not believed, or not all of them: by place."""

    rows: dict[str, dict[str, Any]] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)

    @property
    def settled(self) -> dict[str, dict[str, Any]]:
        """The rows that need not be asked again."""
        return {key: row for key, row in self.rows.items() if settles(row)}

    def add(self, row: dict[str, Any]) -> None:
        """Take a row that is newer than those before it."""
        earlier = self.rows.get(row["key"])
        if earlier is None or settles(row) or not settles(earlier):
            self.rows[row["key"]] = row


@dataclass
class Totals:
    """What rows of one participant add up to. dollars: paid; dearest: by one row; unknown: rows that do not tell it so
    that it can be believed; means: of the settled rows, sum and number of the values of each column of `AVERAGED`."""

    dollars: float = 0.0
    dearest: float = 0.0
    unknown: int = 0
    means: dict[str, tuple[float, int]] = field(default_factory=dict)

    def add(self, row: Mapping[str, Any] | None) -> None:
        """Count a row; None: a damaged one."""
        cost = 0.0 if row is None else row.get("cost_usd") or 0.0
        if row is None or not is_cost(cost):
            self.unknown += 1
            return
        self.dollars, self.dearest = self.dollars + cost, max(self.dearest, cost)
        if row.get("outcome") not in FAILED:
            for column, is_possible in AVERAGED.items():
                if is_possible(row.get(column)):
                    self._add_to_mean(column, row[column], 1)

    def join(self, other: Totals) -> None:
        """Count what other rows of the participant add up to."""
        self.dollars, self.dearest = self.dollars + other.dollars, max(self.dearest, other.dearest)
        self.unknown += other.unknown
        for column, (total, count) in other.means.items():
            self._add_to_mean(column, total, count)

    def mean(self, column: str) -> float | None:
        """The mean of a column; None where no row has a value."""
        total, count = self.means.get(column, (0.0, 0))
        return total / count if count else None

    def _add_to_mean(self, column: str, total: float, count: int) -> None:
        before = self.means.get(column, (0.0, 0))
        self.means[column] = (before[0] + total, before[1] + count)


class Writer(ABC):
    """Who appends rows to an evaluation, while nobody else does."""

    @abstractmethod
    async def require(self) -> None:
        """Return if another call may be sent. Raises TrapsError when this writer is not the evaluation's any more."""

    @abstractmethod
    def open(self) -> None:
        """Be ready before anything is asked whose answer is to be taken. Raises TrapsError."""

    @abstractmethod
    def append(self, row: Mapping[str, Any], beside: Mapping[str, str] | None = None) -> None:
        """Add one row, and what is kept beside it by name in ASIDES. Raises TrapsError."""

    @abstractmethod
    async def kept(self) -> None:
        """Return when no kill of this process loses what was appended. Raises TrapsError when it cannot be kept."""

    @abstractmethod
    def sync_if_due(self) -> None:
        """Bring what was appended to the disk, if some time has passed since the last time. Raises TrapsError."""

    @abstractmethod
    def sync(self) -> None:
        """Bring what was appended to the disk. Raises TrapsError."""

    @abstractmethod
    def finish(self) -> None:
        """Say that all that was asked is answered: the rows may go where they stay. Raises TrapsError."""


class Ledger(ABC):
    """Append-only rows by key, for each evaluation. kind: what the rows are, `answers` or `votes`."""

    def __init__(self, kind: str) -> None:
        self.kind = kind

    @abstractmethod
    def read(self, evaluation: str, wanted: Collection[str] | None = None) -> Known:
        """The rows of an evaluation, or those of the wanted keys: the others are neither parsed nor held in memory. Of
        a key with several rows the newest counts, but no failure in the place of an answer.

        A row that is not what was written, and values that no table can hold, are noted and not believed.
        """

    @abstractmethod
    def totals(self) -> dict[str, Totals]:
        """What every row of every evaluation adds up to, by participant: repeated keys were paid for as well."""

    @abstractmethod
    def reasoning(self, evaluation: str, wanted: Collection[str] | None = None) -> dict[str, str]:
        """Reasoning traces by key (of the wanted keys)."""

    @abstractmethod
    def writing(
        self, evaluation: str, waiting: Waiting, give_up: GiveUp = never
    ) -> AbstractAsyncContextManager[Writer]:
        """Be the one writer of an evaluation. While another one is, wait and say once who it is.

        Raises LockGivenUp when `give_up` says so while waiting, and TrapsError.
        """

    @abstractmethod
    async def store(self, rows: Mapping[str, Sequence[Stored]], waiting: Waiting) -> int:
        """Add rows of evaluations whose keys are not settled, all of them or none; how many settle a key. Nobody else
        writes to these evaluations meanwhile. Raises TrapsError."""

    @abstractmethod
    def evaluations(self) -> list[str]:
        """Those that have rows."""

    @abstractmethod
    def rows(self, evaluation: str) -> Iterator[Stored]:
        """Every row of an evaluation as it was written, the oldest first, and what stands beside it. Rows that are not
        what was written are left out."""

    @abstractmethod
    def damage(self) -> Iterator[str]:
        """A sentence for each place where rows are not what was written. Reads all."""


def row_of(line: bytes) -> tuple[dict[str, Any], list[str]]:
    """The row of a line, and the names of values in it that were not possible. Raises ValueError, KeyError and
    TypeError."""
    row = json.loads(line)
    row["key"]
    row.pop("sum", None)
    return row, heal(row)


def participant_of(row: Mapping[str, Any] | None, line: bytes = b"") -> str:
    """Whose call a row tells of, as far as it can be told; None: a damaged row, of which there is only its line."""
    components = (row or {}).get("components")
    name = components.get("participant") if isinstance(components, Mapping) else None
    found = _PARTICIPANT.search(line)
    return name if isinstance(name, str) else found[1].decode() if found else "unknown"
