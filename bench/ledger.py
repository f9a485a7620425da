"""Ledger writes and reads against SQLite in WAL mode, the same 20,000 rows of 1 KB, one run.

Both keep the ledger's promise that a row survives kill -9 as soon as it is written (SQLite: a commit a row, without a
sync to disk; the ledger also syncs every 100 rows). python bench/ledger.py
"""

from __future__ import annotations

import json
import sqlite3
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

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


def _rate(work: Callable[[Path], object], folder: Path) -> float:
    began = time.perf_counter()
    work(folder)
    return len(ROWS) / (time.perf_counter() - began)


def main() -> None:
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
