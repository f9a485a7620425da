"""A cap that holds: the worst case of a call is reserved before it is sent and settled when its cost is known.

What was spent is the sum of the costs in the ledger, so it survives restarts. Only what is not there yet stands in a
small journal, so that calls in flight when a process is killed count as their worst case ever after.
"""

from __future__ import annotations

import asyncio
import json
import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import remedy, write_bytes
from traps_pipeline.models.account_budget import AccountBudget
from traps_pipeline.models.registry import NETWORK, Entry, ModelEntry
from traps_pipeline.models.request import Request
from traps_pipeline.storage.lines import NOT_WHOLE, append_whole, checked_line, read_checked
from traps_pipeline.storage.study import Study

OVERHEAD_TOKENS = 200  # roles, separators, JSON around the text
RELEASED = "released.jsonl"  # beside the journal: what a person gave back, and why (`models.release`)
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


def read_releases(path: Path) -> list[Mapping[str, Any]]:
    """Return the records of what a person released (`models.release`). A damaged one releases nothing, and is named."""
    records, damaged = list[Mapping[str, Any]](), list[int]()
    for line in read_checked(path) if path.exists() else ():
        if line.whole:
            records.append(json.loads(line.content))
        elif not line.torn:
            damaged.append(line.number)
    if damaged:
        numbers = ", ".join(map(str, damaged))
        progress.current().note(f"{path}: line {numbers} {NOT_WHOLE}; what it released counts as spent")
    return records


def released_usd(records: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """Return the dollars that were released, by participant."""
    released = defaultdict[str, float](float)
    for record in records:
        released[record["participant"]] += record["usd"]
    return released


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
        async with self._changed:
            while not (await self._fits(participant, worst_usd) and self._fits_account(participant, worst_usd)):
                await self._wait()
            for slot in (None, participant):
                self._reserved[slot] += worst_usd
        self._note(participant, worst_usd)

    async def _fits(self, participant: str, worst_usd: float) -> bool:
        """Whether the study has room for a call now. Raises BudgetReached when nothing can make any."""
        full = [slot for slot in self._slots(participant) if self._room(slot) < worst_usd - 1e-9]
        if hopeless := [slot for slot in full if self._reserved[slot] <= 1e-9]:
            raise BudgetReached(self._explain(hopeless[0], worst_usd))
        return not full

    def _fits_account(self, participant: str, worst_usd: float) -> bool:
        """Whether the participant's account has room, which is taken then. Raises BudgetReached as `_fits` does."""
        shared = self._shared.get(participant)
        if shared is None or shared.reserve(worst_usd):
            return True
        if not self._in_flight_through(shared):
            raise BudgetReached(shared.explain(worst_usd))
        return False

    async def _wait(self) -> None:
        """Wait until there may be more room; `_changed` is held."""
        await self._changed.wait()

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
        return reached(slot, self._spent[slot], self._caps[slot], worst_usd)


def reached(participant: str | None, spent_usd: float, cap_usd: float, worst_usd: float) -> str:
    """Why a budget leaves no room for a call; None: the study's."""
    return (
        f"the budget of {participant or 'the study'} is reached: ${spent_usd:.2f} of ${cap_usd:.2f} spent, the next "
        f"call may cost ${worst_usd:.4f}. Raise it (--budget-usd, or study.yaml) and run the same command to go on"
    )
