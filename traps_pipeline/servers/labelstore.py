"""Store labels of `traps people annotate` in SQLite and an append-only file.

A label is committed, appended to `labels.jsonl` and synced to disk before it is confirmed, so that a kill loses no
confirmed label. A label that a kill leaves between the two steps is appended when the store is next opened; if the
database is lost, labels are restored from the file.
"""

import fcntl
import hmac
import json
import os
import secrets
import sqlite3
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from traps_pipeline.base.databases import reason_and_remedy
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import sync_folder
from traps_pipeline.people.human_label_rows import LABELS_FILE
from traps_pipeline.people.labels import label_lines
from traps_pipeline.storage.lines import append_whole, line_with_checksum

DATABASE = "labels.sqlite"
HANDLE_DIGITS = 24
_TAIL = 1 << 14  # bytes at the file's end that contain the last label
_SCHEMA = """
CREATE TABLE IF NOT EXISTS secrets (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS shown (
  who TEXT NOT NULL, task TEXT NOT NULL, unit TEXT NOT NULL, scenario_id TEXT NOT NULL, at REAL NOT NULL,
  waits INTEGER NOT NULL, PRIMARY KEY (who, task, unit)
);
CREATE TABLE IF NOT EXISTS labels (
  seq INTEGER PRIMARY KEY AUTOINCREMENT, who TEXT NOT NULL, task TEXT NOT NULL, unit TEXT NOT NULL,
  at TEXT NOT NULL, seconds REAL NOT NULL, label TEXT NOT NULL
);
CREATE INDEX IF NOT EXISTS labels_of_a_person ON labels (who, task);
"""


class NotWaiting(TrapsError):
    """The error that a unit waits for no label, e.g. as another window labelled it."""


@dataclass(frozen=True)
class ShownUnit:
    """A unit shown to a person: last at `at` (s since 1970); `waits` while unlabelled."""

    task: str
    unit: str
    scenario_id: str
    at: float
    waits: bool


