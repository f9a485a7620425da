"""The cap holds: worst cases are reserved, costs settled, and nothing is sent that could exceed it."""

from __future__ import annotations

import asyncio
import datetime
import json
import random
import shutil
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.ask import Call, Work, run_work
from traps_pipeline.models.budget import (
    Budget,
    BudgetReached,
    Journal,
    check_money,
    most_tokens,
    worst_case_usd,
)
from traps_pipeline.models.participants import Participants
from traps_pipeline.models.registry import Account, Entry, Limits, Prices
from traps_pipeline.models.request import Outcome, Request, TransientError
from traps_pipeline.models.spending import spending
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.storage.segments import SegmentLedger
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


def entry(prices: Prices | None) -> Entry:
    fields = {
        "id": "m",
        "backend": "api",
        "account": "a",
        "provider_id": "openai/m",
        "params": {"temperature": 0.8, "top_p": 0.95, "max_tokens": 8000},
        "prices": prices,
    }
    return Entry.model_validate(fields, context={"accounts": {"a": Account()}})


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
        await budget.reserve("m", 0.05)
        await asyncio.sleep(draw.uniform(0, 0.002))
        cost = draw.uniform(0, 0.05)
        spent += cost
        most = max(most, spent)
        await budget.settle("m", 0.05, cost)

    async def run() -> int:
        budget, reached = Budget(10.0, {}, {"m": 1.0}), 0
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


def test_a_models_own_cap_stops_it_and_not_the_others() -> None:
    async def run() -> None:
        budget = Budget(10.0, {"m": 0.10}, {})
        await budget.reserve("m", 0.06)
        await budget.settle("m", 0.06, 0.06)
        with pytest.raises(BudgetReached, match=r"budget of m is reached: \$0\.06 of \$0\.10 spent"):
            await budget.reserve("m", 0.06)
        await budget.reserve("other", 0.06)

    asyncio.run(run())


def test_an_unknown_cost_counts_as_the_worst() -> None:
    async def run() -> float:
        budget = Budget(1.0, {}, {})
        await budget.reserve("m", 0.4)
        await budget.settle("m", 0.4, None)
        return budget.spent_usd

    assert asyncio.run(run()) == pytest.approx(0.4)


def test_costs_that_cannot_be_count_as_the_dearest_call_and_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rows as version 0.1.0 wrote them, of a provider that sent negative and huge numbers of tokens."""
    workspace = Workspace.create(tmp_path, Study(budget_usd=5))
    folder = workspace.answers.folder("m__standard__run1")
    folder.mkdir(parents=True)
    costs: list[Any] = [0.25, -1000.0, 36_893_508_147_419.0, "0.5", True, None]
    rows = [{"key": f"k{n}", "cost_usd": cost, "components": {"participant": "m"}} for n, cost in enumerate(costs)]
    rows.append({"key": "x", "text": None, "usage": {"cost_usd": -5}, "components": {"participant": "m"}})
    (folder / "20261101.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    with spending(workspace, [PRICED]) as budget:
        assert budget.spent_usd == pytest.approx(5 * 0.25)
    assert "4 rows of m are damaged or tell a cost that cannot be; each counts as $0.2500" in capsys.readouterr().err


def test_a_short_write_in_the_journal_ends_no_later_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    journal = Journal(tmp_path / "in_flight.jsonl")
    for dollars in (0.5, 0.25, -0.25):
        journal.add("m", dollars)
    journal.close()
    first, second, third = journal.path.read_bytes().splitlines(keepends=True)
    journal.path.write_bytes(first + second[:20] + third)  # as a half-written line before version 0.2 left it
    assert Journal(journal.path).lost_usd == {"m": 0.5, "unknown": 0.5}
    assert "in_flight.jsonl: line 2 not what was written; $0.5000 each are counted as spent" in capsys.readouterr().err
    journal.path.write_bytes(first + second[:20])
    assert Journal(journal.path).lost_usd == {"m": 0.5}  # a torn last line: its call was never sent
    journal.path.write_text('["m", 0.5]\n["m", -0.125]\n')
    assert Journal(journal.path).lost_usd == {"m": 0.375}  # as version 0.1.0 wrote it


def test_a_journal_that_takes_half_a_line_takes_none(tmp_path: Path) -> None:
    filling = """
import resource, sys
from pathlib import Path
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.budget import Journal
journal = Journal(Path(sys.argv[1]))
journal.add("m", 0.5)
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
try:
    journal.add("m", 0.25)
