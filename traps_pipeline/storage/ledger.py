"""The ledger: a call is paid for once.

Answers (and votes) are appended as they come back, one JSON line each, before anything counts them as done. A segment
has one writer; each line reaches the kernel at once (survives kill -9) and the disk every 0.5 s or 100 rows (survives
power loss). A torn last line is ignored and counted: that answer is asked again. An OS lock per evaluation keeps two
runs from asking the same key at the same time; the kernel frees it when its holder dies.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import secrets
import time
from collections.abc import AsyncIterator, Callable, Container, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from traps_pipeline.errors import TrapsError
from traps_pipeline.files import remedy, require_in_place, sync_folder, try_lock, write_bytes
from traps_pipeline.storage.lines import NOT_WHOLE, Line, append_whole, checked_line, read_checked
from traps_pipeline.storage.rows import heal, is_cost, is_count, is_seconds

SYNC_ROWS, SYNC_SECONDS = 100, 0.5
LOCK_POLL_SECONDS = 0.1
FAILED = ("error", "malformed")  # outcomes that settle nothing
JOURNAL = "in_flight.jsonl"  # beside the segments' folders: calls that no row tells of yet (`models.budget`)
ASIDES = ("reasoning", "raw")  # texts kept beside a segment, each in a file of its own
_KEY = b'{"key": "'  # how every row begins
_LONG = 2**18  # bytes of a segment whose totals are kept
# Columns whose means forecast what a call takes, and what is a possible value of each.
AVERAGED = {"prompt_tokens": is_count, "completion_tokens": is_count, "latency_s": is_seconds}
_CHECKED = "-v2.jsonl"  # how the names of segments end whose lines have checksums; earlier ones have none
# Found without parsing the row, to leave most of them out. Inside a string the quote before the colon has a backslash
# before it, so that no text of a model can look like this; what is counted is read from the parsed row.
_PARTICIPANT = re.compile(rb'"participant": "([a-z0-9.-]+)"')


class LockGivenUp(Exception):
    """Waiting for a lock was stopped."""


def settles(row: Mapping[str, Any]) -> bool:
    """Whether a row settles its key: a failed call is kept for the record, and asked again."""
    return row["outcome"] not in FAILED


@dataclass
class Known:
    """What a ledger holds for one evaluation: the newest row of each key (a failure never takes the place of an
    answer), and what a person should know of lines that are not believed, or not all of them: by place (file:line)."""

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


def _totals_of(segment: Path) -> dict[str, Totals]:
    """What the rows of a segment add up to, by participant. Of a long one it is kept beside it, and counted again where
    it is not of this very file: a ledger of a million rows would else take seconds at the start of each run."""
    found, kept = segment.stat(), segment.with_name(f".{segment.name}.totals")
    stamp = f"{found.st_size} {found.st_mtime_ns}"
    if found.st_size >= _LONG and kept.is_file():
        (line, *_) = [*read_checked(kept)] or [None]
        told = json.loads(line.content) if line is not None and line.whole else {}
        if told.get("of") == stamp:
            return {participant: _as_totals(its) for participant, its in told["totals"].items()}
    totals: dict[str, Totals] = {}
    for line in _lines(segment):
        if not line.torn:  # what a crash cut off stands in the journal
            row = _parsed(line)
            its = totals.setdefault(_participant(row, line.content), Totals())
            for _ in range(1 if row else max(1, line.content.count(_KEY))):  # rows whose line ends are gone
                its.add(row)
    if found.st_size >= _LONG:
        with suppress(TrapsError):  # a study that can only be read is counted again next time
            told = {"of": stamp, "totals": {name: asdict(its) for name, its in totals.items()}}
            write_bytes(kept, checked_line(told))
    return totals


def _as_totals(kept: Mapping[str, Any]) -> Totals:
    return Totals(**{**kept, "means": {column: tuple(mean) for column, mean in kept["means"].items()}})


class Ledger:
    """Append-only rows by key, one folder an evaluation: `<root>/<kind>/<evaluation>/<segment>.jsonl`."""

    def __init__(self, root: Path, kind: str) -> None:
        self.root, self.kind = root, kind

    def folder(self, evaluation: str) -> Path:
        """Where an evaluation's segments lie."""
        return self.root / self.kind / evaluation

    def read(self, evaluation: str, wanted: Container[str] | None = None) -> Known:
        """The rows of an evaluation, or those of the wanted keys: the others are neither parsed nor held in memory.

        A torn last line of a segment, a line that is not what was written, and values that no table can hold are noted
        and not believed. In a segment of version 0.1.0, whose lines have no checksums, a bad line raises TrapsError.
        """
        known = Known()
        for segment in sorted(self.folder(evaluation).glob("*.jsonl")):
            for place, row, note in _read_segment(segment, wanted):
                if note:
                    known.notes[place] = note
                if row is not None:
                    known.add(row)
        return known

    def totals(self) -> dict[str, Totals]:
        """What every row of every evaluation adds up to, by participant: repeated keys were paid for as well."""
        totals: dict[str, Totals] = {}
        for segment in sorted((self.root / self.kind).glob("*/*.jsonl")):
            for participant, its in _totals_of(segment).items():
                totals.setdefault(participant, Totals()).join(its)
        return totals

    def reasoning(self, evaluation: str, wanted: Container[str] | None = None) -> dict[str, str]:
        """Reasoning traces by key (of the wanted keys), in sibling segments so that reading answers stays quick."""
        traces: dict[str, str] = {}
        for segment in sorted(self.folder(evaluation).glob("*.jsonl.reasoning")):
            traces.update({row["key"]: row["reasoning"] for _, row, _ in _read_segment(segment, wanted) if row})
        return traces

    @contextmanager
    def writer(self, evaluation: str) -> Iterator[SegmentWriter]:
        """A writer of a new segment; the file appears with the first row, or when it is opened."""
        second, rest = divmod(time.time_ns(), 10**9)  # one reading, so that names sort as segments were begun
        name = f"{time.strftime('%Y%m%dT%H%M%S', time.gmtime(second))}-{rest:09d}-{secrets.token_hex(3)}{_CHECKED}"
        writer = SegmentWriter(self.folder(evaluation) / name)
        try:
            yield writer
        finally:
            writer.close()

    @asynccontextmanager
    async def lock(
        self, evaluation: str, waiting: Callable[[str], None], give_up: Callable[[], bool] = lambda: False
    ) -> AsyncIterator[Callable[[], None]]:
        """Hold the evaluation's lock; while another process has it, wait and say once who holds it. The value raises
        TrapsError when it is called after the lock's file was removed.

        Raises LockGivenUp when `give_up` says so while waiting.
        """
        path, told = self.root / "locks" / f"{self.kind}-{evaluation}.lock", False
        while True:
            with _writing(path):
                descriptor = try_lock(path)
            if descriptor is not None:
                break
            if not told:
                waiting(f"{self.kind} of {evaluation} are being asked by {_holder(path)}; waiting for it to finish")
                told = True
            if give_up():
                raise LockGivenUp(evaluation)
            await asyncio.sleep(LOCK_POLL_SECONDS)
        try:
            with _writing(path):
                os.ftruncate(descriptor, 0)
                os.pwrite(descriptor, json.dumps({"pid": os.getpid(), "since": time.strftime("%H:%M:%S")}).encode(), 0)
            yield lambda: require_in_place(descriptor, path)
        finally:
            os.close(descriptor)


