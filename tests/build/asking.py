"""Work on a few calls of models that do what a test says."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tests.build.ledger import local
from traps_pipeline.models.asking.ask import Call, SettledCell, Work, run_work
from traps_pipeline.models.asking.participants import Participants
from traps_pipeline.models.money.budget import Budget
from traps_pipeline.models.registry.accounts import Limits
from traps_pipeline.models.registry.entries import Entry
from traps_pipeline.models.request import Outcome, Request
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.storage.study import Study

QUICK = Limits(concurrency=4, retries=2, backoff_s=0.001)
LEFT = Outcome("answer", "left", reasoning="it leans left")


class Answering:
    """A backend that counts calls and does what the test says: answers after a while, or raises."""

    def __init__(
        self, says: Callable[[Request, int], Outcome | BaseException] = lambda *_: LEFT, after_s: float = 0.0
    ) -> None:
        self.calls: list[str] = []
        self.moments: list[float] = []
        self._says, self._after_s = says, after_s

    async def ask(self, request: Request) -> Outcome:
        item = str(request.about["item_id"])
        self.calls.append(item)
        self.moments.append(time.monotonic())
        await asyncio.sleep(0)
        said = self._says(request, self.calls.count(item))
        if isinstance(said, BaseException):
            raise said
        await asyncio.sleep(self._after_s)
        return said


def request(item: int | str, model: str = "m", **changes: Any) -> Request:
    about = {"item_id": f"item-{item}", "model": model, "regime": "standard", "run": 1}
    return replace(Request(model, "test", {}, "system", "user", about), **changes)


ONE, TEN = [request(1)], [request(n) for n in range(10)]


def of_model(name: str) -> Cell:
    return Cell("occlusion", Evaluation(name, "standard", 1))


CELL = of_model("m")


def work(
    root: Path, backends: Mapping[str, Answering], wanted: Sequence[Request], limits: Limits = QUICK
) -> Work[Cell, Call, dict[str, Any]]:
    """Work on the wanted requests of each model, whose finish returns what it was given, as {cell, rows, tally}."""

    def calls(cell: Cell) -> list[Call]:
        name = cell.evaluation.model
        return [Call(replace(one, participant=name, about={**one.about, "model": name})) for one in wanted]

    def finish(settled: SettledCell[Cell, Call]) -> dict[str, Any]:
        return {"cell": settled.cell, "rows": list(settled.rows.values()), "tally": settled.tally}

    entries = {name: Entry(id=name, backend="test", limits=limits) for name in backends}
    asked = Participants(entries, lambda entry: backends[entry.id], Study())
    return Work("responses", local(root), asked, Budget(0.0, {}), "1", calls, finish)


def ask(root: Path, backend: Answering, wanted: Sequence[Request] = ONE, limits: Limits = QUICK) -> dict[str, Any]:
    """What a run with one model finishes."""
    (finished,) = run_work(work(root, {"m": backend}, wanted, limits), [CELL])
    return finished


def kept(root: Path, cell: Cell = CELL) -> list[str]:
    """The items whose answers the ledger has."""
    rows = local(root).read(cell.evaluation.key).rows.values()
    return [row["components"]["about"]["item_id"] for row in rows]
