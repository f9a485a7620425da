"""Map a study's paths to current objects, by rows of its ledger's database.

The rows of one change are written in one transaction. Changes are numbered, under a lock that lasts until the commit,
so that a process that asks for changes after the last number it has seen misses none.
"""

from __future__ import annotations

import threading
import time
from bisect import bisect_left, insort
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects.postgresql import insert

from traps_pipeline.ledger.postgres import PostgresDatabase

LARGE_FOLDERS = ("clips/", "media/")  # folders whose names are only looked up one by one: there may be millions
FRESH_S = 0.5  # minimum age of the last look before the rows are read again
REMOVAL_S = 15.0  # a process that held its lock for longer was suspended, and removes nothing
_TABLES_LOCK = 7_206_551_933  # PostgreSQL's lock while a process creates the tables
_METADATA = sa.MetaData()
# removals: the number of removals so far; content uploaded earlier may have been removed by one.
_CHANGES = sa.Table(
    "traps_changes",
    _METADATA,
    sa.Column("study", sa.Text, primary_key=True),
    sa.Column("number", sa.BigInteger, nullable=False),
    sa.Column("removals", sa.BigInteger, nullable=False),
)
_OBJECTS = sa.Table(
    "traps_objects",
    _METADATA,
    sa.Column("study", sa.Text, primary_key=True),
    sa.Column("name", sa.Text, primary_key=True),
    sa.Column("digest", sa.LargeBinary),  # null: the name was removed
    sa.Column("size", sa.BigInteger),
    sa.Column("note", sa.Text),
    sa.Column("number", sa.BigInteger, nullable=False),  # number of the change
    sa.Column("at", sa.DateTime(timezone=True), nullable=False, server_default=sa.func.clock_timestamp()),
    sa.Index("traps_objects_number", "study", "number"),
)


@dataclass(frozen=True, slots=True)
class CurrentObject:
    """A path's current object; size in bytes, time in ns (0 before it is named)."""

    digest: bytes
    size: int
    note: str | None = None
    at_ns: int = 0


