"""Keep one machine's ledger in a SQLite file, with locks that end with a process.

A commit survives a kill of the process at once, and a power cut from the next `sync` on. The file must lie on a local
disk: SQLite's write-ahead log does not work over a network.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

import sqlalchemy as sa
from sqlalchemy import event, exc
from typing_extensions import override

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import remedy, require_in_place, sync_folder, try_lock
from traps_pipeline.ledger.database import Database, Lock, sentence

T = TypeVar("T")
FILE = "ledger.sqlite"
WAIT_S = 600.0  # to wait for another process's transaction on a slow disk


class SqliteDatabase(Database):
    """The ledger in a folder, created on the first write.

    A file holds one study, whatever its name: it can be copied into another study's folder.
    """

    def __init__(self, folder: Path, study: str = "study", file: str = FILE) -> None:
        super().__init__(study, str(folder / file))
        self.folder, self.path = folder, folder / file
        # paramstyle: `Batch` hands dicts to either driver.
        self._engine = sa.create_engine("sqlite://", creator=self._open, poolclass=sa.NullPool, paramstyle="named")
        event.listen(self._engine, "begin", _begin)

    @override
    def exists(self) -> bool:
        return self.path.is_file()

    def _open(self) -> sqlite3.Connection:
        # A folder that cannot be written holds a file that nobody changes, and SQLite could not make its log there.
        is_fixed = self.path.exists() and not os.access(self.folder, os.W_OK)
        # A log left by a killed process holds committed rows, which `immutable` would not read.
        mode = "mode=ro" if self.path.with_name(f"{self.path.name}-wal").exists() else "immutable=1"
        uri = f"file:{quote(str(self.path))}" + (f"?{mode}" if is_fixed else "")
        connection = sqlite3.connect(uri, uri=True, timeout=WAIT_S, isolation_level=None, check_same_thread=False)
        if not is_fixed:
            connection.execute("pragma journal_mode=wal")
            connection.execute("pragma synchronous=normal")
        return connection

    @override
    def read(self) -> sa.Connection:
        try:
            return self._engine.connect().execution_options(is_reading=True)
        except exc.DBAPIError as error:
            raise sentence(error, self.place) from error

    @override
    def connect(self) -> sa.Connection:
        self.folder.mkdir(parents=True, exist_ok=True)
        return self._engine.connect()

    @override
    def run(self, work: Callable[[sa.Connection], T]) -> T:
        with self._transaction:
            try:
                return self._attempt(work)
            except (exc.DBAPIError, sqlite3.Error) as error:
                self.end()
                raise sentence(error, self.place) from error
            except OSError as error:
                raise TrapsError(f"{self.path}: cannot be written ({error.strerror}); {remedy(error)}") from error

    @override
    def try_lock(self, name: str) -> Lock | None:
        """The lock is a file's."""
        path = self.folder / "locks" / f"{name}.lock"
        try:
            descriptor = try_lock(path)
        except OSError as error:
            raise TrapsError(f"{path}: could not be written ({error.strerror}); {remedy(error)}") from error
        if descriptor is None:
            return None

        def release() -> None:
            with suppress(OSError):
                path.unlink()  # first: a process that opened it meanwhile then sees that its lock file is gone
            os.close(descriptor)

        return Lock(release, lambda: require_in_place(descriptor, path))

    @override
    def sync(self) -> None:
        """Sync the log, which SQLite does only at a checkpoint.

        The file itself must not be opened here: closing it would release the locks by which SQLite tells other
        processes that this one uses the log, and the next process to end would remove the log.
        """
        path = self.path.with_name(f"{self.path.name}-wal")
        try:
            with path.open("rb") as log:
                os.fsync(log.fileno())
            sync_folder(self.folder)
        except FileNotFoundError:
            return  # all of it was copied into the file, which SQLite syncs
        except OSError as error:
            raise TrapsError(f"{path}: could not be written ({error.strerror}); {remedy(error)}") from error

    @override
    def faults(self) -> Iterator[str]:
        """Find rows that are in an index but not in the table."""
        with self.read() as connection:
            try:
                for (fault,) in connection.exec_driver_sql("pragma integrity_check(5)"):
                    if fault != "ok":
                        yield f"{self.path}: {fault}; what can be read goes on elsewhere by `traps study export-ledger`"
            except exc.DBAPIError as error:
                raise sentence(error, self.place) from error

    @override
    def beat(self) -> None:
        """The kernel keeps the locks."""


def _begin(connection: sa.Connection) -> None:
    """Begin a transaction as SQLite does, or at once with the right to write.

    With that right none of its changes fails later. The driver's own way to begin is switched off
    (`isolation_level=None`): it would begin only before a change.
    """
    options: Any = connection.get_execution_options()
    connection.exec_driver_sql("begin" if options.get("is_reading") else "begin immediate")
