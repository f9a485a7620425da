"""The ledger of one machine: files in the study's folder.

One JSON line a row. A segment has one writer; each line reaches the kernel at once (survives kill -9) and the disk
every 0.5 s or 100 rows (survives power loss). A torn last line is ignored and counted: that answer is asked again. An
OS lock per evaluation keeps two runs from asking the same key at the same time; the kernel frees it when its holder
dies.
"""

from __future__ import annotations

import asyncio
import json
import os
import secrets
import shutil
import time
from collections.abc import AsyncIterator, Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import remedy, require_in_place, sync_folder, try_lock, write_bytes
from traps_pipeline.storage.ledger import (
    ASIDES,
    SYNC_ROWS,
    SYNC_SECONDS,
    GiveUp,
    Known,
    Ledger,
    LockGivenUp,
    Stored,
    Totals,
    Waiting,
    Writer,
    never,
    participant_of,
    row_of,
    settles,
)
from traps_pipeline.storage.lines import NOT_WHOLE, Line, append_whole, checked_line, read_checked

LOCK_POLL_SECONDS = 0.1
JOURNAL = "in_flight.jsonl"  # beside the segments' folders: calls that no row tells of yet (`models.budget`)
_KEY = b'{"key": "'  # how every row begins
_LONG = 2**18  # bytes of a segment whose totals are kept
_CHECKED = "-v2.jsonl"  # how the names of segments end whose lines have checksums; earlier ones have none


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
            its = totals.setdefault(participant_of(row, line.content), Totals())
            for _ in range(1 if row else max(1, line.content.count(_KEY))):  # rows whose line ends are gone
                its.add(row)
    if found.st_size >= _LONG:
        with suppress(TrapsError):  # a study that can only be read is counted again next time
            told = {"of": stamp, "totals": {name: asdict(its) for name, its in totals.items()}}
            write_bytes(kept, checked_line(told))
    return totals


def _as_totals(kept: Mapping[str, Any]) -> Totals:
    return Totals(**{**kept, "means": {column: tuple(mean) for column, mean in kept["means"].items()}})


