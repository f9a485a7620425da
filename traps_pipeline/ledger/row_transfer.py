"""Copy a ledger verbatim: to a file, from a file, or into hosts' shared database. What is damaged stays behind."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from itertools import groupby
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import exc

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.wording import count_noun
from traps_pipeline.ledger.batch import Batch
from traps_pipeline.ledger.database import Database
from traps_pipeline.ledger.rows import NOT_WHOLE, is_amount, is_whole
from traps_pipeline.ledger.schema import EVALUATIONS, RELEASES, RESERVATIONS, ROWS, SEALS, STUDIES, TOTALS
from traps_pipeline.ledger.sqlite import SqliteDatabase

_FETCHED = 1000
_NAMED = 10  # ranges of lost rows
_BY_INDEX = f"select max(id) from {ROWS.name} indexed by ix_traps_rows_evaluation"
Lost = Callable[[str], None]  # is told what could not be copied


def export_ledger(ledger: Database, file: Path, lost: Lost) -> int:
    """Write a ledger to a new SQLite file; return its row count. Raises TrapsError."""
    if file.exists():
        raise TrapsError(f"{file}: is there already; name another file")
    return copy_ledger(ledger, SqliteDatabase(file.parent, file=file.name), lost)


def import_ledger(file: Path, ledger: Database, lost: Lost) -> int:
    """Read a file's ledger into an empty one; return its row count. Raises TrapsError."""
    if not file.is_file():
        raise TrapsError(f"{file}: no such file; name one that `traps study export-ledger` wrote")
    return copy_ledger(SqliteDatabase(file.parent, file=file.name), ledger, lost)


def copy_ledger(source: Database, target: Database, lost: Lost, settle: Callable[[], None] = lambda: None) -> int:
    """Copy all rows and money that are whole, or none; return the number of rows.

    Nobody may write to the source meanwhile. settle: called after the copy, before others may write. A killed copy is
    repeated. Raises TrapsError, also if the target has other rows, or from `lost`.
    """
    mark = f"copied from {source.place}"
    with ExitStack() as stack:
        copy = _Copy(source, stack.enter_context(source.salvage()) if source.exists() else None, lost)
        stack.enter_context(target.writing())
        for each in copy.evaluations:
            lock = source.try_lock(f"{each.kind}-{each.name}")
            if lock is None:
                raise TrapsError(
                    f"{source.place}: {each.kind} of {each.name} are being asked; wait until that run ends, then run "
                    "the same command again"
                )
            stack.callback(lock.release)
        count = target.submit(lambda batch: copy.into(batch, target, mark)).result()
        target.sync()
        settle()
        clear_mark = sa.update(EVALUATIONS).where(EVALUATIONS.c.writer == mark).values(writer=None)
        target.submit(lambda batch: batch.connection.execute(clear_mark)).result()
    return count


