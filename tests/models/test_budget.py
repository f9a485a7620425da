"""The cap holds: worst cases are reserved, costs settled, and nothing is sent that could exceed it."""

from __future__ import annotations

import asyncio
import datetime
import random
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from tests.build.calls import entry_of
from tests.build.errors import raises
from tests.build.ledger import budget as budget_of
from tests.build.ledger import budget_in, local
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.money import Money, Releasable
from traps_pipeline.models.asking.ask import Call, Work, run_work
from traps_pipeline.models.asking.participants import Participants
from traps_pipeline.models.money.budget import Budget, BudgetReached, check_money, most_tokens, worst_case_usd
from traps_pipeline.models.money.spending import open_budget
from traps_pipeline.models.registry.entries import Account, Entry, Limits, Prices
from traps_pipeline.models.request import Outcome, Request, TransientError
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


def entry(prices: Prices | None) -> Entry:
    return entry_of("m").model_copy(update={"prices": prices})


PRICED = entry(Prices(input=2.0, output=10.0, as_of=datetime.date(2026, 11, 1)))


def test_the_worst_case_is_every_token_that_may_be_billed() -> None:
    request = Request("m", "api", {}, "s" * 100, "u" * 100, {})
    assert most_tokens(PRICED, request).prompt == 200 + 2 + 200  # a byte a token, no schema (""), the overhead
    assert worst_case_usd(PRICED, request) == pytest.approx((402 * 2 + 8000 * 10) / 1e6)
    assert worst_case_usd(entry(None), request) == 0


def test_two_hundred_connections_never_spend_a_cent_above_the_cap() -> None:
    spent = most = 0.0
    draw = random.Random(1)

    async def call(budget: Budget) -> None:
        nonlocal spent, most
        reservation = await budget.reserve("m", 0.05)
        await asyncio.sleep(draw.uniform(0, 0.002))
        cost = draw.uniform(0, 0.05)
        spent += cost
        most = max(most, spent)
        await budget.settle(reservation, cost)

    async def run() -> int:
        budget, reached = budget_of(10.0, {}, {"m": 1.0}), 0
        queue = list(range(2000))

        async def worker() -> None:
            nonlocal reached
            while queue:
                queue.pop()
                try:
                    await call(budget)
                except BudgetReached:
                    reached += 1
                    return

        await asyncio.gather(*(worker() for _ in range(200)))
        assert budget.spent_usd == pytest.approx(1.0 + spent)
        return reached

    assert asyncio.run(run()) == 200
    assert 9.0 - 0.05 <= most <= 9.0 + 1e-9  # used up to the last call's worst case, never above


def test_an_unknown_cost_counts_as_the_worst() -> None:
    async def run() -> float:
        budget = budget_of(1.0)
        await budget.settle(await budget.reserve("m", 0.4), None)
        return budget.spent_usd

    assert asyncio.run(run()) == pytest.approx(0.4)


def test_paid_calls_want_a_budget_and_unknown_prices_a_word() -> None:
    with raises(TrapsError, "models.money.budget.check_money", "--budget-usd", "budget_usd"):
        check_money(Study(), PRICED)
    check_money(Study(budget_usd=1), PRICED)
    with raises(TrapsError, "models.money.budget.check_money", "--allow-unknown-prices", "allow_unknown_prices"):
        check_money(Study(budget_usd=1), entry(None))
    check_money(Study(allow_unknown_prices=True), entry(None))
    check_money(Study(), entry(Prices(input=0, output=0, as_of=datetime.date(2026, 11, 1))))


class Failing:
    """A provider that fails in one way so many times, then answers."""

    def __init__(self, kind: str, times: int) -> None:
        self.kind, self.left = kind, times

    async def ask(self, request: Request) -> Outcome:
        await asyncio.sleep(0)
        self.left -= 1
        if self.left >= 0:
            raise TransientError(self.kind, billed=self.kind != "rate_limited")
        return Outcome("answer", "left", cost_usd=0.001)


def row_after(kind: str, times: int, cap_usd: float, folder: Path) -> dict[str, Any] | None:
    """The ledger's row of one call with two retries under a cap; None if there is none."""
    asked = PRICED.model_copy(update={"limits": Limits(concurrency=1, retries=2, backoff_s=0.001)})
    participants = Participants(
        {"m": asked}, lambda _: Failing(kind, times), Study(budget_usd=cap_usd), {"a": Account()}
    )
    ledger, cell = local(folder), Cell("occlusion", Evaluation("m", "standard", 1))
    calls = [Call(Request("m", "api", {}, "s", "u", {"item_id": "x"}))]
    with budget_in(ledger, cap_usd) as budget, suppress(BudgetReached):
        work = Work("responses", ledger, participants, budget, "1", lambda _: calls, lambda _: None)
        list(run_work(work, [cell]))
    with ledger.database.writing():
        assert Money(ledger.database).releasable().get("m", Releasable(0, 0)).in_flight == 0  # all of it is in rows
    return next(iter(ledger.read(cell.evaluation.key).rows.values()), None)


WORST = (1 + 1 + 2 + 200) * 2 / 1e6 + 8000 * 10 / 1e6


@pytest.mark.parametrize(
    ("kind", "times", "cap_usd", "outcome", "cost_usd"),
    [
        ("rate_limited", 2, 1.0, "answer", 0.001),  # nothing was generated
        ("timeout", 2, 1.0, "answer", 2 * WORST + 0.001),  # each may be billed
        ("timeout", 9, 1.0, "error", 3 * WORST),
        ("timeout", 9, 2.5 * WORST, "error", 2 * WORST),  # the third would have been above the cap
        ("timeout", 9, 0.5 * WORST, None, None),
    ],
)
def test_a_call_that_may_be_billed_counts_as_its_worst_case(
    tmp_path: Path, kind: str, times: int, cap_usd: float, outcome: str | None, cost_usd: float | None
) -> None:
    row = row_after(kind, times, cap_usd, tmp_path)
    assert (row and row["outcome"]) == outcome
    assert (row and row["cost_usd"]) == (None if cost_usd is None else pytest.approx(cost_usd))
    assert sum(its.dollars for its in local(tmp_path).totals().values()) <= cap_usd


def test_a_cap_for_nobody_is_refused(tmp_path: Path) -> None:
    workspace = Workspace.create(tmp_path, Study(budget_usd=5, model_budgets_usd={"gpt-5-mini": 1, "gpt-6": 1}))
    by, names = "models.money.spending._check_names", ("study.yaml", "model_budgets_usd", "gpt-6")
    with raises(TrapsError, by, *names) as caught, open_budget(workspace, [PRICED]):
        pass
    assert "gpt-5-mini" not in str(caught.value)


def test_a_price_wants_a_bound() -> None:
    boundless = {"params": {"temperature": 0.8, "top_p": 0.95}, "waivers": {"max_tokens": "a test"}}
    fields, context = PRICED.model_dump() | boundless, {"accounts": {"a": Account()}}
    with raises(ValidationError, "Entry", "params.max_tokens"):
        Entry.model_validate(fields, context=context)
    Entry.model_validate(fields | {"prices": None}, context=context)
