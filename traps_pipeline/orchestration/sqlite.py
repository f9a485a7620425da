"""Dagster's own SQLite history, in Dagster's own files, at a fraction of the cost of an event.

For each event Dagster makes a SQLAlchemy engine, which compiles its statements anew, and opens and closes the file,
which writes SQLite's log back to it. Here engine and connection of a file are kept, and a commit does not wait for the
disk: a power cut may take the last events, never the history; what counts (versions, inputs) stands in the tables'
footers. Each run has a file of its own, whose tables Dagster makes by going through all its migrations; here they are
taken over from the file of all runs, which takes a twentieth of the time. `dagster.yaml` names this class; a study may
name another storage in its own.
"""

import contextlib
import threading
from collections.abc import Iterator
from functools import cache
from typing import Any, cast

import sqlalchemy as db
from alembic.script import ScriptDirectory
from dagster._core.storage.event_log.sqlite import sqlite_event_log
from dagster._core.storage.event_log.sqlite.sqlite_event_log import INDEX_SHARD_NAME, SqliteEventLogStorage
from dagster._core.storage.runs.sqlite.sqlite_run_storage import SqliteRunStorage
from dagster._core.storage.sql import get_alembic_config
from dagster._core.storage.sqlite import SQLITE_BUSY_TIMEOUT_SECONDS
from dagster._core.storage.sqlite_storage import DagsterSqliteStorage
from sqlalchemy.event import listen
from sqlalchemy.exc import DBAPIError, OperationalError

from traps_pipeline.base.databases import reason_and_remedy

FILES = 32  # kept open at most: each run has a file of its own, and a server sees many


class _Engines(dict[str, db.Engine]):
    """The engine of each file. Threads of a web server ask for it at once."""

    def __init__(self) -> None:
        super().__init__()
        self._lock = threading.Lock()

    def __missing__(self, address: str) -> db.Engine:
        with self._lock:
            if address in self:  # another thread was first
                return self[address]
            if len(self) >= FILES:
                self.pop(next(iter(self))).dispose()
            engine = db.create_engine(address, connect_args={"timeout": SQLITE_BUSY_TIMEOUT_SECONDS})
            listen(engine, "connect", lambda connection, _: connection.execute("PRAGMA synchronous=NORMAL"))
            self[address] = engine
            return engine

    def dispose(self) -> None:
        """Close all files."""
        while self:
            self.popitem()[1].dispose()


class HistoryUnwritable(OperationalError):
    """A full, failing or read-only disk. Its message is ours: Dagster prints and stores it."""

    sentence = ""

    def __str__(self) -> str:
        return self.sentence


@contextlib.contextmanager
def _transaction(engine: db.Engine) -> Iterator[db.Connection]:
    """A connection whose changes are committed when the block ends without an error. Raises HistoryUnwritable."""
    try:
        with engine.begin() as connection:
            yield connection
    except DBAPIError as error:
        why, what, is_unwritable = reason_and_remedy(error)
        if not is_unwritable or error.orig is None:
            raise
        told = HistoryUnwritable(None, None, error.orig)
        told.sentence = (
            f"{engine.url.database}: Dagster's history could not be written ({why}); {what} and run the same command "
            "again: tables are whole, no answer is lost"
        )
        raise told from None


class _Events(SqliteEventLogStorage):
    def __init__(self, base_dir: str) -> None:
        self.engines = _Engines()
        super().__init__(base_dir)

    @contextlib.contextmanager
    def _connect(self, shard: str) -> Iterator[db.Connection]:
        with self._db_lock:
            engine = self.engines[self.conn_string_for_shard(shard)]
            if shard not in self._initialized_dbs:
                self._initdb(engine)
                self._initialized_dbs.add(shard)
            with _transaction(engine) as connection:
                yield connection

    def _initdb(self, engine: db.Engine, for_index_shard: bool = False) -> None:
        if for_index_shard or not self._is_made(engine):
            super()._initdb(engine, for_index_shard)

    def _is_made(self, engine: db.Engine) -> bool:
        """Whether a file has its tables, be it from now on. It is left to Dagster where another process is making them,
        and where the index has those of an older Dagster."""
        index = self.engines[self.conn_string_for_shard(INDEX_SHARD_NAME)]
        with contextlib.suppress(OperationalError), engine.connect() as connection:
            if _revision(connection) is not None:
                return True
            with index.connect() as source:
                revision = _revision(source)
                statements = source.exec_driver_sql(_STATEMENTS).scalars().all()
            if revision == _newest():
                connection.exec_driver_sql("PRAGMA journal_mode=WAL")
                connection.exec_driver_sql("BEGIN IMMEDIATE")  # all tables or none, also if this process is killed
                for statement in statements:
                    connection.exec_driver_sql(statement)
                connection.exec_driver_sql("INSERT INTO alembic_version VALUES (?)", (revision,))
                connection.commit()
                return True
        return False

    def dispose(self) -> None:
        super().dispose()
        self.engines.dispose()


_STATEMENTS = "SELECT sql FROM sqlite_master WHERE sql IS NOT NULL AND name NOT LIKE 'sqlite_%' ORDER BY rowid"


def _revision(connection: db.Connection) -> str | None:
    """Which of Dagster's migrations a file has, None if it has no tables yet."""
    with contextlib.suppress(OperationalError):
        return connection.exec_driver_sql("SELECT version_num FROM alembic_version").scalar()
    return None


@cache
def _newest() -> str | None:
    """The last migration of the Dagster that is installed."""
    return ScriptDirectory.from_config(get_alembic_config(sqlite_event_log.__file__)).get_current_head()


class _Runs(SqliteRunStorage):
    engines: _Engines

    @contextlib.contextmanager
    def connect(self) -> Iterator[db.Connection]:
        with _transaction(self.engines[self._conn_string]) as connection:
            yield connection


class SqliteHistory(DagsterSqliteStorage):
    """See the module. base_dir: `$DAGSTER_HOME`."""

    def __init__(self, base_dir: str, inst_data: Any = None) -> None:
        super().__init__(base_dir, inst_data)
        theirs = cast(SqliteEventLogStorage, self._event_log_storage), cast(SqliteRunStorage, self._run_storage)
        self._event_log_storage = _Events(theirs[0]._base_dir)
        self._run_storage = _Runs(theirs[1]._conn_string)
        self._run_storage.engines = self._event_log_storage.engines

    @classmethod
    def from_config_value(cls, inst_data: Any, config_value: Any) -> "SqliteHistory":
        """Dagster's way to make it of `dagster.yaml`."""
        return cls.from_local(inst_data=inst_data, **config_value)
