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
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from hashlib import blake2b
from typing import Any, TypeVar
from urllib.parse import urlsplit

import sqlalchemy as sa
from sqlalchemy import exc

from traps_pipeline.base.databases import reason_and_remedy
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import require
from traps_pipeline.base.keys import check_key
from traps_pipeline.ledger.database import Database, Lock
from traps_pipeline.ledger.schema import EVALUATIONS, SESSIONS

T = TypeVar("T")

IDLE_S = 30.0  # the server ends a connection that is idle for so long: its process is stopped
OLD_S = 1.5  # locks checked longer ago than this allow no call
PATIENCE_S = 60.0  # how long a run waits for an unreachable server
GRACE_S = 10  # grace period after a server start for former holders to take their locks again
RETRY_S = 0.2
SKEW_S = 60  # Dagster compares times of several hosts to tell a run that never began; stores refuse 15 minutes
KEEPALIVE: dict[str, Any] = {
    "keepalives_idle": 5,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 15_000,
}


def awake_s() -> float:
    """Return a clock (s) that runs on while the process is stopped or the host sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def lock_number(name: str) -> int:
    """Return the number of a named advisory lock."""
    return int.from_bytes(blake2b(name.encode(), digest_size=8).digest(), signed=True)


class PostgresDatabase(Database):
    """A ledger shared by hosts; the environment variable `variable` has its address."""

    def __init__(self, address: str, variable: str, study: str, idle_s: float = IDLE_S) -> None:
        super().__init__(study)
        self._variable, self._idle_s, self.patience_s = variable, idle_s, PATIENCE_S
        self.application = f"traps {secrets.token_hex(8)}"  # the server's ids of this process's connections
        try:
            urlsplit(address).port  # noqa: B018 - raises ValueError
            url = sa.make_url(address)
            if not url.drivername.startswith("postgres"):
                raise ValueError(url.drivername)
            self._place = f"{url.host}:{url.port or 5432}/{url.database}"
        except (exc.ArgumentError, ValueError):
            raise TrapsError(
                f"{variable}: is no address of a PostgreSQL database; write it as "
                f"postgresql://USER:PASSWORD@HOST:5432/DATABASE (study {study}, host {socket.gethostname()})"
            ) from None
        self._engine = sa.create_engine(
            url.set(drivername="postgresql+psycopg"),
            poolclass=sa.NullPool,
            connect_args={"connect_timeout": 10, "application_name": self.application, **KEEPALIVE},
        )
        self._guard_connection = threading.RLock()
        self._connection: sa.Connection | None = None
        self._is_working = False
        self._held: dict[int, bool] = {}  # by lock number: whether this process still holds it
        self._seen_s = float("-inf")  # when the locks were last checked
        self.run(self._compare_clocks, patience_s=0.0)

    @property
    def place(self) -> str:
        """See `Database.place`."""
        return self._place

    def exists(self) -> bool:
        """See `Database.exists`."""
        return True

    def read(self) -> sa.Connection:
        """See `Database.read`."""
        until = time.monotonic() + self.patience_s
        while True:
            try:
                return self._engine.connect()
            except exc.DBAPIError as error:
                if time.monotonic() >= until:
                    raise self._sentence(error) from None
                time.sleep(RETRY_S)

    def run(self, work: Callable[[sa.Connection], T], patience_s: float | None = None) -> T:
        """See `Database.run`; in one thread, a nested `run` joins the outer transaction."""
        until = time.monotonic() + (self.patience_s if patience_s is None else patience_s)
        with self._guard_connection:
            if self._is_working and self._connection is not None:
                return work(self._connection)
            while True:
                try:
                    connection = self._connected()
                    self._is_working = True
                    with connection.begin():
                        return work(connection)
                except exc.DBAPIError as error:
                    is_there = self._connection is not None and not self._connection.invalidated
                    if is_there and not error.connection_invalidated and not isinstance(error, exc.OperationalError):
                        raise self._sentence(error) from None
                    self._drop()
                    if time.monotonic() >= until:
                        raise self._sentence(error) from None
                    time.sleep(RETRY_S)
                finally:
                    self._is_working = False

    def try_lock(self, name: str) -> Lock | None:
        """See `Database.try_lock`; others keep theirs for a grace period after a restart."""
        number = lock_number(f"{self.study_name}/{name}")

        def take(connection: sa.Connection) -> bool:
            if number in self._held:
                return False
            if not name.endswith(self.session) and self._is_starting(connection):
                return False
            return bool(connection.execute(sa.select(sa.func.pg_try_advisory_lock(number))).scalar())

        if not self.run(take):
            return None
        self._held[number] = True
        self._seen_s = awake_s()

        def release() -> None:
            self._held.pop(number, None)
            with suppress(TrapsError):  # a connection that is gone holds no locks
                self.run(lambda c: c.execute(sa.select(sa.func.pg_advisory_unlock(number))), patience_s=0.0)

        return Lock(release, lambda: self._require(number), self._is_fresh)

    def _is_fresh(self) -> bool:
        return awake_s() - self._seen_s <= OLD_S

    def _is_starting(self, connection: sa.Connection) -> bool:
        up_s = "select extract(epoch from now() - pg_postmaster_start_time())"
        if connection.execute(sa.text(up_s)).scalar_one() > GRACE_S or not sa.inspect(connection).has_table(
            SESSIONS.name
        ):
            return False
        other_sessions = sa.select(SESSIONS.c.id).where(SESSIONS.c.id != self.session).limit(1)
        return connection.execute(other_sessions).scalar() is not None

    def _require(self, number: int) -> None:
        if not self._is_fresh():
            self.beat()
        if not self._held.get(number, False):
            raise TrapsError(
                f"{self.place}: another process has begun to ask the same calls, since this one was away; nothing more "
                "is sent. Run the same command again when the other one has ended"
            )

    def beat(self) -> None:
        """See `Database.beat`."""
        if self._held:
            self.run(self._look)

    def _look(self, connection: sa.Connection) -> None:
        began = awake_s()
        connection.execute(sa.select(sa.literal(1)))
        self._seen_s = began

    def sync(self) -> None:
        """See `Database.sync`; PostgreSQL has synced already."""

    def now_s(self, connection: sa.Connection) -> float:
        """See `Database.now_s`."""
        return float(connection.execute(sa.text("select extract(epoch from clock_timestamp())")).scalar_one())

    def prepare(self, connection: sa.Connection) -> None:
        """See `Database.prepare`."""
        # Processes that begin at once would each create the tables, or the study's row.
        connection.execute(sa.select(sa.func.pg_advisory_xact_lock(lock_number("schema"))))
        super().prepare(connection)

    # --- the connection -----------------------------------------------------------------------------------------------

    def _connected(self) -> sa.Connection:
        if self._connection is None:
            self._connection = self._engine.connect()
            try:
                self._enter(self._connection)
            except BaseException:
                self._drop()
                raise
        return self._connection

    def _enter(self, connection: sa.Connection) -> None:
        """Adopt a new connection: end the former ones, and retake locks still free."""
        with connection.begin():
            for name in ("idle_session_timeout", "idle_in_transaction_session_timeout"):
                connection.execute(sa.select(sa.func.set_config(name, f"{int(1000 * self._idle_s)}", False)))
            for name, value in (("idle", "5"), ("interval", "5"), ("count", "3")):
                connection.execute(sa.select(sa.func.set_config(f"tcp_keepalives_{name}", value, False)))
        if not self._held:
            return
        ending = (
            "select pg_terminate_backend(pid) from pg_stat_activity "
            "where application_name = :name and pid <> pg_backend_pid()"
        )
        with connection.begin():
            connection.execute(sa.text(ending), {"name": self.application})
        until = time.monotonic() + 5  # the old connection takes a moment to end
        for number in self._held:
            while True:
                with connection.begin():
                    self._held[number] = bool(
                        connection.execute(sa.select(sa.func.pg_try_advisory_lock(number))).scalar()
                    )
                if self._held[number] or time.monotonic() > until:
                    break
                time.sleep(0.05)
        with connection.begin():
            if sa.inspect(connection).has_table(EVALUATIONS.name):
                self._compare_writers(connection)

    def _compare_writers(self, connection: sa.Connection) -> None:
        """Give up the locks of evaluations that another session has written to meanwhile."""
        query = sa.select(EVALUATIONS.c.kind, EVALUATIONS.c.name, EVALUATIONS.c.writer)
        for row in connection.execute(query.where(EVALUATIONS.c.study == self.study)):
            number = lock_number(f"{self.study_name}/{row.kind}-{row.name}")
            if number in self._held and row.writer not in (None, self.session):
                self._held[number] = False

    def _drop(self) -> None:
        if self._connection is not None:
            with suppress(Exception):
                self._connection.invalidate()
            with suppress(Exception):
                self._connection.close()
            self._connection = None

    def end(self) -> None:
        """See `Database.end`."""
        with self._guard_connection:
            self._drop()

    def _sentence(self, error: Exception) -> TrapsError:
        reason, _, _ = reason_and_remedy(error)
        return TrapsError(
            f"{self._variable}: the database at {self.place} cannot be used from the host {socket.gethostname()} "
            f"({reason}); the study {self.study_name} keeps its ledger there. See that the server runs and that "
            f'address, user and password are right (`psql "${self._variable}"` tries them), then run the same command '
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


def postgres_of(variable: str, study: str) -> PostgresDatabase:
    """Return this process's database at a variable's address. Raises TrapsError."""
    address = os.environ.get(variable)
    if not address:
        raise TrapsError(
            f"{variable} is not set on the host {socket.gethostname()}: study.yaml of {study} says that it holds the "
            f"address of the PostgreSQL database with the study's ledger; export "
            f"{variable}=postgresql://USER:PASSWORD@HOST:5432/DATABASE"
        )
    check_key(variable, address)
    return _postgres_of(os.getpid(), address, variable, study)


@cache
def _postgres_of(_pid: int, address: str, variable: str, study: str) -> PostgresDatabase:
    require("cluster", "psycopg")
    return PostgresDatabase(address, variable, study)
