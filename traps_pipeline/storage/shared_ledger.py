"""The ledger that several hosts share: rows in a PostgreSQL database, and segments of finished evaluations in the
object store, where the study has one (`storage/compaction.py`).

A settled key has one row; rows of failed calls are kept for the record. An answer counts when its group is stored
(`storage/stream.py`), and until then its connection makes no other call; so a kill loses no more than the calls in
flight.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any

from traps_pipeline.storage.compaction import COLUMNS, FETCHED, Segment, Segments, segments_of
from traps_pipeline.storage.database import OLD_S, Claim, Session, lock_number
from traps_pipeline.storage.ledger import (
    ASIDES,
    GiveUp,
    Known,
    Ledger,
    LockGivenUp,
    Stored,
    Totals,
    Waiting,
    Writer,
    never,
    row_of,
    settles,
)
from traps_pipeline.storage.lines import NOT_WHOLE, is_whole
from traps_pipeline.storage.stream import (
    Group,
    Stream,
    current_numbers,
    encoded,
    store_groups,
    stream_of,
    taken_over,
    this_process,
    totals_of,
)

if TYPE_CHECKING:
    from psycopg import Connection


LOCK_POLL_S = 0.2


class SharedLedger(Ledger):
    """Append-only rows by key in a database, in which each study has its own. store: where rows of finished
    evaluations go; None where they stay."""

    def __init__(self, session: Session, kind: str, store: Any = None) -> None:
        super().__init__(kind)
        self.session, self.segments = session, Segments(session, store, kind)

    def read(self, evaluation: str, wanted: Collection[str] | None = None) -> Known:
        """See `Ledger.read`."""
        known = Known()
        for place, line in self._lines("line", evaluation, wanted):
            if not is_whole(line):
                known.notes[place] = f"{NOT_WHOLE}: it is not believed; its answer is asked again"
                continue
            row, healed = row_of(line)
            if healed:
                known.notes[place] = f"{', '.join(healed)}: no possible value, counted as unknown"
            known.add(row)
        return known

    def reasoning(self, evaluation: str, wanted: Collection[str] | None = None) -> dict[str, str]:
        """See `Ledger.reasoning`."""
        found = (row_of(line)[0] for _, line in self._lines("reasoning", evaluation, wanted) if is_whole(line))
        return {row["key"]: row["reasoning"] for row in found}

    def totals(self) -> dict[str, Totals]:
        """See `Ledger.totals`."""
        sql = """select participant, dollars, dearest, unknown, sums, counts from traps.totals
                 where study = %s and kind = %s"""
        found = self.session.run(lambda c: c.execute(sql, [self.session.study_id, self.kind]).fetchall())
        return {participant: totals_of(*its) for participant, *its in found}

    def evaluations(self) -> list[str]:
        """See `Ledger.evaluations`."""
        sql = """select name from traps.evaluations e where study = %s and kind = %s
                 and (exists (select from traps.rows where evaluation = e.id)
                      or exists (select from traps.segments where evaluation = e.id)) order by name"""
        found = self.session.run(lambda c: c.execute(sql, [self.session.study_id, self.kind]).fetchall())
        return [evaluation for (evaluation,) in found]

    def rows(self, evaluation: str) -> Iterator[Stored]:
        """See `Ledger.rows`."""
        for _, line, *beside in self._pages(COLUMNS, evaluation):
            if is_whole(line):
                row = json.loads(line)
                row.pop("sum")
                kept = {name: json.loads(of)[name] for name, of in zip(ASIDES, beside, strict=True) if of}
                yield row, kept

    def damage(self) -> Iterator[str]:
        """See `Ledger.damage`."""
        for evaluation in self.evaluations():
            mine = self.session.run(lambda c, e=evaluation: segments_of(c, self._slot(e)))
            if damaged := [said for one in mine if (said := self.segments.damage(one, evaluation))]:
                yield from damaged
                continue
            for column in COLUMNS:
                places = [place for place, line in self._lines(column, evaluation) if not is_whole(line)]
                yield from (f"{place} ({column}): {NOT_WHOLE}, and not believed" for place in places)

    def _lines(
        self, column: str, evaluation: str, wanted: Collection[str] | None = None
    ) -> Iterator[tuple[str, bytes]]:
        """Place and content of the lines of an evaluation, the oldest first."""
        for key, line in self._pages([column], evaluation, wanted):
            if line is not None:
                yield f"{self.session.host}: {self.kind} of {evaluation}, key {key[:16]}", line

    def _slot(self, evaluation: str) -> list[Any]:
        return [self.session.study_id, self.kind, evaluation]

    def _pages(
        self, columns: Sequence[str], evaluation: str, wanted: Collection[str] | None = None
    ) -> Iterator[Sequence[Any]]:
        """Key and columns of the rows of an evaluation (of the wanted keys), the oldest first, wherever they lie: those
        that become a segment meanwhile come once, too."""
        sql = f"""select r.id, r.key, {", ".join(columns)} from traps.rows r
                  join traps.evaluations e on e.id = r.evaluation where e.study = %s and e.kind = %s and e.name = %s"""
        read = set[int]()

        def fetched(condition: str, value: Any) -> tuple[Sequence[Any], list[Segment]]:
            """Rows of the database, then the segments that were not read: what has left the rows is in one of them."""
            slot = self._slot(evaluation)
            statement: Any = f"{sql} and {condition}"  # of this file's own words
            work = lambda c: (c.execute(statement, [*slot, value]).fetchall(), segments_of(c, slot))  # noqa: E731
            found, segments = self.session.run(work)
            new = [one for one in segments if one.id not in read]
            read.update(one.id for one in new)
            return found, new

        def numbered(found: Sequence[Any], new: Sequence[Segment]) -> Iterator[Sequence[Any]]:
            for one in new:
                yield from self.segments.rows(one, evaluation, columns, wanted)
            yield from found

        if wanted is not None:
            keys, given = [*wanted], set[int]()
            for first in range(0, len(keys), FETCHED):
                for number, *row in numbered(
                    *fetched("r.key = any(%s::text[]) order by r.id", keys[first : first + FETCHED])
                ):
                    if number not in given:
                        given.add(number)
                        yield row
            return
        last = 0
        while any(pages := fetched(f"r.id > %s order by r.id limit {FETCHED}", last)):
            for number, *row in numbered(*pages):
                if number > last:
                    last = number
                    yield row

    @asynccontextmanager
    async def writing(self, evaluation: str, waiting: Waiting, give_up: GiveUp = never) -> AsyncIterator[Writer]:
        """See `Ledger.writing`."""
        claim = await self._claim(evaluation, waiting, give_up)
        stream = stream_of(self.session)
        writer = SharedWriter(stream, claim, self.kind, self.segments)
        stream.start()
        try:
            yield writer
        finally:
            try:
                writer.sync()
            finally:
                await asyncio.to_thread(self._release, claim)

    async def store(self, rows: Mapping[str, Sequence[Stored]], waiting: Waiting) -> int:
        """See `Ledger.store`."""
        async with AsyncExitStack() as claimed:
            writers = {
                evaluation: await claimed.enter_async_context(self.writing(evaluation, waiting))
                for evaluation in sorted(rows)
            }
            missing = {
                evaluation: [one for one in mine if one[0]["key"] not in known]
                for evaluation, mine in rows.items()
                for known in [self.read(evaluation).settled]
            }
            groups = [
                Group(writer.claim, self.kind, [encoded(one) for one in missing[evaluation]])
                for evaluation, writer in writers.items()
                if isinstance(writer, SharedWriter)
            ]
            refused = await asyncio.to_thread(self._store_whole, groups)
            if refused:
                raise taken_over(self.session, refused[0])
        return sum(settles(row) for mine in missing.values() for row, _ in mine)

    def _store_whole(self, groups: Sequence[Group]) -> list[Claim]:
        """Store all groups, or none where one is refused."""

        def work(connection: Connection[Any]) -> list[Claim]:
            numbers = current_numbers(connection, groups)
            if refused := [g.claim for g in groups if g.claim.number != numbers.get(g.claim.evaluation)]:
                return refused
            return store_groups(connection, self.session, groups)

        refused = self.session.run(work)
        for group in groups:
            group.claim.groups += not refused
        return refused

    # --- the one writer ---------------------------------------------------------------------------------------------

    async def _claim(self, evaluation: str, waiting: Waiting, give_up: GiveUp) -> Claim:
        told = False
        while True:
            found = await asyncio.to_thread(self._try_claim, evaluation)
            if isinstance(found, Claim):
                if found.is_succession:  # by now whoever had it sends nothing more, even if it is only cut off
                    await asyncio.sleep(OLD_S)
                return found
            if not told:
                waiting(f"{self.kind} of {evaluation} are being asked by {found}; waiting for it to finish")
                told = True
            if give_up():
                raise LockGivenUp(evaluation)
            await asyncio.sleep(LOCK_POLL_S)

    def _try_claim(self, evaluation: str) -> Claim | str:
        """The claim, or who has it."""
        session, lock = self.session, lock_number(f"{self.session.study}/{self.kind}/{evaluation}")

        slot = self._slot(evaluation)

        def work(connection: Connection[Any]) -> Claim | str:
            connection.execute("update traps.studies set is_here = true where id = %s and not is_here", slot[:1])
            sql = "insert into traps.evaluations (study, kind, name) values (%s, %s, %s) on conflict do nothing"
            connection.execute(sql, slot)
            sql = """select id, holder, to_char(since, 'HH24:MI:SS') from traps.evaluations
                     where study = %s and kind = %s and name = %s"""
            ((number, holder, since),) = connection.execute(sql, slot).fetchall()
            held = f"{holder} since {since}" if holder else "another process"
            if number in session.claims or not session.try_lock(connection, lock):
                return held
            if holder and not session.is_settled(connection):
                connection.execute("select pg_advisory_unlock(%s)", [lock])
                return f"{held} (the database was started a moment ago, and it may come back)"
            sql = """update traps.evaluations set number = number + 1, groups = 0, holder = %s, since = now()
                     where id = %s returning number"""
            ((fence,),) = connection.execute(sql, [this_process(), number]).fetchall()
            return Claim(number, f"{self.kind} of {evaluation}", lock, fence, is_succession=holder is not None)

        with session.guard:
            found = session.run(work)
            if isinstance(found, Claim):
                session.claims[found.evaluation] = found
        return found

    def _release(self, claim: Claim) -> None:
        def work(connection: Connection[Any]) -> None:
            sql = "update traps.evaluations set holder = null where id = %s and number = %s"
            connection.execute(sql, [claim.evaluation, claim.number])
            connection.execute("select pg_advisory_unlock(%s)", [claim.lock])

        with self.session.guard:
            try:
                if not claim.lost:
                    self.session.run(work, patience_s=5.0)
            finally:
                self.session.claims.pop(claim.evaluation, None)


class SharedWriter(Writer):
    """Appends rows to an evaluation of a database."""

    def __init__(self, stream: Stream, claim: Claim, kind: str, segments: Segments) -> None:
        self.claim, self._stream, self._kind, self._segments = claim, stream, kind, segments
        # Those that may not be stored yet, and what this loop's connections wait for: one for all of them.
        self._groups: dict[Future[None], asyncio.Future[None] | None] = {}

    async def require(self) -> None:
        """See `Writer.require`. While the database is away, or too slow to say, wait for a while."""
        session = self._stream.session
        until = time.monotonic() + session.patience_s
        while not session.is_fresh and not self.claim.lost and time.monotonic() < until:
            await asyncio.to_thread(session.look)
        if self.claim.lost or not session.is_fresh:
            raise taken_over(session, self.claim)

    def open(self) -> None:
        """See `Writer.open`."""

    def append(self, row: Mapping[str, Any], beside: Mapping[str, str] | None = None) -> None:
        """See `Writer.append`."""
        group = self._stream.put(self.claim, self._kind, encoded((row, beside or {})))
        if group not in self._groups:
            self._groups = {one: by for one, by in self._groups.items() if not (one.done() and one.exception() is None)}
            self._groups[group] = None

    async def kept(self) -> None:
        """See `Writer.kept`. The database has what was appended."""
        for group, waited in [*self._groups.items()]:
            if waited is None:
                waited = self._groups[group] = self._groups.get(group) or asyncio.wrap_future(group)
            await asyncio.shield(waited)

    def sync_if_due(self) -> None:
        """See `Writer.sync_if_due`. The stream's thread stores rows as they come."""

    def sync(self) -> None:
        """See `Writer.sync`."""
        self._stream.store()
        for group in self._groups:
            group.result()

    def finish(self) -> None:
        """See `Writer.finish`. They go to the object store, where there is one."""
        self.sync()
        self._segments.compact(self.claim)
