"""The cap of a study holds over all processes that spend from it, and what a dead one may have spent is counted."""

from __future__ import annotations

import asyncio
import secrets
import subprocess
import sys
import threading
import time
from collections.abc import Sequence

import pytest

from tests.conftest import ROOT
from tests.postgres import Postgres
from tests.storage.conftest import VARIABLE
from traps_pipeline.models.budget import BudgetReached
from traps_pipeline.models.shared_budget import SharedBudget
from traps_pipeline.storage.database import Session
from traps_pipeline.storage.purse import Purse
from traps_pipeline.storage.shared_ledger import SharedLedger

WORST = 0.05
# A process that, once it is told to begin, makes calls until there is no room: 24 at once, each costs what its number
# says, up to its worst case.
SPEND = """
import asyncio, sys
from traps_pipeline.models.budget import BudgetReached
from traps_pipeline.models.shared_budget import SharedBudget
from traps_pipeline.storage.database import Session
from traps_pipeline.storage.purse import Purse
from traps_pipeline.storage.shared_ledger import SharedLedger
address, study, name, cap, pause = sys.argv[1:]
session = Session(address, "X", study)
purse = Purse(session)
budget = SharedBudget(float(cap), {}, purse, purse.open())
async def run():
    numbers = iter(range(100_000))
    async with SharedLedger(session, "answers").writing(name, print) as writer:
        async def worker():
            while True:
                number = next(numbers)
                try:
                    await budget.reserve("m", 0.05)
                except BudgetReached as error:
                    return print(error, flush=True)
                print("calls", flush=True)
                await asyncio.sleep(float(pause))
                cost = number % 6 / 100
                await budget.settle("m", 0.05, cost)
                row = {"key": f"{name}-{number}", "outcome": "answer", "cost_usd": cost}
                writer.append(row | {"components": {"participant": "m"}})
                await writer.kept()
                budget.booked("m", cost)
        await asyncio.gather(*(worker() for _ in range(24)))
print("ready", flush=True)
sys.stdin.readline()
asyncio.run(run())
budget.close()
"""


def spender(server: Postgres, study: str, name: str, cap_usd: float, pause_s: float) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", SPEND, server.address(), study, name, str(cap_usd), str(pause_s)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=subprocess.STDOUT, text=True)


def begin(*processes: subprocess.Popen[str]) -> None:
    """Let spenders begin once all are ready: one that is late would find nothing left."""
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()


def opened(server: Postgres, study: str | None = None) -> Session:
    return Session(server.address(), VARIABLE, study or f"study-{secrets.token_hex(4)}")


def spent_usd(session: Session) -> float:
    """Dollars that the database counts as spent."""
    sql = "select coalesce(sum(usd), 0) from traps.spent where study = %s"
    return session.run(lambda connection: connection.execute(sql, [session.study_id]).fetchall())[0][0]


def budget_of(session: Session, cap_usd: float, caps: dict[str, float] | None = None) -> SharedBudget:
    purse = Purse(session)
    return SharedBudget(cap_usd, caps or {}, purse, purse.open())


def reserve(budget: SharedBudget, *calls: tuple[str, float]) -> None:
    async def all_of_them() -> None:
        for participant, worst_usd in calls:
            await asyncio.wait_for(budget.reserve(participant, worst_usd), 60)

    asyncio.run(all_of_them())


def test_two_processes_use_a_cap_up_to_the_last_worst_case_and_never_pass_it(postgres: Postgres) -> None:
    session = opened(postgres)
    running = [spender(postgres, session.study, name, 10.0, 0.002) for name in ("one", "two")]
    begin(*running)
    said = [process.communicate(timeout=300)[0] for process in running]
    assert [process.returncode for process in running] == [0, 0], said
    paid = SharedLedger(session, "answers").totals()["m"].dollars
    assert 10.0 - WORST < paid <= 10.0 + 1e-9
    assert spent_usd(session) == pytest.approx(paid)
    assert all("the budget of the study is reached: $" in each and "of $10.00 spent" in each for each in said)
    assert all("calls" in each for each in said)  # both took part


