"""Account for dollars spent, reserved by calls in flight, or released by a person.

The transaction that stores a call's row removes its reservation (docs/design/money.md).
"""

import secrets
from asyncio import CancelledError
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import sqlalchemy as sa

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.batch import CENT, Batch, CapExhausted, Request
from traps_pipeline.ledger.database import Database
from traps_pipeline.ledger.schema import RELEASES, RESERVATIONS


@dataclass(frozen=True)
class Releasable:
    """Releasable dollars: calls in flight when a process died, and failed calls."""

    in_flight: float
    failed: float


class Money:
    """The money of one study, used within `Database.writing`; raises TrapsError."""

    def __init__(self, database: Database) -> None:
        self._database = database

    async def reserve(self, participant: str, usd: float, caps: Mapping[str | None, float]) -> str | CapExhausted:
        """Reserve dollars and return the reservation's id, or why a cap leaves no room.

        caps: of each participant that has one, and of the study (None). If the caller is cancelled nothing stays
        reserved.
        """
        request = Request(secrets.token_hex(8), participant, usd, caps)
        try:
            await self._database.apply(lambda batch: batch.reserve(request))
        except CancelledError:
            self._database.submit(lambda batch: batch.settle(request.id, 0.0))
            raise
        return request.exhausted or request.id

    async def settle(self, reservation: str, usd: float) -> None:
        """Replace a reservation's worst case by the call's cost, until its row is stored."""
        await self._database.apply(lambda batch: batch.settle(reservation, usd))

    def spent(self) -> dict[str, float]:
        """Return dollars by participant: costs of rows, and reservations in flight."""

        def change(batch: Batch) -> dict[str, float]:
            batch.flush()
            return batch.taken_usd()

        return self._database.submit(change).result()

    def is_any_alive(self, sessions: Iterable[str]) -> bool:
        """Return whether any session is alive, so that its calls may yet cost less."""
        return any(not self._database.is_dead(session) for session in sessions)

    def releasable(self) -> dict[str, Releasable]:
        """Return the releasable dollars by participant."""
        return self._database.submit(self._releasable).result()

    def release(self, participant: str, usd: float | None, why: str, by: str, at: str) -> float:
        """Release a participant's dollars, record it, and return the amount.

        participant: None for all of the study's calls in flight. Raises TrapsError if less is reserved for calls that
        may never have been sent.
        """

        def change(batch: Batch) -> float:
            room = self._releasable(batch).get(participant, Releasable(0.0, 0.0))
            max_usd = room.in_flight + room.failed
            dollars = room.in_flight if usd is None else usd
            if not CENT < dollars <= max_usd + CENT:
                raise TrapsError(
                    f"{participant}: ${dollars:.4f} cannot be released: ${room.in_flight:.4f} are booked for calls in "
                    f"flight when a process died and ${room.failed:.4f} for failed ones; give --usd with at most "
                    f"{max_usd:.4f}, or a participant that `traps study release-money` lists"
                )
            in_flight_usd = min(dollars, room.in_flight)
            failed = min(dollars, max_usd) - in_flight_usd
            self._reduce(batch, participant, in_flight_usd)
            values = {"study": batch.study, "participant": participant, "in_flight": in_flight_usd, "failed": failed}
            batch.connection.execute(sa.insert(RELEASES).values(**values, why=why, by=by, at=at))
            batch.flush()
            return in_flight_usd + failed

        return self._database.submit(change).result()

    def releases(self) -> list[Mapping[str, object]]:
        """Return the records of all releases, the oldest first."""
        query = sa.select(RELEASES).order_by(RELEASES.c.id)
        return self._database.submit(
            lambda batch: [
                dict(row) for row in batch.connection.execute(query.where(RELEASES.c.study == batch.study)).mappings()
            ]
        ).result()

    def _dead_sessions(self, batch: Batch) -> set[str]:
        return {session for session in batch.other_sessions() if self._database.is_dead(session)}

    def _releasable(self, batch: Batch) -> dict[str, Releasable]:
        dead_sessions = self._dead_sessions(batch)
        in_flight_usd, failed = defaultdict[str, float](float), defaultdict[str, float](float)
        for each in batch.amounts():
            failed[each.participant] += -each.failed if each.table == RELEASES.name else each.failed
            if each.session in dead_sessions:
                in_flight_usd[each.participant] += each.usd
        rooms = {
            name: Releasable(in_flight_usd[name], max(0.0, failed[name])) for name in sorted({*in_flight_usd, *failed})
        }
        return {name: room for name, room in rooms.items() if room.in_flight + room.failed > CENT}

    def _reduce(self, batch: Batch, participant: str, usd: float) -> None:
        """Take dollars from the reservations of calls whose process died."""
        query = sa.select(RESERVATIONS).where(
            RESERVATIONS.c.study == batch.study,
            RESERVATIONS.c.participant == participant,
            RESERVATIONS.c.session.in_(self._dead_sessions(batch)),
        )
        for row in batch.connection.execute(query.order_by(RESERVATIONS.c.id)).all():
            remaining_usd = max(0.0, row.usd - usd)
            usd -= row.usd - remaining_usd
            batch.settle(row.id, remaining_usd)
