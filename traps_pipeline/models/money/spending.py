"""Yield the budget of a run, and release money reserved for unsent calls.

A call in flight when its process died, and a failed one that may be billed, count as their worst case until released. A
person who has checked the provider's bill releases them; the ledger records who, when and why.
"""

import getpass
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.money import Money, Releasable
from traps_pipeline.models.money.account_budget import AccountBudget
from traps_pipeline.models.money.budget import Budget
from traps_pipeline.models.registry.entries import Entry, load_accounts, load_models
from traps_pipeline.models.registry.judges import load_judges
from traps_pipeline.storage.workspace import Workspace


@contextmanager
def open_budget(workspace: Workspace, participants: Iterable[Entry]) -> Iterator[Budget]:
    """Yield the study's remaining budget, shared by its processes. Raises TrapsError."""
    _check_names(workspace)
    caps = workspace.study.budget_usd, workspace.study.model_budgets_usd
    if not any(entry.prices for entry in participants):
        yield Budget(*caps)
        return
    with workspace.ledger.writing():
        money = Money(workspace.ledger)
        yield Budget(*caps, money, account_budgets(workspace, money.spent()))


@contextmanager
def share_accounts(workspace: Workspace, participants: Iterable[Entry]) -> Iterator[Callable[[str], int]]:
    """Announce which accounts this process uses; yield a function that counts an account's processes."""
    accounts = {entry.account for entry in participants if entry.account}
    if not accounts:
        yield lambda account: 1
        return
    with workspace.ledger.sharing(accounts) as sharers:
        yield sharers


def account_budgets(workspace: Workspace, spent: Mapping[str, float]) -> dict[str, AccountBudget]:
    """Return by participant the account budgets that `study.yaml` names. Raises TrapsError."""
    study, budgets = workspace.study, dict[str, AccountBudget]()
    entries: list[Entry] = [*load_models().values(), *load_judges().values()]
    for account, folder in study.account_budgets.items():
        model_ids = [entry.id for entry in entries if entry.account == account]
        if workspace.is_shared and not Path(folder).is_absolute():
            raise TrapsError(
                f"{workspace.place}/study.yaml: account_budgets names the folder {folder}, which other hosts do not "
                "see; give the path of a folder that all hosts of this study share"
            )
        budget = AccountBudget(account, workspace.root / folder, study.name)
        budget.begin(sum(spent.get(name, 0.0) for name in model_ids))
        budgets |= dict.fromkeys(model_ids, budget)
    return budgets


def releasable(workspace: Workspace) -> dict[str, Releasable]:
    """Return by participant the reserved dollars that may be released. Raises TrapsError."""
    with workspace.ledger.writing():
        return Money(workspace.ledger).releasable()


def release_money(workspace: Workspace, participant: str, usd: float | None, why: str) -> float:
    """Release a participant's dollars (None: all in flight); return the amount. Raises TrapsError if less is held."""
    with workspace.ledger.writing():
        money = Money(workspace.ledger)
        account = account_budgets(workspace, money.spent()).get(participant)
        dollars = money.release(participant, usd, why, _person(), datetime.now(UTC).isoformat())
        if account is not None:
            account.correct(-dollars)
        return dollars


def _check_names(workspace: Workspace) -> None:
    """Raise TrapsError for a cap of a participant that is not in the study."""
    if unknown := workspace.study.account_budgets.keys() - load_accounts().keys():
        raise TrapsError(
            f"{workspace.root / 'study.yaml'}: account_budgets names {', '.join(sorted(unknown))}, no account of "
            "assets/models.yaml; correct the name, or remove its line"
        )
    if unknown := workspace.study.model_budgets_usd.keys() - load_models().keys() - load_judges().keys():
        raise TrapsError(
            f"{workspace.root / 'study.yaml'}: model_budgets_usd names {', '.join(sorted(unknown))}, neither a model "
            "of assets/models.yaml nor a judge of assets/judges.yaml; correct the name, or remove its line"
        )


def _person() -> str:
    """Return the user's name, if the user id has one (in a container it may not)."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())
