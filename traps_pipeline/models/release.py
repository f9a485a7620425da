"""Release money reserved for unsent calls (`traps study release-money`).

A call in flight when its process died, and a failed one that may be billed, count as their worst case until released. A
person who has checked the provider's bill releases them; the ledger records who, when and why.
"""

from __future__ import annotations

import getpass
import os
from datetime import UTC, datetime

from traps_pipeline.ledger.money import Money, Releasable
from traps_pipeline.models.spending import account_budgets
from traps_pipeline.storage.workspace import Workspace


def releasable(workspace: Workspace) -> dict[str, Releasable]:
    """Return the releasable dollars by participant. Raises TrapsError."""
    with workspace.ledger.writing():
        return Money(workspace.ledger).releasable()


def release(workspace: Workspace, participant: str, usd: float | None, why: str) -> float:
    """Release a participant's dollars (None: all in flight); return the amount.

    Raises TrapsError if less is reserved for calls that may never have been sent.
    """
    with workspace.ledger.writing():
        money = Money(workspace.ledger)
        account = account_budgets(workspace, money.spent()).get(participant)
        dollars = money.release(participant, usd, why, _person(), datetime.now(UTC).isoformat())
        if account is not None:
            account.correct(-dollars)
        return dollars


def _person() -> str:
    """Return the user's name, if the user id has one (in a container it may not)."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())
