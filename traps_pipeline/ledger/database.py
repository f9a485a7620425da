"""Share a ledger's database: transactions, named locks, and grouped commits.

Changes are queued, and one thread applies all waiting ones in one transaction. A change is done when its future is.
What differs between databases is in `sqlite.py` and `cluster/postgres.py`.
"""

from __future__ import annotations

import asyncio
import secrets
import threading
import time
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

import sqlalchemy as sa
from sqlalchemy import exc

from traps_pipeline.base.databases import reason_and_remedy
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.batch import Batch
from traps_pipeline.ledger.schema import METADATA, SESSIONS, SHARERS, STUDIES

T = TypeVar("T")
BEAT_S = 0.5  # how often a process renews its locks and reservations
MAX_CHANGES = 1000  # per transaction
SHARE_S, SHARER_S = 2.0, 10.0  # how often a process announces that it uses an account, and how long that is valid


Change = Callable[[Batch], Any]
AnyFuture = Future[Any] | asyncio.Future[Any]


@dataclass(frozen=True)
class Lock:
    """A named lock of this process.

    require(): raises TrapsError once the lock is lost. is_fresh(): whether that is known at once, without asking a
    server, which may be unreachable.
    """

    release: Callable[[], None]
    require: Callable[[], None]
    is_fresh: Callable[[], bool] = lambda: True


class Database(ABC):
    """The ledger's database of one study in this process; thread-safe.

    place: its location for people, without a password.
    """

    def __init__(self, study: str, place: str) -> None:
        self.study_name, self.place = study, place
        self.session = ""  # while this process writes: a unique id
        self.study = 0  # the study's number, once there is one
        self._queue: SimpleQueue[tuple[Change, AnyFuture] | None] = SimpleQueue()
        self._users, self._guard = 0, threading.Lock()
        self._thread: threading.Thread | None = None
        self._session_lock: Lock | None = None
        self.sharers: dict[str, int] = {}  # by account in use: the number of processes that use it now
        self._connection: sa.Connection | None = None  # for writing; `end` closes it
        self._transaction = threading.RLock()

    # --- what differs between databases -------------------------------------------------------------------------------

    def exists(self) -> bool:
        """Return whether the database may exist."""
        return True

    @abstractmethod
    def connect(self) -> sa.Connection:
        """Return a new connection for writing. Raises SQLAlchemy's errors."""

    @abstractmethod
    def read(self) -> sa.Connection:
        """Return a read connection, which the caller closes. Raises TrapsError."""

    @abstractmethod
    def run(self, work: Callable[[sa.Connection], T]) -> T:
        """Run `work` in one transaction, repeated if the connection breaks.

        Raises TrapsError.
        """

    def run_once(self, work: Callable[[sa.Connection], T]) -> T:
        """Run `work` as `run` does, but not again if only its commit's answer was lost."""
        return self.run(work)

    @abstractmethod
    def try_lock(self, name: str) -> Lock | None:
        """Lock a name until this process ends; None if it is taken. Raises TrapsError."""

    def now_s(self, connection: sa.Connection) -> float:
        """Return seconds since 1970, by a clock that all processes of the study share."""
        return time.time()

    @abstractmethod
    def sync(self) -> None:
        """Sync to disk everything that was committed. Raises TrapsError."""

    def faults(self) -> Iterator[str]:
        """Yield faults of the database itself, if it can check. Raises TrapsError."""
        yield from ()

    @abstractmethod
    def beat(self) -> None:
        """Renew this process's locks if they could expire. Raises TrapsError."""

    # --- writing ------------------------------------------------------------------------------------------------------

    def _attempt(self, work: Callable[[sa.Connection], T]) -> T:
        """Run `work` in one transaction; for `run`, which holds `_transaction`."""
        if self._connection is None:
            self._connection = self.connect()
        with self._connection.begin():
            return work(self._connection)

    def end(self) -> None:
        """Close the connection for writing."""
        with self._transaction:
            connection, self._connection = self._connection, None
            if connection is not None:
                with suppress(exc.SQLAlchemyError):
                    connection.invalidate()  # unlike `close`, it sends no rollback to a server that may be unreachable

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Open a session and a commit thread within the block. Raises TrapsError."""
        with self._guard:
            if not self._users:
                self._begin()
            self._users += 1
        try:
            yield
        except BaseException:
            with suppress(TrapsError):  # report the block's error, not this one
                self._leave()
            raise
        self._leave()

    def submit(self, change: Change) -> Future[Any]:
        """Queue a change for the next commit, which resolves its future; within `writing`."""
        future: Future[Any] = Future()
        self._queue.put((change, future))
        return future

    def apply(self, change: Change) -> asyncio.Future[Any]:
        """Queue a change for an event loop; it is made even if the caller is cancelled.

        With hundreds of calls in flight it takes half the CPU time of `submit`, as a commit wakes the loop once.
        """
        future: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        self._queue.put((change, future))
        return future

    def is_dead(self, session: str) -> bool:
        """Return whether another process's session has ended. Raises TrapsError."""
        if session == self.session:
            return False
        lock = self.try_lock(f"session-{session}")
        if lock is not None:
            lock.release()
        return lock is not None

    @contextmanager
    def sharing(self, accounts: Collection[str]) -> Iterator[Callable[[str], int]]:
        """Use these accounts within the block, and announce that to other processes.

        The yielded function returns the number of processes that use an account, this one included, as of the last
        beat. Raises TrapsError.
        """
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
        """Announce that this process uses its accounts, and count the processes that do."""
        now_s = self.now_s(batch.connection)
        self._unshare(batch)
        for account in self.sharers:
            batch.connection.execute(sa.insert(SHARERS).values(session=self.session, account=account, seen_s=now_s))
        counts = sa.select(SHARERS.c.account, sa.func.count()).where(SHARERS.c.seen_s > now_s - SHARER_S)
        for account, count in batch.connection.execute(counts.group_by(SHARERS.c.account)):
            if account in self.sharers:
                self.sharers[account] = count

    def _unshare(self, batch: Batch) -> None:
        expired = (SHARERS.c.session == self.session) | (SHARERS.c.seen_s < self.now_s(batch.connection) - SHARER_S)
        batch.connection.execute(sa.delete(SHARERS).where(expired))

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
        if connection.execute(sa.select(SESSIONS.c.id).where(SESSIONS.c.id == self.session)).first() is None:
            connection.execute(sa.insert(SESSIONS).values(id=self.session, study=self.study))

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
            self.session, self._session_lock = "", None
            self.end()

    def _work(self) -> None:
        """Commit queued changes until the queue ends."""
        shared_at = beaten_at = time.monotonic()
        while True:
            changes, is_last = list[tuple[Change, AnyFuture]](), False
            try:
                while (queued := self._queue.get(block=not changes, timeout=BEAT_S)) is not None:
                    changes.append(queued)
                    if len(changes) == MAX_CHANGES:
                        break
                is_last = queued is None
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
                with suppress(TrapsError):  # reported to the next caller
                    self.beat()

    def _commit(self, changes: list[tuple[Change, AnyFuture]]) -> None:
        """Apply changes in one transaction; skip any that raises TrapsError."""

        def work(connection: sa.Connection) -> list[Any]:
            results, batch = list[Any](), Batch(connection, self.study, self.session)
            for change, _ in changes:
                try:
                    results.append(change(batch))
                except TrapsError as error:
                    results.append(error)
            batch.flush()
            return results

        try:
            results = self.run_once(work)
        except Exception as error:  # noqa: BLE001 - handed to those who wait for these changes
            results = [error] * len(changes)
        by_loop = defaultdict[asyncio.AbstractEventLoop | None, list[tuple[AnyFuture, Any]]](list)
        for (_, future), result in zip(changes, results, strict=True):
            by_loop[future.get_loop() if isinstance(future, asyncio.Future) else None].append((future, result))
        for loop, settled in by_loop.items():
            if loop is None:
                _settle(settled)
                continue
            with suppress(RuntimeError):  # it is closed, and nobody waits
                loop.call_soon_threadsafe(_settle, settled)  # once: each costs a system call


