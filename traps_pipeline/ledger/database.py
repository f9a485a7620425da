"""The database of a study's ledger: transactions, named locks, and a thread in which calls share commits.

Hundreds of calls are in flight at once, and each changes the database twice: before it is sent and when it is
answered. So changes are put into a queue, and one thread applies all that wait there in one transaction. A change is
done when its future is. What differs between SQLite and PostgreSQL is in the two modules beside this one.
"""

from __future__ import annotations

import secrets
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

import sqlalchemy as sa

from traps_pipeline.base.databases import reason_and_remedy
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.batch import Batch
from traps_pipeline.ledger.schema import (
    METADATA,
    SESSIONS,
    SHARERS,
    STUDIES,
)

T = TypeVar("T")
BEAT_S = 0.5  # how often a process that holds something says so
MOST_CHANGES = 1000  # of one transaction
SHARE_S, SHARER_S = 2.0, 10.0  # how often a process says that it asks through an account, and how long that holds


Change = Callable[[Batch], Any]


@dataclass(frozen=True)
class Lock:
    """A named lock of this process. require(): raises TrapsError when it is not this process's any more. is_fresh():
    whether that can be told at once, without asking a server, which may be away."""

    release: Callable[[], None]
    require: Callable[[], None]
    is_fresh: Callable[[], bool] = lambda: True


