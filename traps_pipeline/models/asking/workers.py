"""Send the missing calls of a cell through its participants' connections, and record each answer."""

import asyncio
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.ledger import SYNC_S, Writer
from traps_pipeline.ledger.rows import is_settled
from traps_pipeline.models.asking.participants import CallContext, Participant, Participants, Row, ask_once, ledger_row
from traps_pipeline.models.money.budget import Budget
from traps_pipeline.models.request import Outcome, Request


@dataclass
class EvaluationState:
    """The state that an evaluation's cells share. reported: places of the ledger. is_over: no call is sent any more."""

    participants: Participants
    budget: Budget
    epoch: str
    writer: Writer
    stop: asyncio.Event
    reported: set[str] = field(default_factory=set)
    is_over: bool = False

    def is_halted(self) -> bool:
        """Return whether to stop sending calls."""
        return self.stop.is_set() or self.is_over


@dataclass
class Asking:
    """The workers that ask a cell's missing requests. again: what to record of a call that is repeated to settle it."""

    its: EvaluationState
    missing: Sequence[Request]
    all_sent: asyncio.Event
    again: Callable[[Outcome], Outcome] | None = None
    rows: dict[str, Row] = field(default_factory=dict)
    problems: list[Exception] = field(default_factory=list)
    n_sent: int = 0

    async def _worker(self, participant: Participant, queue: deque[Request]) -> None:
        try:
            while await self._one(participant, queue):
                pass
        except Exception as error:  # noqa: BLE001 - raised by `run`, once the calls in flight are in the ledger
            self.problems.append(error)
            self.its.is_over = True

    async def _one(self, participant: Participant, queue: deque[Request]) -> bool:
        """Ask and record one request of the queue; return False if none is left."""
        if not queue or self.its.is_halted():
            return False
        request, name = queue.popleft(), participant.entry.id
        self.n_sent += 1
        if self.n_sent == len(self.missing):
            self.all_sent.set()
        context = CallContext(self.its.budget, self.its.stop, self.its.is_halted, self.its.writer.require)
        attempt_result = await ask_once(participant, request, context)
        if attempt_result is None:
            return False
        outcome = attempt_result[0] if self.again is None else self.again(attempt_result[0])
        try:
            if self.again is None:
                participant.breaker.watch(outcome)
        except TrapsError:  # the participant is stopped
            self.its.is_over = True  # at once: no further call is sent while the row is written
            raise
        finally:
            row = await self.write(request, outcome, *attempt_result[1:], [each.id for each in context.paid_by])
            progress.current().called(name, not is_settled(row), row["latency_s"], row["cost_usd"] or 0.0)
        return True

    async def write(self, request: Request, outcome: Outcome, attempts: int, seconds: float, paid_by: list[str]) -> Row:
        """Record an outcome in the ledger and return its row."""
        row, side_texts = ledger_row(request, outcome, attempts, seconds, self.its.epoch)
        await self.its.writer.write(row, side_texts, paid_by)
        self.rows[request.key] = HeldRow(row)
        return row

    async def _sync(self) -> None:
        while True:
            await asyncio.sleep(SYNC_S)
            try:
                await self.its.writer.sync()
            except TrapsError as error:  # a disk that cannot be synced stops new calls
                self.problems.append(error)
                self.its.is_over = True
                return

    async def run(self) -> None:
        """Ask for all that is missing; record calls in flight before raising an error."""
        queues: dict[str, deque[Request]] = {}
        for request in self.missing:
            queues.setdefault(request.participant, deque()).append(request)
        queue_of = [(self.its.participants[name], queue) for name, queue in queues.items()]
        sync_task = asyncio.create_task(self._sync())
        try:
            async with asyncio.TaskGroup() as group:
                for participant, queue in queue_of:
                    for _ in range(min(participant.entry.limits.concurrency, len(queue))):
                        group.create_task(self._worker(participant, queue))
        finally:
            sync_task.cancel()
        if self.problems:
            raise self.problems[0]


class HeldRow(Mapping[str, Any]):
    """A ledger row in little memory: without its components, which the request holds too."""

    __slots__ = ("_places", "_values")
    _shared: ClassVar[dict[tuple[str, ...], dict[str, int]]] = {}

    def __init__(self, row: Row) -> None:
        names = tuple(name for name in row if name != "components")
        self._places = self._shared.setdefault(names, {name: place for place, name in enumerate(names)})
        self._values = tuple(row[name] for name in names)

    def __getitem__(self, name: str) -> Any:
        return self._values[self._places[name]]

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._values)
