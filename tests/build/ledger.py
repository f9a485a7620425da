"""Rows of a ledger, and their writing."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

from traps_pipeline.storage.ledger import Ledger


def write(ledger: Ledger, *rows: Mapping[str, object], evaluation: str = "m") -> None:
    async def all_of_them() -> None:
        async with ledger.writing(evaluation, print) as writer:
            await writer.require()
            writer.open()
            for row in rows:
                writer.append(row)
            await writer.kept()

    asyncio.run(all_of_them())


def answer(key: str, text: str) -> dict[str, Any]:
    return {"key": key, "outcome": "answer", "text": text}


def paid(key: str, cost: float | None, participant: str = "m") -> dict[str, Any]:
    return answer(key, "left") | {"cost_usd": cost, "components": {"participant": participant}}
