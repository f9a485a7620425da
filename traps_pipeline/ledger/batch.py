"""Collect a ledger transaction: rows, their totals, and the money they move."""

import json
import os
import socket
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from hashlib import blake2b
from typing import Any, NamedTuple

import sqlalchemy as sa
from sqlalchemy import exc

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.rows import AVERAGED_COLUMNS, NOT_WHOLE, Totals, is_amount, is_whole, participant_of
from traps_pipeline.ledger.schema import EVALUATIONS, RELEASES, RESERVATIONS, ROWS, SEALS, STUDIES, TOTALS

CENT = 1e-9  # below this, dollars are rounding
LOST = "lost-rows"  # the session of money whose rows were lost; it never lives, so that a person can release it


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
    """A call's worst case, to be reserved under the caps of participants and study. exhausted: the full cap, if any."""

    id: str
    participant: str
    usd: float
    caps: Mapping[str | None, float]
    exhausted: CapExhausted | None = None


class Amount(NamedTuple):
    """Money of one row of `table`; name: its id, or the kind of a total. failed: the part of failed calls."""

    table: str
    name: str
    session: str
    participant: str
    usd: float
    failed: float


class Batch:
    """A transaction of the commit thread: changes that `flush` seals. damaged: makes the error about damage."""

    def __init__(
        self, connection: sa.Connection, study: int, session: str, damaged: Callable[[str], TrapsError]
    ) -> None:
        self.connection, self.study, self.session, self._damaged = connection, study, session, damaged
        self.booked = dict[str, float]()  # by participant, after `flush`: dollars of rows, lost ones included
        self.sealed_rows = 0  # after `flush`
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

    def amounts(self) -> list[Amount]:
        """Return all money of the study. Raises TrapsError for what is no amount."""
        amounts = [Amount(*row) for row in self._execute(_AMOUNTS, {"of_study": self.study})]
        for each in amounts:
            if not (is_amount(each.usd) and is_amount(each.failed)):
                value = each.failed if is_amount(each.usd) else each.usd
                raise self._damaged(f"{each.table} has {value!r:.40} as dollars of {each.participant}")
        return amounts

    def taken_usd(self, amounts: Iterable[Amount] | None = None) -> dict[str, float]:
        """Return dollars by participant: costs of rows less released ones, and reservations."""
        taken = defaultdict[str, float](float)
        for each in self.amounts() if amounts is None else amounts:
            taken[each.participant] += -each.failed if each.table == RELEASES.name else each.usd
        return taken

    def other_sessions(self) -> frozenset[str]:
        """Return the sessions of other processes that hold reservations."""
        return frozenset(each.session for each in self.amounts()) - {self.session, ""}

    def flush(self) -> None:
        """Write the collected rows and money, and renew the ledger's seal."""
        self._execute(_ADD_ROW, *self.rows)
        self._execute(_REMOVE, *({"of_study": self.study, "of_id": reservation} for reservation in self._gone))
        settled = ({"of_study": self.study, "of_id": each, "new_usd": usd} for each, usd in self._settled.items())
        self._execute(_SETTLE, *settled)
        for (kind, participant), totals in self.totals.items():
            self._add_totals(kind, participant, totals)
        amounts = self.amounts()
        granted = self._granted(amounts)
        self._execute(_RESERVE, *granted)
        amounts += (Amount(RESERVATIONS.name, r["id"], r["session"], r["participant"], r["usd"], 0.0) for r in granted)
        sealed = {"of_study": self.study, "more_rows": len(self.rows), "new_money": _digest(amounts)}
        (self.sealed_rows,) = self._execute(_SEAL, sealed).fetchone() or (0,)
        self.booked = self.taken_usd(each for each in amounts if each.table == TOTALS.name or each.session == LOST)
        for collected in (self.rows, self.totals, self._requests, self._settled, self._gone):
            collected.clear()

    def _execute(self, statement: sa.Executable, *values: dict[str, Any]) -> Any:
        """Execute a statement for each of `values` by the driver, faster than SQLAlchemy; return its cursor."""
        cursor, driver = self.connection.connection.cursor(), self.connection.dialect.loaded_dbapi
        if values:
            sql = _compiled(statement, self.connection.dialect, tuple(values[0]))
            try:
                cursor.execute(sql, values[0]) if len(values) == 1 else cursor.executemany(sql, values)
            except driver.Error as error:
                raise exc.DBAPIError.instance(sql, None, error, driver.Error) from error
        return cursor

    def is_sealed(self) -> bool:
        """Return whether the study has a seal. Raises TrapsError unless all is as the last transaction left it."""
        query, amounts = sa.select(SEALS).where(SEALS.c.study == self.study), self.amounts()
        if (seal := self.connection.execute(query).first()) is None:
            orphans = sa.select(EVALUATIONS.c.study).where(EVALUATIONS.c.study.not_in(sa.select(STUDIES.c.id)))
            if self.connection.execute(orphans).first():
                raise self._damaged(f"the number of the study: {NOT_WHOLE}")
            return False
        for what, value, sealed in (
            ("the number of rows", self._row_count(), seal.rows),
            ("totals, reservations or releases", _digest(amounts), seal.money),
            ("the names of evaluations", self.evaluations(), seal.evaluations),
        ):
            if value != sealed:
                counts = f" ({value}, and {sealed} were written)" if isinstance(value, int) else ""
                raise self._damaged(f"{what}: {NOT_WHOLE}{counts}")
        return True

    def reseal(self) -> None:
        """Seal the ledger's present rows; raise totals that are below the rows' costs."""
        totals = self.connection.execute(sa.select(TOTALS).where(TOTALS.c.study == self.study))
        stored, sums = (
            {(row.kind, row.participant): row for row in totals},
            defaultdict[tuple[str, str], Totals](Totals),
        )
        query = sa.select(EVALUATIONS.c.kind, EVALUATIONS.c.name, ROWS).join(
            ROWS, ROWS.c.evaluation == EVALUATIONS.c.id
        )
        query = query.where(EVALUATIONS.c.study == self.study).execution_options(yield_per=1000)
        for row in self.connection.execute(query):
            if is_whole(row, f"{row.kind}/{row.name}"):
                content = json.loads(row.content)
                sums[row.kind, participant_of(content)].add(content)
        for key, its in sums.items():
            if old := stored.get(key):
                its = Totals(max(0.0, its.dollars - old.dollars), max(0.0, its.failed - old.failed))
            self._add_totals(*key, its)
        self.connection.execute(sa.delete(SEALS).where(SEALS.c.study == self.study))
        values = {"rows": self._row_count(), "money": _digest(self.amounts()), "evaluations": self.evaluations()}
        self.connection.execute(sa.insert(SEALS).values(study=self.study, **values))

    def evaluations(self) -> bytes:
        """Return the digest of the evaluations' names, for the seal."""
        query = sa.select(EVALUATIONS.c.id, EVALUATIONS.c.kind, EVALUATIONS.c.name)
        return _digest(self.connection.execute(query.where(EVALUATIONS.c.study == self.study)))

    def _row_count(self) -> int:
        mine = ROWS.c.evaluation.in_(sa.select(EVALUATIONS.c.id).where(EVALUATIONS.c.study == self.study))
        return self.connection.execute(sa.select(sa.func.count()).select_from(ROWS).where(mine)).scalar_one()

    def _granted(self, amounts: Iterable[Amount]) -> list[dict[str, Any]]:
        """Return the reservations for which there is room, in the order of the requests."""
        by_participant, granted = self.taken_usd(amounts), list[dict[str, Any]]()
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
                granted.append({**values, "participant": request.participant, "usd": float(request.usd)})
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


