"""Translate database errors into a reason and a remedy that quote no statement."""

import re
import sqlite3

from traps_pipeline.base.terminal import plain

NO_SPACE = "no space left"
MAX_WORDS = 200  # characters of a reason that has no sentence here
# What SQLite, PostgreSQL and the system say; the first that is found counts.
_UNWRITABLE = (
    (r"disk is full|no space left|disk quota exceeded", NO_SPACE, "free some space"),
    (r"readonly database|read-only file system", "it is read-only", "make its folder writable for this user"),
    (r"disk I/O error|input/output error", "its disk fails or is full", "free some space"),
)
_PG_DAMAGED = ("XX001", "XX002")  # PostgreSQL: a table, an index is damaged
_SERVER = r"connection to server|could not translate host name|server closed the connection|terminating connection"


def reason_and_remedy(error: BaseException) -> tuple[str, str, bool]:
    """Return why a database is unusable, a remedy, and whether it is unwritable."""
    words = plain(" ".join(str(getattr(error, "orig", None) or error).split()))[:MAX_WORDS]
    for pattern, reason, remedy in _UNWRITABLE:
        if re.search(pattern, words, re.IGNORECASE):  # own text: at most MAX_WORDS of it
            return reason, remedy, True
    if is_damaged(error):
        return "it is damaged, or no database", "move that file away, or restore a copy of it", False
    if re.search(_SERVER, words, re.IGNORECASE):
        return words, "see that the server runs and that address, user and password are right on this host", False
    return words or "it gives no reason", "free some space, or move that folder away", False


def is_damaged(error: BaseException) -> bool:
    """Return whether a database says that it is damaged, or that a file is none, by the code of its error."""
    cause = getattr(error, "orig", None) or error
    code = getattr(cause, "sqlite_errorcode", 0) & 0xFF  # the lowest byte is the kind
    return code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB) or getattr(cause, "sqlstate", "") in _PG_DAMAGED


def database_error(error: BaseException) -> BaseException | None:
    """Return the database error that an exception is or was raised from, if any."""
    from sqlalchemy.exc import DBAPIError

    current: BaseException | None = error
    while current is not None and not isinstance(current, DBAPIError):
        current = current.__cause__
    return current
