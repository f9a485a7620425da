"""A study's ledger moves from the workspace's folder into a database that several hosts share, and back.

What is moved is complete where it goes before `study.yaml` says that it is there, and stays where it came from until
then: a move that is killed has changed nothing, and the same command does it again.
"""

from __future__ import annotations

import asyncio
import re
import secrets
import time
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager, closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import sync_folder, write_bytes
from traps_pipeline.models.budget import RELEASED, Journal, read_releases, released_usd
from traps_pipeline.models.spending import alone, spent_usd
from traps_pipeline.storage.database import Session, session_of
from traps_pipeline.storage.ledger import Ledger, LockGivenUp, Stored, settles
from traps_pipeline.storage.lines import checked_line
from traps_pipeline.storage.purse import Purse, keep_releases
from traps_pipeline.storage.segments import JOURNAL, SegmentLedger
from traps_pipeline.storage.shared_ledger import SharedLedger
from traps_pipeline.storage.stream import add_spent, add_totals, encoded, insert_rows
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    from psycopg import Connection

KINDS = ("answers", "votes")
BATCH, SEGMENT = 500, 20_000  # rows that are sent at once, and rows of a segment at most


@dataclass(frozen=True)
class Moved:
    """What was moved. where: that the ledger lies there now; kept: the folder of what lay there before, if any."""

    rows: int
    where: str
    kept: Path | None


def move_to_database(workspace: Workspace, variable: str) -> Moved:
    """Move a study's ledger and what it has spent into the database whose address a variable holds. The files stay,
    where nothing reads them. Raises TrapsError, also while anybody asks."""
    if workspace.study.database:
        raise TrapsError(
            f"{workspace.root}/study.yaml: the ledger lies in a database already ({workspace.study.database}); move it "
            "back first (`traps ledger move --back`)"
        )
    if not re.fullmatch(r"[A-Z][A-Z0-9_]*", variable):  # not repeated: it may be an address with its password
        raise TrapsError(
            "--to: give the name of a variable of the environment, in capitals (LAB_DATABASE), that holds the address; "
            "study.yaml holds the name, and never the address"
        )
    session = session_of(variable, workspace.study.name)
    return move_rows(workspace, session, lambda: workspace.allow(database=variable))


def move_rows(workspace: Workspace, session: Session, settle: Callable[[], object]) -> Moved:
    """Put the ledger of a study's folder into a database. settle: makes it count there, once all is there. Raises
    TrapsError, also while anybody asks."""
    return asyncio.run(_move_in(workspace, session, settle))


async def _move_in(workspace: Workspace, session: Session, settle: Callable[[], object]) -> Moved:
    ledgers = [SegmentLedger(workspace.ledger_folder, kind) for kind in KINDS]
    async with _nobody_asks(ledgers):
        with alone(workspace), closing(Journal(workspace.ledger_folder / JOURNAL)) as journal:
            spent = spent_usd(workspace, journal)
            for place in (note for ledger in ledgers for note in ledger.damage()):
                progress.current().note(f"{place}; it is not moved, and what it cost counts as spent")
            releases = read_releases(workspace.ledger_folder / RELEASED)
            rows = session.run(lambda connection: _fill(connection, session, ledgers, spent, releases))
            settle()
        session.run(lambda c: c.execute("update traps.studies set is_here = true where id = %s", [session.study_id]))
        return Moved(rows, session.host, _put_aside(workspace))


def _fill(
    connection: Connection[Any],
    session: Session,
    ledgers: Iterable[SegmentLedger],
    spent: Mapping[str, float],
    releases: Iterable[Mapping[str, Any]],
) -> int:
    """Put all rows into the database, in the place of what an unfinished move left there; how many."""
    ((is_here, holds),) = connection.execute(
        """select is_here, exists (select from traps.rows r join traps.evaluations e on e.id = r.evaluation
           where e.study = s.id) from traps.studies s where id = %s for update""",
        [session.study_id],
    ).fetchall()
    if is_here and holds:
        raise TrapsError(
            f"{session.host}: holds a ledger of the study {session.study} already, which another folder uses; give "
            "this study another `name` in its study.yaml, or use another database"
        )
    _clear(connection, session)
    connection.execute("update traps.studies set is_here = false where id = %s", [session.study_id])
    count = 0
    for ledger in ledgers:
        for evaluation in ledger.evaluations():
            sql = "insert into traps.evaluations (study, kind, name) values (%s, %s, %s) returning id"
            ((number,),) = connection.execute(sql, [session.study_id, ledger.kind, evaluation]).fetchall()
            newest = {row["key"]: place for place, (row, _) in enumerate(ledger.rows(evaluation)) if _settles(row)}
            written = enumerate(ledger.rows(evaluation))
            while batch := list(islice(written, BATCH)):
                rows = [encoded(one, is_newest=newest.get(one[0]["key"]) == place) for place, one in batch]
                insert_rows(connection, number, rows)
                count += len(rows)
        for participant, its in ledger.totals().items():
            add_totals(connection, session, ledger.kind, participant, its)
    for participant, usd in spent.items():
        add_spent(connection, session, participant, usd)
    keep_releases(connection, session, releases)
    return count


