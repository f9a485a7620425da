"""Ask for the wanted calls that the ledger lacks, and yield complete cells.

The same code asks models and judges, reference ones and paid ones. There is no resume mode: a crash, a second run and a
correction are the same operation (docs/models.md, "Ledger").
"""

import asyncio
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any, ClassVar, Generic, TypeVar

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.progress import Tally
from traps_pipeline.ledger.ledger import SYNC_S, Ledger, LockGivenUp, Writer
from traps_pipeline.ledger.rows import is_settled
from traps_pipeline.models.asking.backends import make_backend
from traps_pipeline.models.asking.draining import drain_on_interrupt
from traps_pipeline.models.asking.participants import CallContext, Participant, Participants, Row, ask_once, ledger_row
from traps_pipeline.models.asking.refusals import CONTROL, RefusedCalls, control_outcome, refusal, refused_calls
from traps_pipeline.models.money.budget import Budget, BudgetReached
from traps_pipeline.models.money.spending import open_budget, share_accounts
from traps_pipeline.models.registry.entries import NETWORK, Entry
from traps_pipeline.models.request import Backend, Outcome, Request
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.workspace import Workspace


@dataclass(frozen=True)
class Call:
    """A call that a stage wants; each stage's subclass adds its table's columns."""

    request: Request


AnyCell = TypeVar("AnyCell", bound=Cell)
AnyCall = TypeVar("AnyCall", bound=Call)
Finished = TypeVar("Finished")


@dataclass(frozen=True)
class SettledCell(Generic[AnyCell, AnyCall]):
    """A cell whose calls are all answered, the ledger's row of each key, and a tally."""

    cell: AnyCell
    calls: Sequence[AnyCall]
    rows: Mapping[str, Row]
    tally: Tally

    def answered(self) -> Iterator[tuple[AnyCall, Row]]:
        """Return each call with its ledger row."""
        return ((call, self.rows[call.request.key]) for call in self.calls)

    def output(self, row_of: Callable[[AnyCell, AnyCall, Row], Any]) -> tuple[AnyCell, StageOutput]:
        """Return the cell and its table, one row per call, with the tally of its calls."""
        dollars = sum(row["cost_usd"] or 0.0 for row in self.rows.values())
        shown = {"wanted": len(self.rows), "dollars": round(dollars, 6)}
        return self.cell, StageOutput([row_of(self.cell, *pair) for pair in self.answered()], self.tally, shown)


@dataclass(frozen=True)
class Work(Generic[AnyCell, AnyCall, Finished]):
    """A stage's calls by cell, and `finish`, which makes its table."""

    stage: str
    ledger: Ledger
    participants: Participants
    budget: Budget
    epoch: str
    calls: Callable[[AnyCell], Sequence[AnyCall]]
    finish: Callable[[SettledCell[AnyCell, AnyCall]], Finished]
    is_counted: bool = False  # the progress was told of all calls before the first


def collect_outcomes(
    workspace: Workspace,
    stage: str,
    ledger: Ledger,
    entries: Iterable[Entry],
    cells: Sequence[AnyCell],
    calls: Callable[[AnyCell], Sequence[AnyCall]],
    finish: Callable[[SettledCell[AnyCell, AnyCall]], Finished],
    make: Callable[[Entry], Backend] = make_backend,
) -> Iterator[Finished]:
    """Ask participants for missing calls under the budget; yield each finished cell.

    entries: all participants of the calls. make: returns an entry's backend. `run_work` documents exceptions and
    Ctrl-C.
    """
    entry_of = {entry.id: entry for entry in entries}
    with (
        workspace.ledger.writing(),
        share_accounts(workspace, entry_of.values()) as sharers,
        open_budget(workspace, entry_of.values()) as budget,
    ):
        if any(entry.prices for entry in entry_of.values()):
            progress.current().money(budget.spent_usd, workspace.study.budget_usd)
        participants = Participants(entry_of, make, workspace.study, sharers=sharers)
        is_slow = any(entry.backend == NETWORK for entry in entry_of.values())
        work = Work(stage, ledger, participants, budget, workspace.study.epoch, calls, finish, is_slow)
        if is_slow:
            _expect(work, cells)
        yield from run_work(work, cells)


def _expect(work: Work[AnyCell, Any, Any], cells: Sequence[AnyCell]) -> None:
    """Tell the progress of the missing calls of all cells."""
    totals = Counter[tuple[str, bool]]()
    for evaluation, evaluation_cells in _by_evaluation(cells):
        counted = set[str]()
        for cell in evaluation_cells:
            with suppress(TrapsError):  # the cell's own turn raises it
                requests = [call.request for call in work.calls(cell) if call.request.key not in counted]
                counted.update(request.key for request in requests)
                recorded = work.ledger.read(evaluation.key, [request.key for request in requests]).settled
                totals.update((request.participant, request.key in recorded) for request in requests)
    progress.current().expect(work.stage, _by_name(totals), sum(cell.share for cell in cells))


