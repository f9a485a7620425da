"""Collect a ledger transaction: rows, their totals, and the money they move."""

from __future__ import annotations

import os
import socket
import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import sqlalchemy as sa
from sqlalchemy import exc

from traps_pipeline.ledger.rows import AVERAGED_COLUMNS, Totals
from traps_pipeline.ledger.schema import EVALUATIONS, RELEASES, RESERVATIONS, ROWS, TOTALS

CENT = 1e-9  # below this, dollars are rounding


@dataclass(frozen=True)
class CapExhausted:
    """The reason why a call was not reserved.

    slot: the participant whose cap is exhausted, None for the study's; taken_usd: spent and reserved under that cap;
    others: sessions of other processes that hold reservations.
    """

    slot: str | None
    taken_usd: float
    others: frozenset[str]


@dataclass
class Request:
    """A call's worst case, to be reserved under the caps of participants and of the study (None).

    exhausted: set by the commit, if a cap leaves no room.
    """

    id: str
    participant: str
    usd: float
    caps: Mapping[str | None, float]
    exhausted: CapExhausted | None = None


class Batch:
    """A transaction of the commit thread: collects changes, which `flush` writes."""

    def __init__(self, connection: sa.Connection, study: int, session: str) -> None:
        self.connection, self.study, self.session = connection, study, session
        self.rows: list[dict[str, Any]] = []
        self.totals = defaultdict[tuple[str, str], Totals](Totals)
        self._writers: dict[int, bool] = {}
        # By reservation: requests, new amounts of existing ones, and those to remove.
        self._requests: dict[str, Request] = {}
        self._settled: dict[str, float] = {}
        self._gone: dict[str, None] = {}

    def reserve(self, request: Request) -> None:
        """Reserve dollars once everything else of the transaction is written."""
        self._requests[request.id] = request

    def settle(self, reservation: str, usd: float) -> None:
        """Replace a reservation's amount; 0 removes it, as a row that records the call's cost does."""
        if usd > CENT:
            self._settled[reservation] = usd
        elif self._requests.pop(reservation, None) is None:
            self._gone[reservation] = None

    def is_writer(self, evaluation: int) -> bool:
        """Return whether this session still holds an evaluation's lock and may add rows."""
        if evaluation not in self._writers:
            self._writers[evaluation] = self._execute(_WRITER, {"of_id": evaluation}).fetchone() == (self.session,)
        return self._writers[evaluation]

    def taken_usd(self) -> dict[str, float]:
        """Return dollars by participant: costs of rows less released ones, and reservations."""
        return dict(self._execute(_TAKEN, {"of_study": self.study}).fetchall())

    def other_sessions(self) -> frozenset[str]:
        """Return the sessions of other processes that hold reservations."""
        query = sa.select(RESERVATIONS.c.session).where(RESERVATIONS.c.study == self.study).distinct()
        return frozenset(self.connection.execute(query).scalars()) - {self.session}

    def flush(self) -> None:
        """Write the collected changes."""
        self._execute(_ADD_ROW, *self.rows)
        self._execute(_REMOVE, *({"of_study": self.study, "of_id": reservation} for reservation in self._gone))
        settled = ({"of_study": self.study, "of_id": each, "new_usd": usd} for each, usd in self._settled.items())
        self._execute(_SETTLE, *settled)
        for (kind, participant), totals in self.totals.items():
            self._add_totals(kind, participant, totals)
        if self._requests:
            self._execute(_RESERVE, *self._granted())
        for collected in (self.rows, self.totals, self._requests, self._settled, self._gone):
            collected.clear()

    def _execute(self, statement: sa.Executable, *values: dict[str, Any]) -> Any:
        """Execute a statement for each of `values` by the driver, and return its cursor.

        SQLAlchemy's own way takes more time than SQLite itself.
        """
        cursor, driver = self.connection.connection.cursor(), self.connection.dialect.loaded_dbapi
        if values:
            sql = _compiled(statement, self.connection.dialect, tuple(values[0]))
            try:
                cursor.execute(sql, values[0]) if len(values) == 1 else cursor.executemany(sql, values)
            except driver.Error as error:
                raise exc.DBAPIError.instance(sql, None, error, driver.Error) from error
        return cursor

    def _granted(self) -> list[dict[str, Any]]:
        """Return the reservations for which there is room, in the order of the requests."""
        by_participant, granted = self.taken_usd(), list[dict[str, Any]]()
        taken = defaultdict[str | None, float](float, by_participant | {None: sum(by_participant.values())})
        for request in self._requests.values():
            slots, request.exhausted = (None, request.participant), None
            for slot in slots:
                if slot in request.caps and request.caps[slot] - taken[slot] < request.usd - CENT:
                    request.exhausted = CapExhausted(slot, taken[slot], self.other_sessions())
                    break
            else:
                for slot in slots:
                    taken[slot] += request.usd
                values = {"study": self.study, "id": request.id, "session": self.session}
                granted.append({**values, "participant": request.participant, "usd": request.usd})
        return granted

    def _add_totals(self, kind: str, participant: str, its: Totals) -> None:
        values: dict[str, float] = {"dollars": its.dollars, "failed": its.failed, "unknown": its.unknown}
        for column in AVERAGED_COLUMNS:
            values[f"{column}_sum"], values[f"{column}_n"] = its.means.get(column, (0.0, 0))
        key = {"of_study": self.study, "of_kind": kind, "of_participant": participant}
        increments = {f"more_{name}": value for name, value in values.items()}
        if not self._execute(_ADD_TOTALS, {**key, **increments, "its_dearest": its.dearest}).rowcount:
            new = {"study": self.study, "kind": kind, "participant": participant, "dearest": its.dearest}
            self.connection.execute(sa.insert(TOTALS).values(**new, **values))


