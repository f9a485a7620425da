"""Finished evaluations become segments in the object store, and the ledger says what it said before."""

from __future__ import annotations

import asyncio
import secrets
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psycopg
import pytest

from tests.build.ledger import answer, paid, write
from tests.conftest import ROOT
from tests.objectstore import S3
from tests.postgres import Postgres
from tests.remedies.remedied import remedied
from tests.storage.conftest import VARIABLE
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cluster.bucket import object_name
from traps_pipeline.cluster.database import Database
from traps_pipeline.cluster.objects import Bucket, ObjectStore
from traps_pipeline.storage import compaction
from traps_pipeline.storage.compaction import Segment, segments_of
from traps_pipeline.storage.database import FORMAT, Session
from traps_pipeline.storage.ledger import Writer
from traps_pipeline.storage.shared_ledger import SharedLedger, SharedWriter

FAILED = {"key": "f", "outcome": "error", "error": "timeout", "text": None}
Open = Callable[[str], SharedLedger]
FINISH = """
import asyncio, os, signal, sys
from pathlib import Path
from tests.storage.test_compaction import finish, opened
from traps_pipeline.storage import compaction
compaction._release = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
finish(opened(*sys.argv[1:4], Path(sys.argv[4])))
"""


def opened(database: str, address: str, study: str, scratch: Path) -> SharedLedger:
    """The ledger of a study in an object store, as a host with that scratch folder opens it."""
    session = Session(database, VARIABLE, study)
    store = ObjectStore(scratch, Bucket(address), Database(database, session), study, b"anchor")
    return SharedLedger(session, "answers", store)


@pytest.fixture
def study(s3: S3) -> str:
    return f"study-{secrets.token_hex(4)}"


@pytest.fixture
def host(postgres: Postgres, study: str, tmp_path: Path) -> Open:
    """Opens the ledger of one study as the host of that name does."""
    return lambda name: opened(postgres.address(), f"s3://lab/{study}", study, tmp_path / name)


def writing(ledger: SharedLedger, work: Callable[[Writer], object]) -> None:
    async def as_writer() -> None:
        async with ledger.writing("m", print) as writer:
            await asyncio.to_thread(work, writer)

    asyncio.run(as_writer())


def finish(ledger: SharedLedger) -> None:
    writing(ledger, lambda writer: writer.finish())


def in_database(ledger: SharedLedger) -> int:
    sql = "select count(*) from traps.rows r join traps.evaluations e on e.id = r.evaluation where e.study = %s"
    return ledger.session.run(lambda c: c.execute(sql, [ledger.session.study_id]).fetchall())[0][0]


def segments(ledger: SharedLedger) -> list[Segment]:
    return ledger.session.run(lambda c: segments_of(c, [ledger.session.study_id, "answers", "m"]))


def seen(ledger: SharedLedger) -> list[Any]:
    """What anybody reads of the evaluation."""
    known, some = ledger.read("m"), ledger.read("m", ["b", "f", "none"])
    return [
        known.rows, known.notes, list(known.rows), known.settled, some.rows, ledger.reasoning("m"),
        ledger.reasoning("m", ["b"]), list(ledger.rows("m")), ledger.totals(), ledger.evaluations(),
        list(ledger.damage()),
    ]  # fmt: skip


def fill(ledger: SharedLedger) -> None:
    def rows(writer: Writer) -> None:
        writer.append(FAILED)
        writer.append(paid("a", 0.25) | {"text": "left – 左 \x00"}, {"reasoning": "It rolls left.", "raw": "{"})
        writer.append(paid("b", 0.5))
        writer.append(FAILED | {"error": "http_500"})
        writer.append(paid("c", None), {"raw": "["})

    writing(ledger, rows)


def test_a_finished_evaluation_reads_as_before_on_every_host_and_leaves_no_row_in_the_database(host: Open) -> None:
    one = host("one")
    fill(one)
    before = seen(one)
    finish(one)
    assert in_database(one) == 0
    assert [segment.rows for segment in segments(one)] == [5]
    assert seen(one) == before == seen(host("other"))
    finish(one)  # nothing is left to become one
    assert len(segments(one)) == 1


def test_what_is_asked_later_and_what_lies_in_segments_are_one_ledger(host: Open) -> None:
    one = host("one")
    fill(one)
    finish(one)
    write(one, answer("f", "left"), answer("d", "right"))
    assert {key: row["text"] for key, row in one.read("m").settled.items()}.keys() == {"a", "b", "c", "d", "f"}
    assert [row["key"] for row, _ in one.rows("m")] == ["f", "a", "b", "f", "c", "f", "d"]
    known = [(answer(key, "again"), {}) for key in "abcdf"]
    assert asyncio.run(one.store({"m": known}, print)) == 0  # none is taken a second time
    before = seen(one)
    finish(one)
    assert seen(one) == before == seen(host("other")) and in_database(one) == 0
    assert [segment.rows for segment in segments(one)] == [5, 2]