def _settle(results: Iterable[tuple[AnyFuture, Any]]) -> None:
    """Hand the results of changes to those who wait for them."""
    for future, result in results:
        if future.done():
            continue  # its caller was cancelled
        if isinstance(result, Exception):
            future.set_exception(result)
        else:
            future.set_result(result)


def taken_over(place: str) -> TrapsError:
    """Return the error of a writer whose evaluation another process has taken over."""
    return TrapsError(
        f"{place}: another process has begun to ask the same calls, since this one was away; nothing more is sent. Run "
        "the same command again when the other one has ended"
    )


def sentence(error: Exception, place: str) -> TrapsError:
    """Return a database error as a sentence, without the statement and its values."""
    reason, remedy, _ = reason_and_remedy(error)
    return TrapsError(
        f"{place}: cannot be read or written ({reason}); {remedy} and run the same command again: everything answered "
        "before is kept, only what was in flight is asked again"
    )


_LOCK_STUDY = sa.select(STUDIES.c.id).where(STUDIES.c.id == sa.bindparam("of_study")).with_for_update()
_NUMBER = sa.bindparam("number", type_=sa.BigInteger)
_COUNT = (
    sa.update(SESSIONS)
    .where(SESSIONS.c.id == sa.bindparam("of_session"), SESSIONS.c.batch == _NUMBER - 1)
    .values(batch=_NUMBER)
)


class NumberedDatabase(Database):
    """A database over a network, where the answer to a commit may be lost: transactions are numbered."""

    _batch = 0  # the number of this session's last transaction

    def prepare(self, connection: sa.Connection) -> None:
        """See `Database.prepare`."""
        super().prepare(connection)
        self._batch = 0

    def run_once(self, work: Callable[[sa.Connection], T]) -> T:
        """See `Database.run_once`; one transaction of a study runs at a time."""
        results, number = list[T](), self._batch + 1

        def numbered(connection: sa.Connection) -> T:
            connection.execute(_LOCK_STUDY, {"of_study": self.study})
            is_first = connection.execute(_COUNT, {"of_session": self.session, "number": number}).rowcount
            if is_first or not results:
                results[:] = [work(connection)]
            return results[0]

        result = self.run(numbered)
        self._batch = number
        return result
