"""Several hosts, one ledger: a writer that was silent may not go on, and a server that stops costs nothing."""

from __future__ import annotations

import asyncio
import os
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.build.ledger import answer, write
from tests.conftest import ROOT
from tests.postgres import Postgres
from tests.storage.conftest import VARIABLE, Place, in_database, opened
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.storage.database import Claim, Session, session_of
from traps_pipeline.storage.shared_ledger import SharedLedger
from traps_pipeline.storage.stream import Stream, encoded

# Asks as a run does: looks whether it may, makes the call (a byte in a file, which the provider counts), keeps the row.
ASK = """
import asyncio, itertools, sys
from traps_pipeline.base.errors import TrapsError
async def ask():
    async with ledger.writing("m", print) as writer:
        for n in itertools.count():
            await writer.require()
            with open(sys.argv[1], "ab", buffering=0) as calls:
                calls.write(b"x")
            writer.append({"key": f"k{n}", "outcome": "answer", "text": "of the first"})
            await writer.kept()
            if n == 20:
                print("asking", flush=True)
            await asyncio.sleep(0.005)
try:
    asyncio.run(ask())
except TrapsError as error:
    print(error, flush=True)
"""


@pytest.mark.slow
def test_a_writer_that_slept_while_another_took_over_pays_nothing_and_stores_nothing(
    postgres: Postgres, tmp_path: Path
) -> None:
    place, calls = in_database(postgres, idle_s=2), tmp_path / "calls"
    with place.process(ASK, str(calls)) as sleeper:
        assert sleeper.stdout is not None and sleeper.stdout.readline() == "asking\n"
        os.kill(sleeper.pid, signal.SIGSTOP)
        try:
            ledger, began = place.open(), time.monotonic()
            asyncio.run(asyncio.wait_for(_take_over(ledger), 120))
            assert time.monotonic() - began > 1.5  # the sleeper's session must be ended first
            paid, stored = calls.stat().st_size, len(ledger.read("m").rows)
        finally:
            os.kill(sleeper.pid, signal.SIGCONT)
        said = sleeper.stdout.read()
    assert "answers of m of the study" in said and "are another process's now" in said, said
    assert calls.stat().st_size <= paid + 1  # one may have been on its way when the process was stopped
    assert len(ledger.read("m").rows) == stored


async def _take_over(ledger: Any) -> None:
    async with ledger.writing("m", print) as writer:
        writer.append(answer("of the successor", "left"))
        await writer.kept()


def _claimed(ledger: SharedLedger) -> Claim:
    """A claim without the thread that looks after it: its process is stopped."""
    until = time.monotonic() + 60  # a server that was started a moment ago waits for who held it before
    while not isinstance(found := ledger._try_claim("m"), Claim):
        assert time.monotonic() < until, found
        time.sleep(0.2)
    return found


def _lose_connection(ledger: SharedLedger, by: SharedLedger) -> None:
    """End a session from the server's side."""
    sql = "select pg_terminate_backend(pid, 60000) from pg_stat_activity where application_name = %s"
    by.session.run(lambda connection: connection.execute(sql, [f"traps {ledger.session.id}"]))


def two_of(postgres: Postgres) -> tuple[SharedLedger, SharedLedger]:
    place = in_database(postgres)
    one, two = place.open(), place.open()
    assert isinstance(one, SharedLedger) and isinstance(two, SharedLedger)
    return one, two


def test_a_group_with_an_old_number_is_refused(postgres: Postgres) -> None:
    one, two = two_of(postgres)
    old, stream = _claimed(one), Stream(one.session)
    kept = stream.put(old, "answers", encoded((answer("a", "left"), {})))
    stream.store()
    kept.result()
    _lose_connection(one, two)
    new = _claimed(two)
    assert new.number == old.number + 1 and new.is_succession
    late = stream.put(old, "answers", encoded((answer("b", "left"), {})))
    stream.store()
    with pytest.raises(TrapsError, match=r"are another process's now: .* Run the same command again"):
        late.result()
    assert old.lost and list(two.read("m").rows) == ["a"]
    assert two.totals()["unknown"].unknown == 0  # nothing of the refused row was counted


