"""What is altered, cut or lost in a ledger is named before a call is paid, or the cap holds nevertheless."""

from __future__ import annotations

import asyncio
import json
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import sqlalchemy as sa

from tests.build.errors import raises
from tests.build.ledger import answer, budget_in, local, paid, write
from tests.conftest import ROOT, Checkout
from tests.ledger.conftest import Place, line_of
from tests.ledger.test_money import SPEND
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.batch import Batch
from traps_pipeline.ledger.ledger import Ledger
from traps_pipeline.ledger.money import Money
from traps_pipeline.ledger.row_transfer import export_ledger
from traps_pipeline.ledger.rows import digest_of
from traps_pipeline.ledger.schema import EVALUATIONS, METADATA, ROWS
from traps_pipeline.ledger.sqlite import SqliteDatabase
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

CAP_USD, CALL_USD = 5.0, 0.25
SPENT_USD = 3.0  # of `asked`: 2 by m and 0.5 by n, 0.5 reserved by a dead process
ODD = (None, -1000.0, 0, 1e308, float("nan"), 2**62, "abc", b"\xff\xfe")


def ask(folder: Path) -> Ledger:
    """A ledger of two evaluations that spent `SPENT_USD`."""
    ledger = local(folder)
    write(ledger, paid("a", 0.5), paid("b", 1.5))
    write(ledger, paid("c", 0.5, "n"), evaluation="n")
    with budget_in(ledger, CAP_USD) as budget:
        asyncio.run(budget.reserve("m", 1.0))
    with ledger.database.writing():
        Money(ledger.database).release("m", 0.5, "never sent", "me", "2026-11-25")
    return ledger


def granted_usd(ledger: Ledger) -> float:
    """Reserve calls until the cap is reached; return their dollars."""

    async def reserve() -> float:
        usd, money = 0.0, Money(ledger.database)
        while usd <= CAP_USD and isinstance(await money.reserve("m", CALL_USD, {None: CAP_USD}), str):
            usd += CALL_USD
        return usd

    with ledger.database.writing():
        return asyncio.run(reserve())


def outcome(ledger: Ledger) -> str:
    """What comes of a ledger: `named` before a call is paid, `holds` if the cap does, or `passed`."""
    with suppress(TrapsError):
        ledger.totals()
    for evaluation in ("m", "n"):
        with suppress(TrapsError):
            ledger.read(evaluation)
    faults = [*ledger.damage()]
    try:
        usd = granted_usd(ledger)
    except TrapsError:
        return "named"
    return "holds" if SPENT_USD + usd <= CAP_USD + 1e-9 else f"passed by {faults}"


def altered(file: Path, *changes: tuple[str, tuple[Any, ...]]) -> bool:
    """Alter a file as another program does; return whether SQLite lets it."""
    connection = sqlite3.connect(file)
    try:
        for change, values in changes:
            connection.execute(change, values)
        connection.commit()
    except sqlite3.Error:
        return False
    finally:
        connection.close()
    return True


def alterations(whole: sqlite3.Connection) -> Iterator[tuple[str, str, Any]]:
    """Yield each column of each table with each odd value, another row's among them."""
    for table in METADATA.sorted_tables:
        for column in table.columns:
            others = whole.execute(f"select {column.name} from {table.name} order by 1 desc limit 1").fetchone() or ()
            for value in (*ODD, *others):
                yield table.name, column.name, value