def _settles(row: Any) -> bool:
    return "outcome" in row and settles(row)


def _clear(connection: Connection[Any], session: Session) -> None:
    """Remove all that the database holds of a study."""
    mine = [session.study_id]
    connection.execute(
        "delete from traps.rows where evaluation in (select id from traps.evaluations where study = %s)", mine
    )
    connection.execute(
        "delete from traps.segments where evaluation in (select id from traps.evaluations where study = %s)", mine
    )
    connection.execute("delete from traps.evaluations where study = %s", mine)
    connection.execute("delete from traps.totals where study = %s", mine)
    connection.execute("delete from traps.spent where study = %s", mine)
    connection.execute("delete from traps.blocks where study = %s", mine)
    keep_releases(connection, session, [])  # the table
    connection.execute("delete from traps.released where study = %s", mine)


def move_back(workspace: Workspace) -> Moved:
    """Move a study's ledger from its database into the workspace's folder. Raises TrapsError, also while anybody asks
    or spends."""
    session = workspace.session
    if session is None:
        raise TrapsError(f"{workspace.root}/study.yaml: the ledger lies in {workspace.ledger_folder} already")
    if workspace.is_shared:
        raise TrapsError(
            f"{workspace.place}: a study in an object store keeps its ledger in its database, where the names of its "
            "files lie, too"
        )
    return asyncio.run(_move_out(workspace, session))


async def _move_out(workspace: Workspace, session: Session) -> Moved:
    ledgers = [SharedLedger(session, kind) for kind in KINDS]
    staged = workspace.ledger_folder / f"incoming-{secrets.token_hex(4)}"
    async with _nobody_asks(ledgers):
        purse = Purse(session)
        standing = purse.open()
        try:
            if sum(standing.others.values()) > 0:
                raise TrapsError(
                    f"{session.host}: another process spends from the budget of {session.study}; wait for it to finish"
                )
            count = 0
            for ledger in ledgers:
                (staged / ledger.kind).mkdir(parents=True)
                files = SegmentLedger(staged, ledger.kind)
                for evaluation in ledger.evaluations():
                    for segment in _each_key_once(ledger.rows(evaluation)):
                        with files.writer(evaluation) as writer:
                            for one in segment:
                                writer.append(*one)
                        count += len(segment)
            booked = [ledger.totals() for ledger in ledgers]
            releases = purse.releases()
            if releases:
                write_bytes(staged / RELEASED, b"".join(map(checked_line, releases)), durable=True)
            released = released_usd(releases)
            with closing(Journal(staged / JOURNAL)) as journal:
                for participant, usd in standing.spent.items():
                    told = sum(its[participant].dollars for its in booked if participant in its)
                    if (lost := usd - told + released.get(participant, 0.0)) > 1e-6:
                        journal.add(participant, lost)
            sync_folder(staged)
            kept = _put_aside(workspace)
            for path in sorted(staged.iterdir()):
                path.rename(workspace.ledger_folder / path.name)
            staged.rmdir()
            sync_folder(workspace.ledger_folder)
            workspace.allow(database=None)
            session.run(lambda connection: _clear(connection, session))
        finally:
            purse.close()
    return Moved(count, str(workspace.ledger_folder), kept)


def _each_key_once(rows: Iterable[Stored]) -> Iterator[list[Stored]]:
    """Rows in parts for a segment each, in which no key comes twice: what stands beside a row is found by its key."""
    part, keys = list[Stored](), set[str]()
    for one in rows:
        if one[0]["key"] in keys or len(part) == SEGMENT:
            yield part
            part, keys = [], set()
        part.append(one)
        keys.add(one[0]["key"])
    if part:
        yield part


def _put_aside(workspace: Workspace) -> Path | None:
    """Move the files of a ledger that counts no more to a folder of their own; None where there are none."""
    there = [path for path in (workspace.ledger_folder / name for name in (*KINDS, JOURNAL, RELEASED)) if path.exists()]
    if not there:
        return None
    aside = workspace.ledger_folder / f"moved-{time.strftime('%Y%m%dT%H%M%S', time.gmtime())}-{secrets.token_hex(2)}"
    aside.mkdir()
    for path in there:
        path.rename(aside / path.name)
    sync_folder(workspace.ledger_folder)
    return aside


@asynccontextmanager
async def _nobody_asks(ledgers: Iterable[Ledger]) -> AsyncIterator[None]:
    """Be the one writer of all evaluations that have rows. Raises TrapsError where another process asks."""
    said: list[str] = []
    async with AsyncExitStack() as claimed:
        try:
            for ledger in ledgers:
                for evaluation in ledger.evaluations():
                    await claimed.enter_async_context(ledger.writing(evaluation, said.append, lambda: True))
        except LockGivenUp:
            raise TrapsError(f"{said[-1].partition(';')[0]}; nothing was moved. Wait, then move the ledger") from None
        yield
