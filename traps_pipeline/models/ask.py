"""Asking: wanted keys minus known keys, call the difference, append to the ledger, hand on what is complete.

The same code asks models and judges, reference ones and paid ones. There is no resume mode: a crash, a second run and
a correction are the same operation (docs/models.md, "Ledger").
"""

from __future__ import annotations

import asyncio
import random
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from itertools import groupby
from typing import Any, Generic, TypeVar

from traps_pipeline import progress
from traps_pipeline.errors import TrapsError
from traps_pipeline.models.budget import Budget, BudgetReached, check_money, most_tokens, worst_case_usd
from traps_pipeline.models.registry import Account, Entry, load_accounts
from traps_pipeline.models.request import RATE_LIMITED, UNBILLED, Backend, Outcome, Request, TransientError
from traps_pipeline.models.traffic import Breaker, Gate, Meter
from traps_pipeline.partitions import Cell, Evaluation
from traps_pipeline.progress import Tally
from traps_pipeline.storage.ledger import SYNC_SECONDS, Ledger, LockGivenUp, SegmentWriter, settles
from traps_pipeline.storage.workspace import Study

Row = dict[str, Any]
Finished = TypeVar("Finished")
MAX_BACKOFF_S, MAX_RETRY_AFTER_S = 60.0, 900.0


@dataclass(frozen=True)
class Participant:
    """A model or judge as it is asked: its backend and entry, its connections, its account's pace, its failures."""

    backend: Backend
    entry: Entry
    gate: Gate
    meter: Meter
    breaker: Breaker


class Participants:
    """Participants by id, made when first asked: one that is not asked needs neither key nor budget. Connections are
    shared by all evaluations of a run, the pace by all participants of an account."""

    def __init__(
        self,
        entries: Mapping[str, Entry],
        make: Callable[[Entry], Backend],
        study: Study,
        accounts: Mapping[str, Account] | None = None,
    ) -> None:
        self._entries, self._make, self._study = entries, make, study
        self._accounts = load_accounts() if accounts is None else accounts
        self._made: dict[str, Participant] = {}
        self._meters: dict[str | None, Meter] = {}

    def __getitem__(self, name: str) -> Participant:
        if name not in self._made:
            entry = self._entries[name]
            check_money(self._study, entry)
            gate, breaker = Gate(entry.limits.concurrency), Breaker(name)
            breaker.check()
            self._made[name] = Participant(self._make(entry), entry, gate, self._meter(entry.account), breaker)
        return self._made[name]

    def _meter(self, account: str | None) -> Meter:
        if account not in self._meters:
            limits = Account() if account is None else self._accounts[account]
            self._meters[account] = Meter(limits.requests_per_minute, limits.tokens_per_minute)
        return self._meters[account]


@dataclass(frozen=True)
class Work(Generic[Finished]):
    """What a stage asks. requests(cell): all calls it wants. finish(cell, rows by key, tally): writes its table."""

    stage: str
    ledger: Ledger
    participants: Participants
    budget: Budget
    epoch: str
    requests: Callable[[Cell], Sequence[Request]]
    finish: Callable[[Cell, Mapping[str, Row], Tally], Finished]


@dataclass(frozen=True)
class Settled:
    """A cell all of whose calls are answered: the ledger's row of each key, and what it took."""

    cell: Cell
    rows: Mapping[str, Row]
    tally: Tally