@pytest.mark.slow
def test_each_odd_value_of_each_column_is_named_or_the_cap_holds(tmp_path: Path) -> None:
    ask(tmp_path / "whole")
    whole = tmp_path / "whole" / "ledger.sqlite"
    assert outcome(local(shutil.copytree(tmp_path / "whole", tmp_path / "as it is"))) == "holds"
    # Nulls are what a lost page leaves; SQLite itself would let none in.
    nullable = "update sqlite_master set sql = replace(sql, ' NOT NULL', '') where name <> 'traps_reservations'"
    assert altered(whole, ("pragma writable_schema = 1", ()), (nullable, ()))
    outcomes, folder = dict[str, str](), tmp_path / "copy"
    with sqlite3.connect(whole) as connection:
        changes = [*alterations(connection)]
    for table, column, value in changes:
        for rows in ("", f" where {column} = (select min({column}) from {table})"):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            for name in ("ledger.sqlite", "ledger.booked.json"):
                shutil.copy(whole.with_name(name), folder)
            if altered(folder / "ledger.sqlite", (f"update {table} set {column} = ?{rows}", (value,))):
                outcomes[f"{table}.{column} = {value!r}{rows}"] = outcome(local(folder))
    passed = {change: words for change, words in outcomes.items() if words not in ("named", "holds")}
    assert passed == {} and len(outcomes) > 400


