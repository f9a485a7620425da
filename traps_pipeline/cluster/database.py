"""The database in which hosts share names of files and leases: the one that holds the study's ledger."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from functools import cache
from typing import TypeVar

import sqlalchemy as sa
from sqlalchemy.exc import OperationalError

from traps_pipeline.storage.database import PATIENCE_S, RETRY_S, Session, lock_number, session_of
from traps_pipeline.storage.store import Lease
from traps_pipeline.storage.stream import stream_of

T = TypeVar("T")


class Database:
    """The database of a study, for this process. Threads may share it."""

    def __init__(self, address: str, session: Session) -> None:
        url = "postgresql+psycopg://" + address.partition("://")[2]
        self._engine = sa.create_engine(url, pool_size=1, max_overflow=-1, pool_pre_ping=True)
        self._session = session

    def run(self, work: Callable[[sa.Connection], T]) -> T:
        """Return what `work` returns, done in one transaction. Where the connection breaks it is done again, for
        PATIENCE_S, so it must be idempotent. Raises TrapsError when the server stays away."""
        until = time.monotonic() + PATIENCE_S
        while True:
            try:
                with self._engine.begin() as connection:
                    return work(connection)
            except OperationalError as error:
                if time.monotonic() >= until:
                    raise self._session.unusable(error.orig or error) from None  # its arguments hold the password
                time.sleep(RETRY_S)

    def lease(self, name: str) -> Lease | None:
        """Take a piece of work of the study, as `Store.lease` says: an advisory lock of the process's session."""
        lock = lock_number(f"{self._session.study}/lease/{name}")
        if not self._session.take(lock):
            return None
        stream_of(self._session).start()  # whose thread keeps the session alive while something is held
        return Lease(lambda: self._session.give_back(lock))


def database_of(variable: str, study: str) -> Database:
    """Return the database of a study whose address a variable of the environment holds. Raises TrapsError."""
    return _database_of(session_of(variable, study), os.environ[variable])


@cache
def _database_of(session: Session, address: str) -> Database:
    return Database(address, session)