class SegmentLedger(Ledger):
    """Append-only rows by key, one folder an evaluation: `<root>/<kind>/<evaluation>/<segment>.jsonl`."""

    def __init__(self, root: Path, kind: str) -> None:
        super().__init__(kind)
        self.root = root

    def folder(self, evaluation: str) -> Path:
        """Where an evaluation's segments lie."""
        return self.root / self.kind / evaluation

    def read(self, evaluation: str, wanted: Collection[str] | None = None) -> Known:
        """See `Ledger.read`. A torn last line of a segment is noted. In a segment of version 0.1.0, whose lines have no
        checksums, a bad line raises TrapsError."""
        known = Known()
        for segment in sorted(self.folder(evaluation).glob("*.jsonl")):
            for place, row, note in _read_segment(segment, wanted):
                if note:
                    known.notes[place] = note
                if row is not None:
                    known.add(row)
        return known

    def totals(self) -> dict[str, Totals]:
        """See `Ledger.totals`."""
        totals: dict[str, Totals] = {}
        for segment in sorted((self.root / self.kind).glob("*/*.jsonl")):
            for participant, its in _totals_of(segment).items():
                totals.setdefault(participant, Totals()).join(its)
        return totals

    def reasoning(self, evaluation: str, wanted: Collection[str] | None = None) -> dict[str, str]:
        """See `Ledger.reasoning`. Traces lie in sibling segments, so that reading answers stays quick."""
        traces: dict[str, str] = {}
        for segment in sorted(self.folder(evaluation).glob("*.jsonl.reasoning")):
            traces.update({row["key"]: row["reasoning"] for _, row, _ in _read_segment(segment, wanted) if row})
        return traces

    @contextmanager
    def writer(self, evaluation: str, held: Callable[[], None] = lambda: None) -> Iterator[SegmentWriter]:
        """A writer of a new segment; the file appears with the first row, or when it is opened. held: raises
        TrapsError when no other call is to be sent."""
        second, rest = divmod(time.time_ns(), 10**9)  # one reading, so that names sort as segments were begun
        name = f"{time.strftime('%Y%m%dT%H%M%S', time.gmtime(second))}-{rest:09d}-{secrets.token_hex(3)}{_CHECKED}"
        writer = SegmentWriter(self.folder(evaluation) / name, held)
        try:
            yield writer
        finally:
            writer.close()

    @asynccontextmanager
    async def writing(self, evaluation: str, waiting: Waiting, give_up: GiveUp = never) -> AsyncIterator[Writer]:
        """See `Ledger.writing`. A writer may not go on when the file of its lock was removed."""
        async with self.lock(evaluation, waiting, give_up) as held:
            with self.writer(evaluation, held) as writer:
                yield writer

    @asynccontextmanager
    async def lock(
        self, evaluation: str, waiting: Waiting, give_up: GiveUp = never
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

    async def store(self, rows: Mapping[str, Sequence[Stored]], waiting: Waiting) -> int:
        """See `Ledger.store`. Rows are written beside the ledger first and then moved in, which takes no more space."""
        new, staged = 0, SegmentLedger(self.root / f"importing-{secrets.token_hex(4)}", self.kind)
        async with AsyncExitStack() as locks:
            for evaluation in sorted(rows):
                await locks.enter_async_context(self.lock(evaluation, waiting))
            try:
                for evaluation, mine in rows.items():
                    known = self.read(evaluation).settled
                    with staged.writer(evaluation) as writer:
                        for row, beside in mine:
                            if row["key"] not in known:
                                writer.append(row, beside)
                                new += settles(row)
                # What stands beside rows goes first: a row without its reasoning would be taken for one that has none.
                for path in sorted(staged.root.rglob("*.jsonl*"), key=lambda path: path.suffix == ".jsonl"):
                    target = self.root / path.relative_to(staged.root)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    path.replace(target)
                    sync_folder(target.parent)
            finally:
                shutil.rmtree(staged.root, ignore_errors=True)
        return new

    def evaluations(self) -> list[str]:
        """See `Ledger.evaluations`."""
        return sorted({path.parent.name for path in (self.root / self.kind).glob("*/*.jsonl")})

    def rows(self, evaluation: str) -> Iterator[Stored]:
        """See `Ledger.rows`."""
        for segment in sorted(self.folder(evaluation).glob("*.jsonl")):
            beside: dict[str, dict[str, str]] = {}
            for name in ASIDES:
                path = segment.with_suffix(f".jsonl.{name}")
                for row in _whole_rows(path) if path.exists() else ():
                    beside.setdefault(row["key"], {})[name] = row[name]
            for row in _whole_rows(segment):
                yield row, beside.get(row["key"], {})

    def damage(self) -> Iterator[str]:
        """See `Ledger.damage`."""
        for path in sorted((self.root / self.kind).glob("*/*.jsonl*")):
            if lines := damaged_lines(path):
                yield f"{path}: line {', '.join(map(str, lines))}: {NOT_WHOLE}, and not believed"


class SegmentWriter(Writer):
    """Appends rows to one segment. Not shared between processes; used by one thread at a time."""

    def __init__(self, path: Path, held: Callable[[], None] = lambda: None) -> None:
        self.path, self._held = path, held
        self._files: dict[Path, int] = {}
        self._dirty: set[Path] = set()
        self._named = False  # whether the names of the files are on the disk
        self._unsynced, self._synced_at = 0, time.monotonic()

    async def require(self) -> None:
        """See `Writer.require`."""
        self._held()

    def open(self) -> None:
        """See `Writer.open`. Makes the files."""
        for path in (self.path, *(self._beside(name) for name in ASIDES)):
            self._file(path)

    def _beside(self, name: str) -> Path:
        return self.path.with_suffix(f".jsonl.{name}")

    def append(self, row: Mapping[str, Any], beside: Mapping[str, str] | None = None) -> None:
        """See `Writer.append`. The row is written at once. Raises TrapsError when the disk is full; earlier rows are
        safe."""
        for name, text in (beside or {}).items():
            self._write(self._beside(name), {"key": row["key"], name: text})
        self._write(self.path, row)
        self._unsynced += 1
        self.sync_if_due()

    async def kept(self) -> None:
        """See `Writer.kept`. The kernel has what was appended."""

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
        """See `Writer.sync_if_due`: after 100 rows, or 0.5 s."""
        if self._unsynced and (self._unsynced >= SYNC_ROWS or time.monotonic() - self._synced_at >= SYNC_SECONDS):
            self.sync()

    def sync(self) -> None:
        """See `Writer.sync`."""
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

    def finish(self) -> None:
        """See `Writer.finish`. They lie there already."""

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
    path: Path, wanted: Collection[str] | None = None
) -> Iterator[tuple[str, dict[str, Any] | None, str | None]]:
    """The place of each line, its row, and what is to be said of it."""
    for line in _lines(path):
        place = f"{path}:{line.number}"
        if not line.whole:
            what = "torn last line ignored (a crash cut it off)" if line.torn else f"{NOT_WHOLE}: it is not believed"
            yield place, None, f"{what}; its answer is asked again"
        elif wanted is None or not line.content.startswith(_KEY) or _key(line.content) in wanted:
            try:
                row, healed = row_of(line.content)
            except (ValueError, KeyError, TypeError) as error:
                raise TrapsError(
                    f"{place}: not a ledger row ({error!r}); remove that line and run again: its answer "
                    "will be asked anew, all others are kept"
                ) from error
            yield place, row, f"{', '.join(healed)}: no possible value, counted as unknown" if healed else None


def _whole_rows(path: Path) -> Iterator[dict[str, Any]]:
    """The rows of a segment, or of what is kept beside it, that are what was written."""
    for line in _lines(path):
        row = _parsed(line)
        if row is not None and "key" in row:
            row.pop("sum", None)
            yield row


def _parsed(line: Line) -> dict[str, Any] | None:
    """What a line says, for counting; None if it says nothing that is to be believed."""
    try:
        row = json.loads(line.content) if line.whole else None
    except ValueError:
        return None
    return row if isinstance(row, dict) else None


def _key(line: bytes) -> str:
    return line[len(_KEY) : line.index(b'"', len(_KEY))].decode("ascii", "replace")


def _holder(path: Path) -> str:
    try:
        holder = json.loads(path.read_text() or "{}")
    except (OSError, ValueError):
        holder = {}
    return f"process {holder.get('pid', '?')} since {holder.get('since', '?')}"