CHANGES = {
    "a total lowered": "update traps_totals set dollars = 0 where participant = 'm'",
    "a total below zero": "update traps_totals set dollars = -1000 where participant = 'm'",
    "a total of words": "update traps_totals set dollars = 'abc' where participant = 'm'",
    "a total of another": "update traps_totals set participant = 'o' where participant = 'm'",
    "no totals": "delete from traps_totals",
    "no reservations": "delete from traps_reservations",
    "a reservation below zero": "insert into traps_reservations values (1, 'x', 'y', 'm', -1000)",
    "a row less": "delete from traps_rows where key = 'a'",
    "a row twice": "insert into traps_rows (evaluation, key, content, digest) select evaluation, key, content, digest "
    "from traps_rows where key = 'a'",
    "another name": "update traps_evaluations set name = 'o' where name = 'm'",
    "another study": "update traps_studies set name = 'o'",
    "a trigger": "create trigger t after insert on traps_rows begin delete from traps_totals; end",
    "a view": "alter table traps_totals rename to t; create view traps_totals as select * from t where 0",
    "a view that cannot be read": "alter table traps_studies rename to s; "
    "create view traps_studies as select 1 as id, load_extension('x') as name",
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_changed_ledger_is_named_before_a_call_is_paid_and_by_verify(tmp_path: Path, change: str) -> None:
    ledger = ask(tmp_path)
    with sqlite3.connect(tmp_path / "ledger.sqlite") as connection:
        connection.executescript(change)
    (fault, *_) = local(tmp_path).damage()
    assert ledger.database.place in fault
    with raises(TrapsError, "", ledger.database.place, "export-ledger"):
        granted_usd(local(tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        "update traps_totals set dollars = 0 where study = {study}",
        "update traps_totals set dollars = -1000 where study = {study}",
        "update traps_totals set dollars = 'NaN' where study = {study}",
        "delete from traps_rows where evaluation in (select id from traps_evaluations where study = {study})",
        "update traps_evaluations set name = 'o' where study = {study}",
    ],
)
def test_a_changed_ledger_of_several_hosts_is_named_before_a_call_is_paid(place: Place, change: str) -> None:
    ledger = place.open()
    write(ledger, paid("a", 0.5))
    words = change.format(study=ledger.database.study)
    ledger.database.run(lambda connection: connection.execute(sa.text(words)))
    ledger.database.end()
    assert [*place.open().damage()] != []
    with raises(TrapsError, "ledger.batch.Batch", "export-ledger"):
        granted_usd(place.open())


def test_a_row_in_another_evaluation_is_not_believed(ledger: Ledger) -> None:
    write(ledger, answer("a", "left"))
    write(ledger, answer("b", "left"), evaluation="n")
    numbers = sa.select(EVALUATIONS.c.id).where(EVALUATIONS.c.study == ledger.database.study)
    m, n = (numbers.where(EVALUATIONS.c.name == name).scalar_subquery() for name in "mn")
    move = sa.update(ROWS).where(ROWS.c.evaluation == m).values(evaluation=n)
    ledger.database.run(lambda connection: connection.execute(move))
    assert [*ledger.read("n").rows] == ["b"] and len(ledger.read("n").notes) == 1
    assert len([*ledger.damage()]) == 1


def as_before_04(folder: Path) -> Path:
    """Make of a ledger one of an earlier version: without seal, with digests that do not bind the evaluation."""
    file = folder / "ledger.sqlite"
    (folder / "ledger.booked.json").unlink()
    with sqlite3.connect(file) as connection:
        connection.execute("drop table traps_seals")
        for number, key, content in connection.execute("select id, key, content from traps_rows").fetchall():
            digest = digest_of(key, content, None, None)
            assert len(digest) == 16
            connection.execute("update traps_rows set digest = ? where id = ?", (digest, number))
    return file


@pytest.mark.parametrize("totals", ["kept", "set to 0", "emptied"])
def test_a_ledger_of_an_earlier_version_is_read_and_its_totals_are_those_of_its_rows(
    tmp_path: Path, totals: str
) -> None:
    ask(tmp_path)
    file = as_before_04(tmp_path)
    changes = {
        "kept": "select 1",
        "set to 0": "update traps_totals set dollars = 0",
        "emptied": "delete from traps_totals",
    }
    assert altered(file, (changes[totals], ())) and [*local(tmp_path).damage()] == []
    assert granted_usd(local(tmp_path)) == CAP_USD - SPENT_USD
    assert [*local(tmp_path).read("m").settled] == ["a", "b"]
    assert local(tmp_path).totals()["m"].dollars == 2.0


def rewound(folder: Path) -> None:
    """Put back the file as it was before a row of $1.5."""
    write(local(folder), paid("a", 0.5))
    earlier = (folder / "ledger.sqlite").read_bytes()
    write(local(folder), paid("b", 1.5))
    (folder / "ledger.sqlite").write_bytes(earlier)


def emptied(folder: Path) -> None:
    write(local(folder), paid("a", 0.5), paid("b", 1.5))
    (folder / "ledger.sqlite").write_bytes(b"")


@pytest.mark.parametrize("damage", [rewound, emptied])
def test_money_of_rows_that_vanished_counts_until_it_is_released(
    tmp_path: Path, damage: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> None:
    damage(tmp_path)
    for _ in range(2):  # and is counted once
        ledger = local(tmp_path)
        with ledger.database.writing():
            assert sum(Money(ledger.database).spent().values()) == 2.0
    assert f"{tmp_path}/ledger.sqlite" in capsys.readouterr().err
    with ledger.database.writing():
        Money(ledger.database).release("m", None, "the bill says so", "me", "2026-11-25")
    with local(tmp_path).database.writing():
        pass
    with ledger.database.writing():
        assert sum(Money(ledger.database).spent().values()) == (0.5 if damage is rewound else 0.0)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "note",
    ["", "{}", "[" * 100_000, "[1e999, {}]", '[1, {"m": 1e999}]', f'[1, {{"m": {10**400}}}]', '[1, {"\\ud800": 1}]'],
)
def test_a_damaged_note_of_money_is_not_believed(tmp_path: Path, note: str) -> None:
    write(local(tmp_path), paid("a", 0.5))
    (tmp_path / "ledger.booked.json").write_text(note)
    with (ledger := local(tmp_path)).database.writing():
        assert Money(ledger.database).spent() == {"m": 0.5}


@pytest.mark.slow
def test_money_of_a_killed_run_counts_where_its_log_is_lost(tmp_path: Path) -> None:
    place = Place(("sqlite", str(tmp_path)))
    with place.process(SPEND, "one", "10.0", "0.05") as process:
        assert line_of(process) == "ready"
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write("\n")
        process.stdin.flush()
        for _ in range(1000):
            assert "calls" in line_of(process)
            if (tmp_path / "ledger.booked.json").exists() and local(tmp_path).totals()["m"].dollars > 1.0:
                break
        process.kill()
        process.wait()
    noted_usd = local(tmp_path).totals()["m"].dollars
    for log in tmp_path.glob("ledger.sqlite-*"):
        log.unlink()
    with (ledger := place.open()).database.writing():
        spent_usd = sum(Money(ledger.database).spent().values())
    assert 0.3 * noted_usd < spent_usd


def test_a_refused_change_leaves_nothing_of_what_it_wrote_and_the_others_are_kept(ledger: Ledger) -> None:
    def refused(batch: Batch) -> None:
        batch.totals["answers", "m"].dollars += 1.0
        batch.connection.execute(sa.text("delete from traps_rows"))
        batch.flush()
        raise TrapsError("no")

    async def run() -> tuple[object, ...]:
        async with ledger.writing("m", print) as writer:
            await writer.write(paid("a", 0.5))
            changes = writer.write(paid("b", 0.5)), ledger.database.apply(refused), writer.write(paid("c", 0.5))
            return await asyncio.gather(*changes, return_exceptions=True)

    before, error, after = asyncio.run(run())
    assert (before, str(error), after) == (None, "no", None)
    assert [*ledger.read("m").rows] == ["a", "b", "c"] and ledger.totals()["m"].dollars == 1.5
    assert [*ledger.damage()] == []


def test_an_account_is_used_until_its_last_use_in_a_process_ends(place: Place) -> None:
    ledger, other = place.open(), place.open()
    with ledger.database.sharing(["a"]), other.database.sharing(["a"]) as count:
        with ledger.database.sharing(["a", "b"]):
            pass
        with other.database.sharing([]):
            assert count("a") == 2


@pytest.mark.parametrize("size", [2000, 400])
@pytest.mark.parametrize("into_a_page", [0, 1000, 3000])
def test_what_is_whole_of_a_cut_ledger_is_saved_and_the_rest_is_told(
    tmp_path: Path, size: int, into_a_page: int
) -> None:
    rows = [paid(f"k{number}", 0.25) | {"text": "x" * size} for number in range(200)]
    write(local(tmp_path), *rows)
    file, told = tmp_path / "ledger.sqlite", list[str]()
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 4096 * 3 // 4 * 4096 + into_a_page])
    count = export_ledger(local(tmp_path).database, tmp_path / "saved" / "whole.sqlite", told.append)
    saved = Ledger(SqliteDatabase(tmp_path / "saved", file="whole.sqlite"), "answers")
    assert 100 < count < 200 and len(saved.read("m").settled) == count
    assert all(saved.read("m").rows[key] == rows[int(key[1:])] for key in saved.read("m").rows)
    assert f"{200 - count} rows" in told[0] and all(str(file) in words for words in told)
    assert saved.totals()["m"].dollars == 50.0  # those that were lost were paid, too


def test_plan_and_status_tell_what_the_seal_finds_before_a_run_refuses_it(tmp_path: Path) -> None:
    workspace = Workspace.create(tmp_path / "study", Study(panel="rules"))
    write(workspace.answers, paid("a", 0.5))
    checkout = Checkout(ROOT, workspace.root)
    commands = (("status",), ("plan", "demo"))
    for command in commands:
        assert json.loads(checkout.traps(*command, "--json").ok().out)["ledger"] == []
    file = workspace.root / "ledger" / "ledger.sqlite"
    with sqlite3.connect(file) as connection:
        connection.executescript(CHANGES["a total lowered"].replace("'m'", "participant"))
    for command in commands:
        (fault,) = json.loads(checkout.traps(*command, "--json").ok().out)["ledger"]
        assert str(file.parent) in fault and fault in checkout.traps(*command).ok().out


def test_rows_that_tables_have_and_the_ledger_lacks_are_told(tmp_path: Path) -> None:
    workspace = Workspace.create(tmp_path / "study", Study())
    write(workspace.answers, paid("a", 0.5))
    table, folder = (
        pa.table({"request_key": ["a", "b", None], "cost_usd": [0.5, 0.25, None]}),
        workspace.root / "tables",
    )
    (folder / "responses").mkdir(parents=True)
    pq.write_table(table, folder / "responses" / "1.parquet")
    (line,) = (
        each
        for each in Checkout(ROOT, workspace.root).traps("doctor", "--verify").out.splitlines()
        if "ledger" in each and "$" in each
    )
    assert "responses/1.parquet" in line and "1 row" in line and "$0.25" in line
