"""Give back money that is booked for calls which never left, with the reason: `traps ledger release`.

A call in flight when its process died, and a failed one that may be billed, count as their worst case for good. A
person who has compared the provider's bill says so here. What is released is a line of `ledger/released.jsonl`, or a
row of the database that holds the ledger; what was booked stays as it is, and the budget subtracts the one from the
other.
"""

from __future__ import annotations

import getpass
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import remedy
from traps_pipeline.models.budget import RELEASED, Journal, read_releases, released_usd
from traps_pipeline.models.spending import account_budgets, alone, spent_usd
from traps_pipeline.storage.ledger import FAILED, is_cost, participant_of
from traps_pipeline.storage.lines import append_whole, checked_line
from traps_pipeline.storage.purse import CENT, Purse
from traps_pipeline.storage.segments import JOURNAL
from traps_pipeline.storage.workspace import Workspace


@dataclass(frozen=True)
class Releasable:
    """Dollars of a participant that may be released. in_flight: of calls whose process died; failed: of calls that
    came to nothing, as their rows have it."""

    in_flight: float
    failed: float


@dataclass
class _Booked:
    """What a study has booked, while nobody else spends from it."""

    spent: Mapping[str, float]
    in_flight: Mapping[str, float]
    released: Mapping[str, float]


def releasable(workspace: Workspace) -> dict[str, Releasable]:
    """Return what may be released by participant. Waits while another process spends from the study. Raises
    TrapsError."""
    with _booked(workspace) as booked:
        return _releasable(workspace, booked)


def release(workspace: Workspace, participant: str, usd: float | None, why: str) -> float:
    """Release dollars of a participant (None: all of its calls in flight); how many. Raises TrapsError where less is
    booked for calls that may never have left."""
    with _booked(workspace) as booked:
        room = _releasable(workspace, booked).get(participant, Releasable(0.0, 0.0))
        most = room.in_flight + room.failed
        dollars = room.in_flight if usd is None else usd
        if not CENT < dollars <= most + CENT:
            raise TrapsError(
                f"{participant}: ${dollars:.4f} cannot be released: ${room.in_flight:.4f} are booked for calls in "
                f"flight when a process died and ${room.failed:.4f} for failed ones; give --usd with at most "
                f"{most:.4f}, or a participant that `traps ledger release` lists"
            )
        dollars = min(dollars, most)
        now = datetime.now(UTC).isoformat()
        record = {"participant": participant, "usd": dollars, "why": why, "by": _person(), "at": now}
        if workspace.session is None:
            _append(workspace, record)
        else:
            Purse(workspace.session).release(record)
        account = account_budgets(workspace, booked.spent).get(participant)
        if account is not None:
            with closing(account):
                account.correct(-dollars)
        return dollars


@contextmanager
def _booked(workspace: Workspace) -> Iterator[_Booked]:
    with ExitStack() as opened:
        if workspace.session is None:
            opened.enter_context(alone(workspace))
            journal = opened.enter_context(closing(Journal(workspace.ledger_folder / JOURNAL)))
            released = released_usd(read_releases(workspace.ledger_folder / RELEASED))
            yield _Booked(spent_usd(workspace, journal), journal.lost_usd, released)
            return
        purse = Purse(workspace.session)
        standing = purse.open()
        opened.callback(purse.close)
        released, in_flight = released_usd(purse.releases()), dict[str, float]()
        ledgers = (workspace.answers.totals(), workspace.votes.totals())
        for participant, usd in standing.spent.items():
            rows = sum(its[participant].dollars for its in ledgers if participant in its)
            in_flight[participant] = usd - rows + released.get(participant, 0.0)
        yield _Booked(standing.spent, in_flight, released)


def _releasable(workspace: Workspace, booked: _Booked) -> dict[str, Releasable]:
    failed = defaultdict[str, float](float)
    for ledger in (workspace.answers, workspace.votes):
        for evaluation in ledger.evaluations():
            for row, _ in ledger.rows(evaluation):
                cost = row.get("cost_usd") or 0.0
                if row.get("outcome") in FAILED and is_cost(cost):
                    failed[participant_of(row)] += cost
    rooms = dict[str, Releasable]()
    for participant in sorted({*booked.in_flight, *failed}):
        lost, before = booked.in_flight.get(participant, 0.0), booked.released.get(participant, 0.0)
        room = Releasable(max(0.0, lost - before), max(0.0, failed[participant] - max(0.0, before - lost)))
        if room.in_flight + room.failed > CENT:
            rooms[participant] = room
    return rooms


def _person() -> str:
    """Return the user's name; a container may have no name for its number."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())


def _append(workspace: Workspace, record: Mapping[str, Any]) -> None:
    path = workspace.ledger_folder / RELEASED
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            append_whole(descriptor, checked_line(record))
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        raise TrapsError(f"{path}: cannot be written ({error.strerror}); {remedy(error)} and run it again") from error
