"""The PostgreSQL database that several hosts share: one direct connection of a process, its locks, and what happens to
them when the connection breaks.

The connection holds the process's locks, and its rows are written through it: where it is gone, so is the right to
write. A process that is silent for IDLE_S (stopped, or cut off) loses it. It may go on after a new connection only if
nobody took its locks over meanwhile, which a number tells that every new holder raises. PostgreSQL must be reached
directly, not through a pool that shares connections.
"""

from __future__ import annotations

import os
import secrets
import socket
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, LiteralString, TypeVar
from urllib.parse import urlsplit

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import require
from traps_pipeline.base.keys import check_key

if TYPE_CHECKING:
    from psycopg import Connection

T = TypeVar("T")

IDLE_S = 30  # after so long the server ends a session that says nothing: its process is stopped
BEAT_S = 0.5  # how often a process that may write says so, and looks whether it still may
FRESH_S, OLD_S = 0.4, 1.5  # a look that is younger is not repeated; one that is older allows no call
PATIENCE_S = 60.0  # how long a run waits for a server that is away
GRACE_S = 10  # after the server was started, those who held a lock before have so long to take it again
RETRY_S = 0.2
SKEW_S = 60  # Dagster compares times of several hosts to tell a run that never began; stores refuse 15 minutes
FORMAT = 2  # of the tables; those of format 1 have no segments, and are given them
KEEPALIVE: dict[str, Any] = {
    "keepalives_idle": 5,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 15_000,
}
_SCHEMA = """
create schema traps;
create table traps.format (version int not null);
create table traps.studies (id serial primary key, name text not null unique, is_here boolean not null default true);
create table traps.evaluations (
    id serial primary key, study int not null references traps.studies, kind text not null, name text not null,
    number bigint not null default 0,  -- raised by every new writer; a group of rows with an old one is refused
    groups bigint not null default 0,  -- stored by this writer, so that none is stored twice
    holder text, since timestamptz, unique (study, kind, name));
create table traps.rows (
    id bigserial primary key, evaluation int not null references traps.evaluations, key text not null,
    settled boolean not null, line bytea not null, digest bytea not null, reasoning bytea, raw bytea);
create unique index on traps.rows (evaluation, key) where settled;
create index on traps.rows (evaluation, key);
create table traps.totals (
    study int not null references traps.studies, kind text not null, participant text not null,
    dollars float8 not null, dearest float8 not null, unknown bigint not null,
    sums float8[] not null, counts float8[] not null,  -- of the columns whose means forecast what a call takes
    primary key (study, kind, participant));
create table traps.spent (
    study int not null references traps.studies, participant text not null, usd float8 not null,
    primary key (study, participant));
create table traps.blocks (
    study int not null references traps.studies, session text not null, participant text not null,
    granted float8 not null, booked float8 not null default 0, lost float8 not null default 0,
    primary key (study, session, participant));
"""
_SEGMENTS = """
create table if not exists traps.segments (  -- rows that lie in the object store (`storage/compaction.py`)
    id bigserial primary key, evaluation int not null references traps.evaluations,
    digest bytea not null, size bigint not null, rows bigint not null, unique (evaluation, digest))
"""