def _by_name(counts: Counter[tuple[str, bool]]) -> dict[str, tuple[int, int]]:
    """Return the numbers of missing and of recorded calls by model or judge."""
    return {name: (counts[name, False], counts[name, True]) for name, _ in counts}


def _by_evaluation(cells: Sequence[AnyCell]) -> list[tuple[Evaluation, list[AnyCell]]]:
    ordered = sorted(cells, key=lambda cell: (cell.evaluation, cell.dataset))
    return [(evaluation, list(group)) for evaluation, group in groupby(ordered, key=lambda cell: cell.evaluation)]


@dataclass
class _Asking:
    """Workers over an evaluation's missing requests. again: what to record of a call that is repeated to settle it."""

    work: Work[Any, Any, Any]
    writer: Writer
    missing: Sequence[Request]
    stop: asyncio.Event
    again: Callable[[Outcome], Outcome] | None = None
    rows: dict[str, Row] = field(default_factory=dict)
    problems: list[Exception] = field(default_factory=list)

    async def worker(self, participant: Participant, queue: deque[Request]) -> None:
        try:
            while await self.one(participant, queue):
                pass
        except Exception as error:  # noqa: BLE001 - raised by `run`, once the calls in flight are in the ledger
            self.problems.append(error)

    async def one(self, participant: Participant, queue: deque[Request]) -> bool:
        """Ask and record one request of the queue; return False if none is left."""
        if not queue or self.halted():
            return False
        request, name = queue.popleft(), participant.entry.id
        context = CallContext(self.work.budget, self.stop, self.halted, self.writer.require)
        attempt_result = await ask_once(participant, request, context)
        if attempt_result is None:
            return False
        outcome = attempt_result[0] if self.again is None else self.again(attempt_result[0])
        row = await self.write(request, outcome, *attempt_result[1:], [each.id for each in context.paid_by])
        progress.current().called(name, not is_settled(row), row["latency_s"], row["cost_usd"] or 0.0)
        if self.again is None:
            participant.breaker.watch(outcome)
        return True

    async def write(self, request: Request, outcome: Outcome, attempts: int, seconds: float, paid_by: list[str]) -> Row:
        row, side_texts = ledger_row(request, outcome, attempts, seconds, self.work.epoch)
        await self.writer.write(row, side_texts, paid_by)
        self.rows[request.key] = _Held(row)
        return row

    def halted(self) -> bool:
        """Return whether to stop sending calls."""
        return self.stop.is_set() or bool(self.problems)

    async def sync(self) -> None:
        while True:
            await asyncio.sleep(SYNC_S)
            try:
                await self.writer.sync()
            except TrapsError as error:  # a disk that cannot be synced stops new calls
                self.problems.append(error)
                return

    async def run(self) -> None:
        """Ask for all that is missing; record calls in flight before raising an error."""
        queues: dict[str, deque[Request]] = {}
        for request in self.missing:
            queues.setdefault(request.participant, deque()).append(request)
        queue_of = [(self.work.participants[name], queue) for name, queue in queues.items()]
        sync_task = asyncio.create_task(self.sync())
        try:
            async with asyncio.TaskGroup() as group:
                for participant, queue in queue_of:
                    for _ in range(min(participant.entry.limits.concurrency, len(queue))):
                        group.create_task(self.worker(participant, queue))
        finally:
            sync_task.cancel()
        if self.problems:
            raise self.problems[0]


class _Held(Mapping[str, Any]):
    """A ledger row without its components, which the request holds too."""

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


@dataclass(frozen=True)
class _Evaluation:
    """State that the cells of an evaluation share: writer, and ledger places reported."""

    writer: Writer
    reported: set[str]


async def settle_evaluation(
    work: Work[AnyCell, AnyCall, Any], evaluation: Evaluation, cells: Sequence[AnyCell], stop: asyncio.Event
) -> AsyncIterator[SettledCell[AnyCell, AnyCall]]:
    """Settle one evaluation's cells by asking missing calls; yield the finished ones.

    Calls and rows are held one cell at a time; a call that two cells share (a steered control) is found by the second.
    """
    reported_keys = set[str]()
    async with work.ledger.writing(evaluation.key, progress.current().note, stop.is_set) as writer:
        for cell in cells:
            settled_cell = await _settle_cell(work, cell, _Evaluation(writer, reported_keys), stop)
            if settled_cell is None:
                return  # finished answers are in the ledger
            yield settled_cell
            del settled_cell
            await asyncio.sleep(0)  # let the loop run calls of other cells after a fully known one


