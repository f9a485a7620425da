"""Rows on their way into the database that several hosts share: a thread stores them in groups as they come.

A group is stored in one transaction with the number of its writer, what it adds to the totals, and what was spent. One
whose writer is not the evaluation's any more is refused.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from hashlib import sha256
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.storage.database import BEAT_S, Claim, Session
from traps_pipeline.storage.ledger import ASIDES, AVERAGED, FAILED, SYNC_ROWS, Stored, Totals, participant_of
from traps_pipeline.storage.lines import checked_line

if TYPE_CHECKING:
    from psycopg import Connection

# A group costs the same with one row as with ten: for a little while after a group was stored, rows gather, unless they
# are many. In proportion to what the group took, so that a call that waits for its row waits little longer.
MANY, GATHER, GATHER_S = 16, 2.0, 0.05


@dataclass(frozen=True)
class Encoded:
    """A row as it is stored. settles: whether it is the one row that settles its key; beside: what is kept beside it,
    in the order of ASIDES, None where there is none."""

    row: Mapping[str, Any]
    settles: bool
    line: bytes
    beside: tuple[bytes | None, ...]


def encoded(stored: Stored, *, is_newest: bool = True) -> Encoded:
    """A row, ready to be stored. is_newest: no later row of the ledger that it comes from settles its key. Raises
    ValueError for what no line can hold."""
    row, its = stored
    beside = (checked_line({"key": row["key"], name: its[name]}) if name in its else None for name in ASIDES)
    return Encoded(row, is_newest and row.get("outcome") not in FAILED, checked_line(row), tuple(beside))


@dataclass
class Group:
    """Rows of an evaluation that are stored together. stored: done when they are, or an error why they are not."""

    claim: Claim
    kind: str
    rows: list[Encoded]
    stored: Future[None] = field(default_factory=Future)


class Stream:
    """The rows of a process on their way to the database, and the thread that stores them. One a session."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self._waiting: deque[Group] = deque()
        self._mutex, self._storing = threading.Lock(), threading.Lock()
        self._changed, self._are_many = threading.Event(), threading.Event()
        self._count = 0  # rows that are waiting
        self._thread: threading.Thread | None = None

    def put(self, claim: Claim, kind: str, row: Encoded) -> Future[None]:
        """Add a row; the result is done when it is stored."""
        with self._mutex:
            last = next((group for group in reversed(self._waiting) if group.claim is claim), None)
            if last is None or len(last.rows) == SYNC_ROWS:
                last = Group(claim, kind, [])
                self._waiting.append(last)
            last.rows.append(row)
            self._count += 1
            if self._count >= MANY:
                self._are_many.set()
        self._changed.set()
        return last.stored

    def start(self) -> None:
        """See that a thread stores what is put, and looks after the session's claims."""
        with self._mutex:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="ledger", daemon=True)
                self._thread.start()

    def _run(self) -> None:
        took_s = 0.0
        while not self.session.closed:
            if self._changed.wait(BEAT_S):
                self._are_many.wait(min(GATHER_S, GATHER * took_s))
                self._changed.clear()
            began = time.monotonic()
            with self._storing:
                self._store(self._take())
            took_s = time.monotonic() - began
            if self._count:
                self._changed.set()
            if self.session.is_held:
                try:
                    self.session.look()
                except TrapsError:
                    continue  # whoever wants to send a call looks too, and is told

    def store(self) -> None:
        """Store all that is waiting, in this thread. What cannot be stored is told to those that wait for it."""
        with self._storing:
            while taken := self._take():
                self._store(taken)

    def _store(self, taken: Sequence[Group]) -> None:
        if not taken:
            return
        try:
            refused = self.session.run(lambda c: store_groups(c, self.session, taken))
        except Exception as error:  # noqa: BLE001 - handed to those that wait, each of whom raises it
            for group in taken:
                group.stored.set_exception(error)
            return
        for group in taken:
            if group.claim in refused:
                group.stored.set_exception(taken_over(self.session, group.claim))
            else:
                group.claim.groups += 1
                group.stored.set_result(None)

    def _take(self) -> list[Group]:
        """Groups of different evaluations, of at most SYNC_ROWS rows together."""
        taken, rows = list[Group](), 0
        with self._mutex:
            while self._waiting:
                group = self._waiting[0]
                rows += len(group.rows)
                if taken and (rows > SYNC_ROWS or any(group.claim is other.claim for other in taken)):
                    break
                taken.append(self._waiting.popleft())
                self._count -= len(group.rows)
            if self._count < MANY:
                self._are_many.clear()
        return taken


_streams: WeakKeyDictionary[Session, Stream] = WeakKeyDictionary()


def stream_of(session: Session) -> Stream:
    """The stream of a session."""
    return _streams.setdefault(session, Stream(session))


def taken_over(session: Session, claim: Claim) -> TrapsError:
    """What a writer is told whose evaluation is another process's now."""
    return TrapsError(
        f"{claim.name} of the study {session.study} are another process's now: this one ({this_process()}) was silent, "
        f"or cut off from {session.host}, for too long. Nothing more is sent, and what it had not stored is refused. "
        "Run the same command again: only what is missing is asked"
    )


def this_process() -> str:
    """How this process is named to others."""
    return f"process {os.getpid()} on {socket.gethostname()}"


