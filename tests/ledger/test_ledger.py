"""A call is paid for once: what holds of the ledger in SQLite and in PostgreSQL."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from tests.build.errors import raises
from tests.build.ledger import answer, local, paid, write
from tests.conftest import ROOT
from tests.ledger.conftest import WRITE_ONE, Place, go_on, line_of
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.ledger import Ledger, LockGivenUp
from traps_pipeline.ledger.rows import EvaluationRows, Totals, digest_of, encode_row
from traps_pipeline.ledger.schema import EVALUATIONS, ROWS, STUDIES

HOLD = """
import asyncio, time
async def hold():
    async with ledger.writing("m", print):
        print("held", flush=True)
        time.sleep(600)
asyncio.run(hold())
"""
WRITE = """
import asyncio, itertools
async def write():
    async with ledger.writing("m", print) as writer:
        for n in itertools.count():
            await writer.write({"key": f"k{n}", "outcome": "answer", "text": "x" * 500})
            print(f"k{n}", flush=True)
asyncio.run(write())
"""
KEEP = """
import asyncio
async def keep():
    async with ledger.writing("m", print) as writer:
        await writer.write({"key": "before", "outcome": "answer", "text": "left"})
        await writer.sync()
        print("synced", flush=True)
        sys.stdin.readline()
        await writer.write({"key": "after", "outcome": "answer", "text": "left"})
        print("kept", flush=True)
        sys.stdin.readline()
asyncio.run(keep())
"""
FILL = """
import asyncio, resource, sys
from pathlib import Path
from tests.build.ledger import answer, local
from traps_pipeline.base.errors import TrapsError
async def fill():
    stored = 0
    try:
        async with local(Path(sys.argv[1])).writing("m", print) as writer:
            resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, 2_000_000))
            while True:
                await writer.write(answer(f"k{stored}", "x" * 500))
                stored += 1
    except TrapsError as error:
        print(stored, error, sep="\\n")
