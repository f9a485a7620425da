"""The ledger that hosts share, when a process is stopped or cut off, and when the server goes away."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from tests.build.errors import raises
from tests.build.ledger import answer, paid, write
from tests.conftest import ROOT
from tests.ledger.conftest import VARIABLE, WRITE_ONE, begin, in_database, line_of, opened
from tests.postgres import Postgres
from traps_cluster.postgres import PostgresDatabase, open_ledger
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.ledger import Ledger

pytestmark = pytest.mark.slow
# Asks as a run does: looks whether it may, makes the call (a byte in a file, which the provider counts), keeps the row.
ASK = """
import asyncio, itertools, sys
from tests.build.errors import raised_in
from traps_pipeline.base.errors import TrapsError
async def ask():
    async with ledger.writing("m", print) as writer:
        for n in itertools.count():
            await writer.require()
            with open(sys.argv[1], "ab", buffering=0) as calls:
                calls.write(b"x")
            await writer.write({"key": f"k{n}", "outcome": "answer", "text": "of the first"})
            if n == 20:
                print("asking", flush=True)
            await asyncio.sleep(0.005)
try:
    asyncio.run(ask())
except TrapsError as error:
    print(raised_in(error), error, flush=True)
"""
# What tells a process that another one has begun to ask the same calls.
TAKEN_OVER = ("traps_cluster.postgres.PostgresDatabase._require", "ledger.ledger.Writer.check")


def test_a_writer_that_slept_while_another_took_over_pays_nothing_and_stores_nothing(
    postgres: Postgres, tmp_path: Path
) -> None:
    place, calls = in_database(postgres, idle_s=2), tmp_path / "calls"
    with place.process(ASK, str(calls)) as sleeper:
        assert line_of(sleeper) == "asking" and sleeper.stdout is not None
        os.kill(sleeper.pid, signal.SIGSTOP)
        try:
            ledger, began = place.open(), time.monotonic()
            asyncio.run(asyncio.wait_for(_take_over(ledger), 1200))
            assert time.monotonic() - began > 1.5  # the sleeper's connection must be ended first
            sent, stored = calls.stat().st_size, len(ledger.read("m").rows)
        finally:
            os.kill(sleeper.pid, signal.SIGCONT)
        said = sleeper.stdout.read()
    assert said.startswith(TAKEN_OVER), said
    assert calls.stat().st_size <= sent + 1  # one may have been on its way when the process was stopped
    assert len(ledger.read("m").rows) == stored


async def _take_over(ledger: Ledger) -> None:
    async with ledger.writing("m", print) as writer:
        await writer.write(answer("of the successor", "left"))


def _end_connection(of: Ledger, by: Ledger) -> None:
    """End a connection from the server's side."""
    sql = sa.text("select pg_terminate_backend(pid, 60000) from pg_stat_activity where application_name = :name")
    by.database.run(lambda connection: connection.execute(sql, {"name": getattr(of.database, "application", None)}))


def test_a_writer_whose_connection_broke_goes_on_where_nobody_took_over(postgres: Postgres) -> None:
    place = in_database(postgres)
    one, two = place.open(), place.open()

    async def scenario() -> None:
        async with one.writing("m", print) as writer:
            await writer.write(answer("a", "left"))
            _end_connection(one, two)
            await writer.require()
            await writer.write(answer("b", "left"))
            assert await asyncio.to_thread(two.database.try_lock, "answers-m") is None  # it was taken again

    asyncio.run(scenario())
    assert list(two.read("m").rows) == ["a", "b"]


def test_a_transaction_whose_end_is_not_heard_is_not_applied_twice(postgres: Postgres) -> None:
    ledger = in_database(postgres).open()
    real, broken = ledger.database.run, list[str]()

    def run(work: Any, patience_s: float | None = None) -> Any:
        """The transaction is committed, its end is lost, and it is done again."""
        if not broken and work.__name__ == "numbered":
            broken.append("once")
            real(work)
        return real(work)

    async def scenario() -> None:
        async with ledger.writing("m", print) as writer:
            ledger.database.run = run
            await writer.write(paid("a", 0.5))
            assert broken and ledger.totals()["m"].dollars == 0.5
            await writer.write(paid("b", 0.5))

    asyncio.run(scenario())
    assert ledger.totals()["m"].dollars == 1.0 and [*ledger.read("m").rows] == ["a", "b"]