def store_groups(connection: Connection[Any], session: Session, groups: Sequence[Group]) -> list[Claim]:
    """Store groups of rows, with what they add to the totals and to what was spent; the claims whose groups are
    refused. A group that was stored before, when the connection broke, is not stored again."""
    claims = [group.claim for group in groups]
    sql = """update traps.evaluations e set groups = e.groups + 1
             from unnest(%s::int[], %s::bigint[], %s::bigint[]) as mine (id, number, groups)
             where e.id = mine.id and e.number = mine.number and e.groups = mine.groups returning e.id"""
    values = [[claim.evaluation for claim in claims], [claim.number for claim in claims], [c.groups for c in claims]]
    allowed = {evaluation for (evaluation,) in connection.execute(sql, values).fetchall()}
    new = [group for group in groups if group.claim.evaluation in allowed]
    for group in new:
        insert_rows(connection, group.claim.evaluation, group.rows)
    add_up(connection, session, ((group.kind, one.row) for group in new for one in group.rows))
    others = [group for group in groups if group.claim.evaluation not in allowed]
    numbers = current_numbers(connection, others) if others else {}
    refused = [g.claim for g in others if numbers.get(g.claim.evaluation) != g.claim.number]
    for claim in refused:
        claim.lost = True
    return refused


def current_numbers(connection: Connection[Any], groups: Sequence[Group]) -> dict[int, int]:
    """The writer's number by evaluation; nobody else can change it before this transaction's end."""
    sql = "select id, number from traps.evaluations where id = any(%s) order by id for update"
    return dict(connection.execute(sql, [[group.claim.evaluation for group in groups]]).fetchall())


def insert_rows(connection: Connection[Any], evaluation: int, rows: Sequence[Encoded]) -> None:
    """Insert rows; a key that is settled keeps its row, unless that is damaged."""
    keys = [one.row["key"] for one in rows]
    lines = [one.line for one in rows]
    beside = [[one.beside[number] for one in rows] for number in range(len(ASIDES))]
    settled = [one.settles for one in rows]
    digests = [sha256(line).digest() for line in lines]
    sql = """insert into traps.rows (evaluation, key, settled, line, digest, reasoning, raw)
             select %s, * from unnest(%s::text[], %s::bool[], %s::bytea[], %s::bytea[], %s::bytea[], %s::bytea[])
             on conflict (evaluation, key) where settled do nothing returning key"""
    stored = connection.execute(sql, [evaluation, keys, settled, lines, digests, *beside]).fetchall()
    if len(stored) < len(rows):
        sql = """delete from traps.rows where evaluation = %s and settled and key = any(%s) and sha256(line) <> digest
                 returning key"""
        damaged = connection.execute(sql, [evaluation, keys]).fetchall()
        if again := [one for one in rows if one.settles and (one.row["key"],) in damaged]:
            insert_rows(connection, evaluation, again)


def add_up(connection: Connection[Any], session: Session, rows: Iterable[tuple[str, Mapping[str, Any]]]) -> None:
    """Add rows (with their kinds) to the study's totals and to what was spent, out of this session's blocks. Rows of
    the database are locked in one order everywhere: evaluations, totals, spent, blocks."""
    totals: dict[tuple[str, str], Totals] = {}
    for kind, row in rows:
        totals.setdefault((kind, participant_of(row)), Totals()).add(row)
    spent: dict[str, float] = {}
    for (kind, participant), its in sorted(totals.items()):
        spent[participant] = spent.get(participant, 0.0) + its.dollars
        add_totals(connection, session, kind, participant, its)
    for participant, usd in sorted(spent.items()):
        if usd > 0:
            add_spent(connection, session, participant, usd)
            sql = "update traps.blocks set booked = booked + %s where study = %s and session = %s and participant = %s"
            connection.execute(sql, [usd, session.study_id, session.id, participant])


def add_totals(connection: Connection[Any], session: Session, kind: str, participant: str, its: Totals) -> None:
    """Add to what all rows of a participant add up to."""
    sql = """insert into traps.totals values (%s, %s, %s, %s, %s, %s, %s, %s)
             on conflict (study, kind, participant) do update set dollars = totals.dollars + excluded.dollars,
             dearest = greatest(totals.dearest, excluded.dearest), unknown = totals.unknown + excluded.unknown,
             sums = array(select a + b from unnest(totals.sums, excluded.sums) as two (a, b)),
             counts = array(select a + b from unnest(totals.counts, excluded.counts) as two (a, b))"""
    sums, counts = ([float(its.means.get(column, (0.0, 0))[place]) for column in AVERAGED] for place in (0, 1))
    values = [session.study_id, kind, participant, its.dollars, its.dearest, its.unknown, sums, counts]
    connection.execute(sql, values)


def add_spent(connection: Connection[Any], session: Session, participant: str, usd: float) -> None:
    """Count dollars as spent by the study."""
    sql = """insert into traps.spent values (%s, %s, %s)
             on conflict (study, participant) do update set usd = spent.usd + excluded.usd"""
    connection.execute(sql, [session.study_id, participant, usd])


def totals_of(dollars: float, dearest: float, unknown: int, sums: Sequence[float], counts: Sequence[float]) -> Totals:
    """Totals as the database holds them."""
    means = {name: (total, int(n)) for name, total, n in zip(AVERAGED, sums, counts, strict=True) if n}
    return Totals(dollars, dearest, unknown, means)
