"""Account for dollars spent, reserved by calls in flight, or released by a person.

A call's worst case is reserved before it is sent. The transaction that stores the call's row removes the reservation. A
reservation of a dead process stays, and counts as spent, until a person releases it.
"""

from __future__ import annotations

import secrets
from collections import defaultdict
from collections.abc import Iterable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass

import sqlalchemy as sa

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.batch import CENT, Batch
from traps_pipeline.ledger.database import Database
from traps_pipeline.ledger.schema import RELEASES, RESERVATIONS, TOTALS


@dataclass(frozen=True)
class CapExhausted:
    """The reason why a call was not reserved.

    slot: the participant whose cap is exhausted, None for the study's; taken_usd: spent and reserved under that cap;
    others: sessions of other processes that hold reservations.
    """

    slot: str | None
    taken_usd: float
    others: frozenset[str]


@dataclass(frozen=True)
class Releasable:
    """Releasable dollars: calls in flight when a process died, and failed calls."""

    in_flight: float
    failed: float


class Money:
    """The money of one study, used within `Database.writing`; raises TrapsError."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def reserve(self, participant: str, usd: float, caps: Mapping[str | None, float]) -> Future[str | CapExhausted]:
        """Reserve dollars and return the reservation's id, or why a cap leaves no room.

        caps: of each participant that has one, and of the study (None).
        """
        reservation = secrets.token_hex(8)
        slots = [slot for slot in (None, participant) if slot in caps]

        def change(batch: Batch) -> str | CapExhausted:
            for slot in slots:
                committed = sum(sum(_slot_dollars(amounts, slot)) for amounts in (batch.spent, batch.reserved))
                if caps[slot] - committed < usd - CENT:
                    return CapExhausted(slot, committed, _other_sessions(batch))
            batch.reserve(reservation, participant, usd)
            return reservation

        return self._database.submit(change)

    def forget(self, pending: Future[str | CapExhausted], participant: str, usd: float) -> None:
        """Remove an abandoned reservation, if it was made."""
        if not pending.cancelled() and pending.exception() is None and isinstance(pending.result(), str):
            self.settle(str(pending.result()), participant, usd, 0.0)

    def settle(self, reservation: str, participant: str, was_usd: float, usd: float) -> Future[None]:
        """Replace a reservation's worst case by the call's cost, until its row is stored."""
        return self._database.submit(lambda batch: batch.settle(reservation, participant, was_usd, usd))

    def spent(self) -> dict[str, float]:
        """Return dollars by participant: costs of rows, and reservations in flight."""

        def change(batch: Batch) -> dict[str, float]:
            return {
                name: batch.spent.get(name, 0.0) + batch.reserved.get(name, 0.0)
                for name in {*batch.spent, *batch.reserved}
            }

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
            batch.spend(participant, -failed)
            values = {"study": batch.study, "participant": participant, "in_flight": in_flight_usd, "failed": failed}
            batch.connection.execute(sa.insert(RELEASES).values(**values, why=why, by=by, at=at))
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
        return {session for session in _other_sessions(batch) if self._database.is_dead(session)}

    def _releasable(self, batch: Batch) -> dict[str, Releasable]:
        dead_sessions = self._dead_sessions(batch)
        in_flight_usd, failed = defaultdict[str, float](float), defaultdict[str, float](float)
        query = sa.select(RESERVATIONS).where(
            RESERVATIONS.c.study == batch.study, RESERVATIONS.c.session.in_(dead_sessions)
        )
        for row in batch.connection.execute(query):
            in_flight_usd[row.participant] += row.usd
        for row in batch.connection.execute(sa.select(TOTALS).where(TOTALS.c.study == batch.study)):
            failed[row.participant] += row.failed
        for row in batch.connection.execute(sa.select(RELEASES).where(RELEASES.c.study == batch.study)):
            failed[row.participant] -= row.failed
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
            batch.settle(row.id, participant, row.usd, remaining_usd)


def _slot_dollars(dollars: Mapping[str, float], slot: str | None) -> list[float]:
    return [*dollars.values()] if slot is None else [dollars.get(slot, 0.0)]


def _other_sessions(batch: Batch) -> frozenset[str]:
    query = sa.select(RESERVATIONS.c.session).where(RESERVATIONS.c.study == batch.study).distinct()
    return frozenset({*batch.connection.execute(query).scalars()} - {batch.session})