def test_a_writer_whose_connection_broke_goes_on_where_nobody_took_over(postgres: Postgres) -> None:
    one, two = two_of(postgres)
    claim, stream = _claimed(one), Stream(one.session)
    _lose_connection(one, two)
    kept = stream.put(claim, "answers", encoded((answer("a", "left"), {})))
    stream.store()
    kept.result()
    assert isinstance(two._try_claim("m"), str)  # the lock was taken again
    assert list(two.read("m").rows) == ["a"]


def test_a_group_that_was_stored_when_the_connection_broke_is_not_stored_again(postgres: Postgres) -> None:
    one, _ = two_of(postgres)
    claim, stream = _claimed(one), Stream(one.session)
    row = answer("a", "left") | {"cost_usd": 0.5, "components": {"participant": "m"}}
    real, broken = one.session.run, list[str]()

    def run(work: Any, patience_s: float = 60.0) -> Any:
        """The transaction is committed and its answer is lost; the session does it again."""
        if not broken:
            broken.append("once")
            real(work, patience_s)
        return real(work, patience_s)

    one.session.run = run
    stream.put(claim, "answers", encoded((row, {})))
    stream.store()
    assert broken and one.totals()["m"].dollars == 0.5
    again = stream.put(claim, "answers", encoded((row | {"key": "b"}, {})))
    stream.store()
    again.result()
    assert one.totals()["m"].dollars == 1.0


@pytest.mark.slow
def test_a_server_that_stops_and_starts_ends_no_run_and_loses_no_row(tmp_path: Path) -> None:
    with Postgres.running(durable=True) as server:
        place = in_database(server)
        with place.process(ASK, str(tmp_path / "calls")) as process:
            assert process.stdout is not None and process.stdout.readline() == "asking\n"
            server.stop(signal.SIGQUIT)
            time.sleep(1)
            asked = (tmp_path / "calls").stat().st_size
            server.start()
            until = time.monotonic() + 540
            while (tmp_path / "calls").stat().st_size < asked + 20 and process.poll() is None:
                assert time.monotonic() < until
                time.sleep(0.05)
            assert process.poll() is None, process.stdout.read()
            other = place.open()
            assert isinstance(other, SharedLedger)
            held = other._try_claim("m")
            assert isinstance(held, str) and f"process {process.pid}" in held
            process.kill()
            process.wait()
            assert abs(len(other.read("m").rows) - (tmp_path / "calls").stat().st_size) <= 1


@pytest.mark.slow
def test_while_the_server_is_away_no_call_is_sent_and_then_the_run_ends_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Postgres.running() as server:
        ledger = in_database(server).open()
        assert isinstance(ledger, SharedLedger)

        async def scenario() -> None:
            async with ledger.writing("m", print) as writer:
                await writer.require()
                monkeypatch.setattr(ledger.session, "patience_s", 1.0)
                await asyncio.sleep(1)  # the thread's look takes the new patience
                server.stop()
                await asyncio.sleep(2)  # what was seen before does not count for longer
                await writer.require()

        with pytest.raises(
            TrapsError, match=rf"{VARIABLE}: the database at 127.0.0.1:{server.port}/postgres cannot be"
        ):
            asyncio.run(scenario())


@contextmanager
def proxy(port: int) -> Iterator[tuple[int, threading.Event]]:
    """A port that leads to another one until the event is set, when all connections through it are cut."""
    cut, ends = threading.Event(), list[socket.socket]()
    listener = socket.create_server(("127.0.0.1", 0))

    def pump(source: socket.socket, target: socket.socket) -> None:
        try:
            while data := source.recv(65536):
                target.sendall(data)
        except OSError:
            pass  # cut
        finally:
            for end in (source, target):
                end.close()

    def accept() -> None:
        while True:
            try:
                near, _ = listener.accept()
            except OSError:
                return
            if cut.is_set():
                near.close()
                continue
            far = socket.create_connection(("127.0.0.1", port))
            ends.extend((near, far))
            for pair in ((near, far), (far, near)):
                threading.Thread(target=pump, args=pair, daemon=True).start()

    def watch() -> None:
        cut.wait()
        for end in ends:
            try:
                end.shutdown(socket.SHUT_RDWR)
            except OSError:
                continue

    threading.Thread(target=accept, daemon=True).start()
    threading.Thread(target=watch, daemon=True).start()
    try:
        yield listener.getsockname()[1], cut
    finally:
        cut.set()
        listener.close()


