"""A study's money in both databases: reserved before a call, settled with its row, shared by all processes."""

from __future__ import annotations

import asyncio
import time
from contextlib import ExitStack

import pytest

from tests.build.errors import raises
from tests.build.ledger import budget_in, paid, write
from tests.ledger.conftest import Place, begin, line_of
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.ledger import Ledger
from traps_pipeline.ledger.money import Money, Releasable
from traps_pipeline.models.money.budget import Budget, BudgetReached

WORST = 0.05
# Asks as a run does, 24 calls at a time that cost 0 to 5 cents of 5, until there is no room.
SPEND = """
import asyncio
from traps_pipeline.ledger.money import Money
from traps_pipeline.models.money.budget import Budget, BudgetReached
name, cap, pause = sys.argv[1:]
async def run():
    numbers = iter(range(100_000))
    budget = Budget(float(cap), {}, Money(ledger.database))
    async with ledger.writing(name, print) as writer:
        async def worker():
            while True:
                number = next(numbers)
                try:
                    reservation = await budget.reserve("m", 0.05)
                except BudgetReached as error:
                    return print(error, flush=True)
                print("calls", flush=True)
                await asyncio.sleep(float(pause))
                cost = number % 6 / 100
                await budget.settle(reservation, cost)
                row = {"key": f"{name}-{number}", "outcome": "answer", "cost_usd": cost}
                await writer.write(row | {"components": {"participant": "m"}}, {}, [reservation.id] if cost else [])
        await asyncio.gather(*(worker() for _ in range(24)))
with ledger.database.writing():
    print("ready", flush=True)
    sys.stdin.readline()
    asyncio.run(run())
"""


def spent_usd(ledger: Ledger) -> float:
    with ledger.database.writing():
        return sum(Money(ledger.database).spent().values())


def releasable(ledger: Ledger) -> dict[str, Releasable]:
    with ledger.database.writing():
        return Money(ledger.database).releasable()


@pytest.mark.slow
@pytest.mark.promise
def test_two_processes_use_a_cap_up_to_the_last_worst_case_and_never_pass_it(place: Place) -> None:
    with ExitStack() as running:
        processes = [running.enter_context(place.process(SPEND, name, "10.0", "0.002")) for name in ("one", "two")]
        begin(*processes)
        said = [process.communicate(timeout=3000)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], said
    ledger = place.open()
    dollars = ledger.totals()["m"].dollars
    assert 10.0 - WORST < dollars <= 10.0 + 1e-9
    assert spent_usd(ledger) == pytest.approx(dollars)
    assert releasable(ledger) == {}  # nothing is left of reservations
    assert all("$10.00" in each and "calls\n" in each for each in said)  # both took part and were told


def test_what_a_killed_process_may_have_spent_is_counted_until_it_is_released(place: Place) -> None:
    with place.process(SPEND, "one", "10.0", "3000") as process:
        begin(process)
        assert [line_of(process) for _ in range(24)] == ["calls"] * 24
        process.kill()
        process.wait()
    ledger, until = place.open(), time.monotonic() + 600
    while releasable(ledger) == {}:  # a server that is busy sees later that nobody is there
        assert time.monotonic() < until
        time.sleep(0.1)
    assert releasable(ledger) == {"m": Releasable(in_flight=pytest.approx(24 * WORST), failed=0.0)}
    assert spent_usd(ledger) == pytest.approx(24 * WORST)
    with ledger.database.writing():
        money = Money(ledger.database)
        assert money.release("m", 1.0, "killed before it connected", "me", "2026-11-25") == pytest.approx(1.0)
        assert sum(money.spent().values()) == pytest.approx(0.2)
        assert money.release("m", None, "the rest", "me", "2026-11-25") == pytest.approx(0.2)
        assert [record["why"] for record in money.releases()] == ["killed before it connected", "the rest"]
        with raises(TrapsError, "ledger.money.Money.release", "m: $1.0000"):
            money.release("m", 1.0, "once more", "me", "2026-11-25")


def test_room_that_a_call_in_flight_may_make_is_waited_for(ledger: Ledger) -> None:
    async def run() -> list[str]:
        events = list[str]()
        with budget_in(ledger, 0.08) as budget:
            first = await budget.reserve("m", 0.05)

            async def second() -> None:
                await budget.reserve("m", 0.05)
                events.append("second")

            waiting = asyncio.create_task(second())
            await asyncio.sleep(0.7)
            events.append("settled")
            async with ledger.writing("m", print) as writer:
                await budget.settle(first, 0.02)
                await writer.write(paid("k", 0.02), {}, [first.id if first else ""])
            await waiting
        return events

    assert asyncio.run(run()) == ["settled", "second"]


def test_a_models_own_cap_stops_it_and_not_the_others(ledger: Ledger) -> None:
    write(ledger, paid("k", 0.06))

    async def reserve() -> None:
        with ledger.database.writing():
            budget = Budget(10.0, {"m": 0.10}, Money(ledger.database))
            with raises(BudgetReached, "models.money.budget.Budget.reserve", " m ", "$0.06", "$0.10"):
                await budget.reserve("m", 0.06)
            assert await budget.reserve("other", 0.06) is not None

    asyncio.run(reserve())


def test_a_call_that_cost_nothing_leaves_nothing(ledger: Ledger) -> None:
    async def run() -> float:
        with budget_in(ledger, 1.0) as budget:
            await budget.settle(await budget.reserve("m", 0.4), 0.0)
            assert await budget.reserve("m", 0.0) is None
            return budget.spent_usd

    assert asyncio.run(run()) == 0.0


def test_a_cancelled_reservation_leaves_nothing(ledger: Ledger) -> None:
    async def run() -> float:
        with budget_in(ledger, 1.0) as budget:
            reserving = asyncio.create_task(budget.reserve("m", 0.4))
            await asyncio.sleep(0)
            reserving.cancel()
            with pytest.raises(asyncio.CancelledError):
                await reserving
            return budget.spent_usd

    assert asyncio.run(run()) == 0.0


def test_a_cost_above_the_worst_case_is_spent_and_asked_for_no_more(ledger: Ledger) -> None:
    async def run() -> float:
        with budget_in(ledger, 1.0) as budget:
            reservation = await budget.reserve("m", 0.4)
            assert reservation is not None
            await budget.settle(reservation, 2.0)
            async with ledger.writing("m", print) as writer:
                await writer.write(paid("k", 2.0), {}, [reservation.id])
            with raises(BudgetReached, "models.money.budget.Budget.reserve", "$2.00", "$1.00"):
                await budget.reserve("m", 0.1)
            return budget.spent_usd

    assert asyncio.run(run()) == 2.0


@pytest.mark.slow
def test_processes_that_ask_through_an_account_are_counted(place: Place) -> None:
    one, two = place.open().database, place.open().database
    with one.sharing(["openai", "other"]) as of_one:
        assert of_one("openai") == 1
        with two.sharing(["openai"]) as of_two:
            assert of_two("openai") == 2
            until = time.monotonic() + 600
            while of_one("openai") != 2:
                assert time.monotonic() < until
                time.sleep(0.1)
            assert of_one("other") == 1
        while of_one("openai") != 1:
            assert time.monotonic() < until
            time.sleep(0.1)
