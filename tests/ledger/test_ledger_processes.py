"""Processes that share a study's ledger: what one has kept, the end of another does not take away."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.postgres import Postgres
from traps_pipeline.ledger.ledger import Ledger
from traps_pipeline.ledger.sqlite import SqliteDatabase

BEGIN = """
import asyncio, sys
from pathlib import Path
from traps_pipeline.ledger.ledger import Ledger
from traps_pipeline.ledger.postgres import PostgresDatabase
from traps_pipeline.ledger.sqlite import SqliteDatabase
def answer(key):
    return {"key": key, "outcome": "answer", "text": "left"}
"""
KEEP = """
async def keep():
    async with Ledger(SqliteDatabase(Path(sys.argv[1]), "study"), "answers").writing("m", print) as writer:
        await writer.write(answer("before"))
        await writer.sync()
        print("synced", flush=True)
        sys.stdin.readline()
        await writer.write(answer("after"))
        print("kept", flush=True)
        sys.stdin.readline()
asyncio.run(keep())
"""
WRITE_ONE = """
async def write(ledger):
    async with ledger.writing(sys.argv[2], print) as writer:
        await writer.write(answer("k"))
"""
IN_FOLDER = f'{WRITE_ONE}asyncio.run(write(Ledger(SqliteDatabase(Path(sys.argv[1]), "study"), "answers")))\n'
IN_DATABASE = f"""{WRITE_ONE}
ledger = Ledger(PostgresDatabase(sys.argv[1], "VARIABLE", "study"), "answers")
print("ready", flush=True)
sys.stdin.readline()
asyncio.run(write(ledger))
"""


def process(code: str, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", BEGIN + code, *arguments]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=subprocess.STDOUT, text=True)


def test_rows_kept_after_another_process_has_ended_survive_a_kill(tmp_path: Path) -> None:
    keeping = process(KEEP, str(tmp_path))
    try:
        assert keeping.stdout is not None and keeping.stdin is not None
        assert keeping.stdout.readline() == "synced\n"
        said, _ = process(IN_FOLDER, str(tmp_path), "another").communicate()
        assert said == ""
        keeping.stdin.write("\n")
        keeping.stdin.flush()
        assert keeping.stdout.readline() == "kept\n"
        assert [*Ledger(SqliteDatabase(tmp_path, "study"), "answers").read("m").rows] == ["before", "after"]
    finally:
        keeping.kill()
        keeping.communicate()
    assert [*Ledger(SqliteDatabase(tmp_path, "study"), "answers").read("m").rows] == ["before", "after"]


@pytest.mark.slow
def test_processes_that_begin_at_once_in_an_empty_database_all_write() -> None:
    with Postgres.running() as server:
        running = [process(IN_DATABASE, server.address(), f"m{number}") for number in range(4)]
        for one in running:
            assert one.stdout is not None and one.stdout.readline() == "ready\n"
        for one in running:
            assert one.stdin is not None
            one.stdin.write("\n")
            one.stdin.flush()
        said = [one.communicate()[0] for one in running]
    assert [one.returncode for one in running] == [0] * 4, said
