"""The ledger: a call is paid for once.

Answers (and votes) are appended as they come back, one JSON line each, before anything counts them as done. A segment
has one writer; each line reaches the kernel at once (survives kill -9) and the disk every 0.5 s or 100 rows (survives
power loss). A torn last line is ignored and counted: that answer is asked again. An OS lock per evaluation keeps two
runs from asking the same key at the same time; the kernel frees it when its holder dies.
"""

from __future__ import annotations

import asyncio
import errno
import fcntl
import json
import os
import re
import secrets
import time
from collections.abc import AsyncIterator, Callable, Container, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from traps_pipeline.errors import TrapsError

SYNC_ROWS, SYNC_SECONDS = 100, 0.5
LOCK_POLL_SECONDS = 0.1
FAILED = ("error", "malformed")  # outcomes that settle nothing
ASIDES = ("reasoning", "raw")  # texts kept beside a segment, each in a file of its own
_KEY = b'{"key": "'  # how every row begins
# Found without parsing the row, which would take ten times as long. Inside a string the quote before the colon has a
# backslash before it, so that no text of a model can look like these.
_COST = re.compile(rb'"cost_usd": ([0-9.e+-]+)[,}]')
_PARTICIPANT = re.compile(rb'"participant": "([a-z0-9.-]+)"')


class LockGivenUp(Exception):
    """Waiting for a lock was stopped."""


def settles(row: Mapping[str, Any]) -> bool:
    """Whether a row settles its key: a failed call is kept for the record, and asked again."""
    return row["outcome"] not in FAILED


@dataclass
class Known:
    """What a ledger holds for one evaluation: the newest row of each key (a failure never takes the place of an
    answer), and torn last lines (file:line)."""

    rows: dict[str, dict[str, Any]] = field(default_factory=dict)
    torn: list[str] = field(default_factory=list)

    @property
    def settled(self) -> dict[str, dict[str, Any]]:
        """The rows that need not be asked again."""
        return {key: row for key, row in self.rows.items() if settles(row)}

    def add(self, row: dict[str, Any]) -> None:
        """Take a row that is newer than those before it."""
        earlier = self.rows.get(row["key"])
        if earlier is None or settles(row) or not settles(earlier):
            self.rows[row["key"]] = row


class Ledger:
    """Append-only rows by key, one folder an evaluation: `<root>/<kind>/<evaluation>/<segment>.jsonl`."""

    def __init__(self, root: Path, kind: str) -> None:
        self.root, self.kind = root, kind

    def folder(self, evaluation: str) -> Path:
        """Where an evaluation's segments lie."""
        return self.root / self.kind / evaluation

    def read(self, evaluation: str, wanted: Container[str] | None = None) -> Known:
        """The rows of an evaluation, or those of the wanted keys: the others are neither parsed nor held in memory.

        A torn last line of a segment is counted; any other bad line raises TrapsError.
        """
        known = Known()
        for segment in sorted(self.folder(evaluation).glob("*.jsonl")):
            for row, torn in _read_segment(segment, wanted):
                if torn:
                    known.torn.append(torn)
                elif row is not None:
                    known.add(row)
        return known

    def rows_of(self, participants: Container[str]) -> Iterator[dict[str, Any]]:
        """Rows of some participants, of every evaluation; lines that are not whole are left out."""
        for segment in sorted((self.root / self.kind).glob("*/*.jsonl")):
            with segment.open("rb") as stream:
                for line in stream:
                    about = _PARTICIPANT.search(line)
                    if about and about[1].decode() in participants and line.endswith(b"\n"):
                        yield json.loads(line)

    def spent(self) -> dict[str, float]:
        """Dollars by participant, over every row of every evaluation: repeated keys were paid for as well."""
        spent: dict[str, float] = {}
        for segment in sorted((self.root / self.kind).glob("*/*.jsonl")):
            with segment.open("rb") as stream:
                for line in stream:
                    cost, participant = _COST.search(line), _PARTICIPANT.search(line)
                    if cost and participant and line.endswith(b"\n"):
                        name = participant[1].decode()
                        spent[name] = spent.get(name, 0.0) + float(cost[1])
        return spent

    def reasoning(self, evaluation: str, wanted: Container[str] | None = None) -> dict[str, str]:
        """Reasoning traces by key (of the wanted keys), in sibling segments so that reading answers stays quick."""
        traces: dict[str, str] = {}
        for segment in sorted(self.folder(evaluation).glob("*.jsonl.reasoning")):
            traces.update({row["key"]: row["reasoning"] for row, _ in _read_segment(segment, wanted) if row})
        return traces

    @contextmanager
    def writer(self, evaluation: str) -> Iterator[SegmentWriter]:
        """A writer of a new segment; the file appears with the first row."""
        second, rest = divmod(time.time_ns(), 10**9)  # one reading, so that names sort as segments were begun
        name = f"{time.strftime('%Y%m%dT%H%M%S', time.gmtime(second))}-{rest:09d}-{secrets.token_hex(3)}.jsonl"
        writer = SegmentWriter(self.folder(evaluation) / name)
        try:
            yield writer
        finally:
            writer.close()

    @asynccontextmanager
    async def lock(
        self, evaluation: str, waiting: Callable[[str], None], give_up: Callable[[], bool] = lambda: False
    ) -> AsyncIterator[None]:
        """Hold the evaluation's lock; while another process has it, wait and say once who holds it.

        Raises LockGivenUp when `give_up` says so while waiting.
        """
        path = self.root / "locks" / f"{self.kind}-{evaluation}.lock"
        with _writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        told = False
        try:
            while True:
                try:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    if not told:
                        waiting(
                            f"{self.kind} of {evaluation} are being asked by {_holder(path)}; waiting for it to finish"
                        )
                        told = True
                    if give_up():
                        raise LockGivenUp(evaluation) from None
                    await asyncio.sleep(LOCK_POLL_SECONDS)
            with _writing(path):
                os.ftruncate(descriptor, 0)
                os.pwrite(descriptor, json.dumps({"pid": os.getpid(), "since": time.strftime("%H:%M:%S")}).encode(), 0)
            yield
        finally:
            os.close(descriptor)


