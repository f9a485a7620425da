"""Collect a ledger transaction: rows, their totals, and the money they move."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import sqlalchemy as sa

from traps_pipeline.ledger.rows import AVERAGED_COLUMNS, Totals
from traps_pipeline.ledger.schema import EVALUATIONS, RESERVATIONS, ROWS, SPENT, TOTALS

CENT = 1e-9  # below this, dollars are rounding


@dataclass
class Batch:
    """A transaction of the commit thread: collects changes, writes them at its end."""

    connection: sa.Connection
    study: int
    session: str
    rows: list[dict[str, Any]] = field(default_factory=list)
    totals: dict[tuple[str, str], Totals] = field(default_factory=dict)
    more_usd: dict[str, float] = field(default_factory=dict)
    reservations: list[dict[str, Any]] = field(default_factory=list)
    covered: dict[str, None] = field(default_factory=dict)  # reservations whose calls' rows are stored
    _open: dict[str, float] = field(default_factory=dict)  # dollars by reservation, once `reserved` is read
    _writers: dict[int, bool] = field(default_factory=dict)

    @cached_property
    def spent(self) -> dict[str, float]:
        """Dollars spent for good, by participant; kept up to date by `spend`."""
        query = sa.select(SPENT.c.participant, SPENT.c.usd).where(SPENT.c.study == self.study)
        usd_by_participant: dict[str, float] = {row.participant: row.usd for row in self.connection.execute(query)}
        for participant, usd in self.more_usd.items():
            usd_by_participant[participant] = usd_by_participant.get(participant, 0.0) + usd
        return usd_by_participant

    @cached_property
    def reserved(self) -> dict[str, float]:
        """Reserved dollars by participant; callers that change reservations update it."""
        query = sa.select(RESERVATIONS.c.id, RESERVATIONS.c.participant, RESERVATIONS.c.usd)
        reserved = dict[str, float]()
        for reservation, participant, usd in self.connection.execute(query.where(RESERVATIONS.c.study == self.study)):
            if reservation not in self.covered:
                self._open[reservation] = usd
                reserved[participant] = reserved.get(participant, 0.0) + usd
        return reserved

    def spend(self, participant: str, usd: float) -> None:
        """Add dollars to a participant's spending; a negative amount is a refund."""
        self.more_usd[participant] = self.more_usd.get(participant, 0.0) + usd
        if "spent" in self.__dict__:
            self.spent[participant] = self.spent.get(participant, 0.0) + usd

    def reserve(self, reservation: str, participant: str, usd: float) -> None:
        """Add a reservation."""
        values = {"id": reservation, "study": self.study, "session": self.session}
        self.reservations.append({**values, "participant": participant, "usd": usd})
        self.reserved[participant] = self.reserved.get(participant, 0.0) + usd

    def settle(self, reservation: str, participant: str, was_usd: float, usd: float) -> None:
        """Replace a reservation's amount; an amount of 0 removes the reservation."""
        is_reservation = RESERVATIONS.c.id == reservation
        if usd > CENT:
            self.connection.execute(sa.update(RESERVATIONS).where(is_reservation).values(usd=usd))
        else:
            self.connection.execute(sa.delete(RESERVATIONS).where(is_reservation))
        if "reserved" in self.__dict__:
            self._open[reservation] = max(usd, 0.0)
            self.reserved[participant] = self.reserved.get(participant, 0.0) + max(usd, 0.0) - was_usd

    def cover(self, participant: str, reservations: Sequence[str]) -> None:
        """Remove the reservations of a call whose row now records its cost."""
        self.covered |= dict.fromkeys(reservations)
        if "reserved" in self.__dict__:
            was_usd = sum(self._open.pop(reservation, 0.0) for reservation in reservations)
            self.reserved[participant] = self.reserved.get(participant, 0.0) - was_usd

    def is_writer(self, evaluation: int) -> bool:
        """Return whether this session still holds an evaluation's lock and may add rows."""
        if evaluation not in self._writers:
            query = sa.select(EVALUATIONS.c.writer).where(EVALUATIONS.c.id == evaluation)
            self._writers[evaluation] = self.connection.execute(query).scalar() == self.session
        return self._writers[evaluation]

    def flush(self) -> None:
        """Write the collected changes."""
        if self.rows:
            self.connection.execute(sa.insert(ROWS), self.rows)
        if self.reservations:
            self.connection.execute(sa.insert(RESERVATIONS), self.reservations)
        if self.covered:
            removals = [{"gone": reservation} for reservation in self.covered]
            self.connection.execute(sa.delete(RESERVATIONS).where(RESERVATIONS.c.id == sa.bindparam("gone")), removals)
        for (kind, participant), totals in self.totals.items():
            self._add_totals(kind, participant, totals)
        for participant, usd in self.more_usd.items():
            key = {"of_study": self.study, "of_participant": participant}
            if not self.connection.execute(_ADD_SPENT, {**key, "more_usd": usd}).rowcount:
                self.connection.execute(sa.insert(SPENT).values(study=self.study, participant=participant, usd=usd))

    def _add_totals(self, kind: str, participant: str, its: Totals) -> None:
        values: dict[str, float] = {"dollars": its.dollars, "failed": its.failed, "unknown": its.unknown}
        for column in AVERAGED_COLUMNS:
            values[f"{column}_sum"], values[f"{column}_n"] = its.means.get(column, (0.0, 0))
        key = {"of_study": self.study, "of_kind": kind, "of_participant": participant}
        increments = {f"more_{name}": value for name, value in values.items()}
        if not self.connection.execute(_ADD_TOTALS, {**key, **increments, "its_dearest": its.dearest}).rowcount:
            new = {"study": self.study, "kind": kind, "participant": participant, "dearest": its.dearest}
            self.connection.execute(sa.insert(TOTALS).values(**new, **values))


def _add_statement(table: sa.Table, *columns: str) -> sa.Update:
    """Return a cached UPDATE that adds `more_COLUMN` where the key is `of_COLUMN`."""
    key = [column == sa.bindparam(f"of_{column.name}") for column in table.primary_key]
    sums = {name: table.c[name] + sa.bindparam(f"more_{name}") for name in columns}
    return sa.update(table).where(*key).values(sums)


_ADD_SPENT = _add_statement(SPENT, "usd")
_DEAREST = sa.bindparam("its_dearest", type_=sa.Double)
_ADD_TOTALS = _add_statement(
    TOTALS,
    *("dollars", "failed", "unknown"),
    *(f"{column}_{what}" for column in AVERAGED_COLUMNS for what in ("sum", "n")),
).values(dearest=sa.case((TOTALS.c.dearest < _DEAREST, _DEAREST), else_=TOTALS.c.dearest))


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
