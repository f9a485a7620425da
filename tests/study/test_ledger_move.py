"""A ledger moves into a database and back, and nothing of it is lost, repeated or spent twice."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from tests.models.test_budget import PRICED
from tests.postgres import Postgres
from tests.storage.conftest import VARIABLE
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cli import main
from traps_pipeline.models.budget import Journal, read_releases
from traps_pipeline.models.release import releasable, release
from traps_pipeline.models.spending import spending
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.study.ledger_move import move_back, move_to_database


@pytest.fixture
def study(tmp_path: Path, postgres: Postgres, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    """A study that has asked: two rows of one key, a failed call, a trace, a damaged row, and a call that a kill cut
    off. It has spent 0.25 + 0.5 + 0.125, 0.5 for the damaged row (the dearest), and 2 in flight."""
    monkeypatch.setenv(VARIABLE, postgres.address())
    workspace = Workspace.create(tmp_path / "study", Study(budget_usd=100))
    for rows in (
        [(row("a", 0.25, "old"), {}), (row("f", None) | {"outcome": "error"}, {})],
        [(row("a", 0.5, "new – 左"), {"reasoning": "It rolls."}), (row("b", 0.125), {}), (row("gone", 0.25), {})],
    ):
        with workspace.answers.writer("m__standard__run1") as writer:  # pyright: ignore
            for one in rows:
                writer.append(*one)
    with workspace.votes.writer("m__standard__run1") as writer:  # pyright: ignore
        writer.append(row("v", None), {"raw": "{"})
    (segment,) = [path for path in segments(workspace) if b'"gone"' in path.read_bytes()]
    segment.write_bytes(segment.read_bytes().replace(b'"gone"', b'"gona"'))
    journal = Journal(workspace.ledger_folder / "in_flight.jsonl")
    journal.add("m", 2.0)
    journal.close()
    return workspace


def row(key: str, cost: float | None, text: str = "left") -> dict[str, Any]:
    about = {"participant": "m", "item_id": key}
    return {"key": key, "outcome": "answer", "text": text, "cost_usd": cost, "latency_s": 0.1, "components": about}


def segments(workspace: Workspace) -> list[Path]:
    return sorted(path for kind in ("answers", "votes") for path in (workspace.ledger_folder / kind).glob("*/*.jsonl*"))


def spent_usd(workspace: Workspace) -> float:
    with spending(workspace, [PRICED]) as budget:
        return budget.spent_usd


def seen(workspace: Workspace) -> Any:
    """What a run reads of a study."""
    ledgers = workspace.answers, workspace.votes
    evaluation = "m__standard__run1"
    return [
        (ledger.read(evaluation).rows, ledger.reasoning(evaluation), list(ledger.rows(evaluation)))
        for ledger in ledgers
    ]


def test_a_ledger_comes_back_line_by_line_with_all_that_was_spent(study: Workspace) -> None:
    before, spent = seen(study), spent_usd(study)
    assert spent == pytest.approx(0.25 + 0.5 + 0.125 + 0.5 + 2.0)
    lines = sorted(line for path in segments(study) for line in path.read_bytes().splitlines() if b"gona" not in line)
    moved = move_to_database(study, VARIABLE)
    assert (moved.rows, moved.kept is not None, segments(study)) == (5, True, [])
    inside = Workspace.open(study.root)
    assert inside.study.database == VARIABLE
    assert seen(inside) == before
    assert spent_usd(inside) == pytest.approx(spent)
    assert inside.answers.totals()["m"].unknown == 1
    back = move_back(inside)
    outside = Workspace.open(study.root)
    assert (back.rows, outside.study.database, seen(outside)) == (5, None, before)
    assert spent_usd(outside) == pytest.approx(spent)
    assert sorted(line for path in segments(outside) for line in path.read_bytes().splitlines()) == lines
    assert inside.answers.evaluations() == [] and inside.answers.totals() == {}


def test_what_a_person_released_stays_released_wherever_the_ledger_lies(study: Workspace) -> None:
    spent = spent_usd(study)
    assert release(study, "m", 0.5, "a dead proxy") == 0.5
    move_to_database(study, VARIABLE)
    inside = Workspace.open(study.root)
    assert spent_usd(inside) == pytest.approx(spent - 0.5)
    before = releasable(inside)["m"].in_flight
    assert release(inside, "m", 1.0, "killed before it connected") == 1.0
    assert spent_usd(inside) == pytest.approx(spent - 1.5)
    assert releasable(inside)["m"].in_flight == pytest.approx(before - 1.0)
    with pytest.raises(TrapsError, match="cannot be released"):
        release(inside, "m", 100.0, "too much")
    move_back(inside)
    outside = Workspace.open(study.root)
    assert spent_usd(outside) == pytest.approx(spent - 1.5)
    records = read_releases(study.ledger_folder / "released.jsonl")
    assert [(one["usd"], one["why"]) for one in records] == [(0.5, "a dead proxy"), (1.0, "killed before it connected")]


def test_a_move_that_was_killed_is_done_again(study: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    before = seen(study)

    def killed(_: Workspace, **changes: Any) -> Workspace:
        raise KeyboardInterrupt

    for move in (move_to_database, lambda workspace, _: move_back(workspace)):
        workspace = Workspace.open(study.root)
        with monkeypatch.context() as patched:
            patched.setattr(Workspace, "allow", killed)
            with pytest.raises(KeyboardInterrupt):
                move(workspace, VARIABLE)
        assert Workspace.open(study.root).study.database == workspace.study.database
        assert seen(Workspace.open(study.root)) == before
        assert move(Workspace.open(study.root), VARIABLE).rows == 5
        assert seen(Workspace.open(study.root)) == before


def test_nothing_moves_while_somebody_asks(study: Workspace) -> None:
    async def while_asking(move: Any) -> None:
        async with Workspace.open(study.root).answers.writing("m__standard__run1", print):
            with pytest.raises(TrapsError, match=r"answers of m__standard__run1 are being asked .*nothing was moved"):
                await asyncio.to_thread(move)

    asyncio.run(while_asking(lambda: move_to_database(study, VARIABLE)))
    assert Workspace.open(study.root).study.database is None and segments(study)
    move_to_database(study, VARIABLE)
    asyncio.run(while_asking(lambda: move_back(Workspace.open(study.root))))
    assert Workspace.open(study.root).study.database == VARIABLE


def test_a_database_that_holds_the_ledger_of_a_study_of_that_name_is_refused(study: Workspace, tmp_path: Path) -> None:
    other = Workspace.create(tmp_path / "other", Study(name=study.study.name))
    with other.answers.writer("m__standard__run1") as writer:  # pyright: ignore
        writer.append(row("a", 0.5))
    move_to_database(other, VARIABLE)
    with pytest.raises(TrapsError, match=rf"holds a ledger of the study {study.study.name} already, which another"):
        move_to_database(study, VARIABLE)
    assert len(segments(study)) > 0


def test_the_command_says_where_the_ledger_lies(study: Workspace, capsys: pytest.CaptureFixture[str]) -> None:
    where = ["--workspace", str(study.root)]
    assert main(["ledger", "move", "--back", *where]) == 1
    assert "the ledger lies in" in capsys.readouterr().err
    assert main(["ledger", "move", "--to", VARIABLE, *where]) == 0
    said = capsys.readouterr()
    assert "5 rows moved; the ledger of study-" in said.out and "127.0.0.1" in said.out
    assert "not what was written, and not believed; it is not moved" in said.err
    assert main(["ledger", "move", "--to", VARIABLE, *where]) == 1
    assert "already" in capsys.readouterr().err
    assert main(["ledger", "move", "--back", *where]) == 0


def test_an_address_in_the_place_of_a_variable_is_refused_and_not_repeated(
    study: Workspace, capsys: pytest.CaptureFixture[str]
) -> None:
    address = "postgresql://traps:secret@127.0.0.1/postgres"
    assert main(["ledger", "move", "--to", address, "--workspace", str(study.root)]) == 1
    said = capsys.readouterr().err
    assert "give the name of a variable of the environment" in said and "secret" not in said
    assert "secret" not in (study.root / "study.yaml").read_text()


def test_a_study_whose_database_cannot_be_reached_says_so(study: Workspace, capsys: pytest.CaptureFixture[str]) -> None:
    study.allow(database="NOT_SET")
    assert main(["ledger", "move", "--back", "--workspace", str(study.root)]) == 1
    said = capsys.readouterr().err
    assert "traps: NOT_SET is not set on the host " in said and f": study.yaml of {study.study.name} says" in said
