"""Money that is booked for calls which never left is given back with a reason, and a blocked study goes on."""

from __future__ import annotations

import asyncio
import datetime
from pathlib import Path

import pytest

from tests.build.calls import entry_of
from tests.build.errors import raises
from tests.build.ledger import write
from tests.conftest import ROOT, Checkout
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.money import Money, Releasable
from traps_pipeline.models.money.account_budget import AccountBudget
from traps_pipeline.models.money.budget import BudgetReached
from traps_pipeline.models.money.spending import open_budget, releasable, release_money
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


def row(key: str, outcome: str, cost_usd: float) -> dict[str, object]:
    return {"key": key, "outcome": outcome, "cost_usd": cost_usd, "components": {"participant": "m"}}


@pytest.fixture
def blocked(tmp_path: Path) -> Workspace:
    """A study with a budget of $5: $1 was answered, $3 failed, $1 was in flight when a process died."""
    workspace = Workspace.create(tmp_path / "study", Study(budget_usd=5))
    write(workspace.answers, row("a", "answer", 1.0), row("b", "error", 2.0), row("c", "error", 1.0))
    in_flight(workspace, "m")
    return workspace


def in_flight(workspace: Workspace, participant: str) -> None:
    """Let a process die while a call of $1 of a participant is in flight."""
    with workspace.ledger.writing():
        asyncio.run(Money(workspace.ledger).reserve(participant, 1.0, {}))


def room_for(workspace: Workspace, dollars: float) -> bool:
    """Whether a call of so many dollars fits into the study's budget."""
    with open_budget(workspace, [entry_of("m")]) as budget:
        try:
            reservation = asyncio.run(budget.reserve("m", dollars))
        except BudgetReached:
            return False
        asyncio.run(budget.settle(reservation, 0.0))
        return True


def test_what_was_in_flight_or_failed_is_released_with_its_reason_and_the_study_goes_on(blocked: Workspace) -> None:
    assert not room_for(blocked, 0.5)
    assert releasable(blocked) == {"m": Releasable(in_flight=1.0, failed=3.0)}
    assert release_money(blocked, "m", None, "the process was killed before it connected") == 1.0
    assert room_for(blocked, 0.9) and not room_for(blocked, 1.1)
    assert release_money(blocked, "m", 2.5, "a dead proxy") == 2.5
    assert releasable(blocked) == {"m": Releasable(in_flight=0.0, failed=0.5)}
    assert room_for(blocked, 3.4) and not room_for(blocked, 3.6)
    with blocked.ledger.writing():
        records = Money(blocked.ledger).releases()
    assert [(one["in_flight"], one["failed"], one["why"]) for one in records] == [
        (1.0, 0.0, "the process was killed before it connected"),
        (0.0, 2.5, "a dead proxy"),
    ]
    assert all(one["by"] and datetime.datetime.fromisoformat(str(one["at"])) for one in records)


@pytest.mark.parametrize("usd", [4.1, 0.0, -1.0, float("nan"), float("inf")])
def test_no_more_is_released_than_is_booked_for_calls_that_may_never_have_left(blocked: Workspace, usd: float) -> None:
    with raises(TrapsError, "ledger.money.Money.release", "m: $", "$1.0000", "$3.0000", "--usd"):
        release_money(blocked, "m", usd, "why")
    with raises(TrapsError, "ledger.money.Money.release", "nobody: $0.0000"):
        release_money(blocked, "nobody", None, "why")
    assert not room_for(blocked, 0.5)


def test_an_account_that_several_studies_share_gets_the_money_back_too(blocked: Workspace, tmp_path: Path) -> None:
    (tmp_path / "openai").mkdir()
    (tmp_path / "openai" / "budget.yaml").write_text("usd: 100\n")
    blocked = blocked.allow(account_budgets={"openai": str(tmp_path / "openai")})
    in_flight(blocked, "gpt-5-mini")
    assert release_money(blocked, "gpt-5-mini", None, "killed") == 1.0
    assert AccountBudget("openai", tmp_path / "openai", "x").spent_usd == {blocked.study.name: 0.0}


def test_the_command_lists_and_releases_and_wants_a_reason(blocked: Workspace) -> None:
    study, command = Checkout(ROOT, blocked.root), ("study", "release-money")
    assert study.traps(*command).ok().out.splitlines()[1].split() == ["m", "1.0000", "3.0000"]
    refused = study.traps(*command, "--participant", "m", "--all-in-flight")
    assert (refused.code, refused.raised) == (1, "cli.ledger_commands.release") and "--why" in refused.err
    assert "$1.0000" in study.traps(*command, "--participant", "m", "--all-in-flight", "--why", "killed").ok().out
    assert releasable(blocked) == {"m": Releasable(in_flight=0.0, failed=3.0)}
