"""Share a ledger's database: transactions, named locks, and grouped commits.

Changes are queued, and one thread applies all waiting ones in one transaction. A change is done when its future is.
What differs between databases is in `sqlite.py` and `traps_cluster/postgres.py`.
"""

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

from traps_pipeline.base import progress
from traps_pipeline.base.databases import is_damaged, reason_and_remedy
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.batch import LOST, Batch, Request
from traps_pipeline.ledger.schema import METADATA, SEALS, SESSIONS, SHARERS, STUDIES

T = TypeVar("T")
BEAT_S = 0.5  # how often a process renews its locks and reservations
ROUNDING_USD = 1e-6  # sums of dollars may differ by as much
MAX_CHANGES = 1000  # per transaction
SHARE_S, SHARER_S = 2.0, 10.0  # how often a process announces that it uses an account, and how long that is valid


Change = Callable[[Batch], Any]
AnyFuture = Future[Any] | asyncio.Future[Any]


class _Refused(Exception):
    """A change of a transaction was refused: the others are applied without it."""


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

    place: its location for people, without a password. additions: SQL for the names of triggers, and of views with a
    table's name, which could change or hide what is written.
    """

    additions: str

    def __init__(self, study: str, place: str) -> None:
        self.study_name, self.place = study, place
        self.session = ""  # while this process writes: a unique id
        self.study = 0  # the study's number, once there is one
        self._queue: SimpleQueue[tuple[Change, AnyFuture] | None] = SimpleQueue()
        self._users, self._guard = 0, threading.Lock()
        self._thread: threading.Thread | None = None
        self._session_lock: Lock | None = None
        self._accounts: tuple[str, ...] = ()  # in use, once for each use; replaced under `_guard`, never changed
        self._sharers: dict[str, int] = {}  # by account: the number of processes that use it; of the commit thread
        # Rows, and dollars by participant: of the last commit, and as noted outside of the database (none: 0).
        self.booked, self.noted = (0, dict[str, float]()), (0, dict[str, float]())
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

    def salvage(self) -> sa.Connection:
        """Return a read connection that reads past damage where the database can. Raises TrapsError."""
        return self.read()

    @abstractmethod
    def run(self, work: Callable[[sa.Connection], T]) -> T:
        """Run `work` in one transaction, repeated if the connection breaks. Raises TrapsError."""

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
        """Yield faults of the database itself, and of its money. Raises TrapsError."""
        try:
            with self.read() as connection:
                self._check_additions(connection)
                if sa.inspect(connection).has_table(SEALS.name) and (study := self.find_study(connection)):
                    Batch(connection, study, self.session, self.damaged).is_sealed()
        except exc.DBAPIError as error:
            yield str(self.sentence(error))
        except TrapsError as error:
            yield str(error)

    @abstractmethod
    def beat(self) -> None:
        """Renew this process's locks if they could expire. Raises TrapsError."""

    @property
    @abstractmethod
    def restart_words(self) -> str:
        """The command or step, in words, by which a person starts anew in an empty database."""

    def damaged(self, what: str) -> TrapsError:
        """Return the error of a ledger that must not be written on, with the way to save it."""
        return TrapsError(
            f"{self.place}: {what}, so nothing is asked; `traps study export-ledger FILE` saves what is whole, then "
            f"{self.restart_words}, and `traps study import-ledger FILE` brings it back"
        )

    def sentence(self, error: Exception) -> TrapsError:
        """Return a database error as a sentence, without the statement and its values."""
        if is_damaged(error):
            return self.damaged("it is damaged, or no database")
        reason, remedy, _ = reason_and_remedy(error)
        return TrapsError(
            f"{self.place}: cannot be read or written ({reason}); {remedy} and run the same command again: everything "
            "answered before is kept, only what was in flight is asked again"
        )

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
            with self._guard:
                self._accounts += tuple(accounts)
            try:
                self.submit(self._share).result()
                yield lambda account: max(1, self._sharers.get(account, 1))
            finally:
                with self._guard:
                    remaining = [*self._accounts]
                    for account in accounts:
                        remaining.remove(account)
                    self._accounts = tuple(remaining)
                self.submit(self._share).result()

    def _share(self, batch: Batch) -> None:
        """Announce that this process uses its accounts, and count the processes that do."""
        now_s, accounts = self.now_s(batch.connection), {*self._accounts}
        expired = (SHARERS.c.session == self.session) | (SHARERS.c.seen_s < now_s - SHARER_S)
        batch.connection.execute(sa.delete(SHARERS).where(expired))
        for account in accounts:
            batch.connection.execute(sa.insert(SHARERS).values(session=self.session, account=account, seen_s=now_s))
        counts = sa.select(SHARERS.c.account, sa.func.count()).where(SHARERS.c.seen_s > now_s - SHARER_S)
        self._sharers = dict(batch.connection.execute(counts.group_by(SHARERS.c.account)).all())

    def _begin(self) -> None:
        self.session = secrets.token_hex(8)
        try:
            self.run(self.prepare)
        except BaseException:
            self.end()  # the file may be replaced before the next try
            raise
        self._session_lock = self.try_lock(f"session-{self.session}")
        self._thread = threading.Thread(target=self._work, name="ledger", daemon=True)
        self._thread.start()

    def prepare(self, connection: sa.Connection) -> None:
        """Create what is missing, and verify the rest. Raises TrapsError for a ledger that must not be written on."""
        self._check_additions(connection)
        METADATA.create_all(connection)
        self.study = (
            self.find_study(connection)
            or connection.execute(sa.insert(STUDIES).values(name=self.study_name).returning(STUDIES.c.id)).scalar_one()
        )
        if connection.execute(sa.select(SESSIONS.c.id).where(SESSIONS.c.id == self.session)).first() is None:
            connection.execute(sa.insert(SESSIONS).values(id=self.session, study=self.study))
        batch = Batch(connection, self.study, self.session, self.damaged)
        if not batch.is_sealed():  # as before 0.4
            batch.reseal()

    def book_lost(self, connection: sa.Connection) -> None:
        """Reserve what was noted as booked and is no longer, until a person releases it; say what is gone."""
        batch, (rows, noted) = Batch(connection, self.study, LOST, self.damaged), self.noted
        batch.flush()
        lost = {name: usd - batch.booked.get(name, 0.0) for name, usd in noted.items()}
        lost = {name: usd for name, usd in lost.items() if usd > ROUNDING_USD}
        if lost or rows > batch.sealed_rows:
            usd = f"; ${sum(lost.values()):.4f} of lost ones count until `traps study release-money` releases them"
            words = f"{self.place}: {batch.sealed_rows} of {rows} written rows are there{usd * bool(lost)}"
            progress.current().note(f"{words}; `traps doctor --verify` says more")
        for participant, usd in lost.items():
            batch.reserve(Request(secrets.token_hex(8), participant, usd, {}))
        batch.flush()
        self.booked = batch.sealed_rows, batch.booked

    def _check_additions(self, connection: sa.Connection) -> None:
        if names := [*connection.exec_driver_sql(self.additions).scalars()]:
            raise self.damaged(f"it has {', '.join(map(str, names))}, which this program did not make")

    def find_study(self, connection: sa.Connection) -> int | None:
        """Return this study's number, None before its first row."""
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
            if self._accounts and time.monotonic() - shared_at > SHARE_S:
                shared_at = time.monotonic()
                changes.append((self._share, Future()))
            if changes:
                self._commit(changes)
            if is_last or time.monotonic() - beaten_at > BEAT_S:
                beaten_at = time.monotonic()
                with suppress(TrapsError):  # reported to the next caller
                    self.beat()
            if is_last:
                return

    def _commit(self, changes: list[tuple[Change, AnyFuture]]) -> None:
        """Apply changes in one transaction, without any that raises TrapsError: nothing of it is kept."""
        refused = dict[int, TrapsError]()

        def work(connection: sa.Connection) -> tuple[list[Any], Batch]:
            results, batch = list[Any](), Batch(connection, self.study, self.session, self.damaged)
            for number, (change, _) in enumerate(changes):
                try:
                    results.append(refused.get(number) or change(batch))
                except TrapsError as error:
                    refused[number] = error
                    raise _Refused from error
            batch.flush()
            return results, batch

        results = list[Any]()
        while not results:
            try:
                results, batch = self.run_once(work)
                self.booked = batch.sealed_rows, batch.booked
            except _Refused:
                continue
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
