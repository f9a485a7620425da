"""Cap spending: the worst case of a call is reserved before it is sent.

The reservation is a row of the ledger's database (`ledger/money.py`, docs/design/money.md).
"""

import asyncio
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.money import CapExhausted, Money
from traps_pipeline.models.money.account_budget import AccountBudget
from traps_pipeline.models.money.media_tokens import frame_bound
from traps_pipeline.models.registry.entries import NETWORK, Entry, ModelEntry
from traps_pipeline.models.request import Request
from traps_pipeline.protocol.datasets import dataset_of
from traps_pipeline.storage.study import Study

OVERHEAD_TOKENS = 200  # roles, separators, JSON around the text
LOOK_S = 0.5  # how often to check whether other processes have freed room
BYTES_A_TOKEN = 1  # some tokenizers make a token of every digit, and judges are shown arbitrary text


class BudgetReached(TrapsError):
    """Raised where the budget has no room for another call."""


@dataclass(frozen=True)
class Tokens:
    """The maximum numbers of prompt and completion tokens of a call."""

    prompt: int
    completion: int


def most_tokens(entry: Entry, request: Request) -> Tokens:
    """Return upper bounds of a call's tokens."""
    frames = request.sent.n_frames if request.sent else 0
    dataset = dataset_of(str(request.about.get("item_id", "")))
    tokens_per_frame = frame_bound(entry, dataset) if isinstance(entry, ModelEntry) else 0
    schema = json.dumps(request.params.get("response_format", ""))
    text = len((request.system + request.user + schema).encode()) // BYTES_A_TOKEN
    return Tokens(frames * tokens_per_frame + text + OVERHEAD_TOKENS, entry.max_tokens)


def worst_case_usd(entry: Entry, request: Request) -> float:
    """Return a call's maximum cost in dollars; 0 if its price is unknown."""
    if entry.prices is None:
        return 0.0
    tokens = most_tokens(entry, request)
    return entry.prices.cost(tokens.prompt, tokens.completion)


def check_money(study: Study, entry: Entry) -> None:
    """Raise TrapsError unless the study allows a participant's possible cost."""
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


@dataclass(frozen=True)
class Reservation:
    """The maximum dollars of a call, held from before it is sent until its row is stored."""

    id: str
    participant: str
    usd: float


class Budget:
    """The remaining budget, in total and per participant with its own cap.

    money: None if nobody who is asked has a price. accounts: by participant, the budget of its account if that spans
    several studies.
    """

    def __init__(
        self,
        cap_usd: float,
        caps_usd: Mapping[str, float],
        money: Money | None = None,
        accounts: Mapping[str, AccountBudget] | None = None,
    ) -> None:
        self._caps: dict[str | None, float] = {None: cap_usd, **caps_usd}
        self._money, self._accounts = money, accounts or {}
        self._in_flight: dict[str, Reservation] = {}
        self._changed = asyncio.Condition()

    @property
    def spent_usd(self) -> float:
        """Dollars spent by all runs, with the worst case of calls in flight."""
        return sum(self._money.spent().values()) if self._money else 0.0

    async def reserve(self, participant: str, worst_usd: float) -> Reservation | None:
        """Reserve a call's worst case (None if free), or wait for calls in flight.

        Raises BudgetReached if there is no room and no call in flight that could free some, and TrapsError.
        """
        if worst_usd <= 0:
            return None
        assert self._money is not None, "a participant with a price is asked with the study's money"
        while True:
            result = await self._money.reserve(participant, worst_usd, self._caps)
            if isinstance(result, str):
                reservation = Reservation(result, participant, worst_usd)
                account = self._accounts.get(participant)
                if account is None or account.reserve(worst_usd):
                    self._in_flight[reservation.id] = reservation
                    return reservation
                await self._money.settle(reservation.id, 0.0)
                if not self._has_calls_through(account):
                    raise BudgetReached(account.explain(worst_usd))
            elif not await self._has_room_later(result):
                raise BudgetReached(
                    budget_reached_reason(result.slot, result.taken_usd, self._caps[result.slot], worst_usd)
                )
            async with self._changed:
                with suppress(TimeoutError):
                    await asyncio.wait_for(self._changed.wait(), LOOK_S)

    async def settle(self, reservation: Reservation | None, cost_usd: float | None) -> None:
        """Replace a call's worst case by its cost, unless that is unknown."""
        if reservation is None:
            return
        cost = reservation.usd if cost_usd is None else cost_usd
        if account := self._accounts.get(reservation.participant):
            account.correct(cost - reservation.usd)
        try:
            if cost != reservation.usd:
                assert self._money is not None, "what is settled was reserved"
                await self._money.settle(reservation.id, cost)
        finally:
            async with self._changed:
                self._in_flight.pop(reservation.id, None)
                self._changed.notify_all()

    async def _has_room_later(self, full: CapExhausted) -> bool:
        """Return whether calls in flight, of any process, may yet cost less than reserved."""
        if any(full.slot in (None, call.participant) for call in self._in_flight.values()):
            return True
        assert self._money is not None, "what is full was asked for"
        return await asyncio.to_thread(self._money.is_any_alive, full.others)

    def _has_calls_through(self, account: AccountBudget) -> bool:
        """Return whether settling this process's calls may free an account's budget."""
        return any(self._accounts.get(call.participant) is account for call in self._in_flight.values())


def budget_reached_reason(participant: str | None, spent_usd: float, cap_usd: float, worst_usd: float) -> str:
    """Return in words why a budget (None: the study's) leaves no room for a call."""
    return (
        f"the budget of {participant or 'the study'} is reached: ${spent_usd:.2f} of ${cap_usd:.2f} spent, the next "
        f"call may cost ${worst_usd:.4f}. Raise it (--budget-usd, or study.yaml) and run the same command to go on"
    )