class SegmentWriter:
    """Appends rows to one segment. Not shared between processes or threads."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._files: dict[Path, int] = {}
        self._dirty: set[Path] = set()
        self._named = False  # whether the names of the files are on the disk
        self._unsynced, self._synced_at = 0, time.monotonic()

    def open(self) -> None:
        """Make the files now, before anything is asked whose answer they are to take. Raises TrapsError."""
        for path in (self.path, *(self._beside(name) for name in ASIDES)):
            self._file(path)

    def _beside(self, name: str) -> Path:
        return self.path.with_suffix(f".jsonl.{name}")

    def append(self, row: Mapping[str, Any], beside: Mapping[str, str] | None = None) -> None:
        """Write one row (and what is kept beside it, by name in ASIDES) at once. Raises TrapsError when the disk is
        full; earlier rows are safe."""
        for name, text in (beside or {}).items():
            self._write(self._beside(name), {"key": row["key"], name: text})
        self._write(self.path, row)
        self._unsynced += 1
        self.sync_if_due()

    def _file(self, path: Path) -> int:
        if path not in self._files:
            with _writing(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                self._files[path] = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
                self._named = False
        return self._files[path]

    def _write(self, path: Path, row: Mapping[str, Any]) -> None:
        descriptor = self._file(path)
        with _writing(path):
            append_whole(descriptor, checked_line(row))
            self._dirty.add(path)

    def sync_if_due(self) -> None:
        """Sync to disk when 100 rows or 0.5 s have passed since the last time."""
        if self._unsynced and (self._unsynced >= SYNC_ROWS or time.monotonic() - self._synced_at >= SYNC_SECONDS):
            self.sync()

    def sync(self) -> None:
        """Sync what was written."""
        while self._dirty:
            path = self._dirty.pop()
            with _writing(path):
                os.fsync(self._files[path])
        if self._files and not self._named:  # without a file, not even the folder need be there
            for folder in (self.path.parent, self.path.parent.parent):
                with _writing(folder):
                    sync_folder(folder)
            self._named = True
        self._unsynced, self._synced_at = 0, time.monotonic()

    def close(self) -> None:
        """Sync and close; a file that nothing was written to goes."""
        try:
            if self._unsynced:
                self.sync()
        finally:
            while self._files:
                path, descriptor = self._files.popitem()
                if os.fstat(descriptor).st_size == 0:
                    path.unlink(missing_ok=True)
                os.close(descriptor)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn a full or broken disk into a sentence."""
    try:
        yield
    except OSError as error:
        raise TrapsError(
            f"{path}: could not be written ({error.strerror}); {remedy(error)} and run the same command again: "
            "everything answered before is kept, only what was in flight is asked again"
        ) from error


