"""Dagster's history in the PostgreSQL database that holds the study's ledger: the same runs, seen from every host."""

from __future__ import annotations

import os
import socket
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from dagster import StringSource
from dagster._core.storage.base_storage import DagsterStorage
from dagster._serdes import ConfigurableClassData

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.keys import check_key
from traps_pipeline.base.redaction import redact
from traps_pipeline.storage.database import KEEPALIVE
from traps_pipeline.storage.workspace import VARIABLE


def unusable() -> tuple[type[Exception], ...]:
    """What is raised where the database of a history cannot be reached, or breaks."""
    from sqlalchemy.exc import DBAPIError

    if find_spec("dagster_postgres") is None:
        return (DBAPIError,)
    return DBAPIError, import_module("dagster_postgres.utils").DagsterPostgresException


class SharedHistory(DagsterStorage):
    """Named in `dagster.yaml`; what is made of it is dagster-postgres's own storage. variable: that holds the address,
    which stands in no file and in no run."""

    @classmethod
    def config_type(cls) -> dict[str, Any]:
        """Fields in `dagster.yaml`."""
        return {"variable": StringSource}

    @classmethod
    def from_config_value(cls, inst_data: ConfigurableClassData | None, config_value: Any) -> DagsterStorage:
        """Dagster's way to make it. Raises TrapsError where the variable is not set on this host."""
        variable = config_value["variable"]
        address = os.environ.get(variable)
        if not address:
            raise TrapsError(
                f"{variable} is not set on the host {socket.gethostname()}; export the address of the database of the "
                f"study {os.environ.get(VARIABLE, 'whose history is opened')}"
            )
        check_key(variable, address)
        # SQLAlchemy 2.1 takes psycopg 3 for a plain postgresql://, and dagster-postgres's NOTIFY fails with it.
        url = "postgresql+psycopg2://" + address.partition("://")[2]
        storage = import_module("dagster_postgres").DagsterPostgresStorage
        try:
            return _connected(storage(url, should_autocreate_tables=True, inst_data=inst_data), url)
        except unusable() as error:
            raise TrapsError(
                f"the host {socket.gethostname()} cannot open the history of the study "
                f"{os.environ.get(VARIABLE, 'that it was told of')} with {variable} ({_cause(error)}); see "
                "that the address, its user and its password are right on this host, and run the same command again"
            ) from None  # the cause names the address


def _cause(error: BaseException) -> str:
    """Return the innermost reason in one line."""
    while error.__cause__ is not None or error.__context__ is not None:
        error = error.__cause__ or error.__context__ or error
    return redact(" ".join(str(error).split()))[:300]


def _connected(storage: Any, url: str) -> DagsterStorage:
    """A storage of dagster-postgres that keeps a connection of the process, which its parts share. By itself it makes
    one for each statement, which took two fifths of the time of a run that asks; its own way to keep one, that of the
    web server, loses the event that finds the connection broken."""
    from sqlalchemy import create_engine

    kept: dict[str, Any] = {"pool_size": 1, "max_overflow": -1, "pool_pre_ping": True, "connect_args": KEEPALIVE}
    engine = create_engine(url, isolation_level="AUTOCOMMIT", **kept)
    for part in (storage.event_log_storage, storage.run_storage, storage.schedule_storage):
        part._engine = engine
    return storage
