"""Keep one machine's ledger in a SQLite file, with locks that end with a process.

A commit survives a kill of the process at once, and a power cut from the next `sync` on. The file must lie on a local
disk: SQLite's write-ahead log does not work over a network.
"""

import json
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
from traps_pipeline.base.files import remedy, require_in_place, sync_folder, try_lock, write_text
from traps_pipeline.ledger.database import Database, Lock
from traps_pipeline.ledger.rows import is_amount
from traps_pipeline.ledger.schema import ROWS, STUDIES

T = TypeVar("T")
FILE = "ledger.sqlite"
NOTE = "ledger.booked.json"
QUICK_BYTES = 200_000_000  # larger files are checked in part when they are opened for writing
SAMPLED = 64  # rows, evenly over a large file
WAIT_S = 600.0  # to wait for another process's transaction on a slow disk


class SqliteDatabase(Database):
    """The ledger in a folder, created on the first write.

    A file holds one study, whatever its name: it can be copied into another study's folder. What is booked is noted
    beside it every half second: rows that vanish, as with a lost log, are told and their money counts.
    """

    additions = "select 'the ' || type || ' ' || name from sqlite_master where type in ('trigger', 'view')"

    def __init__(self, folder: Path, study: str = "study", file: str = FILE) -> None:
        super().__init__(study, str(folder / file))
        self.folder, self.path = folder, folder / file
        self._is_checked = False
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
            raise self.sentence(error) from error

    @override
    def salvage(self) -> sa.Connection:
        """Open the file for reading though it is shorter than it says, which SQLite refuses otherwise."""

        def open_cut() -> sqlite3.Connection:
            mode = "mode=ro" if self.path.with_name(f"{self.path.name}-wal").exists() else "immutable=1"
            uri = f"file:{quote(str(self.path))}?{mode}"
            connection = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)
            connection.execute("pragma writable_schema = 1")
            return connection

        return sa.create_engine("sqlite://", creator=open_cut, poolclass=sa.NullPool).connect()

    @override
    def connect(self) -> sa.Connection:
        self.folder.mkdir(parents=True, exist_ok=True)
        return self._engine.connect()

    @override
    def prepare(self, connection: sa.Connection) -> None:
        """Check the file first, once a process."""
        if not self._is_checked:
            self._check(connection)
        super().prepare(connection)
        if not self._is_checked and self.path.name == FILE:
            self.noted = _read_note(self.path.with_name(NOTE))
            self.book_lost(connection)
        self._is_checked = True

    def _check(self, connection: sa.Connection) -> None:
        """Raise TrapsError if the file is damaged; of a large one, some rows stand for all (`faults` reads each)."""
        if self.path.stat().st_size > QUICK_BYTES:
            last = connection.execute(sa.select(sa.func.max(ROWS.c.id))).scalar() or 0
            some = {last * number // SAMPLED for number in range(SAMPLED + 1)}
            connection.execute(sa.select(ROWS.c.key).where(ROWS.c.id.in_(some))).all()
        elif (fault := connection.exec_driver_sql("pragma quick_check(1)").scalar()) != "ok":
            raise self._fault(fault)

    def _fault(self, words: object) -> TrapsError:
        return self.damaged(f"it is damaged ({str(words).splitlines()[-1]})")

    @override
    def find_study(self, connection: sa.Connection) -> int | None:
        number, other = super().find_study(connection), sa.select(STUDIES.c.name).limit(1)
        if number is None and (row := connection.execute(other).first()):
            raise self.damaged(f"it holds the study {row.name}, and not {self.study_name}")
        return number

    @override
    def run(self, work: Callable[[sa.Connection], T]) -> T:
        with self._transaction:
            try:
                return self._attempt(work)
            except (exc.DBAPIError, sqlite3.Error) as error:
                self.end()
                raise self.sentence(error) from error
            except OSError as error:
                raise TrapsError(f"{self.path}: cannot be written ({error.strerror}); {remedy(error)}") from error

    @override
    def try_lock(self, name: str) -> Lock | None:
        """Take the lock of a file below `locks`, or return None if another process has it."""
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
        with self.salvage() as connection:
            try:
                for fault in connection.exec_driver_sql("pragma integrity_check(5)").scalars():
                    if fault != "ok":
                        yield str(self._fault(fault))
            except exc.DBAPIError as error:
                yield str(self.sentence(error))
        yield from super().faults()

    @property
    @override
    def restart_words(self) -> str:
        return f"move {self.path}* away"

    @override
    def beat(self) -> None:
        """Save the money that is booked in a note beside the ledger's file."""
        if self.booked != self.noted and self.path.name == FILE:
            write_text(self.path.with_name(NOTE), json.dumps(self.booked))
            self.noted = self.booked


def _read_note(path: Path) -> tuple[int, dict[str, float]]:
    """Return the noted number of rows, and dollars by participant; none where the note is damaged or missing."""
    try:
        rows, booked = json.loads(path.read_bytes())
        amounts = {name: float(usd) for name, usd in booked.items() if is_amount(usd) and name.isprintable()}
        return int(rows) if is_amount(rows) else 0, amounts
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return 0, {}


def _begin(connection: sa.Connection) -> None:
    """Begin a transaction, at once with the right to write if asked; the driver would begin only before a change."""
    options: Any = connection.get_execution_options()
    connection.exec_driver_sql("begin" if options.get("is_reading") else "begin immediate")
