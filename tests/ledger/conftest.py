"""Ledgers in both databases, here and in processes of their own."""

from __future__ import annotations

import secrets
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.postgres import Postgres
from traps_cluster.postgres import PostgresDatabase
from traps_pipeline.ledger.ledger import Ledger
from traps_pipeline.ledger.sqlite import SqliteDatabase

VARIABLE = "TRAPS_TEST_DATABASE"
# Says that it is ready, waits for a line, and writes one row of the evaluation that it is told.
WRITE_ONE = """
import asyncio
async def write():
    async with ledger.writing(sys.argv[1], print) as writer:
        await writer.write({"key": "k", "outcome": "answer", "text": "left"})
print("ready", flush=True)
sys.stdin.readline()
asyncio.run(write())
"""


def opened(kind: str, *where: str) -> Ledger:
    """A ledger of answers: of `sqlite` in a folder, or of `postgres` at an address, in a study, whose connections may
    be silent for so many seconds."""
    if kind == "sqlite":
        return Ledger(SqliteDatabase(Path(where[0]), "study"), "answers")
    return Ledger(PostgresDatabase(where[0], VARIABLE, where[1], float(where[2])), "answers")


@dataclass(frozen=True)
class Place:
    """Where a ledger is: the arguments of `opened`."""

    where: Sequence[str]

    @property
    def kind(self) -> str:
        return self.where[0]

    def open(self) -> Ledger:
        """The ledger, as another process would open it."""
        return opened(*self.where)

    @contextmanager
    def process(self, code: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
        """A process that runs code with `ledger` defined; `arguments` are in its sys.argv[1:]. Killed at the end."""
        begin = "import sys\nfrom tests.ledger.conftest import opened\nledger = opened(*sys.argv.pop(1).split('|'))\n"
        command = [sys.executable, "-c", begin + code, "|".join(self.where), *arguments]
        pipe = subprocess.PIPE
        process = subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=subprocess.STDOUT, text=True)
        try:
            yield process
        finally:
            process.kill()
            process.communicate()


def line_of(process: subprocess.Popen[str]) -> str:
    """The next line that a process says."""
    assert process.stdout is not None
    return process.stdout.readline().strip()


def begin(*processes: subprocess.Popen[str]) -> None:
    """Let processes begin once all are ready: one that is late would find nothing left."""
    for process in processes:
        assert line_of(process) == "ready"
    for process in processes:
        go_on(process)


def go_on(process: subprocess.Popen[str]) -> None:
    """Give a process the line that it waits for."""
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()


def in_database(server: Postgres, idle_s: float = 30.0) -> Place:
    """A new study's ledger."""
    return Place(("postgres", server.address(), f"study-{secrets.token_hex(4)}", str(idle_s)))


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.slow)])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    """An empty ledger in each database."""
    if request.param == "sqlite":
        return Place(("sqlite", str(tmp_path)))
    return in_database(request.getfixturevalue("postgres"))


@pytest.fixture
def ledger(place: Place) -> Ledger:
    """An empty ledger in each database, opened."""
    return place.open()