class _Copy:
    """A copy of one study, read through a connection; None: of nothing."""

    def __init__(self, source: Database, connection: sa.Connection | None, lost: Lost) -> None:
        self.source, self._connection, self._lost = source, connection, lost
        self.evaluations, self._study = list[sa.Row[Any]](), 0
        if connection is None:
            return
        try:
            studies = {name: number for number, name in connection.execute(sa.select(STUDIES))}
        except exc.DBAPIError as error:
            raise TrapsError(
                f"{source.place}: no study can be read in it ({source.sentence(error)}); restore a copy of it"
            ) from error
        if source.study_name not in studies and len(studies) != 1:
            raise TrapsError(
                f"{source.place}: holds {count_noun(len(studies), 'study', 'studies')}, and not one; name a file that "
                "`traps study export-ledger` wrote"
            )
        self._study = studies.get(source.study_name) or next(iter(studies.values()))
        self._is_alone = len(studies) == 1
        self.evaluations = [*self._rows(EVALUATIONS)]

    def into(self, batch: Batch, target: Database, mark: str) -> int:
        """Copy what is whole; return the number of rows."""
        evaluations = sa.select(EVALUATIONS.c.id).where(EVALUATIONS.c.study == batch.study)
        unmarked_evaluations = evaluations.where(EVALUATIONS.c.writer.is_distinct_from(mark))
        if batch.connection.execute(
            sa.select(ROWS.c.id).where(ROWS.c.evaluation.in_(unmarked_evaluations)).limit(1)
        ).first():
            raise TrapsError(
                f"{target.place}: holds rows of this study already; import into a study that has none, or bring "
                "answers into it one by one with `traps study import-answers`"
            )
        # Remove leftovers of a killed copy, and evaluations without a row.
        batch.connection.execute(sa.delete(ROWS).where(ROWS.c.evaluation.in_(evaluations)))
        for table in (TOTALS, RELEASES, RESERVATIONS, EVALUATIONS):
            batch.connection.execute(sa.delete(table).where(table.c.study == batch.study))
        count = self._copy(batch, mark) if self._connection is not None else 0
        batch.reseal()
        target.book_lost(batch.connection)
        return count

    def _copy(self, batch: Batch, mark: str) -> int:
        count, lost, copied = 0, list[int](), dict[int, tuple[int, str]]()
        for each in self.evaluations:
            values = {"study": batch.study, "kind": each.kind, "name": each.name, "writer": mark}
            insert = sa.insert(EVALUATIONS).values(**values).returning(EVALUATIONS.c.id)
            copied[each.id] = batch.connection.execute(insert).scalar_one(), f"{each.kind}/{each.name}"
        for rows in self._row_chunks(lost):
            whole = [row for row in rows if row.evaluation in copied and is_whole(row, copied[row.evaluation][1])]
            lost += {row.id for row in rows} - {row.id for row in whole}
            values = (
                {name: value for name, value in zip(ROWS.c.keys(), row, strict=True) if name != "id"} for row in whole
            )
            if values := [{**each, "evaluation": copied[each["evaluation"]][0]} for each in values]:
                batch.connection.execute(sa.insert(ROWS), values)
            count += len(whole)
        if lost:
            words = f"{count_noun(len(lost), 'row')} lost ({_ranges(lost)}): unreadable, or {NOT_WHOLE}"
            self._lost(f"{self.source.place}: {words}")
        for table in (TOTALS, RELEASES, RESERVATIONS):
            for row in self._rows(table):
                values = dict(zip(table.c.keys(), row, strict=True)) | {"study": batch.study}
                if table is RELEASES:
                    del values["id"]
                if all(
                    is_amount(values[c.name])
                    for c in table.c
                    if c.name != "study" and c.name in values and not isinstance(c.type, sa.Text)
                ):
                    batch.connection.execute(sa.insert(table), [values])
                else:
                    self._lost(f"{self.source.place}: {table.name} of {row.participant} hold what is no amount")
        for fault in self.source.faults():
            self._lost(fault)
        return count

    def _rows(self, table: sa.Table) -> Iterator[sa.Row[Any]]:
        """Yield the study's rows of a small table, as far as they can be read."""
        assert self._connection is not None, "only then it has rows"
        try:
            yield from self._connection.execute(sa.select(table).where(table.c.study == self._study))
        except exc.DBAPIError as error:
            self._lost(f"{self.source.sentence(error)} ({table.name} are read in part)")

    def _row_chunks(self, lost: list[int]) -> Iterator[Sequence[sa.Row[Any]]]:
        """Yield rows; the numbers of those that cannot be read go to `lost`."""
        assert self._connection is not None, "only then it has rows"
        every, last, top = sa.select(ROWS).order_by(ROWS.c.id), 0, None
        mine = {each.id for each in self.evaluations}
        query = every if self._is_alone else every.where(ROWS.c.evaluation.in_(mine))
        while top is None or last < top:
            try:
                rows = self._connection.execute(query.where(ROWS.c.id > last).limit(_FETCHED)).all()
                if not rows:
                    return
                last = rows[-1].id
            except exc.DBAPIError as error:
                if error.connection_invalidated:  # the server has gone
                    raise self.source.sentence(error) from error
                top = self._last_row() if top is None else top
                rows, numbers = [], range(last + 1, min(last + _FETCHED, top) + 1)
                for number in numbers:
                    with suppress(exc.DBAPIError):
                        rows += self._connection.execute(every.where(ROWS.c.id == number)).all()
                lost += {*numbers} - {row.id for row in rows}  # of a page cut in its middle, SQLite finds none
                rows = [row for row in rows if self._is_alone or row.evaluation in mine]
                last += _FETCHED
            yield rows

    def _last_row(self) -> int:
        """Return the highest number of a row that a damaged table, its index or its seal tells."""
        numbers = [0]
        assert self._connection is not None, "only then it has rows"
        for query in (sa.select(sa.func.max(ROWS.c.id)), sa.text(_BY_INDEX), sa.select(sa.func.sum(SEALS.c.rows))):
            with suppress(exc.DBAPIError):
                numbers.append(int(self._connection.execute(query).scalar() or 0))
        return max(numbers)


def _ranges(numbers: list[int]) -> str:
    """Return numbers as ranges, `1-3, 7`; the first ones of many."""
    ordered = sorted(numbers)
    groups = [[*group] for _, group in groupby(enumerate(ordered), lambda each: each[1] - each[0])]
    words = [f"{group[0][1]}" + (f"-{group[-1][1]}" if len(group) > 1 else "") for group in groups]
    return ", ".join(words[:_NAMED]) + f", and {len(words) - _NAMED} more ranges" * (len(words) > _NAMED)