async def attempt(
    participant: Participant, request: Request, budget: Budget, stop: asyncio.Event, halted: Callable[[], bool]
) -> tuple[Outcome, int, float] | None:
    """An outcome, the calls it took, the seconds of the last one; None when halted before anything was spent.

    The one retry layer: exponential with full jitter, and never sooner than the provider asks. The outcome's cost holds
    what attempts before it may have cost.
    """
    limits, tokens = participant.entry.limits, most_tokens(participant.entry, request)
    lost_usd, seconds = 0.0, 0.0
    for number in range(1, limits.retries + 2):
        async with participant.gate.connection():
            await participant.meter.admit(tokens.prompt + tokens.completion, halted)
            if halted():
                return _given_up("interrupted", number - 1, seconds, lost_usd)
            began = time.monotonic()
            try:
                outcome = await _send(participant, request, budget)
            except TransientError as error:
                failure, seconds = error, time.monotonic() - began
            except BudgetReached:
                if lost_usd:  # first what was lost goes into the ledger; the next call meets the cap again
                    return _given_up("budget", number - 1, seconds, lost_usd)
                raise
            else:
                participant.gate.answered()
                if lost_usd:
                    outcome = replace(outcome, cost_usd=(outcome.cost_usd or 0.0) + lost_usd)
                return outcome, number, time.monotonic() - began
        if failure.kind == RATE_LIMITED:
            participant.gate.slow_down()
        if failure.kind not in UNBILLED:
            lost_usd += worst_case_usd(participant.entry, request)
        if number > limits.retries:
            return _given_up(failure.kind, number, seconds, lost_usd)
        longest = min(limits.backoff_s * 2 ** (number - 1), MAX_BACKOFF_S)
        wait = max(min(failure.retry_after_s or 0.0, MAX_RETRY_AFTER_S), random.uniform(0, longest))
        if await _stopped_within(stop, wait):
            return _given_up("interrupted", number, seconds, lost_usd)
    raise AssertionError("unreachable: the last attempt returns")


def _given_up(kind: str, attempts: int, seconds: float, lost_usd: float) -> tuple[Outcome, int, float] | None:
    """A failure for the ledger; None for a call that was never sent, or that cost nothing and will be made again."""
    if kind in ("interrupted", "budget") and not lost_usd:
        return None
    return Outcome("error", error=kind, cost_usd=lost_usd or None), attempts, seconds


async def _send(participant: Participant, request: Request, budget: Budget) -> Outcome:
    """One attempt under a reservation. Raises TransientError and BudgetReached.

    A call that was sent costs its worst case until the provider says otherwise: one that timed out may be billed.
    """
    entry = participant.entry
    worst_usd = worst_case_usd(entry, request)
    await budget.reserve(entry.id, worst_usd)
    cost_usd = worst_usd
    try:
        async with asyncio.timeout(entry.limits.timeout_s):
            outcome = await participant.backend.ask(request)
        if outcome.kind == "error":
            cost_usd = 0.0  # refused as it is: nothing was generated
        elif outcome.cost_usd is not None:
            cost_usd = outcome.cost_usd
        elif entry.prices is not None:
            outcome = replace(outcome, cost_usd=worst_usd)
        return outcome
    except TimeoutError:
        raise TransientError("timeout") from None
    except TransientError as failure:
        if failure.kind in UNBILLED:
            cost_usd = 0.0
        raise
    finally:
        await budget.settle(entry.id, worst_usd, cost_usd)


async def _stopped_within(stop: asyncio.Event, seconds: float) -> bool:
    with suppress(TimeoutError):
        await asyncio.wait_for(stop.wait(), seconds)
    return stop.is_set()


def ledger_row(
    request: Request, outcome: Outcome, attempts: int, latency_s: float, epoch: str
) -> tuple[Row, str | None]:
    """The row that stands for an answer, and its reasoning trace."""
    fields = asdict(outcome)
    reasoning = fields.pop("reasoning")
    row = {
        "key": request.key,
        "outcome": fields.pop("kind"),
        **fields,
        "attempts": attempts,
        "latency_s": round(latency_s, 6),
    }
    row |= {"epoch": epoch, "created_at": datetime.now(UTC).isoformat(), "components": request.components}
    return row, reasoning


