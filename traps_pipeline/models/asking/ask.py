"""Ask for the wanted calls that the ledger lacks, and yield complete cells.

The same code asks models and judges, reference ones and paid ones. There is no resume mode: a crash, a second run and a
correction are the same operation (docs/models.md, "Ledger").
"""

import asyncio
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, Generic, TypeVar

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.progress import Tally
from traps_pipeline.ledger.ledger import Ledger, LockGivenUp
from traps_pipeline.ledger.rows import is_settled
from traps_pipeline.models.asking.backends import make_backend
from traps_pipeline.models.asking.draining import drain_on_interrupt
from traps_pipeline.models.asking.participants import Participants, Row
from traps_pipeline.models.asking.refusals import CONTROL, RefusedCalls, control_outcome, refusal, refused_calls
from traps_pipeline.models.asking.workers import Asking, EvaluationState, HeldRow
from traps_pipeline.models.money.budget import Budget, BudgetReached
from traps_pipeline.models.money.spending import open_budget, share_accounts
from traps_pipeline.models.registry.entries import NETWORK, Entry
from traps_pipeline.models.request import Backend, Request
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
    """A cell whose calls are all answered, with the ledger's row of each key, and counts of the calls."""

    cell: AnyCell
    calls: Sequence[AnyCall]
    rows: Mapping[str, Row]
    tally: Tally

    def answered(self) -> Iterator[tuple[AnyCall, Row]]:
        """Yield each call with its ledger row."""
        return ((call, self.rows[call.request.key]) for call in self.calls)

    def output(self, row_of: Callable[[AnyCell, AnyCall, Row], Any]) -> tuple[AnyCell, StageOutput]:
        """Return the cell and its table, one row per call, with the counts of its calls."""
        dollars = sum(row["cost_usd"] or 0.0 for row in self.rows.values())
        shown = {"wanted": len(self.rows), "dollars": round(dollars, 6)}
        return self.cell, StageOutput([row_of(self.cell, *pair) for pair in self.answered()], self.tally, shown)


@dataclass(frozen=True)
class Work(Generic[AnyCell, AnyCall, Finished]):
    """The calls of a stage to be asked: of whom, under which budget, by cell, and how its table is made."""

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


_AHEAD = 64  # calls of cells that are begun, beyond which another waits for the first: their rows are held


class _CellTask(Generic[AnyCell, AnyCall]):
    """A cell that is being settled. before: cells of its evaluation that were begun before it.

    keys: those of its calls. n_missing: how many the ledger lacks. all_sent: set once no call of it waits to be sent.
    """

    def __init__(
        self,
        work: Work[AnyCell, AnyCall, Any],
        cell: AnyCell,
        its: EvaluationState,
        before: "Sequence[_CellTask[AnyCell, AnyCall]]",
    ) -> None:
        self._work, self._cell, self._its = work, cell, its
        self.keys, self.n_missing, self.all_sent = set[str](), 0, asyncio.Event()
        self.task = asyncio.create_task(self._settle(before))
        self.task.add_done_callback(lambda _: self.all_sent.set())

    async def _settle(self, before: "Sequence[_CellTask[AnyCell, AnyCall]]") -> SettledCell[AnyCell, AnyCall] | None:
        """Ask for the missing calls; return None if that was stopped."""
        try:
            calls = self._work.calls(self._cell)
            requests = {call.request.key: call.request for call in calls}
            self.keys.update(requests)
            for other in before:
                if other.keys & self.keys:  # a call that two cells share (a steered control) is paid once
                    await asyncio.wait([other.task])
            rows, asker = await self._ask_missing(requests)
            if self._its.stop.is_set() or len(rows) < len(requests):
                return None
            for refused in refused_calls(requests.values(), rows):
                rows |= await _settle_refusals(asker, refused, rows)
            if self._its.stop.is_set():
                return None
            await self._its.writer.sync()
        except BaseException:
            self._its.is_over = True
            raise
        errors = sum(not is_settled(row) for row in rows.values())
        tally = Tally(asked=len(asker.missing), cached=len(requests) - len(asker.missing), errors=errors)
        return SettledCell(self._cell, calls, {key: rows[key] for key in requests}, tally)

    async def _ask_missing(self, requests: Mapping[str, Request]) -> tuple[dict[str, Row], Asking]:
        """Ask for the requests that the ledger lacks; return the rows of all that were answered, and the asker."""
        work, its, report = self._work, self._its, progress.current()
        recorded_rows = await asyncio.to_thread(work.ledger.read, self._cell.evaluation.key, requests)
        for location in sorted({*recorded_rows.notes} - its.reported):
            report.note(f"{location}: {recorded_rows.notes[location]}")
        its.reported.update(recorded_rows.notes)
        rows: dict[str, Row] = {key: HeldRow(row) for key, row in recorded_rows.settled.items()}
        missing = [request for key, request in requests.items() if key not in rows]
        if not work.is_counted:
            counts = Counter((request.participant, key in rows) for key, request in requests.items())
            report.asking(work.stage, _by_name(counts), self._cell.share)
        self.n_missing = len(missing)
        asker = Asking(its, missing, self.all_sent)
        await asker.run()
        return rows | asker.rows, asker


async def settle_evaluation(
    work: Work[AnyCell, AnyCall, Any], evaluation: Evaluation, cells: Sequence[AnyCell], stop: asyncio.Event
) -> AsyncIterator[SettledCell[AnyCell, AnyCall]]:
    """Ask for the missing calls of one evaluation's cells; yield the answered cells in order.

    While the last calls of a cell are in flight, those of the next are sent, so that no connection is idle.
    """
    async with work.ledger.writing(evaluation.key, progress.current().note, stop.is_set) as writer:
        its = EvaluationState(work.participants, work.budget, work.epoch, writer, stop)
        upcoming, begun = deque(cells), deque[_CellTask[AnyCell, AnyCall]]()
        try:
            while upcoming or begun:
                is_full = bool(begun) and (not begun[0].n_missing or sum(each.n_missing for each in begun) >= _AHEAD)
                if upcoming and not is_full:
                    begun.append(_CellTask(work, upcoming.popleft(), its, [*begun]))
                    await begun[-1].all_sent.wait()
                    continue
                if (settled_cell := await begun[0].task) is None:
                    await asyncio.gather(*(each.task for each in begun))  # raises why, unless all was stopped
                    return  # finished answers are in the ledger
                begun.popleft()
                yield settled_cell
                del settled_cell
        finally:
            its.is_over = True
            await asyncio.gather(*(each.task for each in begun), return_exceptions=True)  # records calls in flight


async def _settle_refusals(asker: Asking, calls: RefusedCalls, rows: Mapping[str, Row]) -> dict[str, Row]:
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
    """Ask for the missing calls of all cells, models in parallel; a failing model yields its exception."""
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
    """Ask for the missing calls of all cells; yield each cell once its table is written.

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