class Database(ABC):
    """The ledger's database of one study, as this process uses it. Its methods may be called from any thread."""

    def __init__(self, study: str) -> None:
        self.study_name = study
        self.session = ""  # while this process writes: a name for that, which none had before
        self.study = 0  # the study's number, once there is one
        self._queue: SimpleQueue[tuple[Change, Future[Any]] | None] = SimpleQueue()
        self._users, self._guard, self._batch = 0, threading.Lock(), 0
        self._thread: threading.Thread | None = None
        self._session_lock: Lock | None = None
        self.sharers: dict[str, int] = {}  # by account that is asked through: how many processes do so now

    # --- what differs between databases -------------------------------------------------------------------------------

    @property
    @abstractmethod
    def place(self) -> str:
        """Where the ledger is, for people; no password is in it."""

    @abstractmethod
    def exists(self) -> bool:
        """Return whether there may be something to read."""

    @abstractmethod
    def read(self) -> sa.Connection:
        """Return a connection for reading, which the caller closes. Raises TrapsError."""

    @abstractmethod
    def run(self, work: Callable[[sa.Connection], T]) -> T:
        """Return what `work` returns, done in one transaction that writes; where a connection breaks it is done again.
        Raises TrapsError."""

    @abstractmethod
    def try_lock(self, name: str) -> Lock | None:
        """Take a named lock until this process ends; None while another session has it. Raises TrapsError."""

    def now_s(self, connection: sa.Connection) -> float:
        """Return the seconds since 1970 of a clock that all processes of the study share."""
        return time.time()

    @abstractmethod
    def sync(self) -> None:
        """Return when not even a power cut loses what was committed. Raises TrapsError."""

    def faults(self) -> Iterator[str]:
        """Yield sentences on what is wrong with the database itself, where it can look. Raises TrapsError."""
        yield from ()

    @abstractmethod
    def beat(self) -> None:
        """Do what keeps locks this process's, where they are lost otherwise. Raises TrapsError."""

    @abstractmethod
    def end(self) -> None:
        """Close what writing needed."""

    # --- writing ------------------------------------------------------------------------------------------------------

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Let this process write within the block: it has a session, and a thread that commits. Raises TrapsError."""
        with self._guard:
            if not self._users:
                self._begin()
            self._users += 1
        try:
            yield
        except BaseException:
            with suppress(TrapsError):  # the error of the block is what a person must know
                self._leave()
            raise
        self._leave()

    def submit(self, change: Change) -> Future[Any]:
        """Add a change to the next transaction; its future is done when that is committed. Within `writing`."""
        future: Future[Any] = Future()
        self._queue.put((change, future))
        return future

    def is_dead(self, session: str) -> bool:
        """Return whether another process, by the id of its session, has ended. Raises TrapsError."""
        if session == self.session:
            return False
        lock = self.try_lock(f"session-{session}")
        if lock is not None:
            lock.release()
        return lock is not None

    @contextmanager
    def sharing(self, accounts: Collection[str]) -> Iterator[Callable[[str], int]]:
        """Ask through these accounts within the block. The value tells how many processes do, this one among them, as
        it was at the last beat. Raises TrapsError."""
        with self.writing():
            self.sharers |= dict.fromkeys(accounts, 1)
            self.submit(self._share).result()
            try:
                yield lambda account: max(1, self.sharers.get(account, 1))
            finally:
                for account in accounts:
                    self.sharers.pop(account, None)
                self.submit(self._unshare).result()

    def _share(self, batch: Batch) -> None:
        """Say that this process asks through its accounts, and count who does."""
        now_s = self.now_s(batch.connection)
        self._unshare(batch)
        for account in self.sharers:
            batch.connection.execute(sa.insert(SHARERS).values(session=self.session, account=account, seen_s=now_s))
        counts = sa.select(SHARERS.c.account, sa.func.count()).where(SHARERS.c.seen_s > now_s - SHARER_S)
        for account, count in batch.connection.execute(counts.group_by(SHARERS.c.account)):
            if account in self.sharers:
                self.sharers[account] = count

    def _unshare(self, batch: Batch) -> None:
        gone = (SHARERS.c.session == self.session) | (SHARERS.c.seen_s < self.now_s(batch.connection) - SHARER_S)
        batch.connection.execute(sa.delete(SHARERS).where(gone))

    def _begin(self) -> None:
        self.session = secrets.token_hex(8)
        self.run(self.prepare)
        self._session_lock = self.try_lock(f"session-{self.session}")
        self._thread = threading.Thread(target=self._work, name="ledger", daemon=True)
        self._thread.start()

    def prepare(self, connection: sa.Connection) -> None:
        """Create missing tables, and the rows of the study and of this session."""
        METADATA.create_all(connection)
        self.study = (
            self._study(connection)
            or connection.execute(sa.insert(STUDIES).values(name=self.study_name).returning(STUDIES.c.id)).scalar_one()
        )
        if connection.execute(sa.select(SESSIONS.c.batch).where(SESSIONS.c.id == self.session)).scalar() is None:
            connection.execute(sa.insert(SESSIONS).values(id=self.session, study=self.study, batch=self._batch))

    def _study(self, connection: sa.Connection) -> int | None:
        return connection.execute(sa.select(STUDIES.c.id).where(STUDIES.c.name == self.study_name)).scalar()

    def _leave(self) -> None:
        with self._guard:
            self._users -= 1
            if not self._users:
                self._close()

    def _close(self) -> None:
        self._queue.put(None)
        assert self._thread is not None and self._session_lock is not None, "begun before it is closed"
        self._thread.join()
        try:
            self.run(lambda connection: connection.execute(sa.delete(SESSIONS).where(SESSIONS.c.id == self.session)))
        finally:
            self._session_lock.release()
            self.session, self._session_lock, self._batch = "", None, 0
            self.end()

    def _work(self) -> None:
        """Commit what is in the queue, until it ends."""
        shared_at = beaten_at = time.monotonic()
        while True:
            changes, is_last = list[tuple[Change, Future[Any]]](), False
            try:
                first = self._queue.get(timeout=BEAT_S)
                while first is not None:
                    if first[1].set_running_or_notify_cancel():
                        changes.append(first)
                    if len(changes) == MOST_CHANGES:
                        break
                    first = self._queue.get_nowait()
                is_last = first is None
            except Empty:
                pass
            if self.sharers and time.monotonic() - shared_at > SHARE_S:
                shared_at = time.monotonic()
                changes.append((self._share, Future()))
            if changes:
                self._commit(changes)
            if is_last:
                return
            if time.monotonic() - beaten_at > BEAT_S:
                beaten_at = time.monotonic()
                with suppress(TrapsError):  # told to the next one who needs the database
                    self.beat()

    def _commit(self, changes: list[tuple[Change, Future[Any]]]) -> None:
        """Apply changes in one transaction, and finish their futures. One that raises TrapsError changes nothing."""
        number = self._batch + 1

        def work(connection: sa.Connection) -> list[Any]:
            connection.execute(sa.select(STUDIES.c.id).where(STUDIES.c.id == self.study).with_for_update())
            mine = (SESSIONS.c.id == self.session) & (SESSIONS.c.batch == number - 1)
            if not connection.execute(sa.update(SESSIONS).where(mine).values(batch=number)).rowcount and results:
                return results  # committed before the connection broke
            results.clear()
            batch = Batch(connection, self.study, self.session)
            for change, _ in changes:
                try:
                    results.append(change(batch))
                except TrapsError as error:
                    results.append(error)
            batch.flush()
            return results

        results = list[Any]()
        try:
            self.run(work)
            self._batch = number
        except Exception as error:  # noqa: BLE001 - handed to those who wait for these changes
            for _, future in changes:
                future.set_exception(error)
            return
        for (_, future), result in zip(changes, results, strict=True):
            if isinstance(result, Exception):
                future.set_exception(result)
            else:
                future.set_result(result)


def sentence(error: Exception, place: str) -> TrapsError:
    """Return the error of a database as a sentence for people, without the statement and its values."""
    reason, remedy, _ = reason_and_remedy(error)
    return TrapsError(
        f"{place}: cannot be read or written ({reason}); {remedy} and run the same command again: everything answered "
        "before is kept, only what was in flight is asked again"
    )