def test_a_server_that_stops_and_starts_ends_no_run_and_loses_no_row(tmp_path: Path) -> None:
    with Postgres.running(durable=True) as server:
        place = in_database(server)
        with place.process(ASK, str(tmp_path / "calls")) as process:
            assert line_of(process) == "asking" and process.stdout is not None
            server.stop(signal.SIGQUIT)
            time.sleep(1)
            asked = (tmp_path / "calls").stat().st_size
            server.start()
            until = time.monotonic() + 5400
            while (tmp_path / "calls").stat().st_size < asked + 20 and process.poll() is None:
                assert time.monotonic() < until
                time.sleep(0.05)
            assert process.poll() is None, process.stdout.read()
            other = place.open()
            assert other.database.try_lock("answers-m") is None
            process.kill()
            process.wait()
            assert abs(len(other.read("m").rows) - (tmp_path / "calls").stat().st_size) <= 1


def test_while_the_server_is_away_no_call_is_sent_and_then_the_run_ends_with_the_remedy() -> None:
    with Postgres.running() as server:
        ledger = in_database(server).open()
        assert isinstance(ledger.database, PostgresDatabase)
        ledger.database.patience_s = 1.0

        async def scenario() -> None:
            async with ledger.writing("m", print) as writer:
                await writer.require()
                server.stop()
                await asyncio.sleep(2)  # what was seen before does not count for longer
                await writer.require()

        address = f"127.0.0.1:{server.port}/postgres"
        with raises(TrapsError, "traps_cluster.postgres.PostgresDatabase._patient", VARIABLE, address):
            asyncio.run(scenario())


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("postgresql://traps:wrong@127.0.0.1:{port}/postgres", "password authentication failed"),
        ("postgresql://traps:a-password-0123@127.0.0.1:{port}/nowhere", 'database "nowhere" does not exist'),
        ("postgresql://traps:a-password-0123@127.0.0.1:1/postgres", "Connection refused"),
        ("postgresql://[half", "postgresql://USER:PASSWORD@HOST"),
    ],
)
def test_an_address_that_leads_nowhere_names_variable_host_study_and_remedy(
    postgres: Postgres, address: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, address.format(port=postgres.port))
    by = "traps_cluster.postgres.PostgresDatabase"
    with raises(TrapsError, by, VARIABLE, said, "my-study", socket.gethostname()) as raised:
        open_ledger(VARIABLE, "my-study")
    told = str(raised.value)
    assert "wrong" not in told and "0123" not in told
    assert "127.0.0.1" in told or "postgresql://USER" in told


def test_a_variable_that_is_not_set_and_a_package_that_is_not_there_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    names = (VARIABLE, socket.gethostname(), "my-study", f"export {VARIABLE}=postgresql://")
    with raises(TrapsError, "traps_cluster.postgres.open_ledger", *names):
        open_ledger(VARIABLE, "my-study")
    code = f"""
import os, sys
sys.modules["psycopg"] = None
from traps_cluster.postgres import open_ledger
os.environ["{VARIABLE}"] = "postgresql://traps@127.0.0.1/postgres"
open_ledger("{VARIABLE}", "my-study")
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert "psycopg" in ran.stderr.splitlines()[-1] and "`make setup`" in ran.stderr.splitlines()[-1]


def test_processes_that_begin_at_once_in_an_empty_database_all_write() -> None:
    with Postgres.running() as server, ExitStack() as running:
        place = in_database(server)
        processes = [running.enter_context(place.process(WRITE_ONE, f"m{number}")) for number in range(4)]
        begin(*processes)
        said = [process.communicate()[0] for process in processes]
        assert [process.returncode for process in processes] == [0] * 4, said


def test_studies_of_one_database_do_not_see_each_other(postgres: Postgres) -> None:
    one, two = in_database(postgres).open(), in_database(postgres).open()
    write(one, paid("a", 0.5))
    assert (two.read("m").rows, two.totals(), list(two.damage())) == ({}, {}, [])
    write(two, answer("a", "right"))
    assert one.read("m").rows["a"]["text"] == "left"
    assert opened("postgres", postgres.address(), "other", "30").read("m").rows == {}