@pytest.mark.slow
def test_what_a_killed_process_may_have_spent_is_counted_and_the_cap_holds(postgres: Postgres) -> None:
    session = opened(postgres)
    others = connections(session)
    killed = spender(postgres, session.study, "one", 10.0, 30.0)
    begin(killed)
    assert killed.stdout is not None
    for _ in range(24):
        assert killed.stdout.readline() == "calls\n"
    killed.kill()
    killed.communicate()
    while connections(session) - others:  # a server that is busy sees later that nobody is there
        time.sleep(0.1)
    budget = _standing_after_death(session)
    assert spent_usd(session) >= 24 * WORST - 1e-9  # in flight
    assert spent_usd(session) <= 32 * WORST + 1e-9  # two blocks
    budget.close()
    last = spender(postgres, session.study, "two", 10.0, 0.0)
    begin(last)
    assert "the budget of the study is reached" in last.communicate(timeout=300)[0]
    assert 10.0 - WORST < spent_usd(session) <= 10.0 + 1e-9


def connections(session: Session) -> set[int]:
    """The processes of the server that have a client."""
    sql = "select pid from pg_stat_activity where backend_type = 'client backend'"
    return {pid for (pid,) in session.run(lambda connection: connection.execute(sql).fetchall())}


def _standing_after_death(session: Session) -> SharedBudget:
    """A budget that was opened when the server had been up for long enough to tell who is dead."""
    while not session.run(session.is_settled):
        time.sleep(0.5)
    return budget_of(session, 10.0)


def rows_of_blocks(session: Session) -> Sequence[tuple[float, float, float]]:
    sql = "select granted, booked, lost from traps.blocks where study = %s"
    return session.run(lambda connection: connection.execute(sql, [session.study_id]).fetchall())


def test_free_room_of_one_process_is_no_reason_to_stop_another(postgres: Postgres) -> None:
    one = opened(postgres)
    two = opened(postgres, one.study)
    first, second = budget_of(one, 1.0), budget_of(two, 1.0)
    reserve(first, ("m", 0.05))  # a block of 16 worst cases, 0.80
    assert rows_of_blocks(one) == [(pytest.approx(0.8), 0, 0)]

    async def both() -> None:
        for _ in range(4):
            await second.reserve("m", 0.05)  # what is left
        waiting = asyncio.create_task(second.reserve("m", 0.05))
        await asyncio.sleep(0.7)
        assert not waiting.done()
        for _ in range(15):
            await first.reserve("m", 0.05)
        for _ in range(16):
            await first.settle("m", 0.05, 0.0)
        first.close()
        await asyncio.wait_for(waiting, 60)

    asyncio.run(both())


def test_a_models_own_cap_stops_it_on_every_host_and_not_the_others(postgres: Postgres) -> None:
    one = opened(postgres)
    two = opened(postgres, one.study)
    first, second = budget_of(one, 10.0, {"m": 0.10}), budget_of(two, 10.0, {"m": 0.10})
    reserve(first, ("m", 0.06))
    asyncio.run(first.settle("m", 0.06, 0.06))
    first.close()
    with pytest.raises(BudgetReached, match=r"budget of m is reached: \$0\.06 of \$0\.10 spent"):
        reserve(second, ("m", 0.06))
    reserve(second, ("other", 0.06))


def test_a_call_that_was_given_up_is_spent_though_no_row_tells_of_it(postgres: Postgres) -> None:
    session = opened(postgres)
    budget = budget_of(session, 1.0)
    reserve(budget, ("m", 0.25), ("m", 0.25))
    asyncio.run(budget.settle("m", 0.25, None))  # the other one is in flight when the run ends
    budget.close()
    assert spent_usd(session) == pytest.approx(0.5)
    after = budget_of(session, 1.0)
    assert after.spent_usd == pytest.approx(0.5)
    after.close()
    assert spent_usd(session) == pytest.approx(0.5)


def test_a_cost_above_the_worst_case_is_spent_and_asked_for_no_more(postgres: Postgres) -> None:
    session = opened(postgres)
    budget = budget_of(session, 1.0)
    reserve(budget, ("m", 0.01))
    asyncio.run(budget.settle("m", 0.01, 0.95))
    with pytest.raises(BudgetReached, match=r"\$0\.95 of \$1\.00 spent, the next call may cost \$0\.1000"):
        reserve(budget, ("m", 0.10))
    budget.close()
    assert spent_usd(session) == pytest.approx(0.95)


def test_purses_of_one_process_wait_for_each_other(postgres: Postgres) -> None:
    session = opened(postgres)
    budget, purse = budget_of(session, 1.0), Purse(session)
    opening = threading.Thread(target=purse.open)
    opening.start()
    opening.join(0.5)
    assert opening.is_alive()
    budget.close()
    opening.join(60)
    assert not opening.is_alive()
    purse.close()