async def _settle_cell(
    work: Work[AnyCell, AnyCall, Any], cell: AnyCell, its: _Evaluation, stop: asyncio.Event
) -> SettledCell[AnyCell, AnyCall] | None:
    """Ask for a cell's missing calls; return None if that was stopped."""
    report = progress.current()
    calls = work.calls(cell)
    requests = {call.request.key: call.request for call in calls}
    recorded_rows = await asyncio.to_thread(work.ledger.read, cell.evaluation.key, requests)
    for location in sorted({*recorded_rows.notes} - its.reported):
        report.note(f"{location}: {recorded_rows.notes[location]}")
    its.reported.update(recorded_rows.notes)
    rows = {key: _Held(row) for key, row in recorded_rows.settled.items()}
    missing = [request for key, request in requests.items() if key not in rows]
    if not work.is_counted:
        counts = Counter((request.participant, key in rows) for key, request in requests.items())
        report.asking(work.stage, _by_name(counts), cell.share)
    asker = _Asking(work, its.writer, missing, stop)
    await asker.run()
    rows |= asker.rows
    if stop.is_set() or len(rows) < len(requests):
        return None
    for refused in refused_calls(requests.values(), rows):
        rows |= await _settle_refusals(asker, refused, rows)
    if stop.is_set():
        return None
    await its.writer.sync()
    errors = sum(not is_settled(row) for row in rows.values())
    tally = Tally(asked=len(missing), cached=len(requests) - len(missing), errors=errors)
    return SettledCell(cell, calls, {key: rows[key] for key in requests}, tally)


async def _settle_refusals(asker: _Asking, calls: RefusedCalls, rows: Mapping[str, Row]) -> dict[str, Row]:
    """Ask refused calls again, then one that was answered; return the new rows of the former."""
    again = replace(asker, missing=calls.refused, again=lambda outcome: outcome, rows={})
    await again.run()
    refused = [call for call in calls.refused if again.rows.get(call.key, {}).get("error") == rows[call.key]["error"]]
    control = replace(asker, missing=[calls.control] if refused else [], again=control_outcome, rows={})
    await control.run()
    if any(row["error"] == CONTROL for row in control.rows.values()):
        for call in refused:
            await again.write(call, refusal(row := again.rows[call.key]), row["attempts"], row["latency_s"], [])
    return again.rows


async def settle(
    work: Work[AnyCell, AnyCall, Any], cells: Sequence[AnyCell], stop: asyncio.Event
) -> AsyncIterator[SettledCell[AnyCell, AnyCall] | Exception]:
    """Settle all cells, models in parallel; a failing model yields its exception."""
    results: asyncio.Queue[SettledCell[AnyCell, AnyCall] | Exception | None] = asyncio.Queue()
    write_turn = asyncio.Semaphore(1)  # a cell waits here with its rows until the one before it is written

    async def one_model(evaluations: Sequence[tuple[Evaluation, list[AnyCell]]]) -> None:
        try:
            for evaluation, evaluation_cells in evaluations:
                if stop.is_set():
                    return
                async for settled_cell in settle_evaluation(work, evaluation, evaluation_cells, stop):
                    await write_turn.acquire()
                    results.put_nowait(settled_cell)
                    del settled_cell
        except LockGivenUp:
            return
        except Exception as error:  # noqa: BLE001 - handed to the caller, who reports it and fails the run
            results.put_nowait(error)
        finally:
            results.put_nowait(None)

    tasks = [
        asyncio.create_task(one_model(list(group)))
        for _, group in groupby(_by_evaluation(cells), key=lambda pair: pair[0].model)
    ]
    try:
        open_tasks = len(tasks)
        while open_tasks:
            settled_cell = await results.get()
            if settled_cell is None:
                open_tasks -= 1
            else:
                yield settled_cell
                if isinstance(settled_cell, SettledCell):
                    write_turn.release()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def run_work(work: Work[AnyCell, AnyCall, Finished], cells: Sequence[AnyCell]) -> Iterator[Finished]:
    """Settle cells and finish each (write its table) just before it is yielded.

    The first Ctrl-C, SIGTERM or SIGHUP stops new calls and waits for those in flight, a second one stops at once;
    either way KeyboardInterrupt is raised and the same command continues later. A caller that closes the iterator early
    stops it in the same way. Exceptions of models are raised together after the others have finished.
    """
    loop, stop = asyncio.new_event_loop(), asyncio.Event()
    results, problems = settle(work, cells, stop), list[Exception]()
    try:
        while True:
            try:
                # Dagster sets a handler of its own around each step of this generator, so ours is set for each too.
                with drain_on_interrupt(loop, stop):
                    settled_cell = loop.run_until_complete(anext(results))
            except StopAsyncIteration:
                break
            except asyncio.CancelledError:
                raise KeyboardInterrupt from None
            if stop.is_set():
                continue  # drain: calls in flight are paid for and go to the ledger, no more tables are built
            if isinstance(settled_cell, Exception):
                problems.append(settled_cell)
            else:
                yield work.finish(settled_cell)
    finally:
        interrupted = stop.is_set()
        stop.set()
        try:
            with drain_on_interrupt(loop, stop):
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
    """Return one exception for all failed models; sentences stay sentences."""
    if problems and all(isinstance(problem, TrapsError) for problem in problems):
        kind = BudgetReached if any(isinstance(problem, BudgetReached) for problem in problems) else TrapsError
        raise kind("\n".join(sorted({str(problem) for problem in problems})))
    if len(problems) == 1:
        raise problems[0]
    if problems:
        causes = "; ".join(sorted({f"{type(problem).__name__}: {problem}" for problem in problems}))
        raise ExceptionGroup(f"{stage}: {causes}", problems)
