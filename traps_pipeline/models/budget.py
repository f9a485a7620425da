"""A cap that holds: the worst case of a call is reserved before it is sent and settled when its cost is known.

What was spent is the sum of the costs in the ledger, so it survives restarts. Only what is not there yet stands in a
small journal, so that calls in flight when a process is killed count as their worst case ever after.
"""

from __future__ import annotations

import asyncio
import json
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from traps_pipeline import progress
from traps_pipeline.errors import TrapsError
from traps_pipeline.files import remedy, require_in_place, try_lock, write_bytes
from traps_pipeline.models.account_budget import AccountBudget
from traps_pipeline.models.judges import load_judges
from traps_pipeline.models.registry import NETWORK, Entry, ModelEntry, load_accounts, load_models
from traps_pipeline.models.request import Request
from traps_pipeline.storage.ledger import Totals
from traps_pipeline.storage.lines import NOT_WHOLE, append_whole, checked_line, read_checked
from traps_pipeline.storage.segments import JOURNAL
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

OVERHEAD_TOKENS = 200  # roles, separators, JSON around the text
UNKNOWN = "unknown"  # the participant of money that nobody can tell whose call it was
BYTES_A_TOKEN = 1  # some tokenizers make a token of every digit, and judges are shown arbitrary text


class BudgetReached(TrapsError):
    """No room is left for another call."""


@dataclass(frozen=True)
class Tokens:
    """Tokens of a call at most."""

    prompt: int
    completion: int


def most_tokens(entry: Entry, request: Request) -> Tokens:
    """An upper bound of what a call takes."""
    frames = request.sent.n_frames if request.sent else 0
    each = entry.tokens_per_frame if isinstance(entry, ModelEntry) else 0
    schema = json.dumps(request.params.get("response_format", ""))
    text = len((request.system + request.user + schema).encode()) // BYTES_A_TOKEN
    return Tokens(frames * each + text + OVERHEAD_TOKENS, entry.max_tokens)


def worst_case_usd(entry: Entry, request: Request) -> float:
    """Dollars that a call may cost at most; 0 where the price is unknown (a study must allow that)."""
    if entry.prices is None:
        return 0.0
    tokens = most_tokens(entry, request)
    return entry.prices.cost(tokens.prompt, tokens.completion)


def check_money(study: Study, entry: Entry) -> None:
    """Raises TrapsError unless the study allows what asking this participant may cost."""
    if entry.backend != NETWORK:
        return
    if entry.prices is None:
        if not study.allow_unknown_prices:
            raise TrapsError(
                f"the price of {entry.id} is unknown: give it prices in the registry, or accept that nothing bounds it "
                "(--allow-unknown-prices, or allow_unknown_prices: true in study.yaml)"
            )
    elif (entry.prices.input or entry.prices.output) and study.budget_usd <= 0:
        raise TrapsError(
            f"{entry.id} costs money and the study has no budget: set one (--budget-usd, or budget_usd in study.yaml); "
            "`traps plan` says how much is needed"
        )