class ObjectNames:
    """The paths of a study's files and their current objects; thread-safe."""

    def __init__(self, database: PostgresDatabase, study: str) -> None:
        self._database, self._study = database, study
        self._rows: dict[str, CurrentObject] = {}
        self._sorted: list[str] = []  # names of these rows
        self._asked = set[str]()  # names in MANY that were looked up; later changes arrive in any case
        self._number, self._looked_at = -1, float("-inf")
        self._guard = threading.RLock()
        self.removals = 0  # the last change that this process has seen
        database.run(_create_tables)

    def look(self, age_s: float = 0.0) -> None:
        """Read other hosts' changes, unless this process did so less than `age_s` ago."""
        with self._guard:
            if time.monotonic() - self._looked_at <= age_s:
                return
            began, is_first = time.monotonic(), self._number < 0

            def work(connection: sa.Connection) -> tuple[Any, Sequence[Any]]:
                # Read the number first: later commits are seen now or, once more, the next time.
                change = connection.execute(sa.select(_CHANGES).where(_CHANGES.c.study == self._study)).one_or_none()
                few = sa.and_(*(~_OBJECTS.c.name.startswith(folder) for folder in LARGE_FOLDERS))
                return change, self._select(connection, few if is_first else _OBJECTS.c.number > self._number)

            change, rows = self._database.run(work)
            self._take(rows)
            newest = [row.number for row in rows] if not is_first else [change.number if change is not None else 0]
            self._number = max([self._number, *newest])
            self.removals = change.removals if change is not None else 0
            self._looked_at = began

    def _select(self, connection: sa.Connection, condition: Any) -> Sequence[Any]:
        return connection.execute(sa.select(_OBJECTS).where(_OBJECTS.c.study == self._study, condition)).all()

    def _take(self, rows: Iterable[Any]) -> None:
        for row in rows:
            if row.digest is None:
                if self._rows.pop(row.name, None) is not None:
                    del self._sorted[bisect_left(self._sorted, row.name)]
                continue
            if row.name not in self._rows:
                insort(self._sorted, row.name)
            at_ns = int(row.at.timestamp() * 1e6) * 1000
            self._rows[row.name] = CurrentObject(bytes(row.digest), row.size, row.note, at_ns)

    def current(self, names: Collection[str]) -> dict[str, CurrentObject]:
        """Return the current objects of these names, if they have one."""
        with self._guard:
            self.look(FRESH_S)
            if new := sorted({name for name in names if name.startswith(LARGE_FOLDERS)} - self._asked):
                self._take(self._database.run(lambda c: self._select(c, _OBJECTS.c.name.in_(new))))
                self._asked |= {*new}
            return {name: self._rows[name] for name in names if name in self._rows}

    def below(self, folder: str) -> list[str]:
        """Return the names below a folder, sorted."""
        start, end = f"{folder}/", f"{folder}0"  # 0 comes after /
        with self._guard:
            self.look(FRESH_S)
            if start.startswith(LARGE_FOLDERS):
                condition = _OBJECTS.c.name.startswith(start, autoescape=True)
                self._take(self._database.run(lambda c: self._select(c, condition)))
            return self._sorted[bisect_left(self._sorted, start) : bisect_left(self._sorted, end)]

    def naming(self, digests: Collection[bytes] | None = None) -> dict[str, bytes]:
        """Query the names of all objects (or of these), with their digests."""
        condition = _OBJECTS.c.digest.is_not(None) if digests is None else _OBJECTS.c.digest.in_(digests)
        return {row.name: bytes(row.digest) for row in self._database.run(lambda c: self._select(c, condition))}

    def change(self, changed: Mapping[str, CurrentObject | None], removals: int) -> int:
        """Set or remove names' current objects in one transaction; return `removals`.

        removals: the number of removals before the objects were uploaded. If there are more by now, nothing is changed,
        and their number is returned: upload the objects again.
        """
        values = [
            {"study": self._study, "name": name, "digest": None, "size": None, "note": None}
            | ({} if row is None else {"digest": row.digest, "size": row.size, "note": row.note})
            for name, row in changed.items()
        ]

        def work(connection: sa.Connection) -> int:
            number, now = self._next_change(connection)
            if now == removals:
                upsert = insert(_OBJECTS)
                new = {name: upsert.excluded[name] for name in ("digest", "size", "note", "number")}
                upsert = upsert.on_conflict_do_update(
                    index_elements=["study", "name"], set_={**new, "at": sa.func.clock_timestamp()}
                )
                connection.execute(upsert, [value | {"number": number} for value in values])
            return now

        if not changed:
            return removals
        now = self._database.run(work)
        self.look()
        return now

    def _next_change(self, connection: sa.Connection, *, removals: int = 0) -> tuple[int, int]:
        """Number a change, locking names until the commit; return it and the removals."""
        upsert = insert(_CHANGES).values(study=self._study, number=1, removals=removals)
        upsert = upsert.on_conflict_do_update(
            index_elements=["study"],
            set_={"number": _CHANGES.c.number + 1, "removals": _CHANGES.c.removals + removals},
        )
        row = connection.execute(upsert.returning(_CHANGES.c.number, _CHANGES.c.removals)).one()
        return row.number, row.removals

    def remove(self, digests: Collection[bytes], delete: Callable[[Sequence[bytes]], None]) -> list[bytes]:
        """Delete objects, except those that are named by now; return the deleted ones.

        No object is named meanwhile, and a process that has uploaded one earlier uploads it again.
        """

        def work(connection: sa.Connection) -> list[bytes]:
            began = time.monotonic()
            self._next_change(connection, removals=1)
            named = {bytes(row.digest) for row in self._select(connection, _OBJECTS.c.digest.in_(digests))}
            unnamed = [digest for digest in digests if digest not in named]
            if time.monotonic() - began > REMOVAL_S:
                return []  # the server may have ended the session, and thus the lock, meanwhile
            delete(unnamed)
            return unnamed

        return self._database.run(work)


def _create_tables(connection: sa.Connection) -> None:
    connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_TABLES_LOCK)))
    _METADATA.create_all(connection)