@dataclass
class _Asking:
    """Workers over the missing requests of one evaluation."""

    work: Work[Any]
    writer: SegmentWriter
    missing: Sequence[Request]
    stop: asyncio.Event
    rows: dict[str, Row] = field(default_factory=dict)
    problems: list[Exception] = field(default_factory=list)

    async def worker(self, participant: Participant, queue: deque[Request]) -> None:
        try:
            while await self.one(participant, queue):
                pass
        except Exception as error:  # noqa: BLE001 - raised by `run`, once the calls in flight are in the ledger
            self.problems.append(error)

    async def one(self, participant: Participant, queue: deque[Request]) -> bool:
        """Ask and record one request of the queue; False when there is nothing more to do."""
        if not queue or self.halted():
            return False
        request, name = queue.popleft(), participant.entry.id
        attempted = await attempt(participant, request, self.work.budget, self.stop, self.halted)
        if attempted is None:
            return False
        row, reasoning = ledger_row(request, *attempted, self.work.epoch)
        dollars = row["cost_usd"] or 0.0
        self.writer.append(row, reasoning)
        self.work.budget.booked(name, dollars)
        self.rows[request.key] = row
        progress.current().called(self.work.stage, name, not settles(row), row["latency_s"], dollars)
        participant.breaker.watch(attempted[0])
        return True

    def halted(self) -> bool:
        """Whether no more calls are to be sent."""
        return self.stop.is_set() or bool(self.problems)

    async def sync(self) -> None:
        while True:
            await asyncio.sleep(SYNC_SECONDS)
            try:
                self.writer.sync_if_due()
            except TrapsError as error:  # a disk that cannot be synced stops new calls, as one that cannot be written
                self.problems.append(error)
                return

    async def run(self) -> None:
        """Ask all that is missing. An exception stops new calls; it is raised when those in flight are recorded."""
        queues: dict[str, deque[Request]] = {}
        for request in self.missing:
            queues.setdefault(request.participant, deque()).append(request)
        asked = [(self.work.participants[name], queue) for name, queue in queues.items()]
        syncing = asyncio.create_task(self.sync())
        try:
            async with asyncio.TaskGroup() as group:
                for participant, queue in asked:
                    for _ in range(min(participant.entry.limits.concurrency, len(queue))):
                        group.create_task(self.worker(participant, queue))
        finally:
            syncing.cancel()
        if self.problems:
            raise self.problems[0]


async def settle_evaluation(
    work: Work[Any], evaluation: Evaluation, cells: Sequence[Cell], stop: asyncio.Event
) -> AsyncIterator[Settled]:
    """Settle the cells of one evaluation, asking only what its ledger does not hold. Unfinished cells are left out.

    Requests and rows are made and read a cell at a time: none is held once its cell is finished, and a call that two
    cells share (a steered control stands in two datasets) is found by the second.
    """
    torn: set[str] = set()
    async with work.ledger.lock(evaluation.key, progress.current().note, stop.is_set):
        with work.ledger.writer(evaluation.key) as writer:
            for cell in cells:
                settled = await _settle_cell(work, cell, writer, stop, torn)
                if settled is None:
                    return  # what was answered is in the ledger
                yield settled
                del settled
                await asyncio.sleep(0)  # a cell that was all known must not keep the loop from those that are asked


async def _settle_cell(
    work: Work[Any], cell: Cell, writer: SegmentWriter, stop: asyncio.Event, torn: set[str]
) -> Settled | None:
    """Ask what is missing of a cell; None if that was stopped. torn: torn lines that a person was told of."""
    report = progress.current()
    wanted = {request.key: request for request in work.requests(cell)}
    known = work.ledger.read(cell.evaluation.key, wanted)
    for place in sorted({*known.torn} - torn):
        report.note(f"{place}: torn last line ignored (a crash cut it off); its answer is asked again")
    torn.update(known.torn)
    rows = known.settled
    missing = [request for key, request in wanted.items() if key not in rows]
    new = Counter(request.participant for request in missing)
    for name, count in Counter(request.participant for request in wanted.values()).items():
        report.asking(work.stage, name, new[name], count - new[name])
    asking = _Asking(work, writer, missing, stop)
    await asking.run()
    rows |= asking.rows
    if stop.is_set() or len(rows) < len(wanted):
        return None
    writer.sync()
    errors = sum(not settles(row) for row in rows.values())
    tally = Tally(asked=len(missing), cached=len(wanted) - len(missing), errors=errors)
    return Settled(cell, {key: rows[key] for key in wanted}, tally)