class LabelStore:
    """A study's labels in a shared folder. Raises TrapsError for a damaged file."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        with self._database() as database:
            database.execute("PRAGMA journal_mode=WAL")
            database.executescript(_SCHEMA)
            database.execute("INSERT OR IGNORE INTO secrets VALUES ('handles', ?)", (secrets.token_hex(32),))
            (self._secret,) = database.execute("SELECT value FROM secrets WHERE name = 'handles'").fetchone()
        self._export(restore=True)

    @contextmanager
    def _database(self) -> Iterator[sqlite3.Connection]:
        """Open a connection; commit and sync at the block's end, unless it raises."""
        try:
            with closing(sqlite3.connect(self.folder / DATABASE, timeout=30, isolation_level=None)) as database:
                database.execute("PRAGMA synchronous=FULL")
                yield database
        except sqlite3.DatabaseError as error:
            reason, remedy, is_unwritable = reason_and_remedy(error)
            if is_unwritable:
                raise TrapsError(f"{self.folder / DATABASE}: cannot be written ({reason}); {remedy}") from error
            raise TrapsError(
                f"{self.folder / DATABASE}: cannot be used ({reason}); every confirmed label is in {LABELS_FILE}: move "
                "the database away, and it is made again from there"
            ) from error

    def handle(self, who: str, task: str, unit: str) -> str:
        """Return an opaque name of a unit, different for each person's browser."""
        content = "\0".join((who, task, unit)).encode()
        return hmac.new(self._secret.encode(), content, "sha256").hexdigest()[:HANDLE_DIGITS]

    def shown(self, who: str) -> list[ShownUnit]:
        """Return the units shown to a person, in all tasks, the latest last."""
        with self._database() as database:
            rows = database.execute(
                "SELECT task, unit, scenario_id, at, waits FROM shown WHERE who = ? ORDER BY at", (who,)
            ).fetchall()
        return [
            ShownUnit(task, unit, scenario, shown_at, bool(is_waiting))
            for task, unit, scenario, shown_at, is_waiting in rows
        ]

    def show(self, who: str, task: str, unit: str, scenario_id: str, *, again: bool = False) -> bool:
        """Record that a unit is shown to a person now and waits for a label.

        Return False, and record nothing, if the person labelled it meanwhile in another window and it does not wait for
        another label. again: show it all the same.
        """
        with self._database() as database:
            shown = database.execute(
                "INSERT INTO shown SELECT :who, :task, :unit, :scenario_id, :at, 1 WHERE :again"
                " OR NOT EXISTS (SELECT 1 FROM labels WHERE who = :who AND task = :task AND unit = :unit)"
                " OR EXISTS (SELECT 1 FROM shown WHERE who = :who AND task = :task AND unit = :unit AND waits)"
                " ON CONFLICT DO UPDATE SET at = excluded.at, waits = 1",
                {"who": who, "task": task, "unit": unit, "scenario_id": scenario_id, "at": time.time(), "again": again},
            )
            return shown.rowcount == 1

    def labelled(self, who: str, task: str) -> list[str]:
        """Return the units that a person has labelled, the latest last."""
        with self._database() as database:
            rows = database.execute(
                "SELECT unit FROM labels WHERE who = ? AND task = ? GROUP BY unit ORDER BY max(seq)", (who, task)
            ).fetchall()
        return [unit for (unit,) in rows]

    def record(self, who: str, task: str, unit: str, label: Mapping[str, Any]) -> None:
        """Store a label; raise NotWaiting if the unit is not shown, or labelled meanwhile."""
        with self._database() as database:
            database.execute("BEGIN IMMEDIATE")
            row = database.execute(
                "SELECT at FROM shown WHERE who = ? AND task = ? AND unit = ? AND waits", (who, task, unit)
            ).fetchone()
            if row is None:
                database.execute("ROLLBACK")
                raise NotWaiting("this was labelled before, in another window perhaps; load the page again")
            now = time.time()
            stamp = datetime.fromtimestamp(now, UTC).isoformat(timespec="milliseconds")
            values = who, task, unit, stamp, round(max(0.0, now - row[0]), 3), json.dumps(label, ensure_ascii=False)
            columns = "who, task, unit, at, seconds, label"
            database.execute(f"INSERT INTO labels ({columns}) VALUES (?, ?, ?, ?, ?, ?)", values)
            database.execute("UPDATE shown SET waits = 0 WHERE who = ? AND task = ? AND unit = ?", (who, task, unit))
            database.execute("COMMIT")
        self._export()

    def _export(self, *, restore: bool = False) -> None:
        """Append labels that the file lacks (`restore`: first import the database's gaps)."""
        path = self.folder / LABELS_FILE
        is_new = not path.exists()
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            last = _last_seq(descriptor)
            if restore:
                self._restore(last)
            with self._database() as database:
                names = "seq, task, unit, who, at, seconds, label"
                rows = database.execute(f"SELECT {names} FROM labels WHERE seq > ? ORDER BY seq", (last,)).fetchall()
            records = [dict(zip(names.split(", "), row, strict=True)) for row in rows]
            append_whole(
                descriptor, b"".join(line_with_checksum(row | {"label": json.loads(row["label"])}) for row in records)
            )
            os.fsync(descriptor)
            if is_new:
                sync_folder(self.folder)
        finally:
            os.close(descriptor)

    def _restore(self, last: int) -> None:
        """Import the labels that are only in the file, after the database was moved away."""
        with self._database() as database:
            (latest,) = database.execute("SELECT coalesce(max(seq), 0) FROM labels").fetchone()
            if latest >= last:
                return
            lines = [line for line in label_lines(self.folder) if line.seq > latest]
            database.execute("BEGIN IMMEDIATE")
            database.executemany(
                "INSERT OR IGNORE INTO labels VALUES (?, ?, ?, ?, ?, ?, ?)",
                [
                    (e.seq, e.who, e.task, e.unit, e.at.isoformat(), e.seconds, json.dumps(e.label, ensure_ascii=False))
                    for e in lines
                ],
            )
            database.execute("COMMIT")


def _last_seq(descriptor: int) -> int:
    """Return the last label's number in the file, or 0; drop half a line of a crash."""
    size = os.lseek(descriptor, 0, os.SEEK_END)
    from_ = max(0, size - _TAIL)
    tail = os.pread(descriptor, _TAIL, from_)
    end = tail.rfind(b"\n") + 1
    if end != len(tail):
        os.ftruncate(descriptor, from_ + end)
    line = tail[:end].rstrip(b"\n").rpartition(b"\n")[2]
    try:
        return int(json.loads(line)["seq"]) if line else 0
    except (ValueError, KeyError, TypeError) as error:
        raise TrapsError(f"{LABELS_FILE}: its last line is no label ({error}); restore the file from a copy") from error
