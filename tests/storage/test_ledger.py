"""A call is paid for once: what holds of every ledger, in a folder of one machine or in a database of several."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import time

import pytest

from tests.build.ledger import answer, paid, write
from tests.storage.conftest import Place
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.storage.ledger import Ledger, LockGivenUp, Totals
from traps_pipeline.storage.lines import checked_line
from traps_pipeline.storage.segments import SegmentLedger
from traps_pipeline.storage.shared_ledger import SharedLedger

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
            writer.append({"key": f"k{n}", "outcome": "answer", "text": "x" * 500})
            await writer.kept()
            print(f"k{n}", flush=True)
asyncio.run(write())
"""


def damage(ledger: Ledger, key: str, change: bytes) -> None:
    """Put something else in the place of the line that begins with a key."""
    if isinstance(ledger, SegmentLedger):
        (segment,) = [path for path in ledger.folder("m").glob("*.jsonl") if f'"{key}"' in path.read_text()]
        lines = segment.read_bytes().splitlines(keepends=True)
        segment.write_bytes(b"".join(change if f'"{key}"'.encode() in line else line for line in lines))
    else:
        assert isinstance(ledger, SharedLedger)
        sql = """update traps.rows set line = %s where key = %s
                 and evaluation in (select id from traps.evaluations where study = %s) returning key"""
        values = [change, key, ledger.session.study_id]
        assert ledger.session.run(lambda connection: connection.execute(sql, values).fetchall()) == [(key,)]


def test_rows_come_back_by_key_and_evaluation(place: Place) -> None:
    rows = [answer("a", "left – 左 \x00"), {"key": "b", "outcome": "empty", "text": None}]
    write(place.open(), *rows)
    ledger = place.open()
    assert ledger.read("m").rows == {"a": rows[0], "b": rows[1]}
    assert ledger.read("m").notes == {}
    assert ledger.read("another").rows == {}


def test_a_row_is_kept_as_the_line_that_was_written(place: Place) -> None:
    ledger, row = place.open(), answer("a", "left – 左")
    write(ledger, row)
    if isinstance(ledger, SegmentLedger):
        (kept,) = [path.read_bytes() for path in ledger.folder("m").glob("*.jsonl")]
    else:
        assert isinstance(ledger, SharedLedger)
        kept = ledger.session.run(lambda c: c.execute("select line from traps.rows order by id").fetchall())[-1][0]
    assert kept == checked_line(row)


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
            writer.append(answer("a", "left"), {"reasoning": "It rolls left."})
            writer.append(answer("b", "right"))
            await writer.kept()

    asyncio.run(write_both())
    assert ledger.reasoning("m") == {"a": "It rolls left."}
    assert ledger.reasoning("m", {"b"}) == {}


def test_totals_are_what_every_row_adds_up_to_repeated_answers_too(place: Place) -> None:
    ledger = place.open()
    trap = 'says "cost_usd": 9.5, and "participant": "evil"'
    for evaluation, cost in (("m__standard__run1", 0.25), ("m__standard__run1", 0.5), ("n__json__run1", 1e-05)):
        name = evaluation.split("__")[0]
        write(ledger, paid("k", cost, name) | {"text": trap}, paid("l", None, name), evaluation=evaluation)
    assert place.open().totals() == {"m": Totals(0.75, 0.5), "n": Totals(1e-05, 1e-05)}


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
    damage(ledger, "a", checked_line(answer("a", "left")).replace(b"left", b"lift"))
    known = ledger.read("m")
    assert list(known.rows) == ["b"]
    (note,) = known.notes.values()
    assert "not what was written: it is not believed; its answer is asked again" in note
    assert len(list(ledger.damage())) == 1
    write(ledger, answer("a", "right"))
    assert ledger.read("m").settled["a"]["text"] == "right"


def test_values_that_no_table_holds_are_unknown_and_told(ledger: Ledger) -> None:
    odd = {"prompt_tokens": 2**63, "completion_tokens": -1, "served_model": 5, "cost_usd": -1000.0}
    write(ledger, answer("a", "left"))
    damage(ledger, "a", checked_line(answer("a", "left") | odd))  # as no version writes it
    known = ledger.read("m")
    assert known.rows["a"] == answer("a", "left") | dict.fromkeys(odd)
    (note,) = known.notes.values()
    assert "cost_usd" in note and "counted as unknown" in note


def test_a_row_that_no_line_can_hold_is_refused_and_the_others_are_kept(ledger: Ledger) -> None:
    with pytest.raises(ValueError, match="JSON compliant"):
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


def test_what_was_kept_survives_the_kill_of_its_writer_and_another_one_goes_on(place: Place) -> None:
    with place.process(WRITE) as process:
        assert process.stdout is not None
        told = [process.stdout.readline().strip() for _ in range(200)]
        process.kill()
        told += process.stdout.read().split()
    ledger = place.open()
    kept = list(ledger.read("m").rows)
    assert kept[: len(told)] == told and len(kept) <= len(told) + 1
    assert set(ledger.read("m").notes.values()) <= {"torn last line ignored (a crash cut it off)"}
    write(ledger, answer("later", "left"))
    assert len(ledger.read("m").rows) == len(kept) + 1


def test_a_second_run_waits_and_says_who_writes_until_that_one_is_killed(place: Place) -> None:
    ledger, said = place.open(), list[str]()

    async def take() -> float:
        began = time.monotonic()
        async with ledger.writing("m", said.append):
            return time.monotonic() - began

    async def scenario() -> tuple[float, float]:
        async with ledger.writing("another", said.append):  # evaluations do not block each other
            pass
        with pytest.raises(LockGivenUp):
            async with ledger.writing("m", print, lambda: True):
                pass
        taking = asyncio.create_task(take())
        await asyncio.sleep(0.5)
        assert not taking.done()
        os.kill(holder.pid, signal.SIGKILL)
        return await asyncio.wait_for(taking, 60), await take()

    with place.process(HOLD) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == "held\n"
        waited, again = asyncio.run(scenario())
    assert again < 0.4 <= waited
    assert len(said) == 1 and f"answers of m are being asked by process {holder.pid}" in said[0]


def test_two_writers_of_one_process_exclude_each_other(ledger: Ledger) -> None:
    async def scenario() -> None:
        async with ledger.writing("m", print):
            with pytest.raises(LockGivenUp):
                async with ledger.writing("m", print, lambda: True):
                    pass
        async with ledger.writing("m", print):
            pass

    asyncio.run(scenario())


def test_an_import_into_an_evaluation_that_is_being_asked_waits_for_it(ledger: Ledger) -> None:
    async def scenario() -> list[str]:
        said = list[str]()
        async with ledger.writing("m", print) as writer:
            writer.append(answer("a", "left"))
            await writer.kept()
            storing = asyncio.create_task(ledger.store({"m": [(answer("a", "right"), {})]}, said.append))
            await asyncio.sleep(0.5)
            assert not storing.done()
        assert await asyncio.wait_for(storing, 60) == 0
        return said

    (said,) = asyncio.run(scenario())
    assert "are being asked by process" in said
    assert json.dumps(ledger.read("m").rows["a"]["text"]) == '"left"'


def test_an_error_in_a_writers_block_is_what_is_raised(ledger: Ledger) -> None:
    async def scenario() -> None:
        async with ledger.writing("m", print) as writer:
            writer.append(answer("a", "left"))
            raise TrapsError("something else")

    with pytest.raises(TrapsError, match="something else"):
        asyncio.run(scenario())
    assert list(ledger.read("m").rows) == ["a"]
