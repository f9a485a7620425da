"""Give back money that is booked for calls which never left, with the reason: `traps study release-money`.

A call in flight when its process died, and a failed one that may be billed, count as their worst case for good. A
person who has compared the provider's bill says so here; the ledger keeps who said it, when and why.
"""

from __future__ import annotations

import getpass
import os
from contextlib import closing
from datetime import UTC, datetime

from traps_pipeline.ledger.money import Money, Releasable
from traps_pipeline.models.spending import account_budgets
from traps_pipeline.storage.workspace import Workspace


def releasable(workspace: Workspace) -> dict[str, Releasable]:
    """Return what may be released by participant. Raises TrapsError."""
    with workspace.ledger.writing():
        return Money(workspace.ledger).releasable()


def release(workspace: Workspace, participant: str, usd: float | None, why: str) -> float:
    """Release dollars of a participant (None: all of its calls in flight); how many. Raises TrapsError where less is
    booked for calls that may never have left."""
    with workspace.ledger.writing():
        money = Money(workspace.ledger)
        account = account_budgets(workspace, money.spent()).get(participant)
        dollars = money.release(participant, usd, why, _person(), datetime.now(UTC).isoformat())
        if account is not None:
            with closing(account):
                account.correct(-dollars)
        return dollars


def _person() -> str:
    """Return the user's name; a container may have no name for its number."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())
