"""Ledgers, rows in them, and budgets."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from traps_pipeline.ledger.database import Database
from traps_pipeline.ledger.ledger import Ledger
from traps_pipeline.ledger.money import Money
from traps_pipeline.ledger.rows import Totals
from traps_pipeline.ledger.sqlite import SqliteDatabase
from traps_pipeline.models.money.budget import Budget

KEPT: list[Any] = []  # databases of budgets, open until the process ends


def local(folder: Path, kind: str = "answers") -> Ledger:
    """A ledger in a folder of this machine."""
    return Ledger(SqliteDatabase(folder, "study"), kind)


def write(ledger: Ledger, *rows: Mapping[str, object], evaluation: str = "m") -> None:
    """Write rows as a run does."""

    async def all_of_them() -> None:
        async with ledger.writing(evaluation, print) as writer:
            await writer.require()
            for row in rows:
                await writer.write(row)

    asyncio.run(all_of_them())


def spend(database: Database, spent_usd: Mapping[str, float]) -> None:
    """Count dollars as spent."""
    with database.writing():
        totals = {("answers", participant): Totals(dollars=usd) for participant, usd in spent_usd.items()}
        database.submit(lambda batch: batch.totals.update(totals)).result()


def budget(
    cap_usd: float, caps_usd: Mapping[str, float] | None = None, spent_usd: Mapping[str, float] | None = None
) -> Budget:
    """A budget in a ledger of its own."""
    KEPT.append(folder := tempfile.TemporaryDirectory())  # removed when the process ends
    database = SqliteDatabase(Path(folder.name), "study")
    KEPT.append(entered := database.writing())
    entered.__enter__()
    spend(database, spent_usd or {})
    return Budget(cap_usd, caps_usd or {}, Money(database))


@contextmanager
def budget_in(ledger: Ledger, cap_usd: float) -> Iterator[Budget]:
    """The budget of the study of a ledger."""
    with ledger.database.writing():
        yield Budget(cap_usd, {}, Money(ledger.database))


def answer(key: str, text: str) -> dict[str, Any]:
    return {"key": key, "outcome": "answer", "text": text}


def paid(key: str, cost: float | None, participant: str = "m") -> dict[str, Any]:
    return answer(key, "left") | {"cost_usd": cost, "components": {"participant": participant}}
