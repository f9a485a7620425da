"""Keep several hosts' ledger in PostgreSQL; a process's connection has its locks.

Locks end with their connection. A process that is silent for IDLE_S (stopped, or cut off) loses both. On a new
connection it takes its locks again, unless another process has them; `Batch.is_writer` tells the writer of each
evaluation whether that one has written meanwhile. PostgreSQL must be reached directly, not through a pool that shares
connections.
"""

from __future__ import annotations

import os
import secrets
import socket
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from datetime import timedelta
from functools import cache, partial
from hashlib import blake2b
from typing import Any, TypeVar
from urllib.parse import urlsplit

import sqlalchemy as sa
from sqlalchemy import exc
from typing_extensions import override

from traps_pipeline.base.databases import is_damaged, reason_and_remedy
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import require_extra
from traps_pipeline.base.keys import check_key
from traps_pipeline.ledger.database import Database, Lock, taken_over
from traps_pipeline.ledger.schema import EVALUATIONS, METADATA, SESSIONS, STUDIES
from traps_pipeline.storage.store import Lease

T = TypeVar("T")

IDLE_S = 30.0  # the server ends a connection that is idle for so long: its process is stopped
OLD_S = 1.5  # locks checked longer ago than this allow no call
PATIENCE_S = 60.0  # how long a run waits for an unreachable server
GRACE_S = 10  # grace period after a server start for former holders to take their locks again
RETAKE_S = 5.0  # how long the server may need to end this process's former connection
RETRY_S = 0.2
SKEW_S = 60  # Dagster compares times of several hosts to tell a run that never began; stores refuse 15 minutes
_awake_s = partial(time.clock_gettime, time.CLOCK_BOOTTIME)  # runs on while the process is stopped or the host sleeps
_ALIVE = {"keepalives_idle": 5, "keepalives_interval": 5, "keepalives_count": 3}
KEEPALIVE: dict[str, Any] = {**_ALIVE, "tcp_user_timeout": 15_000}
_END_FORMER = (
    "select pg_terminate_backend(pid) from pg_stat_activity "
    "where application_name = :application and pid <> pg_backend_pid()"
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

    @override
    def prepare(self, connection: sa.Connection) -> None:
        METADATA.create_all(connection)
        mine = sa.select(STUDIES.c.id).where(STUDIES.c.name == self.study_name)
        connection.execute(mine.with_for_update())  # no other process changes it while it is verified
        super().prepare(connection)
        self._batch = 0

    @override
    def run_once(self, work: Callable[[sa.Connection], T]) -> T:
        """One transaction of a study runs at a time."""
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


class PostgresDatabase(NumberedDatabase):
    """A ledger shared by hosts; the environment variable `variable` has its address."""

    additions = (
        "select 'the trigger ' || trigger_name from information_schema.triggers "
        "where starts_with(event_object_table, 'traps_') union "
        "select 'the view ' || table_name from information_schema.views where starts_with(table_name, 'traps_')"
    )

    def __init__(self, address: str, variable: str, study: str, idle_s: float = IDLE_S) -> None:
        self.variable, self.patience_s = variable, PATIENCE_S
        self.application = f"traps {secrets.token_hex(8)}"  # the server's ids of this process's connections
        try:
            urlsplit(address).port  # noqa: B018 - raises ValueError
            url = sa.make_url(address)
            if not url.drivername.startswith("postgres"):
                raise ValueError(url.drivername)
        except (exc.ArgumentError, ValueError):
            raise TrapsError(
                f"{variable}: is no address of a PostgreSQL database; write it as "
                f"postgresql://USER:PASSWORD@HOST:5432/DATABASE (study {study}, host {socket.gethostname()})"
            ) from None
        super().__init__(study, f"{url.host}:{url.port or 5432}/{url.database}")
        self._engine = sa.create_engine(
            url.set(drivername="postgresql+psycopg"),
            poolclass=sa.NullPool,
            connect_args={"connect_timeout": 10, "application_name": self.application, **KEEPALIVE},
        )
        idle = dict.fromkeys(("idle_session_timeout", "idle_in_transaction_session_timeout"), int(1000 * idle_s))
        self._settings = {**idle, **{f"tcp_{name}": seconds for name, seconds in _ALIVE.items()}}
        self._held: dict[int, bool] = {}  # by lock number: whether this process still holds it
        self._seen_s = float("-inf")  # when the locks were last checked
        self.run(self._compare_clocks, patience_s=0.0)

    @override
    def read(self) -> sa.Connection:
        return self._patient(self._engine.connect).execution_options(isolation_level="REPEATABLE READ")

    @override
    def run(self, work: Callable[[sa.Connection], T], patience_s: float | None = None) -> T:
        """In one thread, a nested `run` joins the outer transaction."""
        with self._transaction:
            if self._connection is not None and self._connection.in_transaction():
                return work(self._connection)
            return self._patient(lambda: self._attempt(work), self.end, patience_s)

    def _patient(
        self, attempt: Callable[[], T], clean_up: Callable[[], None] = lambda: None, patience_s: float | None = None
    ) -> T:
        """Repeat an attempt while the server cannot be reached. Raises TrapsError."""
        until = time.monotonic() + (self.patience_s if patience_s is None else patience_s)
        while True:
            try:
                return attempt()
            except exc.DBAPIError as error:
                is_broken = error.connection_invalidated or isinstance(error, exc.OperationalError)
                if is_broken:
                    clean_up()
                if not is_broken or time.monotonic() >= until:
                    raise self.sentence(error) from None
                time.sleep(RETRY_S)

    @override
    def connect(self) -> sa.Connection:
        """End the former connection, and retake its locks."""
        connection = self._engine.connect()
        with connection.begin():
            settings = (sa.func.set_config(name, str(value), False) for name, value in self._settings.items())
            connection.execute(sa.select(*settings))
            if self._held:
                self._retake(connection)
        return connection

    def _retake(self, connection: sa.Connection) -> None:
        """Take those locks again that nobody else has, or had for an evaluation."""
        connection.execute(sa.text(_END_FORMER), {"application": self.application})
        until = time.monotonic() + RETAKE_S
        for number in self._held:
            while not (is_held := self._take(connection, number)) and time.monotonic() < until:
                time.sleep(0.05)
            self._held[number] = is_held
        query = sa.select(EVALUATIONS.c.kind, EVALUATIONS.c.name, EVALUATIONS.c.writer)
        for row in connection.execute(query.where(EVALUATIONS.c.study == self.study)):
            number = _lock_number(self.study_name, f"{row.kind}-{row.name}")
            if number in self._held and row.writer not in (None, self.session):
                self._held[number] = False

    def lock_schema(self, connection: sa.Connection) -> None:
        """Lock the creation of tables until the commit: processes begin at once."""
        connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_lock_number("schema"))))

    @override
    def prepare(self, connection: sa.Connection) -> None:
        self.lock_schema(connection)
        super().prepare(connection)

    @override
    def now_s(self, connection: sa.Connection) -> float:
        return float(connection.execute(sa.text("select extract(epoch from clock_timestamp())")).scalar_one())

    @property
    @override
    def restart_words(self) -> str:
        return f"set {self.variable} to the address of an empty database"

    @override
    def sync(self) -> None:
        """PostgreSQL has synced already."""

    @override
    def try_lock(self, name: str) -> Lock | None:
        """Others keep theirs for a grace period after a restart."""
        number = _lock_number(self.study_name, name)

        def take(connection: sa.Connection) -> bool:
            is_starting = sa.func.now() - sa.func.pg_postmaster_start_time() <= timedelta(seconds=GRACE_S)
            query = sa.select(is_starting & sa.exists().where(SESSIONS.c.id != self.session))
            is_theirs = not name.endswith(self.session) and connection.execute(query).scalar()
            return not is_theirs and self._take(connection, number)

        with self._transaction:
            if number in self._held or not self.run(take):
                return None
            self._held[number], self._seen_s = True, _awake_s()

        def release() -> None:
            with self._transaction, suppress(TrapsError):  # a connection that is gone holds no locks
                self._held.pop(number, None)
                self.run(lambda c: c.execute(sa.select(sa.func.pg_advisory_unlock(number))), patience_s=0.0)

        return Lock(release, lambda: self._require(number), self._is_fresh)

    def _take(self, connection: sa.Connection, number: int) -> bool:
        return bool(connection.execute(sa.select(sa.func.pg_try_advisory_lock(number))).scalar())

    def lease(self, name: str) -> Lease | None:
        """Take a lease, as `Store.lease` says: a lock, which this process keeps alive."""
        with ExitStack() as opened:
            opened.enter_context(self.writing())
            if (lock := self.try_lock(f"lease/{name}")) is None:
                return None
            opened.callback(lock.release)
            return Lease(opened.pop_all().close)

    def _is_fresh(self) -> bool:
        return _awake_s() - self._seen_s <= OLD_S

    def _require(self, number: int) -> None:
        if not self._is_fresh():
            self.beat()
        if not self._held.get(number, False):
            raise taken_over(self.place)

    @override
    def beat(self) -> None:
        if self._held:
            began = _awake_s()
            self.run(lambda connection: connection.execute(sa.select(sa.literal(1))))
            self._seen_s = began

    @override
    def sentence(self, error: Exception) -> TrapsError:
        if is_damaged(error):
            return super().sentence(error)
        reason, _, _ = reason_and_remedy(error)
        return TrapsError(
            f"{self.variable}: the database at {self.place} cannot be used from the host {socket.gethostname()} "
            f"({reason}); the study {self.study_name} keeps its ledger there. See that the server runs and that "
            f'address, user and password are right (`psql "${self.variable}"` tries them), then run the same command '
            "again: what is stored is kept"
        )

    def _compare_clocks(self, connection: sa.Connection) -> None:
        """Raise TrapsError if this host's clock and the database's are too far apart."""
        before = time.time()
        server_s = self.now_s(connection)
        gap_s = max(server_s - time.time(), before - server_s)
        if gap_s > SKEW_S:
            order = "behind" if server_s > before else "ahead of"
            raise TrapsError(
                f"the clock of the host {socket.gethostname()} is {gap_s:.0f} s {order} that of the database at "
                f"{self.place}, and hosts of the study {self.study_name} may be {SKEW_S} s apart; set the clocks of "
                "both by NTP, then run the same command again"
            )


def _lock_number(*names: str) -> int:
    """Return the number of a named advisory lock."""
    return int.from_bytes(blake2b("/".join(names).encode(), digest_size=8).digest(), signed=True)


def open_ledger(variable: str, study: str) -> PostgresDatabase:
    """See `SeveralHosts`."""
    address = os.environ.get(variable)
    if not address:
        raise TrapsError(
            f"{variable} is not set on the host {socket.gethostname()}: study.yaml of {study} says that it holds the "
            f"address of the PostgreSQL database with the study's ledger; export "
            f"{variable}=postgresql://USER:PASSWORD@HOST:5432/DATABASE"
        )
    check_key(variable, address)
    return _opened(os.getpid(), address, variable, study)


@cache
def _opened(_pid: int, address: str, variable: str, study: str) -> PostgresDatabase:
    require_extra("cluster", "psycopg")
    return PostgresDatabase(address, variable, study)
