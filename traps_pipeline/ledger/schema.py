"""Define the tables of the ledger, the same in SQLite and PostgreSQL.

Money moves in the transaction of the row that it pays for: a call's worst case is a row of `reservations` before the
call is sent, and the transaction that stores its answer deletes that row and adds the cost to `totals`. Spent are the
totals' dollars, less the failed ones of `releases`.
"""

from typing import Any

import sqlalchemy as sa

from traps_pipeline.ledger.rows import AVERAGED_COLUMNS

METADATA = sa.MetaData()


def _study(**options: Any) -> sa.Column[int]:
    return sa.Column("study", sa.Integer, sa.ForeignKey("traps_studies.id"), **options)


STUDIES = sa.Table(
    "traps_studies",
    METADATA,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("name", sa.Text, nullable=False, unique=True),
)
# batch: the number of the last transaction of a session, so that one which is repeated after a lost connection is
# not applied twice.
SESSIONS = sa.Table(
    "traps_sessions",
    METADATA,
    sa.Column("id", sa.Text, primary_key=True),
    _study(nullable=False),
    sa.Column("batch", sa.BigInteger, nullable=False, default=0),
)
# writer: the session that may add rows; a transaction of another one is refused. holder: for people.
EVALUATIONS = sa.Table(
    "traps_evaluations",
    METADATA,
    sa.Column("id", sa.Integer, primary_key=True),
    _study(nullable=False),
    sa.Column("kind", sa.Text, nullable=False),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("writer", sa.Text),
    sa.Column("holder", sa.Text),
    sa.UniqueConstraint("study", "kind", "name"),
)
# Keys are digests: an index of them would take half the time of writing rows, as each changes a page of its own.
ROWS = sa.Table(
    "traps_rows",
    METADATA,
    sa.Column("id", sa.BigInteger().with_variant(sa.Integer, "sqlite"), primary_key=True),
    sa.Column("evaluation", sa.Integer, sa.ForeignKey("traps_evaluations.id"), nullable=False, index=True),
    sa.Column("key", sa.Text, nullable=False),
    sa.Column("content", sa.LargeBinary, nullable=False),
    sa.Column("digest", sa.LargeBinary, nullable=False),
    sa.Column("reasoning", sa.LargeBinary),
    sa.Column("raw", sa.LargeBinary),
)
TOTALS = sa.Table(
    "traps_totals",
    METADATA,
    _study(primary_key=True),
    sa.Column("kind", sa.Text, primary_key=True),
    sa.Column("participant", sa.Text, primary_key=True),
    sa.Column("dollars", sa.Double, nullable=False),
    sa.Column("failed", sa.Double, nullable=False),
    sa.Column("dearest", sa.Double, nullable=False),
    sa.Column("unknown", sa.Integer, nullable=False),
    *(
        sa.Column(f"{column}_{what}", kind, nullable=False)
        for column in AVERAGED_COLUMNS
        for what, kind in (("sum", sa.Double()), ("n", sa.BigInteger()))
    ),
)
# Reservations of a dead session count as spent until a person releases them.
RESERVATIONS = sa.Table(
    "traps_reservations",
    METADATA,
    _study(primary_key=True),
    sa.Column("id", sa.Text, primary_key=True),
    sa.Column("session", sa.Text, nullable=False),
    sa.Column("participant", sa.Text, nullable=False),
    sa.Column("usd", sa.Double, nullable=False),
    sqlite_with_rowid=False,
)
# in_flight and failed: released dollars of calls whose process died, and of failed calls.
RELEASES = sa.Table(
    "traps_releases",
    METADATA,
    sa.Column("id", sa.Integer, primary_key=True),
    _study(nullable=False),
    sa.Column("participant", sa.Text, nullable=False),
    sa.Column("in_flight", sa.Double, nullable=False),
    sa.Column("failed", sa.Double, nullable=False),
    sa.Column("why", sa.Text, nullable=False),
    sa.Column("by", sa.Text, nullable=False),
    sa.Column("at", sa.Text, nullable=False),
)
# What each transaction leaves: the number of rows, and digests of all money and of the evaluations' names (`Batch`).
SEALS = sa.Table(
    "traps_seals",
    METADATA,
    _study(primary_key=True),
    sa.Column("rows", sa.BigInteger, nullable=False),
    sa.Column("money", sa.LargeBinary, nullable=False),
    sa.Column("evaluations", sa.LargeBinary, nullable=False),
)
# Sessions that use an account; each renews its row about every second (`seen_s`, seconds since 1970).
SHARERS = sa.Table(
    "traps_sharers",
    METADATA,
    sa.Column("session", sa.Text, primary_key=True),
    sa.Column("account", sa.Text, primary_key=True),
    sa.Column("seen_s", sa.Double, nullable=False),
)
