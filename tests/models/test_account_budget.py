"""One cap of an account holds over several studies, however many of them spend at once and however they end."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.build.errors import raises
from tests.build.ledger import paid, write
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.money.account_budget import AccountBudget
from traps_pipeline.models.money.budget import Budget, BudgetReached
from traps_pipeline.models.money.spending import open_budget
from traps_pipeline.models.registry.entries import get_model
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

# Reserves ten cents a call and pays seven, until the account is empty; says how many calls it made.
SPENDER = """
import sys
from pathlib import Path
from traps_pipeline.models.money.account_budget import AccountBudget
budget, calls = AccountBudget("openai", Path(sys.argv[1]), sys.argv[2]), 0
while budget.reserve(0.10):
    calls += 1
    if sys.argv[3:] == ["hang"]:
        print("hanging", flush=True)
        sys.stdin.read()
    budget.correct(-0.03)
print(calls)
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    account = tmp_path / "account"
    account.mkdir()
    (account / "budget.yaml").write_text("usd: 10\n")
    return account


def spender(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", SPENDER, str(folder), *arguments]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_processes_that_spend_at_once_share_one_cap_to_the_cent(folder: Path) -> None:
    calls = [int(process.communicate()[0]) for process in [spender(folder, name) for name in "abc"]]
    # 7 cents a call until less than ten are left; calls in flight of the others may leave up to 20 cents more unused.
    assert 10 - 0.10 - 2 * 0.10 < 0.07 * sum(calls) <= 10
    spent = AccountBudget("openai", folder, "d").spent_usd
    assert spent == pytest.approx({name: 0.07 * n for name, n in zip("abc", calls, strict=True) if n})


def test_a_call_in_flight_at_a_kill_stays_spent(folder: Path) -> None:
    process = spender(folder, "killed", "hang")
    assert process.stdout is not None
    assert process.stdout.readline() == "hanging\n"
    process.send_signal(signal.SIGKILL)
    process.communicate()
    budget = AccountBudget("openai", folder, "next")
    assert budget.spent_usd == pytest.approx({"killed": 0.10})
    assert budget.reserve(9.90)
    assert not budget.reserve(0.01)


def test_a_damaged_file_stops_paid_calls_and_a_lost_one_is_filled_again(folder: Path) -> None:
    budget = AccountBudget("openai", folder, "a")
    assert budget.reserve(1.0)
    path = folder / "spent.json"
    path.write_bytes(path.read_bytes().replace(b"1.0", b"0.1"))
    for spend in (lambda: budget.reserve(0.1), lambda: AccountBudget("openai", folder, "b")):
        with raises(TrapsError, "models.money.account_budget.AccountBudget._read", str(path)):
            spend()
    path.unlink()
    budget.begin(known_usd=1.0)
    assert AccountBudget("openai", folder, "b").spent_usd == {"a": 1.0}


def study(root: Path, folder: Path) -> Workspace:
    return Workspace.create(root, Study(budget_usd=50, account_budgets={"openai": str(folder)}))


def test_a_second_study_stops_where_the_first_has_spent_the_accounts_money(tmp_path: Path, folder: Path) -> None:
    entry = get_model("gpt-5-mini")

    async def pay(budget: Budget, dollars: float) -> None:
        await budget.settle(await budget.reserve(entry.id, dollars), dollars - 1)

    with open_budget(study(tmp_path / "one", folder), [entry]) as one:
        asyncio.run(pay(one, 6))
        with open_budget(study(tmp_path / "two", folder), [entry]) as two:  # at the same time
            asyncio.run(pay(two, 5))
            names = "openai", " 2 ", "$9.00", "$10.00", str(folder / "budget.yaml")
            with raises(BudgetReached, "models.money.budget.Budget.reserve", *names):
                asyncio.run(pay(two, 2))
            asyncio.run(two.reserve("gemini-2.5-pro", 2))  # another account


def test_money_spent_before_a_study_named_the_account_counts(tmp_path: Path, folder: Path) -> None:
    workspace = study(tmp_path / "study", folder)
    write(workspace.answers, paid("k", 4.0, "gpt-5-mini"))
    for _ in range(2):  # once, not each time
        with open_budget(workspace, [get_model("gpt-5-mini")]):
            pass
    assert AccountBudget("openai", folder, "x").spent_usd == {workspace.study.name: 4.0}


def test_an_account_without_a_file_or_a_name_is_refused(tmp_path: Path) -> None:
    entry = get_model("gpt-5-mini")
    nobody = Workspace.create(tmp_path / "a", Study(budget_usd=5, account_budgets={"opnai": "x"}))
    names = "study.yaml", "account_budgets", "opnai"
    with raises(TrapsError, "models.money.spending._check_names", *names), open_budget(nobody, [entry]):
        pass
    missing = study(tmp_path / "b", tmp_path / "nowhere")
    names = str(tmp_path / "nowhere" / "budget.yaml"), "`usd: 100`", "study.yaml"
    with (
        raises(TrapsError, "models.money.account_budget.AccountBudget.__init__", *names),
        open_budget(missing, [entry]),
    ):
        pass
