"""Write Dagster's SQLite history without waiting for the disk, and name the reason if it cannot be written.

Dagster opens and closes a file for each event, and SQLite would wait for the disk each time: half of a small run's wall
time. No kill of a process loses an event. A power cut may damage the history, which begins anew then: the tables'
footers are authoritative (`dagster_history`). The ledger has files of its own, and waits.
"""

from contextlib import suppress
from pathlib import Path
from sqlite3 import DatabaseError
from typing import Any

from sqlalchemy import Connection, Engine, ExceptionContext
from sqlalchemy.event import listens_for

from traps_pipeline.base.databases import reason_and_remedy
from traps_pipeline.base.errors import TrapsError

_FILES = "history/runs.db", "history/runs/*.db"  # below DAGSTER_HOME


def _is_history(engine: Engine) -> bool:
    is_sqlite = engine.dialect.name == "sqlite"
    return is_sqlite and any(map(Path(engine.url.database or "").match, _FILES))


@listens_for(Engine, "engine_connect")
def _do_not_sync(connection: Connection) -> None:
    driver: Any = connection.connection.driver_connection
    if _is_history(connection.engine):
        with suppress(DatabaseError):  # of a file that is no database, which the next statement names
            driver.execute("PRAGMA synchronous=OFF")


@listens_for(Engine, "handle_error")
def _explain(context: ExceptionContext) -> None:
    """Raise TrapsError in place of an error of a disk: Dagster stores the text."""
    reason, remedy, is_unwritable = reason_and_remedy(context.original_exception)
    if context.engine is not None and is_unwritable and _is_history(context.engine):
        raise TrapsError(
            f"{context.engine.url.database}: Dagster's history could not be written ({reason}); {remedy} and run the "
            "same command again: tables are whole, no answer is lost"
        )
