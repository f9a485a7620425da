"""What several hosts may spend of one study's budget: each takes blocks, and gives back what it does not need.

A block is money that a process may spend on one participant; what it spends is booked with the rows that tell of it
(`storage/stream.py`). What is granted and not yet booked counts as spent for everybody else. So does the block of a
process that died: its calls in flight may have cost all of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from traps_pipeline.storage.database import Session
from traps_pipeline.storage.stream import add_spent

if TYPE_CHECKING:
    from psycopg import Connection

CENT = 1e-9  # below this, dollars are rounding
_RELEASED = """create table if not exists traps.released (
    study int not null references traps.studies, participant text not null, usd float8 not null,
    why text not null, "by" text not null, at text not null)"""
RELEASE = ("participant", "usd", "why", "by", "at")  # what is recorded of money that a person gave back


@dataclass(frozen=True)
class Standing:
    """Dollars of a study by participant. spent: for good; out: granted to some process and not booked; others: of that,
    what processes other than this one hold."""

    spent: Mapping[str, float]
    out: Mapping[str, float]
    others: Mapping[str, float]

    def room(self, cap_usd: float, participant: str | None = None) -> float:
        """What a cap leaves, of one participant or of all."""
        taken = (self.spent, self.out)
        if participant is not None:
            return cap_usd - sum(its.get(participant, 0.0) for its in taken)
        return cap_usd - sum(sum(its.values()) for its in taken)


def keep_releases(connection: Connection[Any], session: Session, records: Iterable[Mapping[str, Any]]) -> None:
    """Keep records of what was released; what is spent does not change by it."""
    connection.execute(_RELEASED)
    for record in records:
        sql = "insert into traps.released values (%s, %s, %s, %s, %s, %s)"
        connection.execute(sql, [session.study_id, *(record[name] for name in RELEASE)])


class Purse:
    """The blocks of this process. Raises TrapsError where the database stays away."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def open(self) -> Standing:
        """Count the blocks of processes that died as spent; how the study stands. Until this purse is closed, another
        one of this process waits."""
        self._session.purse.acquire()
        try:
            return self._session.run(self._standing)
        except BaseException:
            self._session.purse.release()
            raise

    def grant(
        self, participant: str, held_usd: float, least_usd: float, most_usd: float, caps: Mapping[str | None, float]
    ) -> tuple[float, Standing]:
        """Take so many dollars more (0 if there is no room for the least) and how the study stood. held_usd: what was
        granted to this process for the participant before; caps: of each participant that has one, and of the study.
        """

        def work(connection: Connection[Any]) -> tuple[float, Standing]:
            standing = self._standing(connection)
            had = self._granted(connection, participant)
            if had is None and held_usd > CENT:
                had = held_usd  # another process took this one for dead and counted its block; begin another
            if had is not None and had > held_usd + CENT:
                return had - held_usd, standing  # granted before, when the connection broke
            whose = (None, participant) if participant in caps else (None,)
            room = min(standing.room(caps[slot], slot) for slot in whose)
            if room < least_usd - CENT:
                return 0.0, standing
            more = max(least_usd, min(most_usd, room))
            sql = """insert into traps.blocks (study, session, participant, granted, booked) values (%s, %s, %s, %s, %s)
                     on conflict (study, session, participant) do update set granted = excluded.granted"""
            slot = [self._session.study_id, self._session.id, participant]
            connection.execute(sql, [*slot, held_usd + more, held_usd])
            return more, standing

        self._session.has_blocks = True
        return self._session.run(work)

    def give_back(self, granted_usd: Mapping[str, float], lost_usd: Mapping[str, float]) -> None:
        """Say by participant what is granted now, no more than before, and what was spent that no row tells of: of a
        row that is on its way, too, until it is said again."""

        def work(connection: Connection[Any]) -> None:
            self._hold(connection)
            for participant in sorted(granted_usd):
                sql = """update traps.blocks b set granted = %s, lost = %s from traps.blocks o
                         where b.study = %s and b.session = %s and b.participant = %s
                         and (o.study, o.session, o.participant) = (b.study, b.session, b.participant)
                         returning b.lost - o.lost"""
                lost = lost_usd.get(participant, 0.0)
                values = [granted_usd[participant], lost, self._session.study_id, self._session.id, participant]
                for (more,) in connection.execute(sql, values).fetchall():
                    add_spent(connection, self._session, participant, more)

        self._session.run(work)

    def release(self, record: Mapping[str, Any]) -> None:
        """Count dollars of a participant as spent no more, and keep the record of it (`models.release`)."""

        def work(connection: Connection[Any]) -> None:
            self._hold(connection)
            keep_releases(connection, self._session, [record])
            add_spent(connection, self._session, record["participant"], -record["usd"])

        self._session.run(work)

    def releases(self) -> list[dict[str, Any]]:
        """Return the records of what was released, the oldest first."""

        def work(connection: Connection[Any]) -> list[dict[str, Any]]:
            keep_releases(connection, self._session, [])
            sql = 'select participant, usd, why, "by", at from traps.released where study = %s order by at'
            rows = connection.execute(sql, [self._session.study_id]).fetchall()
            return [dict(zip(RELEASE, row, strict=True)) for row in rows]

        return self._session.run(work)

    def close(self) -> None:
        """Count what is left of this process's blocks as spent, and end them."""
        try:
            self._session.run(lambda connection: self._settle(connection, self._session.id))
        finally:
            self._session.has_blocks = False
            self._session.purse.release()

    # --- in a transaction -------------------------------------------------------------------------------------------

    def _hold(self, connection: Connection[Any]) -> None:
        """Keep others from taking blocks of the study meanwhile."""
        connection.execute("select from traps.studies where id = %s for update", [self._session.study_id])

    def _standing(self, connection: Connection[Any]) -> Standing:
        self._hold(connection)
        sql = "select distinct session from traps.blocks where study = %s order by session"
        for (session,) in connection.execute(sql, [self._session.study_id]).fetchall():
            if self._session.is_dead(connection, session):
                self._settle(connection, session)
        # In one statement, which sees one moment: a group of rows moves money from one to the other.
        sql = """select participant, sum(usd), sum(left_usd), sum(case session when %s then 0 else left_usd end)
                 from (
                     select participant, '' as session, usd, 0 as left_usd from traps.spent where study = %s
                     union all
                     select participant, session, 0, greatest(granted - booked - lost, 0) from traps.blocks
                     where study = %s
                 ) both_kinds group by participant"""
        mine = self._session.study_id
        found = connection.execute(sql, [self._session.id, mine, mine]).fetchall()
        spent, out, others = ({row[0]: row[column] for row in found} for column in (1, 2, 3))
        return Standing(spent, out, others)

    def _granted(self, connection: Connection[Any], participant: str) -> float | None:
        sql = "select granted from traps.blocks where study = %s and session = %s and participant = %s"
        row = connection.execute(sql, [self._session.study_id, self._session.id, participant]).fetchone()
        return row and row[0]

    def _settle(self, connection: Connection[Any], session: str) -> None:
        sql = "delete from traps.blocks where study = %s and session = %s returning participant, granted, booked, lost"
        for participant, granted, booked, lost in sorted(
            connection.execute(sql, [self._session.study_id, session]).fetchall()
        ):
            if (left := granted - booked - lost) > CENT:
                add_spent(connection, self._session, participant, left)
