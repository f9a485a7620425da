"""Whose money a run spends: the budget that a study and its accounts leave, for as long as a run goes on."""

from __future__ import annotations

import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import require_in_place, try_lock
from traps_pipeline.models.account_budget import AccountBudget
from traps_pipeline.models.budget import RELEASED, Budget, Journal, read_releases, released_usd
from traps_pipeline.models.judges import load_judges
from traps_pipeline.models.registry import Entry, load_accounts, load_models
from traps_pipeline.models.shared_budget import SharedBudget
from traps_pipeline.storage.ledger import Totals
from traps_pipeline.storage.purse import Purse
from traps_pipeline.storage.segments import JOURNAL
from traps_pipeline.storage.workspace import Workspace


@contextmanager
def spending(workspace: Workspace, participants: Iterable[Entry]) -> Iterator[Budget]:
    """The study's budget, less what was spent. Where anyone asked has a price, no other process of this machine spends
    from it meanwhile: two that do not see each other's calls would both use the remainder. Where the ledger lies in a
    database, all hosts see what the others take, and spend at the same time. Raises TrapsError."""
    _check_names(workspace)
    caps = workspace.study.budget_usd, workspace.study.model_budgets_usd
    if not any(entry.prices for entry in participants):
        yield Budget(*caps, {})
        return
    with ExitStack() as opened:
        if workspace.session is not None:
            purse = Purse(workspace.session)
            standing = purse.open()
            with ExitStack() as unless_made:  # else whoever spends next in this process would wait for ever
                unless_made.callback(purse.close)
                budget = SharedBudget(*caps, purse, standing, _accounts(workspace, standing.spent, opened))
                unless_made.pop_all()
            opened.callback(budget.close)
            yield budget
            return
        held = opened.enter_context(alone(workspace))
        journal = Journal(workspace.ledger_folder / JOURNAL)
        opened.callback(journal.close)
        spent = spent_usd(workspace, journal)
        yield Budget(*caps, spent, journal, held, _accounts(workspace, spent, opened))


@contextmanager
def sharing(workspace: Workspace, participants: Iterable[Entry]) -> Iterator[Callable[[str], int]]:
    """Within the block this process asks these participants; the value tells how many processes ask through an account
    at this moment, as far as hosts share a database."""
    accounts = {entry.account for entry in participants if entry.account}
    if workspace.session is None or not accounts:
        yield lambda account: 1
        return
    with workspace.session.sharing(accounts) as sharers:
        yield sharers


def _accounts(workspace: Workspace, spent: Mapping[str, float], opened: ExitStack) -> dict[str, AccountBudget]:
    """By participant, the budget of its account where that spans several studies; closed with the stack."""
    shared = account_budgets(workspace, spent)
    for account in shared.values():
        opened.callback(account.close)
    return shared


@contextmanager
def alone(workspace: Workspace) -> Iterator[Callable[[], None]]:
    """Be the one process of this machine that spends from a study's budget; the value raises TrapsError when it is
    called after the lock's file was removed."""
    path, told = workspace.locks / "budget.lock", False
    while (descriptor := try_lock(path)) is None:
        if not told:
            progress.current().note("another run spends from this study's budget; waiting for it to finish")
            told = True
        time.sleep(0.2)
    try:
        yield lambda: require_in_place(descriptor, path)
    finally:
        os.close(descriptor)


def spent_usd(workspace: Workspace, journal: Journal) -> Mapping[str, float]:
    """Dollars by participant: what the ledgers hold, and calls that were in flight when a process of this machine
    died, less what a person released."""
    spent = defaultdict[str, float](float, journal.lost_usd)
    for ledger in (workspace.answers, workspace.votes):
        for participant, its in ledger.totals().items():
            spent[participant] += its.dollars + its.unknown * _at_most_usd(workspace, participant, its)
    for participant, usd in released_usd(read_releases(workspace.ledger_folder / RELEASED)).items():
        spent[participant] = max(0.0, spent[participant] - usd)
    return spent


def account_budgets(workspace: Workspace, spent: Mapping[str, float]) -> dict[str, AccountBudget]:
    """By participant, the budget of its account where `study.yaml` names a folder for it. Raises TrapsError."""
    study, shared = workspace.study, dict[str, AccountBudget]()
    entries: list[Entry] = [*load_models().values(), *load_judges().values()]
    for account, folder in study.account_budgets.items():
        through = [entry.id for entry in entries if entry.account == account]
        if workspace.is_shared and not Path(folder).is_absolute():
            raise TrapsError(
                f"{workspace.place}/study.yaml: account_budgets names the folder {folder}, which other hosts do not "
                "see; give the path of a folder that all hosts of this study share"
            )
        budget = AccountBudget(account, workspace.root / folder, study.name)
        budget.begin(sum(spent.get(name, 0.0) for name in through))
        shared |= dict.fromkeys(through, budget)
    return shared


def _at_most_usd(workspace: Workspace, participant: str, its: Totals) -> float:
    """What a call whose row is damaged, or tells a cost that cannot be, is counted as: the dearest call of the same
    participant that is known, or all the tokens that its answer may take."""
    entry = load_models().get(participant) or load_judges().get(participant)
    most = entry.prices.cost(0, entry.max_tokens) if entry and entry.prices else 0.0
    each = max(its.dearest, most)
    if its.unknown:
        progress.current().note(
            f"{workspace.ledger_folder}: {its.unknown} rows of {participant} are damaged or tell a cost that cannot "
            f"be; each counts as ${each:.4f}"
        )
    return each


def _check_names(workspace: Workspace) -> None:
    """A cap for nobody caps nothing. Raises TrapsError."""
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