def test_a_large_evaluation_becomes_several_segments_and_rows_that_move_while_they_are_read_come_once(
    host: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compaction, "SEGMENT", 3)
    monkeypatch.setattr(compaction, "FETCHED", 1)
    monkeypatch.setattr("traps_pipeline.storage.shared_ledger.FETCHED", 2)
    one, other = host("one"), host("other")
    write(one, *(answer(f"k{n}", "left") for n in range(8)))
    for wanted in (None, [f"k{n}" for n in range(8)]):
        reading = other._pages(["line"], "m", wanted)
        keys = [next(reading)[0]]
        finish(one)
        assert [*keys, *(key for key, _ in reading)] == [f"k{n}" for n in range(8)]
    assert [segment.rows for segment in segments(one)] == [3, 3, 2]
    assert list(other.read("m", ["k7", "k1"]).rows) == ["k1", "k7"]


def test_a_kill_between_the_upload_and_the_transaction_loses_nothing(
    host: Open, postgres: Postgres, study: str, s3: S3, tmp_path: Path
) -> None:
    one = host("one")
    fill(one)
    before = seen(one)
    command = [sys.executable, "-c", FINISH, postgres.address(), f"s3://lab/{study}", study, str(tmp_path / "killed")]
    killed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert killed.returncode == -9, killed.stderr
    assert seen(one) == before and segments(one) == [] and in_database(one) == 5
    unreferenced = [name for name in s3.names() if name.startswith(study)]
    assert len(unreferenced) == 1
    finish(one)
    assert seen(one) == before and in_database(one) == 0
    (segment,) = segments(one)
    assert f"{study}/{object_name(segment.digest)}" in unreferenced  # the same rows are the same object


def test_who_is_the_writer_no_more_moves_nothing(host: Open) -> None:
    one, two = host("one"), host("two")
    fill(one)

    def taken_over(writer: Writer) -> None:
        assert isinstance(writer, SharedWriter)
        sql = "update traps.evaluations set number = number + 1 where id = %s"
        two.session.run(lambda c: c.execute(sql, [writer.claim.evaluation]))
        writer.finish()
        assert writer.claim.lost

    writing(one, taken_over)
    assert (segments(one), in_database(one)) == ([], 5)


@pytest.mark.parametrize("damage", [lambda old: None, lambda old: old[:-1] + b"?", lambda old: old[:-1]])
def test_a_segment_that_is_gone_or_altered_is_named_and_not_believed_until_it_is_put_back(
    host: Open, damage: Callable[[bytes], bytes | None]
) -> None:
    one, other = host("one"), host("other")
    fill(one)
    before = seen(one)
    finish(one)
    (segment,) = segments(one)
    bucket, name = Bucket(f"s3://lab/{one.session.study}"), object_name(segment.digest)
    whole = bucket.get(name)
    assert whole is not None
    if (damaged := damage(whole)) is None:
        bucket.delete(segment.digest)
    else:
        bucket.put(name, damaged)
    (said,) = other.damage()
    assert f"{name}: holds 5 answers of m, which were paid for, and is " in said
    with pytest.raises(TrapsError, match="none of them is asked meanwhile"):
        other.read("m", ["a"])
    rows = remedied(
        lambda: seen(other) if not list(other.damage()) else other.read("m"),
        "storage.compaction.Segments.rows",
        lambda: bucket.put(name, whole),
    )
    assert rows == before


def test_segments_are_read_at_the_address_of_the_study(host: Open) -> None:
    one = host("one")
    fill(one)
    before = one.read("m").rows
    finish(one)
    rows = remedied(
        lambda: SharedLedger(one.session, "answers").read("m").rows,
        "storage.compaction.Segments.rows",
        again=lambda: host("other").read("m").rows,
    )
    assert rows == before


def test_tables_of_format_1_are_given_segments(postgres: Postgres) -> None:
    with psycopg.connect(postgres.address(), autocommit=True) as connection:
        connection.execute("create database earlier")
    address = postgres.address(database="earlier")
    first = Session(address, VARIABLE, "lab")
    first.run(lambda c: c.execute("drop table traps.segments"))
    first.run(lambda c: c.execute("update traps.format set version = 1"))
    write(SharedLedger(first, "answers"), answer("a", "left"))
    first.close()
    later = Session(address, VARIABLE, "lab")
    assert list(SharedLedger(later, "answers").read("m").rows) == ["a"]
    assert later.run(lambda c: c.execute("select version from traps.format").fetchall()) == [(FORMAT,)]