def _digest(entries: Iterable[Iterable[object]]) -> bytes:
    """Return a digest of entries, in whatever order."""
    return blake2b("\n".join(sorted(map(repr, map(tuple, entries)))).encode(), digest_size=16).digest()


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
# By table: the columns of `Amount`, or SQL where it has none.
_MONEY = {
    TOTALS: ("kind", "''", "participant", "dollars", "failed"),
    RELEASES: ("cast(id as text)", "''", "participant", "in_flight", "failed"),
    RESERVATIONS: ("id", "session", "participant", "usd", "0.0"),
}
_AMOUNTS = sa.union_all(
    *(
        sa.select(*map(sa.literal_column, (f"'{table.name}'", *columns))).select_from(table).where(_is(table.c.study))
        for table, columns in _MONEY.items()
    )
)
_SEAL = (
    sa.update(SEALS)
    .where(_is(SEALS.c.study))
    .values(rows=SEALS.c.rows + sa.bindparam("more_rows", type_=sa.BigInteger), money=sa.bindparam("new_money"))
    .returning(SEALS.c.rows)
)
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
        change = sa.update(SEALS).where(SEALS.c.study == batch.study)
        batch.connection.execute(change.values(evaluations=batch.evaluations()))
    return batch.connection.execute(sa.select(EVALUATIONS.c.id).where(is_own_row)).scalar_one()
