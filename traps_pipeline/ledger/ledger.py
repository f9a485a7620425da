"""Append calls to the ledger, so that each is paid for once (docs/design/ledger.md)."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from functools import partial
from itertools import chain
from typing import Any

import sqlalchemy as sa
from sqlalchemy import exc

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.batch import Batch, claim
from traps_pipeline.ledger.database import Database, Lock, taken_over
from traps_pipeline.ledger.rows import (
    AVERAGED_COLUMNS,
    NOT_WHOLE,
    SIDE_TEXTS,
    EvaluationRows,
    Stored,
    Totals,
    digest_of,
    encode_row,
    is_amount,
    is_settled,
    is_whole,
    participant_of,
    replace_impossible,
)
from traps_pipeline.ledger.schema import EVALUATIONS, ROWS, STUDIES, TOTALS

LOCK_POLL_S = 0.1
SYNC_S = 0.5  # how often rows are synced to disk
_KEYS = 500  # for more keys than these, reading the whole evaluation takes less time than searching it
_FETCHED = 1000  # rows per fetch

Waiting = Callable[[str], None]  # called once with the holder of the lock
GiveUp = Callable[[], bool]  # returns whether to stop waiting


class LockGivenUp(Exception):
    """Waiting for a lock was cancelled."""


class Ledger:
    """Append-only rows (of kind `answers` or `votes`) by key, for each evaluation."""

    def __init__(self, database: Database, kind: str) -> None:
        self.database, self.kind = database, kind

    # --- reading ------------------------------------------------------------------------------------------------------

    def read(self, evaluation: str, wanted: Collection[str] | None = None) -> EvaluationRows:
        """Return the rows of an evaluation; with `wanted`, parse and hold only those keys.

        If a key has several rows the newest counts, but a failure never replaces an answer. Damaged rows, and values
        that no table can hold, are noted and ignored. Raises TrapsError.
        """
        rows = EvaluationRows()
        for entry in self._rows(evaluation, wanted):
            self._add(rows, entry, evaluation)
        return rows

    def naming(self, text: str) -> dict[str, EvaluationRows]:
        """Return the rows in which a text occurs, such as an item's id, by evaluation."""
        query = sa.select(EVALUATIONS.c.name, ROWS).join(ROWS, ROWS.c.evaluation == EVALUATIONS.c.id)
        rows = dict[str, EvaluationRows]()
        for entry in self._select(query.where(self._is_own_kind(EVALUATIONS)).order_by(ROWS.c.id)):
            if isinstance(entry.content, bytes) and text.encode() in entry.content:  # a flipped bit makes another kind
                self._add(rows.setdefault(entry.name, EvaluationRows()), entry, entry.name)
        return rows

    def reasoning(self, evaluation: str, wanted: Collection[str] | None = None) -> dict[str, str]:
        """Return reasoning traces by key (of the wanted keys). Raises TrapsError."""
        return {
            row.key: row.reasoning.decode()
            for row in self._rows(evaluation, wanted)
            if row.reasoning is not None and self._is_whole(row, evaluation)
        }

    def rows(self, evaluation: str) -> Iterator[Stored]:
        """Yield an evaluation's intact rows, oldest first. Raises TrapsError."""
        for row in self._rows(evaluation):
            if self._is_whole(row, evaluation):
                asides = {name: getattr(row, name) for name in SIDE_TEXTS}
                yield (
                    json.loads(row.content),
                    {name: text.decode() for name, text in asides.items() if text is not None},
                )

    def damage(self) -> Iterator[str]:
        """Read everything; yield a sentence per damaged row or fault."""
        if self.database.exists():
            yield from self.database.faults()
        try:
            for evaluation in self.evaluations():
                for row in self._rows(evaluation):
                    if not self._is_whole(row, evaluation):
                        yield f"{self._place(row)}: {NOT_WHOLE}, and not believed"
        except TrapsError as error:
            yield str(error)

    def keys(self) -> set[str]:
        """Return the keys of all rows. Raises TrapsError."""
        mine = sa.select(ROWS.c.key).join(EVALUATIONS, EVALUATIONS.c.id == ROWS.c.evaluation)
        return {row.key for row in self._select(mine.where(self._is_own_kind(EVALUATIONS)))}

    def evaluations(self) -> list[str]:
        """Return the names of evaluations that have rows. Raises TrapsError."""
        has_rows = sa.exists().where(ROWS.c.evaluation == EVALUATIONS.c.id)
        query = (
            sa.select(EVALUATIONS.c.name).where(self._is_own_kind(EVALUATIONS), has_rows).order_by(EVALUATIONS.c.name)
        )
        return [row.name for row in self._select(query)]

    def totals(self) -> dict[str, Totals]:
        """Return totals by participant of all rows, repeated keys too. Raises TrapsError."""
        totals = dict[str, Totals]()
        for row in self._select(sa.select(TOTALS).where(self._is_own_kind(TOTALS))):
            sums = {name: (getattr(row, f"{name}_sum"), getattr(row, f"{name}_n")) for name in AVERAGED_COLUMNS}
            values = (row.dollars, row.failed, row.dearest, row.unknown, *chain(*sums.values()))
            if not all(map(is_amount, values)):
                raise self.database.damaged(f"the totals of {row.participant} hold what is no amount")
            means = {name: its for name, its in sums.items() if its[1]}
            totals[row.participant] = Totals(row.dollars, row.failed, row.dearest, row.unknown, means)
        return totals

    def _is_own_kind(self, table: sa.Table) -> sa.ColumnElement[bool]:
        study = sa.select(STUDIES.c.id).where(STUDIES.c.name == self.database.study_name).scalar_subquery()
        return (table.c.study == study) & (table.c.kind == self.kind)

    def _select(self, query: sa.Select[Any]) -> Iterator[sa.Row[Any]]:
        """Yield the rows of a query; none if the ledger does not exist."""
        if not self.database.exists():
            return
        with self.database.read() as connection:
            try:
                yield from connection.execution_options(yield_per=_FETCHED).execute(query)
            except exc.DBAPIError as error:
                with suppress(exc.DBAPIError):  # a view in its place may fail, too
                    if not sa.inspect(connection.engine).has_table(STUDIES.name):
                        return
                raise self.database.sentence(error) from error

    def _rows(self, evaluation: str, wanted: Collection[str] | None = None) -> Iterator[sa.Row[Any]]:
        ids = sa.select(EVALUATIONS.c.id).where(self._is_own_kind(EVALUATIONS), EVALUATIONS.c.name == evaluation)
        query = sa.select(ROWS).where(ROWS.c.evaluation == ids.scalar_subquery()).order_by(ROWS.c.id)
        if wanted is None:
            yield from self._select(query)
        elif len(wanted) <= _KEYS:
            yield from self._select(query.where(ROWS.c.key.in_([*wanted])))
        else:
            keys = frozenset(wanted)
            yield from (row for row in self._select(query) if row.key in keys)

    def _is_whole(self, row: sa.Row[Any], evaluation: str) -> bool:
        return is_whole(row, f"{self.kind}/{evaluation}")

    def _add(self, rows: EvaluationRows, entry: sa.Row[Any], evaluation: str) -> None:
        """Add a row and a note about impossible values, or only a note if it is damaged."""
        if not self._is_whole(entry, evaluation):
            rows.notes[self._place(entry)] = f"{NOT_WHOLE}: it is not believed; its answer is asked again"
            return
        row = json.loads(entry.content)
        if healed := replace_impossible(row):
            rows.notes[self._place(entry)] = f"{', '.join(healed)}: no possible value, counted as unknown"
        rows.add(row)

    def _place(self, row: sa.Row[Any]) -> str:
        return f"{self.database.place}: row {row.id}"

    # --- writing ------------------------------------------------------------------------------------------------------

    @asynccontextmanager
    async def writing(
        self, evaluation: str, waiting: Waiting, give_up: GiveUp = lambda: False
    ) -> AsyncIterator[Writer]:
        """Become an evaluation's one writer, or wait. Raises TrapsError, and LockGivenUp if `give_up` says so."""
        with self.database.writing():
            lock = await self._lock(evaluation, waiting, give_up)
            try:
                number = await self.database.apply(partial(claim, kind=self.kind, name=evaluation))
                yield Writer(self.database, self.kind, (number, evaluation), lock)
            finally:
                lock.release()

    async def store(self, rows: Mapping[str, Sequence[Stored]], waiting: Waiting) -> int:
        """Add rows of unsettled keys under a lock, all or none; return how many settle one. Raises TrapsError."""
        async with AsyncExitStack() as stack:
            writers = {name: await stack.enter_async_context(self.writing(name, waiting)) for name in sorted(rows)}
            new = list[tuple[Writer, Mapping[str, Any], dict[str, Any]]]()
            for name, writer in writers.items():
                known = self.read(name, {row["key"] for row, _ in rows[name]}).settled
                entries = (entry for entry in rows[name] if entry[0]["key"] not in known)
                new += [(writer, row, writer.encode(row, beside)) for row, beside in entries]

            def change(batch: Batch) -> None:
                for writer in writers.values():  # before the first row: all of them or none
                    writer.check(batch)
                for writer, row, values in new:
                    writer.add(batch, row, values)

            await self.database.apply(change)
            await asyncio.to_thread(self.database.sync)
        return sum(is_settled(row) for _, row, _ in new)

    async def _lock(self, evaluation: str, waiting: Waiting, give_up: GiveUp) -> Lock:
        is_told = False
        while (lock := await asyncio.to_thread(self.database.try_lock, f"{self.kind}-{evaluation}")) is None:
            if not is_told:
                waiting(
                    f"{self.kind} of {evaluation} are being asked by {self._holder(evaluation)}; "
                    "waiting for it to finish"
                )
                is_told = True
            if give_up():
                raise LockGivenUp(evaluation)
            await asyncio.sleep(LOCK_POLL_S)
        return lock

    def _holder(self, evaluation: str) -> str:
        query = sa.select(EVALUATIONS.c.holder).where(self._is_own_kind(EVALUATIONS), EVALUATIONS.c.name == evaluation)
        return next((row.holder for row in self._select(query) if row.holder), "another process")


