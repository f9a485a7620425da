"""Take leases in the database that holds the study's ledger."""

from __future__ import annotations

from contextlib import ExitStack

from traps_pipeline.ledger.postgres import PostgresDatabase, postgres_of
from traps_pipeline.storage.store import Lease

Database = PostgresDatabase
database_of = postgres_of


def lease(database: Database, name: str) -> Lease | None:
    """Take a lease (see `Store.lease`) as an advisory lock that this process renews."""
    with ExitStack() as opened:
        opened.enter_context(database.writing())
        lock = database.try_lock(f"lease/{name}")
        if lock is None:
            return None
        opened.callback(lock.release)
        return Lease(opened.pop_all().close)
