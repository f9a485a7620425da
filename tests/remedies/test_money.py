"""What errors about money and limits say to do lets the same call be made."""

from __future__ import annotations

import asyncio
import datetime
import resource
from collections.abc import Callable
from pathlib import Path

from tests.build.ledger import budget as budget_of
from tests.remedies.remedied import refused, remedied
from traps_pipeline.models.account_budget import AccountBudget
from traps_pipeline.models.budget import Budget, BudgetReached, check_money
from traps_pipeline.models.participants import allow_connections
from traps_pipeline.models.registry import Entry, Prices, get_model
from traps_pipeline.models.request import Outcome
from traps_pipeline.models.spending import spending
from traps_pipeline.models.traffic import Breaker, Stopped
from traps_pipeline.storage.place import Place
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


def priced(prices: Prices | None) -> Entry:
    return get_model("gpt-5-mini").model_copy(update={"prices": prices})


PRICES = Prices(input=2, output=10, as_of=datetime.date(2026, 11, 1))


def test_a_paid_model_is_asked_once_there_is_a_budget_or_a_price() -> None:
    remedied(
        lambda: check_money(Study(), priced(PRICES)),
        "models.budget.check_money",
        again=lambda: check_money(Study(budget_usd=1), priced(PRICES)),
    )
    for study, entry in ((Study(budget_usd=1), priced(PRICES)), (Study(allow_unknown_prices=True), priced(None))):
        remedied(
            lambda: check_money(Study(budget_usd=1), priced(None)),
            "models.budget.check_money",
            again=lambda study=study, entry=entry: check_money(study, entry),
        )


def spend(budget: Budget, dollars: float) -> None:
    asyncio.run(budget.reserve("m", dollars))


def test_a_budget_that_is_raised_leaves_room_for_the_call() -> None:
    remedied(
        lambda: spend(budget_of(1.0), 2.0),
        "models.budget.Budget.reserve",
        again=lambda: spend(budget_of(3.0), 2.0),
        error=BudgetReached,
    )


def paid(root: Place) -> Callable[[], None]:
    """A call of 2 dollars of a model of the account openai, in the study at `root` as its study.yaml now is."""

    def call() -> None:
        entry = get_model("gpt-5-mini")
        with spending(Workspace.open(root), [entry]) as budget:
            asyncio.run(budget.reserve(entry.id, 2.0))

    return call


def test_an_account_has_room_once_its_budget_is_raised_its_file_written_or_its_name_corrected(tmp_path: Path) -> None:
    folder = tmp_path / "openai"
    study = {"budget_usd": 50, "account_budgets": {"opnai": str(folder)}, "model_budgets_usd": {"gpt-5-mni": 5}}
    workspace = Workspace.create(tmp_path / "study", Study.model_validate(study))
    call, file = paid(workspace.root), workspace.root / "study.yaml"

    def corrected(old: str, new: str) -> Callable[[], int]:
        return lambda: file.write_text(file.read_text().replace(old, new))

    refused(call, "models.spending._check_names")
    corrected("opnai", "openai")()
    refused(call, "models.spending._check_names")
    corrected("gpt-5-mni", "gpt-5-mini")()
    refused(call, "models.account_budget.AccountBudget.__init__")
    folder.mkdir()
    (folder / "budget.yaml").write_text("usd: 1")
    remedied(
        call,
        "models.budget.Budget._fits_account",
        lambda: (folder / "budget.yaml").write_text("usd: 100"),
        error=BudgetReached,
    )


def test_an_account_without_its_file_is_left_out_as_told(tmp_path: Path) -> None:
    folder = tmp_path / "nowhere"
    workspace = Workspace.create(tmp_path / "study", Study(budget_usd=50, account_budgets={"openai": str(folder)}))
    remedied(
        paid(workspace.root),
        "models.account_budget.AccountBudget.__init__",
        lambda: workspace.allow(account_budgets={}),
    )


def test_a_file_of_spending_that_is_removed_is_filled_again(tmp_path: Path) -> None:
    (tmp_path / "budget.yaml").write_text("usd: 10")
    running = AccountBudget("openai", tmp_path, "a")
    assert running.reserve(1.0)
    path = tmp_path / "spent.jsonl"
    path.write_bytes(path.read_bytes().replace(b"1.0", b"0.1"))
    remedied(
        lambda: AccountBudget("openai", tmp_path, "b"),
        "models.account_budget.AccountBudget._catch_up",
        path.unlink,
    )
    running.begin(known_usd=1.0)
    assert AccountBudget("openai", tmp_path, "b").spent_usd == {"a": 1.0}


def test_an_account_whose_file_cannot_be_read_is_read_once_that_is_mended(tmp_path: Path) -> None:
    (tmp_path / "budget.yaml").write_text("usd: 10")
    path = tmp_path / "spent.jsonl"
    path.mkdir()
    remedied(
        lambda: AccountBudget("openai", tmp_path, "b"),
        "models.account_budget.AccountBudget._held",
        path.rmdir,
    )


def test_connections_that_a_shell_does_not_allow_are_lowered() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        remedied(
            lambda: allow_connections(hard),
            "models.participants.allow_connections",
            again=lambda: allow_connections(24),
        )
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_stopped_model_is_asked_by_the_same_command_once_the_cause_is_mended() -> None:
    def run(kind: str) -> None:
        breaker = Breaker("m")
        for _ in range(100):
            breaker.watch(
                Outcome(kind, None if kind == "error" else "left", error="timeout" if kind == "error" else None)
            )

    remedied(
        lambda: run("error"),
        "models.traffic.Breaker._stop",
        again=lambda: run("answer"),
        error=Stopped,
    )