asyncio.run(fill())
"""


def damage(ledger: Ledger, key: str, content: bytes, digest: bytes | None = None) -> None:
    """Put something else in the place of the content of the row with a key, and of its digest."""
    values = {"content": content} | ({} if digest is None else {"digest": digest})
    mine = sa.select(EVALUATIONS.c.id).join(STUDIES).where(STUDIES.c.name == ledger.database.study_name)
    change = sa.update(ROWS).where(ROWS.c.key == key, ROWS.c.evaluation.in_(mine)).values(**values)
    assert ledger.database.run(lambda connection: connection.execute(change).rowcount) == 1


def test_a_row_is_kept_even_if_the_call_that_paid_for_it_is_cancelled(ledger: Ledger) -> None:
    async def scenario() -> None:
        async with ledger.writing("m", print) as writer:
            writing = asyncio.create_task(writer.write(paid("a", 0.5)))
            await asyncio.sleep(0)  # it is queued
            writing.cancel()
            with pytest.raises(asyncio.CancelledError):
                await writing

    asyncio.run(scenario())
    assert [*ledger.read("m").rows] == ["a"] and ledger.totals()["m"].dollars == 0.5


def test_rows_come_back_by_key_and_evaluation(place: Place) -> None:
    rows = [answer("a", "left – 左 \x00"), {"key": "b", "outcome": "empty", "text": None}]
    write(place.open(), *rows)
    ledger = place.open()
    assert ledger.read("m").rows == {"a": rows[0], "b": rows[1]}
    assert ledger.read("m").notes == {}
    assert ledger.read("another").rows == {}


def test_a_failure_never_takes_the_place_of_an_answer(ledger: Ledger) -> None:
    failure = {"key": "a", "outcome": "error", "error": "timeout", "text": None}
    write(ledger, failure)
    assert (list(ledger.read("m").rows), ledger.read("m").settled) == (["a"], {})
    write(ledger, failure | {"error": "http_500"})
    assert ledger.read("m").rows["a"]["error"] == "http_500"
    write(ledger, answer("a", "left"))
    write(ledger, failure)
    assert ledger.read("m").settled["a"]["text"] == "left"


def test_of_the_rows_only_those_that_are_wanted_are_read(ledger: Ledger) -> None:
    write(ledger, *(answer(f"k{n}", '"key": "k0"') for n in range(10)))
    assert [*ledger.read("m", {"k3", "k7", "none"}).rows] == ["k3", "k7"]
    assert [*ledger.read("m", {"k7": None, "k3": None}).rows] == ["k3", "k7"]
    assert ledger.read("m", set()).rows == {}


def test_what_stands_beside_rows_comes_back_by_key(ledger: Ledger) -> None:
    async def write_both() -> None:
        async with ledger.writing("m", print) as writer:
            await writer.write(answer("a", "left"), {"reasoning": "It rolls left.", "raw": "{\x00"})
            await writer.write(answer("b", "right"))

    asyncio.run(write_both())
    assert ledger.reasoning("m") == {"a": "It rolls left."}
    assert ledger.reasoning("m", {"b"}) == {}
    first, second = ledger.rows("m")
    assert first == (answer("a", "left"), {"reasoning": "It rolls left.", "raw": "{\x00"})
    assert second == (answer("b", "right"), {})


def test_totals_are_what_every_row_adds_up_to_repeated_answers_too(place: Place) -> None:
    ledger = place.open()
    trap = 'says "cost_usd": 9.5, and "participant": "evil"'
    for evaluation, cost in (("m__standard__run1", 0.25), ("m__standard__run1", 0.5), ("n__json__run1", 1e-05)):
        name = evaluation.split("__")[0]
        write(ledger, paid("k", cost, name) | {"text": trap}, paid("l", None, name), evaluation=evaluation)
    assert place.open().totals() == {"m": Totals(0.75, 0.0, 0.5), "n": Totals(1e-05, 0.0, 1e-05)}


def test_means_are_of_settled_rows_with_a_possible_value(ledger: Ledger) -> None:
    rows = [paid(f"k{n}", 0.0) | {"prompt_tokens": tokens} for n, tokens in enumerate((100, 300, None, -1))]
    failed = paid("f", 0.0) | {"outcome": "error", "prompt_tokens": 10_000}
    write(ledger, *rows[:2])
    write(ledger, *rows[2:], failed)
    assert ledger.totals()["m"].mean("prompt_tokens") == 200
    assert ledger.totals()["m"].mean("latency_s") is None


def test_a_row_that_is_not_what_was_written_is_told_and_asked_again(ledger: Ledger) -> None:
    write(ledger, answer("a", "left"), answer("b", "right"))
    assert list(ledger.damage()) == []
    damage(ledger, "a", encode_row(answer("a", "left")).replace(b"left", b"lift"))
    known = ledger.read("m")
    assert list(known.rows) == ["b"]
    (place,), (told,) = known.notes, ledger.damage()
    assert place in told and ledger.database.place in place
    write(ledger, answer("a", "right"))
    assert ledger.read("m").settled["a"]["text"] == "right"


def test_values_that_no_table_holds_are_unknown_and_told(ledger: Ledger) -> None:
    odd = {"prompt_tokens": 2**63, "completion_tokens": -1, "served_model": 5, "cost_usd": -1000.0}
    write(ledger, answer("a", "left"))
    content = encode_row(answer("a", "left") | odd)  # as no version writes it
    damage(ledger, "a", content, digest_of("a", content, None, None))
    known = ledger.read("m")
    assert known.rows["a"] == answer("a", "left") | dict.fromkeys(odd)
    (note,) = known.notes.values()
    assert [name for name in odd if name not in note] == []


def test_a_row_that_no_line_can_hold_is_refused_and_the_others_are_kept(ledger: Ledger) -> None:
    with raises(ValueError, "ledger.rows.encode_row"):
        write(ledger, answer("a", "left"), answer("b", "left") | {"cost_usd": float("nan")})
    assert list(ledger.read("m").rows) == ["a"]


def test_rows_from_elsewhere_are_stored_where_their_keys_are_not_settled(ledger: Ledger) -> None:
    write(ledger, answer("a", "left"), {"key": "b", "outcome": "error", "text": None})
    failed = {"key": "d", "outcome": "error", "text": None}
    rows = {
        "m": [(answer("a", "right"), {}), (answer("b", "right"), {"reasoning": "Because."}), (failed, {})],
        "n": [(answer("c", "right"), {})],
    }
    assert asyncio.run(ledger.store(rows, print)) == 2
    assert {key: row["text"] for key, row in ledger.read("m").settled.items()} == {"a": "left", "b": "right"}
    assert ledger.read("m").rows["d"] == failed
    assert (ledger.reasoning("m"), list(ledger.read("n").rows)) == ({"b": "Because."}, ["c"])
    assert asyncio.run(ledger.store(rows, print)) == 0


def test_an_import_whose_second_evaluation_is_taken_over_midway_stores_nothing(
    ledger: Ledger, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = sa.update(EVALUATIONS).where(EVALUATIONS.c.name == "n").values(writer="another process")
    read = Ledger.read

    def read_as_another_takes_over(self: Ledger, *wanted: Any) -> EvaluationRows:
        self.database.submit(lambda batch: batch.connection.execute(taken)).result()
        return read(self, *wanted)

    monkeypatch.setattr(Ledger, "read", read_as_another_takes_over)
    rows = {"m": [(answer("a", "left"), {})], "n": [(answer("b", "left"), {})]}
    with raises(TrapsError, "ledger.ledger.Writer.check"):
        asyncio.run(ledger.store(rows, print))
    monkeypatch.undo()
    assert ledger.evaluations() == []


@pytest.mark.slow
def test_what_was_kept_survives_the_kill_of_its_writer_and_another_one_goes_on(place: Place) -> None:
    with place.process(WRITE) as process:
        told = [line_of(process) for _ in range(200)]
        process.kill()
        assert process.stdout is not None
        told += process.stdout.read().split()
    ledger = place.open()
    kept = list(ledger.read("m").rows)
    assert kept[: len(told)] == told and len(kept) <= len(told) + 1
    assert ledger.read("m").notes == {}
    write(ledger, answer("later", "left"))
    assert len(ledger.read("m").rows) == len(kept) + 1


@pytest.mark.slow
def test_rows_kept_after_another_process_has_ended_survive_a_kill(tmp_path: Path) -> None:
    place = Place(("sqlite", str(tmp_path)))
    with place.process(KEEP) as keeping:
        assert line_of(keeping) == "synced"
        with place.process(WRITE_ONE, "another") as other:
            assert other.communicate("\n")[0] == "ready\n" and other.returncode == 0
        go_on(keeping)
        assert line_of(keeping) == "kept"
        assert [*place.open().read("m").rows] == ["before", "after"]
    assert [*place.open().read("m").rows] == ["before", "after"]


@pytest.mark.slow
def test_a_second_run_waits_and_says_who_writes_until_that_one_is_killed(place: Place) -> None:
    ledger, said = place.open(), list[str]()

    async def take() -> None:
        async with ledger.writing("m", said.append):
            pass

    async def scenario() -> None:
        async with ledger.writing("another", said.append):  # evaluations do not block each other
            pass
        with pytest.raises(LockGivenUp):
            async with ledger.writing("m", print, lambda: True):
                pass
        taking = asyncio.create_task(take())
        await asyncio.sleep(0.5)
        assert not taking.done()
        os.kill(holder.pid, signal.SIGKILL)
        await asyncio.wait_for(taking, 600)
        await take()  # nobody holds it: who would wait says so

    with place.process(HOLD) as holder:
        assert line_of(holder) == "held"
        asyncio.run(scenario())
    assert len(said) == 1 and str(holder.pid) in said[0]


def test_an_import_into_an_evaluation_that_is_being_asked_waits_for_it(ledger: Ledger) -> None:
    async def scenario() -> list[str]:
        said = list[str]()
        async with ledger.writing("m", print) as writer:
            await writer.write(answer("a", "left"))
            storing = asyncio.create_task(ledger.store({"m": [(answer("a", "right"), {})]}, said.append))
            await asyncio.sleep(0.5)
            assert not storing.done()
        assert await asyncio.wait_for(storing, 60) == 0
        return said

    (said,) = asyncio.run(scenario())
    assert str(os.getpid()) in said
    assert json.dumps(ledger.read("m").rows["a"]["text"]) == '"left"'


@pytest.mark.slow
@pytest.mark.promise
def test_no_bit_of_a_row_can_flip_unseen(tmp_path: Path) -> None:
    """Bits all over the file of a small ledger: the rows come back as they were, or something is said."""
    rows = [answer(f"k{n}", "left") for n in range(3)]
    ledger = local(tmp_path)
    write(ledger, *rows)
    whole, written, silent = ledger.read("m").rows, ledger.database.path.read_bytes(), list[int]()  # pyright: ignore
    begins = written.index(b'{"key": "k2"')
    for place in range(8 * begins, 8 * (begins + 3 * 100), 11):  # each bit in turn, of two bytes in three
        flipped = bytearray(written)
        flipped[place // 8] ^= 1 << place % 8
        (tmp_path / "ledger.sqlite").write_bytes(flipped)
        try:
            opened = local(tmp_path)
            known, faults = opened.read("m"), [*opened.damage()]
        except TrapsError:
            continue
        if any(whole.get(key) != row for key, row in known.rows.items()) or (len(known.rows) < 3 and not faults):
            silent.append(place)
    assert silent == []


@pytest.mark.slow
def test_a_row_that_cannot_be_written_is_told_and_the_others_are_kept(tmp_path: Path) -> None:
    command = [sys.executable, "-c", FILL, str(tmp_path)]
    ran = subprocess.run(command, capture_output=True, check=True, text=True, cwd=ROOT)
    stored = int(ran.stdout.splitlines()[0])
    assert stored > 50 and "ledger.sqlite" in ran.stdout.splitlines()[1]
    ledger = local(tmp_path)
    assert [*ledger.read("m").rows] == [f"k{n}" for n in range(stored)]
    write(ledger, answer("later", "left"))
    assert len(ledger.read("m").rows) == stored + 1


@pytest.mark.slow
def test_a_ledger_in_a_folder_that_cannot_be_written_is_read() -> None:
    folder = Path(tempfile.mkdtemp(dir="/tmp"))  # others may enter it, as they may not enter pytest's
    write(local(folder), answer("a", "left"))
    reading = """
import os, sys
from pathlib import Path
from tests.build.ledger import local
if os.geteuid() == 0:
    os.setuid(65534)
print(local(Path(sys.argv[1])).read("m").rows["a"]["text"])
"""
    folder.chmod(0o555)
    ran = subprocess.run([sys.executable, "-c", reading, folder], capture_output=True, text=True, cwd=ROOT)
    folder.chmod(0o755)
    shutil.rmtree(folder)
    assert ran.stdout == "left\n", ran.stderr


def test_where_nothing_was_written_nothing_is_made(tmp_path: Path) -> None:
    ledger = local(tmp_path / "none")
    assert (ledger.read("m").rows, ledger.totals(), ledger.evaluations(), [*ledger.damage()]) == ({}, {}, [], [])
    assert not (tmp_path / "none").exists()


def test_the_lock_of_a_run_whose_file_is_removed_lets_no_call_go(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with local(tmp_path).writing("m", print) as writer:
            (tmp_path / "locks" / "answers-m.lock").unlink()
            await writer.require()

    with raises(TrapsError, "base.files.require_in_place", "answers-m.lock"):
        asyncio.run(scenario())