class Writer:
    """The only writer of an evaluation: adds rows to it."""

    def __init__(self, database: Database, kind: str, evaluation: tuple[int, str], lock: Lock) -> None:
        self._database, self._kind, self._lock = database, kind, lock
        self._evaluation, self._bound = evaluation[0], f"{kind}/{evaluation[1]}"
        self._is_synced, self._syncing = True, asyncio.Lock()

    async def require(self) -> None:
        """Raise TrapsError if this writer has lost the evaluation, before a call is sent."""
        if self._lock.is_fresh():
            self._lock.require()
        else:  # calls in flight must not wait for an unreachable server
            await asyncio.to_thread(self._lock.require)

    async def write(
        self, row: Mapping[str, Any], beside: Mapping[str, str] | None = None, paid_by: Sequence[str] = ()
    ) -> None:
        """Add a row, side texts and cost; return once no kill of this process loses them.

        beside: texts by name in SIDE_TEXTS. paid_by: reservations that the row's cost replaces. Raises TrapsError if
        nothing was stored, and ValueError for a row that JSON cannot hold.
        """
        values = self.encode(row, beside or {})
        await self._database.apply(lambda batch: self.add(batch, row, values, paid_by))
        self._is_synced = False

    def encode(self, row: Mapping[str, Any], beside: Mapping[str, str]) -> dict[str, Any]:
        """Return a row of the table, without its id. Raises ValueError if JSON cannot hold the row."""
        content = encode_row(row)
        texts = {name: beside[name].encode("utf-8", "replace") if name in beside else None for name in SIDE_TEXTS}
        digest = digest_of(row["key"], content, **texts, evaluation=self._bound)
        return {"evaluation": self._evaluation, "key": row["key"], "content": content, "digest": digest, **texts}

    def add(self, batch: Batch, row: Mapping[str, Any], values: dict[str, Any], paid_by: Sequence[str] = ()) -> None:
        """Add a row to a transaction, encoded before. Raises TrapsError if another process took over."""
        self.check(batch)
        batch.rows.append(values)
        batch.totals[self._kind, participant_of(row)].add(row)
        for reservation in paid_by:
            batch.settle(reservation, 0.0)

    def check(self, batch: Batch) -> None:
        """Raise TrapsError if another process now writes this evaluation."""
        if not batch.is_writer(self._evaluation):
            raise taken_over(self._database.place)

    async def sync(self) -> None:
        """Sync the written rows to disk. Raises TrapsError."""
        async with self._syncing:  # rows of another cell may be on their way to the disk
            if not self._is_synced:
                self._is_synced = True
                await asyncio.to_thread(self._database.sync)