@pytest.mark.slow
def test_a_writer_that_is_cut_off_sends_nothing_once_another_has_taken_over(postgres: Postgres, tmp_path: Path) -> None:
    direct, calls = in_database(postgres), tmp_path / "calls"
    with proxy(postgres.port) as (port, cut):
        through = Place(("postgres", postgres.address(port=port), *direct.where[2:]))
        with through.process(ASK, str(calls)) as process:
            assert process.stdout is not None and process.stdout.readline() == "asking\n"
            cut.set()

            async def take_over() -> int:
                async with direct.open().writing("m", print):
                    paid = calls.stat().st_size
                    await asyncio.sleep(1)
                    return calls.stat().st_size - paid

            assert asyncio.run(asyncio.wait_for(take_over(), 120)) == 0


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("postgresql://traps:wrong@127.0.0.1:{port}/postgres", "password authentication failed"),
        ("postgresql://traps:a-password-0123@127.0.0.1:{port}/nowhere", 'database "nowhere" does not exist'),
        ("postgresql://traps:a-password-0123@127.0.0.1:1/postgres", "Connection refused"),
        ("postgresql://[half", "is no address of a PostgreSQL database; write it as postgresql://USER:PASSWORD@HOST"),
    ],
)
def test_an_address_that_leads_nowhere_names_variable_host_study_and_remedy(
    postgres: Postgres, address: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, address.format(port=postgres.port))
    with pytest.raises(TrapsError) as raised:
        session_of(VARIABLE, "my-study")
    told = str(raised.value)
    assert told.startswith(f"{VARIABLE}: ") and said in told and "study my-study" in told
    assert f"host {socket.gethostname()}" in told
    assert "wrong" not in told and "0123" not in told
    assert "127.0.0.1" in told or "postgresql://USER" in told


def test_a_variable_that_is_not_set_and_a_package_that_is_not_there_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    with pytest.raises(
        TrapsError, match=rf"{VARIABLE} is not set on the host .*: study.yaml of my-study .* export {VARIABLE}=post"
    ):
        session_of(VARIABLE, "my-study")
    code = f"""
import os, sys
sys.modules["psycopg"] = None
from traps_pipeline.storage.database import session_of
os.environ["{VARIABLE}"] = "postgresql://traps@127.0.0.1/postgres"
session_of("{VARIABLE}", "my-study")
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert "a study that hosts share needs psycopg, which is not installed: `make setup`" in ran.stderr


def test_tables_of_another_format_are_refused() -> None:
    with Postgres.running() as server:
        session = Session(server.address(), VARIABLE, "my-study")
        session.run(lambda connection: connection.execute("update traps.format set version = 99"))
        with pytest.raises(
            TrapsError, match="its tables have format 99, this version reads 2; use the version that made"
        ):
            Session(server.address(), VARIABLE, "my-study")


def test_studies_of_one_database_do_not_see_each_other(postgres: Postgres) -> None:
    one, two = in_database(postgres).open(), in_database(postgres).open()
    write(one, answer("a", "left") | {"cost_usd": 0.5, "components": {"participant": "m"}})
    assert (two.read("m").rows, two.totals(), list(two.damage())) == ({}, {}, [])
    write(two, answer("a", "right"))
    assert one.read("m").rows["a"]["text"] == "left"
    assert opened("postgres", postgres.address(), "other", "30").read("m").rows == {}


def test_processes_of_any_study_that_ask_through_an_account_are_counted_while_they_live(postgres: Postgres) -> None:
    def session() -> Session:
        return Session(postgres.address(), VARIABLE, f"study-{secrets.token_hex(4)}")

    account = f"account-{secrets.token_hex(4)}"
    one, two = session(), session()
    with one.sharing([account, "other"]) as of_one:
        assert of_one(account) == 1
        with two.sharing([account]) as of_two:
            assert of_two(account) == 2
            one.look()
            assert (of_one(account), of_one("other")) == (2, 1)
        time.sleep(0.5)
        one.look()
        assert of_one(account) == 1
        dying = session()
        held = dying.sharing([account])
        held.__enter__()
        time.sleep(0.5)
        one.look()
        assert of_one(account) == 2
        dying.close()  # as its connection is when a process dies
        until = time.monotonic() + 60
        while of_one(account) == 2 and time.monotonic() < until:
            time.sleep(0.5)
            one.look()
        assert of_one(account) == 1