@lru_cache
def _compiled(statement: Any, dialect: sa.Dialect, names: tuple[str, ...]) -> str:
    return str(statement.compile(dialect=dialect, column_keys=names))


def _is(*columns: sa.Column[Any]) -> sa.ColumnElement[bool]:
    """Return a condition that each column has the value of the parameter `of_COLUMN`."""
    return sa.and_(*(column == sa.bindparam(f"of_{column.name}") for column in columns))


_ADD_ROW, _RESERVE = sa.insert(ROWS).inline(), sa.insert(RESERVATIONS).inline()
_REMOVE = sa.delete(RESERVATIONS).where(_is(*RESERVATIONS.primary_key))
_SETTLE = sa.update(RESERVATIONS).where(_is(*RESERVATIONS.primary_key)).values(usd=sa.bindparam("new_usd"))
_WRITER = sa.select(EVALUATIONS.c.writer).where(_is(EVALUATIONS.c.id))
_AMOUNTS = sa.union_all(
    sa.select(TOTALS.c.participant, TOTALS.c.dollars.label("usd")).where(_is(TOTALS.c.study)),
    sa.select(RELEASES.c.participant, -RELEASES.c.failed).where(_is(RELEASES.c.study)),
    sa.select(RESERVATIONS.c.participant, RESERVATIONS.c.usd).where(_is(RESERVATIONS.c.study)),
).subquery()
_TAKEN = sa.select(_AMOUNTS.c.participant, sa.func.sum(_AMOUNTS.c.usd)).group_by(_AMOUNTS.c.participant)
_DEAREST = sa.bindparam("its_dearest", type_=sa.Double)
_SUMS = ("dollars", "failed", "unknown", *(f"{column}_{what}" for column in AVERAGED_COLUMNS for what in ("sum", "n")))
_ADD_TOTALS = (
    sa.update(TOTALS)
    .where(_is(*TOTALS.primary_key))
    .values({name: TOTALS.c[name] + sa.bindparam(f"more_{name}") for name in _SUMS})
    .values(dearest=sa.case((TOTALS.c.dearest < _DEAREST, _DEAREST), else_=TOTALS.c.dearest))
)


def holder() -> str:
    """Return this process and the time, as shown to processes that wait for it."""
    return f"process {os.getpid()} on {socket.gethostname()} since {time.strftime('%H:%M:%S')}"


def claim(batch: Batch, kind: str, name: str) -> int:
    """Make this session, which holds an evaluation's lock, its writer; return its id."""
    own_key = {"study": batch.study, "kind": kind, "name": name}
    is_own_row = sa.and_(*(EVALUATIONS.c[column] == value for column, value in own_key.items()))
    values: Mapping[str, Any] = {"writer": batch.session, "holder": holder()}
    if not batch.connection.execute(sa.update(EVALUATIONS).where(is_own_row).values(**values)).rowcount:
        batch.connection.execute(sa.insert(EVALUATIONS).values(**own_key, **values))
    return batch.connection.execute(sa.select(EVALUATIONS.c.id).where(is_own_row)).scalar_one()