def awake_s() -> float:
    """Seconds of a clock that goes on while this process is stopped or its machine sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def lock_number(name: str) -> int:
    """The number of an advisory lock."""
    return int.from_bytes(blake2b(name.encode(), digest_size=8).digest(), signed=True)


@dataclass
class Claim:
    """The right to write to an evaluation. number: of this writer; groups: how many it has stored; lost: whether
    another process has the right now; is_succession: whether the one before it did not give it back."""

    evaluation: int
    name: str
    lock: int
    number: int
    groups: int = 0
    lost: bool = False
    is_succession: bool = False


class Session:
    """A process's connection to the database, for one study. Its methods may be called from any thread."""

    def __init__(self, address: str, variable: str, study: str, idle_s: float = IDLE_S) -> None:
        self.id = secrets.token_hex(8)
        self.study, self._address, self._variable, self._idle_s = study, address, variable, idle_s
        self.claims: dict[int, Claim] = {}
        self._leases = set[int]()  # locks of pieces of work that were taken
        self.guard, self.closed, self.patience_s = threading.RLock(), False, PATIENCE_S
        self.has_blocks, self.purse = False, threading.Lock()  # of the study's budget; one purse at a time
        self._sharers: dict[str, int] = {}  # by account that is asked through: how many processes ask through it
        self._connection: Connection[Any] | None = None
        self._looked_at = float("-inf")  # when it was last seen that no claim was lost
        self._lock = lock_number(f"session {self.id}")
        try:
            parts = urlsplit(address)
            self.host = f"{parts.hostname}:{parts.port or 5432}{parts.path}"
        except ValueError:
            self.host = "an address that cannot be read"
        self.run(self._compare_clocks, patience_s=0.0)
        self.study_id = self.run(self._prepare, patience_s=0.0)

    # --- connecting -------------------------------------------------------------------------------------------------

    def run(self, work: Callable[[Connection[Any]], T], patience_s: float | None = None) -> T:
        """What `work` returns, done in one transaction. Where the connection breaks it is done again on a new one, so
        it must be such that twice is as good as once. Raises TrapsError when the server stays away."""
        import psycopg

        until = time.monotonic() + (self.patience_s if patience_s is None else patience_s)
        with self.guard:
            while True:
                try:
                    connection = self._connected()
                    # Not in a pipeline: the server does not end a session that is stopped within one.
                    with connection.transaction():
                        return work(connection)
                except psycopg.Error as error:
                    is_there = self._connection is not None and not self._connection.closed
                    if is_there and not isinstance(error, psycopg.OperationalError):
                        raise
                    if self.closed or time.monotonic() >= until:
                        raise self.unusable(error) from None  # its arguments hold the password
                    time.sleep(RETRY_S)

    def _connected(self) -> Connection[Any]:
        if self._connection is None or self._connection.closed:
            import psycopg

            try:
                self._connection = psycopg.connect(
                    self._address, autocommit=True, connect_timeout=10, application_name=f"traps {self.id}",
                    **KEEPALIVE,
                )  # fmt: skip
            except psycopg.ProgrammingError:
                raise TrapsError(
                    f"{self._variable}: is no address of a PostgreSQL database; write it as "
                    "postgresql://USER:PASSWORD@HOST:5432/DATABASE "
                    f"(study {self.study}, host {socket.gethostname()})"
                ) from None
            self._enter(self._connection)
        return self._connection

    def _enter(self, connection: Connection[Any]) -> None:
        """Make a new connection this session's: end those before it, and take again what nobody else has taken."""
        for name, seconds in (("idle_session", self._idle_s), ("idle_in_transaction_session", self._idle_s)):
            setting = f"{name}_timeout", f"{int(1000 * seconds)}"
            connection.execute("select set_config(%s, %s, false)", setting)
        for name, value in (("idle", "5"), ("interval", "5"), ("count", "3")):
            connection.execute("select set_config(%s, %s, false)", [f"tcp_keepalives_{name}", value])
        own = "select pg_terminate_backend(pid) from pg_stat_activity where application_name = %s and pid <> %s"
        connection.execute(own, [f"traps {self.id}", connection.info.backend_pid])
        until = time.monotonic() + 5  # the old connection takes a moment to end
        claimed = {claim.lock: claim for claim in self.claims.values()}
        for lock in (self._lock, *claimed, *self._leases):
            while not (taken := self.try_lock(connection, lock)):
                if time.monotonic() > until:
                    break
                time.sleep(0.05)
            if lock in claimed and not taken:
                claimed[lock].lost = True
        for account in self._sharers:
            connection.execute("select pg_advisory_lock_shared(%s)", [lock_number(f"account {account}")])
        if self.claims:
            self._look(connection)

    @staticmethod
    def try_lock(connection: Connection[Any], lock: int) -> bool:
        """Take an advisory lock, unless another session holds it. One that this session holds is not taken twice."""
        held = """select exists (select from pg_locks where locktype = 'advisory' and granted and pid = pg_backend_pid()
                  and objsubid = 1 and classid::bigint = %s and objid::bigint = %s)"""
        high, low = divmod(lock % 2**64, 2**32)
        return _value(connection, held, high, low) or _value(connection, "select pg_try_advisory_lock(%s)", lock)

    def take(self, lock: int) -> bool:
        """Take an advisory lock for a piece of work, until it is given back; False where it is taken. Where another
        session takes it while this one has no connection, nobody is told. Raises TrapsError when the server stays
        away."""
        with self.guard:
            if lock in self._leases or not self.run(lambda connection: self.try_lock(connection, lock)):
                return False
            self._leases.add(lock)
            return True

    def give_back(self, lock: int) -> None:
        """Give back what was taken."""
        with self.guard:
            self._leases.discard(lock)
            with suppress(TrapsError):  # a connection that is gone holds no locks
                self.run(lambda c: c.execute("select pg_advisory_unlock(%s)", [lock]), patience_s=0.0)

    def unusable(self, error: BaseException) -> TrapsError:
        """Return what a person reads where the database cannot be used."""
        said = " ".join(f"{error}".split()) or type(error).__name__
        return TrapsError(
            f"{self._variable}: the database at {self.host} cannot be used from the host {socket.gethostname()} "
            f"({said}); the study {self.study} keeps its ledger there. See that the server runs and that address, user "
            f'and password are right (`psql "${self._variable}"` tries them), then run the same command again: what is '
            "stored is kept"
        )

    def _compare_clocks(self, connection: Connection[Any]) -> None:
        """Raises TrapsError where this host's clock and the database's are too far apart."""
        before = time.time()
        theirs = float(_value(connection, "select extract(epoch from clock_timestamp())"))
        apart = max(theirs - time.time(), before - theirs)
        if apart > SKEW_S:
            behind = "behind" if theirs > before else "ahead of"
            raise TrapsError(
                f"the clock of the host {socket.gethostname()} is {apart:.0f} s {behind} that of the database at "
                f"{self.host}, and hosts of the study {self.study} may be {SKEW_S} s apart; set the clocks of both by "
                "NTP, then run the same command again"
            )

    def _prepare(self, connection: Connection[Any]) -> int:
        """Make the tables if there are none; the study's number."""
        connection.execute("select pg_advisory_xact_lock(%s)", [lock_number("schema")])
        if not _value(connection, "select to_regclass('traps.format') is not null"):
            for statement in _SCHEMA.split(";\n"):
                if statement.strip():
                    connection.execute(statement)
            connection.execute("insert into traps.format values (1)")
        if _value(connection, "select version from traps.format") == 1:
            connection.execute(_SEGMENTS)
            connection.execute("update traps.format set version = 2")
        found = _value(connection, "select version from traps.format")
        if found != FORMAT:
            raise TrapsError(
                f"{self.host}: its tables have format {found}, this version reads {FORMAT}; use the version that made "
                f"them, or another database (study {self.study})"
            )
        connection.execute("insert into traps.studies (name) values (%s) on conflict do nothing", [self.study])
        return _value(connection, "select id from traps.studies where name = %s", self.study)

    # --- whether this process may still write -----------------------------------------------------------------------

    def look(self) -> None:
        """Look whether the claims are still this process's. Raises TrapsError when the server stays away."""
        with self.guard:
            if self._age_s() > FRESH_S:
                self.run(self._look)

    def _look(self, connection: Connection[Any]) -> None:
        began = awake_s()
        ids = [*self.claims]
        sql = "select id, number from traps.evaluations where id = any(%s)"
        numbers = dict(connection.execute(sql, [ids]).fetchall())
        for evaluation, claim in list(self.claims.items()):
            if evaluation in ids and numbers.get(evaluation) != claim.number:
                claim.lost = True
        for account in self._sharers:
            self._sharers[account] = self._count(connection, account)
        self._looked_at = began

    # --- the pace of an account -------------------------------------------------------------------------------------

    @contextmanager
    def sharing(self, accounts: Collection[str]) -> Iterator[Callable[[str], int]]:
        """Within the block this process asks through these accounts. The value tells how many processes of all studies
        in this database do, itself among them, as it was when the claims were last looked at: never waits. A process
        that dies is not counted any more. Raises TrapsError when the server stays away."""

        def begin(connection: Connection[Any]) -> None:
            for account in accounts:
                if account not in self._sharers:
                    connection.execute("select pg_advisory_lock_shared(%s)", [lock_number(f"account {account}")])
                    self._sharers[account] = 1
                self._sharers[account] = self._count(connection, account)

        mine = [account for account in accounts if account not in self._sharers]
        self.run(begin)
        try:
            yield lambda account: max(1, self._sharers.get(account, 1))
        finally:
            for account in mine:
                del self._sharers[account]
            with suppress(TrapsError):  # a connection that is gone holds no locks
                self.run(
                    lambda connection: [
                        connection.execute("select pg_advisory_unlock_shared(%s)", [lock_number(f"account {account}")])
                        for account in mine
                    ],
                    patience_s=0.0,
                )

    @staticmethod
    def _count(connection: Connection[Any], account: str) -> int:
        sql = """select count(*) from pg_locks where locktype = 'advisory' and granted and objsubid = 1
                 and database = (select oid from pg_database where datname = current_database())
                 and classid::bigint = %s and objid::bigint = %s"""
        return _value(connection, sql, *divmod(lock_number(f"account {account}") % 2**64, 2**32))

    def _age_s(self) -> float:
        return awake_s() - self._looked_at

    @property
    def is_fresh(self) -> bool:
        """Whether it was looked so short a time ago that a call may be sent."""
        return self._age_s() <= OLD_S

    def is_dead(self, connection: Connection[Any], session: str) -> bool:
        """Whether another process, by the id of its session, has ended. One that held its locks when the server was
        stopped has a while to come back."""
        lock = lock_number(f"session {session}")
        if session == self.id or not self.is_settled(connection):
            return False
        if not _value(connection, "select pg_try_advisory_lock(%s)", lock):
            return False
        connection.execute("select pg_advisory_unlock(%s)", [lock])
        return True

    @staticmethod
    def is_settled(connection: Connection[Any]) -> bool:
        """Whether the server has been up for a while."""
        return _value(connection, "select extract(epoch from now() - pg_postmaster_start_time()) > %s", GRACE_S)

    @property
    def is_held(self) -> bool:
        """Whether anything is held that is lost when this process is silent."""
        return bool(self.claims) or bool(self._leases) or self.has_blocks

    def close(self) -> None:
        """End the connection, and with it its locks."""
        with self.guard:
            self.closed = True
            if self._connection is not None:
                with suppress(Exception):
                    self._connection.close()


def _value(connection: Connection[Any], sql: LiteralString, *values: Any) -> Any:
    """The first column of the first row."""
    row = connection.execute(sql, values).fetchone()
    return row[0] if row else None


def session_of(variable: str, study: str) -> Session:
    """The session of this process with the database whose address a variable of the environment holds. Raises
    TrapsError."""
    address = os.environ.get(variable)
    if not address:
        raise TrapsError(
            f"{variable} is not set on the host {socket.gethostname()}: study.yaml of {study} says that it holds the "
            f"address of the PostgreSQL database with the study's ledger; export {variable}=postgresql://USER:PASSWORD@HOST:5432/DATABASE"
        )
    check_key(variable, address)
    return _session_of(os.getpid(), address, variable, study)


@cache
def _session_of(_pid: int, address: str, variable: str, study: str) -> Session:
    require("cluster", "psycopg")
    return Session(address, variable, study)
