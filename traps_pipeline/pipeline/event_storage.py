"""Speed up Dagster's SQLite storage fourfold by persistent connections.

For each event Dagster makes an engine, which compiles its statements anew, and opens and closes the file. Here the
engine of a file is kept. Its commits go to SQLite's write-ahead log beside the file, which its pages do not watch,
so each commit that changes something also touches the file. `dagster.yaml` names this class; a study may name another
storage in its own `dagster.yaml`. `bench/event_storage.py` compares both: it goes once it no longer pays.
"""

import contextlib
import os
import threading
from collections.abc import Iterator
from typing import Any, cast

import sqlalchemy as db
from dagster._core.storage.event_log import SqliteEventLogStorage
from dagster._core.storage.sqlite_storage import (
    DagsterSqliteStorage,
    SqliteRunStorage,  # pyright: ignore[reportPrivateImportUsage] - a part of the storage, of another module
)
from sqlalchemy.event import listen
from sqlalchemy.exc import DBAPIError, OperationalError

from traps_pipeline.base.databases import reason_and_remedy

OPEN_FILES = 32  # at most: each run has a file of its own, and a server sees many
_BUSY_S = 30  # wait for another process's lock, as long as Dagster itself


class HistoryUnwritable(OperationalError):
    """A full, failing or read-only disk, in our own words; Dagster stores the text."""

    sentence = ""

    def __str__(self) -> str:
        return self.sentence


@contextlib.contextmanager
def _transaction(engine: db.Engine) -> Iterator[db.Connection]:
    """Commit the block's changes unless it raises. Raises HistoryUnwritable."""
    try:
        with engine.begin() as connection:
            yield connection
    except DBAPIError as error:
        reason, remedy, is_unwritable = reason_and_remedy(error)
        if not is_unwritable or error.orig is None:
            raise
        unwritable = HistoryUnwritable(None, None, error.orig)
        unwritable.sentence = (
            f"{engine.url.database}: Dagster's history could not be written ({reason}); {remedy} and run the same "
            "command again: tables are whole, no answer is lost"
        )
        raise unwritable from None


def _count_changes(connection: db.Connection) -> int:
    """Return how many rows this connection has changed since it was opened."""
    return connection.connection.driver_connection.total_changes  # pyright: ignore[reportOptionalMemberAccess]


def _persistent_engine(address: str) -> db.Engine:
    engine = db.create_engine(address, connect_args={"timeout": _BUSY_S})
    # A power cut may lose the last events, never the history; the tables' footers are authoritative.
    listen(engine, "connect", lambda connection, _: connection.execute("PRAGMA synchronous=NORMAL"))
    return engine


class _EventStorage(SqliteEventLogStorage):
    def __init__(self, base_dir: str) -> None:
        self._engines: dict[str, db.Engine] = {}
        self._engines_lock = threading.Lock()  # threads of a web server ask at once
        super().__init__(base_dir)

    @contextlib.contextmanager
    def _connect(self, shard: str) -> Iterator[db.Connection]:
        with self._db_lock:
            if shard not in self._initialized_dbs:
                self._initdb(self._engine(shard))
                self._initialized_dbs.add(shard)
            engine = self._engine(shard)
            with _transaction(engine) as connection:
                n_changes = _count_changes(connection)
                yield connection
                is_changed = _count_changes(connection) != n_changes
            if is_changed:
                with contextlib.suppress(FileNotFoundError):
                    os.utime(self.path_for_shard(shard))

    def _engine(self, shard: str) -> db.Engine:
        with self._engines_lock:
            if shard not in self._engines:
                if len(self._engines) >= OPEN_FILES:
                    self._engines.pop(next(iter(self._engines))).dispose()
                self._engines[shard] = _persistent_engine(self.conn_string_for_shard(shard))
            return self._engines[shard]

    def dispose(self) -> None:
        super().dispose()
        with self._engines_lock:
            while self._engines:
                self._engines.popitem()[1].dispose()


class _RunStorage(SqliteRunStorage):
    engine: db.Engine

    @contextlib.contextmanager
    def connect(self) -> Iterator[db.Connection]:
        with _transaction(self.engine) as connection:
            yield connection


class SqliteStorage(DagsterSqliteStorage):
    """Dagster's SQLite storage with connections that are kept. base_dir: `$DAGSTER_HOME`."""

    def __init__(self, base_dir: str, inst_data: Any = None) -> None:
        super().__init__(base_dir, inst_data)
        events, runs = cast(SqliteEventLogStorage, self._event_log_storage), cast(SqliteRunStorage, self._run_storage)
        self._event_log_storage = _EventStorage(events._base_dir)
        self._run_storage = _RunStorage(runs._conn_string)
        self._run_storage.engine = _persistent_engine(runs._conn_string)

    @classmethod
    def from_config_value(cls, inst_data: Any, config_value: Any) -> "SqliteStorage":
        """Create the storage from `dagster.yaml`, as Dagster requires."""
        return cls.from_local(inst_data=inst_data, **config_value)
