"""Copy a ledger verbatim: to a file, from a file, or into hosts' shared database."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.wording import count_noun
from traps_pipeline.ledger.batch import Batch
from traps_pipeline.ledger.database import Database
from traps_pipeline.ledger.ledger import Ledger
from traps_pipeline.ledger.schema import EVALUATIONS, RELEASES, RESERVATIONS, ROWS, STUDIES, TOTALS
from traps_pipeline.ledger.sqlite import SqliteDatabase

KINDS = ("answers", "votes")
_FETCHED = 1000


def export_ledger(ledger: Database, file: Path) -> int:
    """Write a ledger to a new SQLite file; return its row count. Raises TrapsError."""
    if file.exists():
        raise TrapsError(f"{file}: is there already; name another file")
    return copy_ledger(ledger, SqliteDatabase(file.parent, file=file.name))


def import_ledger(file: Path, ledger: Database) -> int:
    """Read a file's ledger into an empty one; return its row count. Raises TrapsError."""
    if not file.is_file():
        raise TrapsError(f"{file}: no such file; name one that `traps study export-ledger` wrote")
    source = SqliteDatabase(file.parent, file=file.name)
    with source.read() as connection:
        names = [*connection.execute(sa.select(STUDIES.c.name)).scalars()]
    if len(names) != 1:
        raise TrapsError(
            f"{file}: holds {count_noun(len(names), 'study', 'studies')}, and not one; name a file that "
            "`traps study export-ledger` wrote"
        )
    source.study_name = names[0]
    return copy_ledger(source, ledger)


def copy_ledger(source: Database, target: Database, settle: Callable[[], None] = lambda: None) -> int:
    """Copy all rows and money verbatim, or none; return the number of rows.

    Nobody may write to the source meanwhile. settle: called after the copy, before others may write. A killed copy is
    repeated. Raises TrapsError, also if the target has other rows.
    """
    mark = f"copied from {source.place}"
    with ExitStack() as stack:
        stack.enter_context(target.writing())
        for kind in KINDS:
            for evaluation in Ledger(source, kind).evaluations():
                lock = source.try_lock(f"{kind}-{evaluation}")
                if lock is None:
                    raise TrapsError(
                        f"{source.place}: {kind} of {evaluation} are being asked; wait until that run ends, then run "
                        "the same command again"
                    )
                stack.callback(lock.release)
        count = target.submit(lambda batch: _copy(source, batch, target.place, mark)).result()
        target.sync()
        settle()
        clear_mark = sa.update(EVALUATIONS).where(EVALUATIONS.c.writer == mark).values(writer=None)
        target.submit(lambda batch: batch.connection.execute(clear_mark)).result()
    return count


def _copy(source: Database, batch: Batch, place: str, mark: str) -> int:
    evaluations = sa.select(EVALUATIONS.c.id).where(EVALUATIONS.c.study == batch.study)
    unmarked_evaluations = evaluations.where(EVALUATIONS.c.writer.is_distinct_from(mark))
    if batch.connection.execute(
        sa.select(ROWS.c.id).where(ROWS.c.evaluation.in_(unmarked_evaluations)).limit(1)
    ).first():
        raise TrapsError(
            f"{place}: holds rows of this study already; import into a study that has none, or bring answers into it "
            "one by one with `traps study import-answers`"
        )
    # Remove leftovers of a killed copy, and evaluations without a row.
    batch.connection.execute(sa.delete(ROWS).where(ROWS.c.evaluation.in_(evaluations)))
    for table in (TOTALS, RELEASES, RESERVATIONS):
        batch.connection.execute(sa.delete(table).where(table.c.study == batch.study))
    batch.connection.execute(sa.delete(EVALUATIONS).where(EVALUATIONS.c.study == batch.study))
    count = 0
    if not source.exists():
        return count
    with source.read() as connection:
        study = connection.execute(sa.select(STUDIES.c.id).where(STUDIES.c.name == source.study_name)).scalar()
        for evaluation in connection.execute(sa.select(EVALUATIONS).where(EVALUATIONS.c.study == study)).all():
            values = {"study": batch.study, "kind": evaluation.kind, "name": evaluation.name, "writer": mark}
            insert = sa.insert(EVALUATIONS).values(**values).returning(EVALUATIONS.c.id)
            number = batch.connection.execute(insert).scalar_one()
            query = sa.select(ROWS).where(ROWS.c.evaluation == evaluation.id).order_by(ROWS.c.id)
            for rows in _row_chunks(connection, query, "id"):
                batch.connection.execute(sa.insert(ROWS), [row | {"evaluation": number} for row in rows])
                count += len(rows)
        for table, omitted_columns in ((TOTALS, ()), (RELEASES, ("id",)), (RESERVATIONS, ())):
            for rows in _row_chunks(connection, sa.select(table).where(table.c.study == study), *omitted_columns):
                batch.connection.execute(sa.insert(table), [row | {"study": batch.study} for row in rows])
    return count


def _row_chunks(connection: sa.Connection, query: sa.Select[Any], *left_out: str) -> Iterator[list[dict[str, Any]]]:
    result = connection.execution_options(yield_per=_FETCHED).execute(query)
    for rows in result.mappings().partitions():
        yield [{name: value for name, value in row.items() if name not in left_out} for row in rows]
