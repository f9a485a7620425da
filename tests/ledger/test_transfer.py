"""A ledger is moved as it is: into a file and from there into another study, or another database."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.build.errors import raises
from tests.build.ledger import answer, budget_in, local, paid, write
from tests.conftest import ROOT, Checkout
from tests.ledger.conftest import Place
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.ledger import Ledger
from traps_pipeline.ledger.money import Money, Releasable
from traps_pipeline.ledger.row_transfer import copy_ledger, export_ledger, import_ledger
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


@pytest.fixture
def asked(tmp_path: Path) -> Ledger:
    """A ledger of answers and votes: $3 paid of which $1 failed and was released, and 50 cents in flight at a kill."""
    ledger = local(tmp_path / "asked")
    failed = {"key": "c", "outcome": "error", "cost_usd": 1.0, "components": {"participant": "m"}}
    write(ledger, paid("a", 1.0), paid("b", 1.0), failed)
    write(local(tmp_path / "asked", "votes"), answer("v", "yes"), evaluation="n")
    with budget_in(ledger, 5.0) as budget:
        asyncio.run(budget.reserve("m", 0.5))
    with ledger.database.writing():
        Money(ledger.database).release("m", None, "killed", "me", "2026-11-25")
    with budget_in(ledger, 5.0) as budget:
        asyncio.run(budget.reserve("m", 0.5))
    return ledger


def test_a_ledger_goes_through_a_file_with_all_that_was_paid(asked: Ledger, place: Place, tmp_path: Path) -> None:
    assert export_ledger(asked.database, tmp_path / "moved.sqlite", print) == 4
    other = place.open()
    assert import_ledger(tmp_path / "moved.sqlite", other.database, print) == 4
    assert [*other.rows("m")] == [*asked.rows("m")] and other.totals() == asked.totals()
    assert [*Ledger(other.database, "votes").rows("n")] == [(answer("v", "yes"), {})]
    with other.database.writing():
        money = Money(other.database)
        assert sum(money.spent().values()) == pytest.approx(3.5)
        assert money.releasable() == {"m": Releasable(0.5, 1.0)}
        assert [record["why"] for record in money.releases()] == ["killed"]
    write(other, answer("d", "left"))  # and is asked on
    assert [*other.read("m").settled] == ["a", "b", "d"]


def test_a_copy_that_was_killed_before_its_end_is_made_again(asked: Ledger, place: Place) -> None:
    def killed() -> None:
        raise KeyboardInterrupt

    other = place.open() if place.kind == "postgres" else local(Path(place.where[1]) / "other")
    with pytest.raises(KeyboardInterrupt):
        copy_ledger(asked.database, other.database, print, killed)
    assert copy_ledger(asked.database, other.database, print) == 4
    assert [*other.rows("m")] == [*asked.rows("m")] and other.totals() == asked.totals()
    with raises(TrapsError, "ledger.row_transfer._Copy.into", other.database.place):
        copy_ledger(asked.database, other.database, print)


def test_nothing_is_moved_into_a_study_that_has_answers_or_while_somebody_asks(asked: Ledger, tmp_path: Path) -> None:
    other = local(tmp_path / "other")
    write(other, answer("a", "right"))
    with raises(TrapsError, "ledger.row_transfer._Copy.into", other.database.place):
        copy_ledger(asked.database, other.database, print)
    assert [row["text"] for row in other.read("m").rows.values()] == ["right"]

    async def while_asking() -> None:
        async with asked.writing("m", print):
            with raises(TrapsError, "ledger.row_transfer.copy_ledger", asked.database.place, "answers", " m "):
                copy_ledger(asked.database, local(tmp_path / "third").database, print)

    asyncio.run(while_asking())
    assert local(tmp_path / "third").evaluations() == []


def test_the_commands_write_a_file_once_and_read_what_they_wrote(tmp_path: Path) -> None:
    one, two = (Workspace.create(tmp_path / name, Study()) for name in ("one", "two"))
    write(one.answers, answer("a", "left"))
    file, source, target = tmp_path / "answers.sqlite", Checkout(ROOT, one.root), Checkout(ROOT, two.root)
    assert f" {file}" in source.traps("study", "export-ledger", file).ok().out
    written, again = file.read_bytes(), source.traps("study", "export-ledger", file)
    assert (again.code, again.raised) == (1, "ledger.row_transfer.export_ledger")
    assert str(file) in again.err and file.read_bytes() == written
    target.traps("study", "import-ledger", file).ok()
    assert [*two.answers.read("m").rows] == ["a"]
    file.write_bytes(b"no ledger")
    refused = target.traps("study", "import-ledger", file)
    assert refused.code == 1 and str(file) in refused.err
