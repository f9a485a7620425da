"""The ledger: CPU seconds to write and read rows of 1 KB, and what a study of 1.6 million rows takes to begin.

Rows are written as a run writes them: each of so many connections waits until its row is kept, with and without a
reservation before it, and many at once, as an import writes them. `--database` does the same in a PostgreSQL that syncs
to the disk, whose own CPU seconds are not counted.

python bench/ledger.py [--database] [--rows 20000] [--study 1600000]
"""

from __future__ import annotations

import argparse
import asyncio
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from hashlib import sha256
from itertools import islice
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.quick import parse
from traps_pipeline.ledger.database import Database
from traps_pipeline.ledger.ledger import Ledger
from traps_pipeline.ledger.money import Money
from traps_pipeline.ledger.sqlite import SqliteDatabase

USD, WORST_USD = 0.001, 0.01
ABOUT = {"outcome": "answer", "cost_usd": USD, "components": {"participant": "m"}, "text": "x" * 850}


def rows(count: int) -> Iterator[dict[str, Any]]:
    """Yield rows whose keys are digests, as those of calls."""
    return ({"key": sha256(b"%d" % number).hexdigest(), **ABOUT} for number in range(count))


@contextmanager
def measured(what: str) -> Iterator[None]:
    """Print the CPU seconds of this process, all threads, and the wall seconds that the block takes."""
    cpu, began = _cpu_s(), time.perf_counter()
    yield
    print(f"{what:<46} {_cpu_s() - cpu:>8.2f} s CPU {time.perf_counter() - began:>8.2f} s", flush=True)


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def store(database: Database, evaluation: str, count: int) -> None:
    """Write rows as an import does."""
    asyncio.run(Ledger(database, "answers").store({evaluation: [(row, {}) for row in rows(count)]}, print))


async def ask(database: Database, evaluation: str, count: int, connections: int, *, paid: bool) -> None:
    """Write rows as calls that are answered at once do. paid: each is reserved before, under a cap it never meets."""
    pending, money = rows(count), Money(database)
    async with Ledger(database, "answers").writing(evaluation, print) as writer:

        async def connection() -> None:
            for row in pending:
                paid_by = [str(await money.reserve("m", WORST_USD, {None: 1e9}))] if paid else []
                await writer.write(row, None, paid_by)

        await asyncio.gather(*(connection() for _ in range(connections)))


def compare(database: Database, count: int) -> None:
    """Write and read `count` rows in each way."""
    ledger = Ledger(database, "answers")
    with database.writing():
        for connections in (24, 200):
            for paid in (False, True):
                what = f"{count:,} rows, {connections} connections" + (", reserved" if paid else "")
                with measured(what):
                    asyncio.run(ask(database, f"m{connections}{paid}", count, connections, paid=paid))
    with measured(f"{count:,} rows, imported at once"):
        store(database, "imported", count)
    with measured(f"read {count:,} rows"):
        assert len(ledger.read("m200False").rows) == count
    wanted = [row["key"] for row in islice(rows(count), 0, None, 200)]
    with measured(f"read {len(wanted):,} of them by key"):
        assert len(ledger.read("m200False", wanted).rows) == len(wanted)


def begin(database: Database, count: int) -> None:
    """What a study of so many rows reads before its first call, and what it takes to recover one evaluation."""
    cell = min(100_000, count)
    for number in range(count // cell):
        store(database, f"m{number}", cell)
    with database.writing(), measured(f"totals and spending of {count:,} rows"):
        Ledger(database, "answers").totals()
        Money(database).spent()
    with measured(f"recover {cell:,} rows by key"):
        assert len(Ledger(database, "answers").read("m0", [row["key"] for row in rows(cell)]).rows) == cell
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"largest memory of this process: {peak_mb:,.0f} MB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--database", action="store_true", help="in PostgreSQL")
    parser.add_argument("--rows", type=int, default=20_000)
    parser.add_argument("--study", type=int, default=1_600_000)
    arguments = parse(parser, rows=500, study=1000)
    with ExitStack() as opened:
        if arguments.database:
            from tests.postgres import Postgres
            from traps_cluster.postgres import PostgresDatabase

            server = opened.enter_context(Postgres.running(durable=True))
            one, two = (PostgresDatabase(server.address(), "BENCH", study) for study in ("one", "two"))
        else:
            folder = Path(opened.enter_context(tempfile.TemporaryDirectory()))
            one, two = SqliteDatabase(folder / "one", "bench"), SqliteDatabase(folder / "two", "bench")
        compare(one, arguments.rows)
        begin(two, arguments.study)


if __name__ == "__main__":
    main()