class SegmentWriter:
    """Appends rows to one segment. Not shared between processes or threads."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._files: dict[Path, int] = {}
        self._sizes: dict[Path, int] = {}
        self._unsynced, self._synced_at = 0, time.monotonic()

    def append(self, row: Mapping[str, Any], beside: Mapping[str, str] | None = None) -> None:
        """Write one row (and what is kept beside it, by name in ASIDES) at once. Raises TrapsError when the disk is
        full; earlier rows are safe."""
        for name, text in (beside or {}).items():
            self._write(self.path.with_suffix(f".jsonl.{name}"), {"key": row["key"], name: text})
        self._write(self.path, row)
        self._unsynced += 1
        self.sync_if_due()

    def _write(self, path: Path, row: Mapping[str, Any]) -> None:
        line = json.dumps(row, ensure_ascii=False, allow_nan=False).encode() + b"\n"
        with _writing(path):
            if path not in self._files:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._files[path] = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
                self._sizes[path] = 0
            if os.write(self._files[path], line) < len(line):
                os.ftruncate(self._files[path], self._sizes[path])  # a half-written line must not swallow the next one
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._sizes[path] += len(line)

    def sync_if_due(self) -> None:
        """Sync to disk when 100 rows or 0.5 s have passed since the last time."""
        if self._unsynced and (self._unsynced >= SYNC_ROWS or time.monotonic() - self._synced_at >= SYNC_SECONDS):
            self.sync()

    def sync(self) -> None:
        """Sync what was written."""
        for path, descriptor in self._files.items():
            with _writing(path):
                os.fsync(descriptor)
        self._unsynced, self._synced_at = 0, time.monotonic()

    def close(self) -> None:
        """Sync and close."""
        if self._unsynced:
            self.sync()
        while self._files:
            os.close(self._files.popitem()[1])


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn a full or broken disk into a sentence."""
    try:
        yield
    except OSError as error:
        raise TrapsError(
            f"{path}: could not be written ({error.strerror}); free some space and run the same command again: "
            "everything answered before is kept, only what was in flight is asked again"
        ) from error


def _read_segment(
    path: Path, wanted: Container[str] | None = None
) -> Iterator[tuple[dict[str, Any] | None, str | None]]:
    with path.open("rb") as stream:
        for number, line in enumerate(stream, start=1):
            if not line.endswith(b"\n"):
                yield None, f"{path}:{number}"
                return
            if wanted is not None and line.startswith(_KEY) and _key(line) not in wanted:
                continue
            try:
                row = json.loads(line)
                row["key"]
            except (ValueError, KeyError, TypeError) as error:
                raise TrapsError(
                    f"{path}:{number}: not a ledger row ({error!r}); remove that line and run again: its answer "
                    "will be asked anew, all others are kept"
                ) from error
            yield row, None


def _key(line: bytes) -> str:
    return line[len(_KEY) : line.index(b'"', len(_KEY))].decode("ascii", "replace")


def _holder(path: Path) -> str:
    try:
        holder = json.loads(path.read_text() or "{}")
    except (OSError, ValueError):
        holder = {}
    return f"process {holder.get('pid', '?')} since {holder.get('since', '?')}"
