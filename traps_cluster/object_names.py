"""Map a study's paths to current objects, by rows of its ledger's database.

The rows of one change are written in one transaction. Changes are numbered, under a lock that lasts until the commit,
so that a process that asks for changes after the last number it has seen misses none.
"""

from __future__ import annotations

import threading
import time
from bisect import bisect_left
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects.postgresql import ARRAY, insert

from traps_cluster.postgres import PostgresDatabase

LARGE_FOLDERS = ("clips/", "media/")  # folders whose names are not kept in memory: there may be millions
FRESH_S = 0.5  # minimum age of the last look before the rows are read again
REMOVAL_S = 15.0  # a process that held its lock for longer was suspended, and removes nothing
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
_IS_LARGE = sa.or_(*(_OBJECTS.c.name.startswith(folder) for folder in LARGE_FOLDERS))


@dataclass(frozen=True, slots=True)
class CurrentObject:
    """A path's current object; size in bytes, time in ns (0 before it is named)."""

    digest: bytes
    size: int
    note: str | None = None
    at_ns: int = 0


class ObjectNames:
    """The paths of a study's files and their current objects; thread-safe."""

    def __init__(self, database: PostgresDatabase) -> None:
        self._database, self._study = database, database.study_name
        self._small: dict[str, CurrentObject | None] = {}  # outside the large folders; None: removed
        self._sorted: list[str] = []  # names of those that are not removed
        self._number, self._looked_at = -1, float("-inf")
        self._guard = threading.RLock()
        self.removals = 0  # the last change that this process has seen
        database.run(lambda connection: (database.lock_schema(connection), _METADATA.create_all(connection)))

    def look(self, age_s: float = 0.0) -> None:
        """Read other hosts' changes, unless this process did so less than `age_s` ago."""
        with self._guard:
            if time.monotonic() - self._looked_at <= age_s:
                return
            began, is_newer = time.monotonic(), _OBJECTS.c.number > self._number
            # The number is read first: later commits are seen now or, once more, the next time.
            change, rows = self._database.run(lambda c: (self._change_of(c), self._select(c, is_newer, ~_IS_LARGE)))
            self._small |= {row.name: _current(row) for row in rows}
            if rows:
                self._sorted = sorted(name for name, row in self._small.items() if row is not None)
            if change is not None:
                self._number, self.removals = change.number, change.removals
            self._looked_at = began

    def _change_of(self, connection: sa.Connection) -> Any:
        return connection.execute(sa.select(_CHANGES).where(_CHANGES.c.study == self._study)).one_or_none()

    def _select(self, connection: sa.Connection, *conditions: sa.ColumnElement[bool]) -> Sequence[Any]:
        return connection.execute(sa.select(_OBJECTS).where(_OBJECTS.c.study == self._study, *conditions)).all()

    def _query(self, *conditions: sa.ColumnElement[bool]) -> dict[str, CurrentObject]:
        current = {row.name: _current(row) for row in self._database.run(lambda c: self._select(c, *conditions))}
        return {name: row for name, row in current.items() if row is not None}

    def current(self, names: Collection[str]) -> dict[str, CurrentObject]:
        """Return the current objects of these names, if they have one."""
        with self._guard:
            self.look(FRESH_S)
            small = {name: row for name in names if (row := self._small.get(name)) is not None}
        large = [name for name in names if name.startswith(LARGE_FOLDERS)]
        return small | (self._query(_is_one_of(_OBJECTS.c.name, large)) if large else {})

    def below(self, folder: str) -> list[str]:
        """Return the names below a folder, sorted."""
        start, end = f"{folder}/", f"{folder}0"  # 0 comes after /
        if start.startswith(LARGE_FOLDERS):
            return sorted(self._query(_OBJECTS.c.name.startswith(start, autoescape=True)))
        with self._guard:
            self.look(FRESH_S)
            return self._sorted[bisect_left(self._sorted, start) : bisect_left(self._sorted, end)]

    def naming(self, digests: Collection[bytes] | None = None) -> dict[str, CurrentObject]:
        """Query the names of all objects (or of these), and the objects."""
        return self._query(*([] if digests is None else [_is_one_of(_OBJECTS.c.digest, digests)]))

    def change(self, changed: Mapping[str, CurrentObject | None], removals: int, again: Callable[[], None]) -> None:
        """Set or remove names' current objects in one transaction.

        removals: the number of removals before the objects were uploaded. If there are more by now, `again` uploads
        them again, while nobody can remove them.
        """

        def work(connection: sa.Connection) -> None:
            number, now = self._next_change(connection)
            if now != removals:
                again()
            same, upsert = {"study": self._study, "number": number}, insert(_OBJECTS)
            values = [
                {**same, "name": name, "digest": row and row.digest, "size": row and row.size, "note": row and row.note}
                for name, row in changed.items()
            ]
            new: dict[str, Any] = {column: upsert.excluded[column] for column in ("digest", "size", "note", "number")}
            new["at"] = sa.func.clock_timestamp()
            connection.execute(upsert.on_conflict_do_update(index_elements=["study", "name"], set_=new), values)

        if changed:
            self._database.run(work)
            self.look()

    def _next_change(self, connection: sa.Connection, *, removals: int = 0) -> tuple[int, int]:
        """Number a change, locking names until the commit; return it and the removals."""
        new = {"number": _CHANGES.c.number + 1, "removals": _CHANGES.c.removals + removals}
        upsert = insert(_CHANGES).values(study=self._study, number=1, removals=removals)
        upsert = upsert.on_conflict_do_update(index_elements=["study"], set_=new)
        row = connection.execute(upsert.returning(_CHANGES.c.number, _CHANGES.c.removals)).one()
        return row.number, row.removals

    def remove(self, digests: Collection[bytes], delete: Callable[[Sequence[bytes]], None]) -> list[bytes]:
        """Delete objects, except those that are named by now; return the deleted ones.

        No object is named meanwhile, and a process that has uploaded one earlier uploads it again.
        """

        def work(connection: sa.Connection) -> list[bytes]:
            began = time.monotonic()
            self._next_change(connection, removals=1)
            named = {bytes(row.digest) for row in self._select(connection, _is_one_of(_OBJECTS.c.digest, digests))}
            unnamed = [digest for digest in digests if digest not in named]
            if time.monotonic() - began > REMOVAL_S:
                return []  # the server may have ended the session, and thus the lock, meanwhile
            delete(unnamed)
            return unnamed

        return self._database.run(work)


def _current(row: Any) -> CurrentObject | None:
    at_ns = int(row.at.timestamp() * 1e6) * 1000
    return None if row.digest is None else CurrentObject(bytes(row.digest), row.size, row.note, at_ns)


def _is_one_of(column: sa.Column[Any], values: Collection[Any]) -> sa.ColumnElement[bool]:
    """Return `column = any(values)`: one value of the statement, which takes 65,535."""
    return column == sa.any_(sa.literal([*values], ARRAY(column.type)))