class Journal:
    """Dollars that calls were sent for and that no row of a ledger holds yet, one line a change, by participant. What
    is left of it when its process dies is what its calls in flight may have cost; that stays. One process has it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lost_usd = {name: dollars for name, dollars in _left_of(path).items() if dollars > 1e-6}
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, b"".join(_line(*loss) for loss in self.lost_usd.items()), durable=True)
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND)

    def add(self, participant: str, dollars: float) -> None:
        """Note a change at once, so that it survives kill -9. Raises TrapsError when the disk is full."""
        try:
            append_whole(self._file, _line(participant, dollars))
        except OSError as error:
            raise TrapsError(
                f"{self.path}: cannot be written ({error.strerror}); {remedy(error)} and run the same command again"
            ) from error

    def close(self) -> None:
        """Close the file; it stays."""
        os.close(self._file)


def _line(participant: str, dollars: float) -> bytes:
    return checked_line({"who": participant, "usd": dollars})


def _left_of(path: Path) -> Mapping[str, float]:
    """What a journal holds, by participant. A damaged line counts as the dearest call of the others, and a person is
    told: it says that money was on its way, and not how much."""
    left, dearest, damaged = defaultdict[str, float](float), 0.0, list[int]()
    for line in read_checked(path) if path.exists() else ():
        if line.torn:
            continue  # what it was written for was never sent
        change = json.loads(line.content) if line.whole else _early(line.content)
        if change is None:
            damaged.append(line.number)
            continue
        left[change["who"]] += change["usd"]
        dearest = max(dearest, change["usd"])
    if damaged:
        progress.current().note(
            f"{path}: line {', '.join(map(str, damaged))} {NOT_WHOLE}; ${dearest:.4f} each are counted as spent"
        )
        left[UNKNOWN] += dearest * len(damaged)
    return left


def _early(line: bytes) -> Mapping[str, Any] | None:
    """A line of a journal as version 0.1.0 wrote it, without a checksum: participant and dollars."""
    try:
        match json.loads(line):
            case [str(who), float() | int() as usd]:
                return {"who": who, "usd": usd}
    except ValueError:
        pass
    return None


class Budget:
    """What may still be spent, in all and by each participant that has a cap of its own. shared: by participant, the
    budget of its account where that spans several studies."""

    def __init__(
        self,
        cap_usd: float,
        caps_usd: Mapping[str, float],
        spent_usd: Mapping[str, float],
        journal: Journal | None = None,
        held: Callable[[], None] = lambda: None,
        shared: Mapping[str, AccountBudget] | None = None,
    ) -> None:
        self._journal, self._held, self._shared = journal, held, shared or {}
        self._caps = {None: cap_usd, **caps_usd}
        self._spent = defaultdict(float, spent_usd) | {None: sum(spent_usd.values())}
        self._reserved: defaultdict[str | None, float] = defaultdict(float)
        self._changed = asyncio.Condition()

    @property
    def spent_usd(self) -> float:
        """Dollars settled, those of earlier runs included."""
        return self._spent[None]

    def _room(self, slot: str | None) -> float:
        return self._caps[slot] - self._spent[slot] - self._reserved[slot]

    def _slots(self, participant: str) -> tuple[str | None, ...]:
        return (None, participant) if participant in self._caps else (None,)

    async def reserve(self, participant: str, worst_usd: float) -> None:
        """Reserve a call's worst case; while calls in flight hold the room, wait for what they really cost.

        Raises BudgetReached when there is no room and nothing in flight that could make some, TrapsError when the lock
        that keeps other runs from the same budget was removed.
        """
        if worst_usd <= 0:
            return
        self._held()
        shared = self._shared.get(participant)
        async with self._changed:
            while True:
                full = [slot for slot in self._slots(participant) if self._room(slot) < worst_usd - 1e-9]
                if hopeless := [slot for slot in full if self._reserved[slot] <= 1e-9]:
                    raise BudgetReached(self._explain(hopeless[0], worst_usd))
                if not full and (shared is None or shared.reserve(worst_usd)):
                    break
                if not full and shared is not None and not self._in_flight_through(shared):
                    raise BudgetReached(shared.explain(worst_usd))
                await self._changed.wait()
            for slot in (None, participant):
                self._reserved[slot] += worst_usd
        self._note(participant, worst_usd)

    async def settle(self, participant: str, worst_usd: float, cost_usd: float | None) -> None:
        """Put a call's cost in the place of its worst case; an unknown cost counts as the worst."""
        cost = worst_usd if cost_usd is None else cost_usd
        self._note(participant, cost - worst_usd)
        if shared := self._shared.get(participant):
            shared.correct(cost - worst_usd)
        async with self._changed:
            for slot in (None, participant):
                self._reserved[slot] = max(0.0, self._reserved[slot] - worst_usd)
                self._spent[slot] = self._spent[slot] + cost
            self._changed.notify_all()

    def _in_flight_through(self, shared: AccountBudget) -> bool:
        """Whether calls of this process are out whose settling may make room in an account's budget."""
        return any(self._reserved[name] > 1e-9 for name, its in self._shared.items() if its is shared)

    def booked(self, participant: str, cost_usd: float) -> None:
        """What a call and its attempts cost stands in the ledger."""
        self._note(participant, -cost_usd)

    def _note(self, participant: str, dollars: float) -> None:
        if self._journal is not None and dollars:
            self._journal.add(participant, dollars)

    def _explain(self, slot: str | None, worst_usd: float) -> str:
        whose = "the study" if slot is None else slot
        return (
            f"the budget of {whose} is reached: ${self._spent[slot]:.2f} of ${self._caps[slot]:.2f} spent, the next "
            f"call may cost ${worst_usd:.4f}. Raise it (--budget-usd, or study.yaml) and run the same command to go on"
        )


@contextmanager
def spending(workspace: Workspace, participants: Iterable[Entry]) -> Iterator[Budget]:
    """The study's budget, less what its ledgers say was spent. Where anyone asked has a price, no other process spends
    from it meanwhile: two that do not see each other's calls would both use the remainder. Raises TrapsError."""
    _check_names(workspace)
    if not any(entry.prices for entry in participants):
        yield Budget(workspace.study.budget_usd, workspace.study.model_budgets_usd, {})
        return
    path = workspace.locks / "budget.lock"
    with _locked(path) as held, ExitStack() as opened:
        journal = Journal(workspace.answers.root / JOURNAL)
        opened.callback(journal.close)
        spent = _spent_usd(workspace, journal)
        shared = _shared_budgets(workspace, spent)
        for account in shared.values():
            opened.callback(account.close)
        caps = workspace.study.budget_usd, workspace.study.model_budgets_usd
        yield Budget(*caps, spent, journal, held, shared)


@contextmanager
def _locked(path: Path) -> Iterator[Callable[[], None]]:
    """Hold a lock file; the value raises TrapsError when it is called after the file was removed."""
    told = False
    while (descriptor := try_lock(path)) is None:
        if not told:
            progress.current().note("another run spends from this study's budget; waiting for it to finish")
            told = True
        time.sleep(0.2)
    try:
        yield lambda: require_in_place(descriptor, path)
    finally:
        os.close(descriptor)


def _spent_usd(workspace: Workspace, journal: Journal) -> Mapping[str, float]:
    """Dollars by participant: what the ledgers hold, and calls that were in flight when a process died."""
    spent = defaultdict[str, float](float, journal.lost_usd)
    for ledger in (workspace.answers, workspace.votes):
        for participant, its in ledger.totals().items():
            spent[participant] += its.dollars + its.unknown * _at_most_usd(workspace, participant, its)
    return spent


def _shared_budgets(workspace: Workspace, spent_usd: Mapping[str, float]) -> dict[str, AccountBudget]:
    """By participant, the budget of its account where `study.yaml` names a folder for it. Raises TrapsError."""
    study, shared = workspace.study, dict[str, AccountBudget]()
    entries: list[Entry] = [*load_models().values(), *load_judges().values()]
    for account, folder in study.account_budgets.items():
        through = [entry.id for entry in entries if entry.account == account]
        budget = AccountBudget(account, workspace.root / folder, study.name)
        budget.begin(sum(spent_usd.get(name, 0.0) for name in through))
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
            f"{workspace.answers.root}: {its.unknown} rows of {participant} are damaged or tell a cost that cannot be; "
            f"each counts as ${each:.4f}"
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
