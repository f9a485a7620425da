"""The budget of a study that several hosts spend from: room comes in blocks, and what is free goes back to the others
before anybody is told that the budget is reached."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import suppress

from traps_pipeline.models.account_budget import AccountBudget
from traps_pipeline.models.budget import Budget, BudgetReached, reached
from traps_pipeline.storage.purse import CENT, Purse, Standing

BLOCK_CALLS = 16  # worst cases that a block holds; those of one that dies unsettled are spent
LOOK_S = 0.5  # how often it is looked whether others have made room


class SharedBudget(Budget):
    """What this process may spend: what its purse has granted, by participant."""

    def __init__(
        self,
        cap_usd: float,
        caps_usd: Mapping[str, float],
        purse: Purse,
        standing: Standing,
        shared: Mapping[str, AccountBudget] | None = None,
    ) -> None:
        super().__init__(cap_usd, caps_usd, standing.spent, shared=shared)
        self._purse, self._before = purse, dict(standing.spent)
        self._granted: dict[str, float] = {}
        self._booked: dict[str, float] = {}

    async def _fits(self, participant: str, worst_usd: float) -> bool:
        if self._free(participant) >= worst_usd - CENT:
            return True
        if await self._grant(participant, worst_usd, BLOCK_CALLS * worst_usd) is None:
            return True
        await asyncio.to_thread(self._give_back)
        standing = await self._grant(participant, worst_usd, worst_usd)
        if standing is None:
            return True
        if self._reserved[None] <= CENT and sum(standing.others.values()) <= CENT:
            for slot in self._slots(participant):
                if standing.room(self._caps[slot], slot) < worst_usd - CENT:
                    spent = sum(standing.spent.values()) if slot is None else standing.spent.get(slot, 0.0)
                    raise BudgetReached(reached(slot, spent, self._caps[slot], worst_usd))
        return False

    async def _grant(self, participant: str, worst_usd: float, most_usd: float) -> Standing | None:
        """None when there is room for the call now; else how the study stands."""
        missing, held = worst_usd - self._free(participant), self._granted.get(participant, 0.0)
        asked = (participant, held, missing, max(missing, most_usd), self._caps)
        more, standing = await asyncio.to_thread(self._purse.grant, *asked)
        self._granted[participant] = held + more
        return None if self._free(participant) >= worst_usd - CENT else standing

    async def _wait(self) -> None:
        with suppress(TimeoutError):
            await asyncio.wait_for(self._changed.wait(), LOOK_S)

    def booked(self, participant: str, cost_usd: float) -> None:
        """See `Budget.booked`."""
        self._booked[participant] = self._booked.get(participant, 0.0) + cost_usd

    def _settled(self, participant: str) -> float:
        """What calls of this process have cost."""
        return self._spent[participant] - self._before.get(participant, 0.0)

    def _free(self, participant: str) -> float:
        """What is granted and neither spent nor in flight."""
        return self._granted.get(participant, 0.0) - self._settled(participant) - self._reserved[participant]

    def _give_back(self) -> None:
        """Give back what is free, and say what was spent that no row will tell of (a call that was given up)."""
        kept, lost = dict[str, float](), dict[str, float]()
        for participant in self._granted:
            free = max(0.0, self._free(participant))
            kept[participant] = self._granted[participant] - free
            lost[participant] = max(0.0, self._settled(participant) - self._booked.get(participant, 0.0))
        self._purse.give_back(kept, lost)
        self._granted = kept

    def close(self) -> None:
        """Give back what is free; what is left of the blocks is spent."""
        try:
            self._give_back()
        finally:
            self._purse.close()
