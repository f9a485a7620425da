"""Ledger writes and reads against SQLite in WAL mode, the same 20,000 rows of 1 KB, one run.

Both keep the ledger's promise that a row survives kill -9 as soon as it is written (SQLite: a commit a row, without a
sync to disk; the ledger also syncs every 100 rows). With `--database` also rows a second of the ledger in a PostgreSQL
that syncs to the disk, from one process and from two, each of whose 24 connections waits until its row is stored.

python bench/ledger.py [--database]
"""

from __future__ import annotations

import argparse
import json
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.quick import parse
from traps_pipeline.storage.segments import SegmentLedger

ROWS = [{"key": f"{number:064x}", "outcome": "answer", "text": "x" * 900} for number in range(20_000)]


def ledger_write(folder: Path) -> None:
    with SegmentLedger(folder, "answers").writer("m__standard__run1") as writer:
        for row in ROWS:
            writer.append(row)


def ledger_read(folder: Path) -> int:
    return len(SegmentLedger(folder, "answers").read("m__standard__run1").rows)


def _connect(folder: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(folder / "ledger.sqlite")
    connection.execute("PRAGMA journal_mode=WAL")
    connection.execute("PRAGMA synchronous=NORMAL")
    return connection


def sqlite_write(folder: Path) -> None:
    connection = _connect(folder)
    connection.execute("CREATE TABLE answers (key TEXT PRIMARY KEY, row TEXT)")
    for row in ROWS:
        connection.execute("INSERT INTO answers VALUES (?, ?)", (row["key"], json.dumps(row)))
        connection.commit()
    connection.close()


def sqlite_read(folder: Path) -> int:
    rows = _connect(folder).execute("SELECT row FROM answers").fetchall()
    return len([json.loads(row) for (row,) in rows])


WRITE = """
import asyncio, sys, time
from traps_pipeline.storage.database import Session
from traps_pipeline.storage.shared_ledger import SharedLedger
address, evaluation, rows = sys.argv[1], sys.argv[2], int(sys.argv[3])
async def write():
    numbers = iter(range(rows))
    async with SharedLedger(Session(address, "BENCH", "bench"), "answers").writing(evaluation, print) as writer:
        async def connection():
            for number in numbers:
                writer.append({"key": f"{number:064x}", "outcome": "answer", "text": "x" * 900})
                await writer.kept()
        began = time.perf_counter()
        await asyncio.gather(*(connection() for _ in range(24)))
        print(rows / (time.perf_counter() - began))
asyncio.run(write())
"""


def database_rates() -> None:
    """Print how many rows a second processes store in one database."""
    from tests.postgres import Postgres
    from traps_pipeline.storage.database import Session
    from traps_pipeline.storage.shared_ledger import SharedLedger

    with Postgres.running(durable=True) as server:
        with tempfile.TemporaryDirectory() as name:
            alone = _rate(ledger_write, Path(name))
            read = _rate(ledger_read, Path(name))
        print(f"files of one machine: {alone:,.0f} rows/s, read: {read:,.0f} rows/s", flush=True)
        for count in (1, 2):
            command = [sys.executable, "-c", WRITE, server.address()]
            running = [
                subprocess.Popen([*command, f"m{count}{n}", str(len(ROWS))], stdout=subprocess.PIPE, text=True)
                for n in range(count)
            ]
            rates = [float(process.communicate()[0].splitlines()[-1]) for process in running]
            said = f"PostgreSQL, {count} processes of 24 connections: {sum(rates):,.0f} rows/s"
            print(f"{said}, {sum(rates) / alone:.2f} of the files", flush=True)
        began = time.perf_counter()
        found = SharedLedger(Session(server.address(), "BENCH", "bench"), "answers").read("m10").rows
        rate = len(found) / (time.perf_counter() - began)
        print(f"PostgreSQL, read: {rate:,.0f} rows/s, {rate / read:.2f} of the files")


def _rate(work: Callable[[Path], object], folder: Path) -> float:
    began = time.perf_counter()
    work(folder)
    return len(ROWS) / (time.perf_counter() - began)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--database", action="store_true")
    parser.add_argument("--rows", type=int, default=len(ROWS))
    arguments = parse(parser, rows=500)
    del ROWS[arguments.rows :]
    if arguments.database:
        database_rates()
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print(f"{'':<8} {'ledger, rows/s':>16} {'SQLite WAL':>14} {'ratio':>7}")
        for what, mine, other in (("write", ledger_write, sqlite_write), ("read", ledger_read, sqlite_read)):
            a, b = _rate(mine, folder), _rate(other, folder)
            print(f"{what:<8} {a:>16,.0f} {b:>14,.0f} {a / b:>7.2f}")
        size = sum(path.stat().st_size for path in (folder / "answers").rglob("*.jsonl"))
        print(f"size: {size / 1e6:.1f} MB against {(folder / 'ledger.sqlite').stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