except TrapsError as error:
    print(error)
"""
    path = tmp_path / "in_flight.jsonl"
    ran = subprocess.run([sys.executable, "-c", filling, str(path)], capture_output=True, check=True, text=True)
    assert f"{path}: cannot be written (File too large); raise the limit of a file's size" in ran.stdout
    assert Journal(path).lost_usd == {"m": 0.5}


def test_paid_calls_want_a_budget_and_unknown_prices_a_word() -> None:
    with pytest.raises(TrapsError, match="m costs money and the study has no budget"):
        check_money(Study(), PRICED)
    check_money(Study(budget_usd=1), PRICED)
    with pytest.raises(TrapsError, match="the price of m is unknown"):
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
    ledger, cell = SegmentLedger(folder, "answers"), Cell("occlusion", Evaluation("m", "standard", 1))
    calls = [Call(Request("m", "api", {}, "s", "u", {"item_id": "x"}))]
    journal = Journal(folder / "in_flight.jsonl")
    budget = Budget(cap_usd, {}, {}, journal)
    work = Work("responses", ledger, participants, budget, "1", lambda _: calls, lambda _: None)
    with suppress(BudgetReached):
        list(run_work(work, [cell]))
    journal.close()
    assert Journal(journal.path).lost_usd == {}  # all of it stands in the ledger
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
    assert sum(its.dollars for its in SegmentLedger(tmp_path, "answers").totals().values()) <= cap_usd


def test_two_runs_never_spend_from_one_budget_at_once(tmp_path: Path) -> None:
    workspace = Workspace.create(tmp_path, Study(budget_usd=5))
    events: list[str] = []

    def second() -> None:
        with spending(workspace, [PRICED]):
            events.append("second")

    with spending(workspace, [PRICED]):
        thread = threading.Thread(target=second)
        thread.start()
        thread.join(0.5)
        with spending(workspace, [entry(None)]):  # who costs nothing need not wait
            events.append("free")
        events.append("first ends")
    thread.join(5)
    assert events == ["free", "first ends", "second"]


def test_a_lock_that_is_removed_under_a_run_ends_its_calls(tmp_path: Path) -> None:
    workspace = Workspace.create(tmp_path, Study(budget_usd=5))
    with spending(workspace, [PRICED]) as budget:
        asyncio.run(budget.reserve("m", 0.5))
        (workspace.locks / "budget.lock").unlink()
        with pytest.raises(TrapsError, match=r"budget\.lock: was removed while this run held it"):
            asyncio.run(budget.reserve("m", 0.5))
        (workspace.locks / "budget.lock").touch()  # of another run
        with pytest.raises(TrapsError, match=r"budget\.lock: was removed while this run held it"):
            asyncio.run(budget.reserve("m", 0.5))


def test_calls_in_flight_at_a_kill_are_spent_for_good(tmp_path: Path) -> None:
    workspace = Workspace.create(tmp_path / "study", Study(budget_usd=5))

    async def three_calls(budget: Budget) -> None:
        for _ in range(3):
            await budget.reserve("m", 0.5)
        await budget.settle("m", 0.5, 0.25)
        await budget.settle("m", 0.5, 0.125)
        budget.booked("m", 0.25)

    with spending(workspace, [PRICED]) as budget:
        asyncio.run(three_calls(budget))
        shutil.copytree(workspace.root, tmp_path / "killed")  # in flight: $0.50; answered and not in the ledger: $0.125
    for _ in range(2):
        with spending(Workspace.open(tmp_path / "killed"), [PRICED]) as after:
            assert after.spent_usd == pytest.approx(0.625)


def test_a_cap_for_nobody_is_refused(tmp_path: Path) -> None:
    workspace = Workspace.create(tmp_path, Study(budget_usd=5, model_budgets_usd={"gpt-5-mini": 1, "gpt-6": 1}))
    complaint = r"study\.yaml: model_budgets_usd names gpt-6, neither a model"
    with pytest.raises(TrapsError, match=complaint), spending(workspace, [PRICED]):
        pass


def test_a_price_wants_a_bound() -> None:
    with pytest.raises(ValidationError, match="without it no budget can bound"):
        fields = PRICED.model_dump() | {"params": {"temperature": 0.8, "top_p": 0.95}}
        Entry.model_validate(fields | {"waivers": {"max_tokens": "a test"}}, context={"accounts": {"a": Account()}})