def damaged_lines(path: Path) -> list[int]:
    """Numbers of the lines of a segment, of what is kept beside it, or of the journal that are not what was written."""
    lines = read_checked(path) if path.name == JOURNAL else _lines(path)
    return [line.number for line in lines if not line.whole]


def _lines(path: Path) -> Iterator[Line]:
    """The lines of a segment. One of an early segment, which has no checksums, counts as whole if it is complete."""
    if path.name.removesuffix(path.suffix if path.suffix != ".jsonl" else "").endswith(_CHECKED):
        yield from read_checked(path)
        return
    with path.open("rb") as stream:
        for number, line in enumerate(stream, start=1):
            yield Line(number, line, line.endswith(b"\n"), torn=not line.endswith(b"\n"))


def _read_segment(
    path: Path, wanted: Container[str] | None = None
) -> Iterator[tuple[str, dict[str, Any] | None, str | None]]:
    """The place of each line, its row, and what is to be said of it."""
    for line in _lines(path):
        place = f"{path}:{line.number}"
        if not line.whole:
            what = "torn last line ignored (a crash cut it off)" if line.torn else f"{NOT_WHOLE}: it is not believed"
            yield place, None, f"{what}; its answer is asked again"
        elif wanted is None or not line.content.startswith(_KEY) or _key(line.content) in wanted:
            try:
                row, healed = _row(line.content)
            except (ValueError, KeyError, TypeError) as error:
                raise TrapsError(
                    f"{place}: not a ledger row ({error!r}); remove that line and run again: its answer "
                    "will be asked anew, all others are kept"
                ) from error
            yield place, row, f"{', '.join(healed)}: no possible value, counted as unknown" if healed else None


def _parsed(line: Line) -> dict[str, Any] | None:
    """What a line says, for counting; None if it says nothing that is to be believed."""
    try:
        row = json.loads(line.content) if line.whole else None
    except ValueError:
        return None
    return row if isinstance(row, dict) else None


def _row(line: bytes) -> tuple[dict[str, Any], list[str]]:
    """A row, and the names of values in it that were not possible."""
    row = json.loads(line)
    row["key"]
    row.pop("sum", None)
    return row, heal(row)


def _participant(row: Mapping[str, Any] | None, line: bytes) -> str:
    """Whose call a line tells of, as far as it can be told."""
    components = (row or {}).get("components")
    name = components.get("participant") if isinstance(components, Mapping) else None
    found = _PARTICIPANT.search(line)
    return name if isinstance(name, str) else found[1].decode() if found else "unknown"


def _key(line: bytes) -> str:
    return line[len(_KEY) : line.index(b'"', len(_KEY))].decode("ascii", "replace")


def _holder(path: Path) -> str:
    try:
        holder = json.loads(path.read_text() or "{}")
    except (OSError, ValueError):
        holder = {}
    return f"process {holder.get('pid', '?')} since {holder.get('since', '?')}"