async def settle(work: Work[Any], cells: Sequence[Cell], stop: asyncio.Event) -> AsyncIterator[Settled | Exception]:
    """Settle all cells, models side by side. A model that fails yields its exception; the others go on."""
    done: asyncio.Queue[Settled | Exception | None] = asyncio.Queue()
    taken = asyncio.Semaphore(1)  # a cell waits here with its rows until the one before it is written

    async def one_model(evaluations: Sequence[tuple[Evaluation, list[Cell]]]) -> None:
        try:
            for evaluation, mine in evaluations:
                if stop.is_set():
                    return
                async for settled in settle_evaluation(work, evaluation, mine, stop):
                    await taken.acquire()
                    done.put_nowait(settled)
                    del settled
        except LockGivenUp:
            return
        except Exception as error:  # noqa: BLE001 - handed to the caller, who reports it and fails the run
            done.put_nowait(error)
        finally:
            done.put_nowait(None)

    ordered = sorted(cells, key=lambda cell: (cell.evaluation, cell.dataset))
    by_evaluation = [(e, list(mine)) for e, mine in groupby(ordered, key=lambda cell: cell.evaluation)]
    tasks = [
        asyncio.create_task(one_model(list(mine))) for _, mine in groupby(by_evaluation, key=lambda pair: pair[0].model)
    ]
    try:
        open_tasks = len(tasks)
        while open_tasks:
            settled = await done.get()
            if settled is None:
                open_tasks -= 1
            else:
                yield settled
                if isinstance(settled, Settled):
                    taken.release()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def run_work(work: Work[Finished], cells: Sequence[Cell]) -> Iterator[Finished]:
    """Settle cells and finish each (write its table) just before it is handed on. For synchronous callers.

    The first Ctrl-C stops new calls and waits for those in flight, a second one stops at once; either way
    KeyboardInterrupt is raised and the same command goes on later. A caller that closes the iterator early stops it in
    the same way. Exceptions of models are raised together after the others have finished.
    """
    loop = asyncio.new_event_loop()
    stop = asyncio.Event()
    results = settle(work, cells, stop)
    problems: list[Exception] = []
    try:
        while True:
            try:
                # Dagster sets a handler of its own around each step of this generator, so ours is set for each too.
                with _drain_on_interrupt(loop, stop):
                    settled = loop.run_until_complete(anext(results))
            except StopAsyncIteration:
                break
            except asyncio.CancelledError:
                raise KeyboardInterrupt from None
            if stop.is_set():
                continue  # drain: calls in flight are paid for and go to the ledger, no more tables are made
            if isinstance(settled, Exception):
                problems.append(settled)
            else:
                yield work.finish(settled.cell, settled.rows, settled.tally)
    finally:
        interrupted = stop.is_set()
        stop.set()
        try:
            with _drain_on_interrupt(loop, stop):
                loop.run_until_complete(_exhaust(results))
        except asyncio.CancelledError:
            raise KeyboardInterrupt from None
        finally:
            loop.close()
    if interrupted:
        raise KeyboardInterrupt
    _raise_together(work.stage, problems)


async def _exhaust(results: AsyncIterator[Any]) -> None:
    async for _ in results:
        pass


def _raise_together(stage: str, problems: Sequence[Exception]) -> None:
    """One exception for all models that failed; sentences stay sentences."""
    if problems and all(isinstance(problem, TrapsError) for problem in problems):
        kind = BudgetReached if any(isinstance(problem, BudgetReached) for problem in problems) else TrapsError
        raise kind("\n".join(sorted({str(problem) for problem in problems})))
    if len(problems) == 1:
        raise problems[0]
    if problems:
        raise ExceptionGroup(f"{stage}: {len(problems)} models failed", problems)


class _drain_on_interrupt:  # noqa: N801 - reads as a verb where it is used
    """Route SIGINT to the stop event while a loop works in the main thread, then give it back."""

    def __init__(self, loop: asyncio.AbstractEventLoop, stop: asyncio.Event) -> None:
        self._loop, self._stop = loop, stop
        self._main = threading.current_thread() is threading.main_thread()

    def __enter__(self) -> None:
        if self._main:
            self._former = signal.getsignal(signal.SIGINT)
            signal.signal(signal.SIGINT, lambda *_: self._interrupt())

    def _interrupt(self) -> None:
        if self._stop.is_set():
            self._loop.call_soon_threadsafe(self._cancel)
            return
        progress.current().note("stopping: waiting for the calls in flight (Ctrl-C again stops at once)")
        self._stop.set()
        self._loop.call_soon_threadsafe(lambda: None)  # wakes the loop from its select

    def _cancel(self) -> None:
        for task in asyncio.all_tasks(self._loop):
            task.cancel()

    def __exit__(self, *_: object) -> None:
        if self._main:
            signal.signal(signal.SIGINT, self._former or signal.SIG_DFL)
