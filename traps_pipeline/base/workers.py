"""Render in recycled worker processes, one per core; yield results in job order."""

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import chain, islice
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import TypeVar

from traps_pipeline.base import progress
from traps_pipeline.base.cores import cores

JOBS_A_WORKER = 100  # GL drivers leak: a worker does so many jobs, then another takes over
Job = TypeVar("Job")
Result = TypeVar("Result")


class _Pool:
    """Worker processes, and how many jobs they do before others take over."""

    def __init__(self, workers: int) -> None:
        self.workers, self.left = workers, workers * JOBS_A_WORKER
        context = get_context("spawn")
        lifeline, self._lifeline = context.Pipe(duplex=False)
        self.executor = ProcessPoolExecutor(
            workers, mp_context=context, initializer=_begin_worker, initargs=(os.getpid(), lifeline)
        )

    def end(self) -> None:
        try:
            self.executor.shutdown(wait=True, cancel_futures=True)
        finally:  # ends a worker that the executor does not know: Ctrl-C came while it was started
            self._lifeline.close()


_idle: list[_Pool] | None = None  # idle pools of `keep_workers`


@contextmanager
def keep_workers() -> Iterator[None]:
    """Keep idle workers for the block's next `run_in_order`, as starting one is slow."""
    global _idle
    if _idle is not None:
        yield
        return
    _idle = []
    try:
        yield
    finally:
        idle_pool, _idle = _idle, None
        for pool in idle_pool:
            pool.end()


def run_in_order(
    function: Callable[[Job], Result],
    jobs: Iterable[Job],
    workers: int | None = None,
    *,
    ahead: int | None = None,
    at_once: bool = False,
) -> Iterator[tuple[Job, Result]]:
    """Yield results of a picklable function over jobs, in their order.

    Jobs are taken lazily: a few ahead of the last yielded result, and at most `ahead` at a time, for callers that may
    stop early. at_once: take the next job before a result is yielded, so that no worker waits while the caller uses it.

    A GL context belongs to a process, so each worker keeps its own. Closing the iterator cancels pending jobs.
    """
    workers = workers or cores()
    max_pending = min(2 * workers - 1, ahead or 2 * workers)
    source = iter(jobs)
    for job in source:  # a fresh pool after so many: recycling inside a pool can deadlock (CPython 3.11)
        with _pool(workers) as pool:
            yield from _in_order(function, chain([job], source), pool, max_pending, at_once=at_once)


@contextmanager
def _pool(workers: int) -> Iterator[_Pool]:
    pool = _idle.pop() if _idle else None
    if pool is not None and pool.workers != workers:
        pool.end()
        pool = None
    pool = pool or _Pool(workers)
    try:
        yield pool
    except BrokenProcessPool:
        pool.left = 0
        raise
    finally:
        if pool.left and _idle is not None:
            _idle.append(pool)
        else:
            pool.end()


def _in_order(
    function: Callable[[Job], Result], jobs: Iterator[Job], pool: _Pool, ahead: int, *, at_once: bool
) -> Iterator[tuple[Job, Result]]:
    batch, pending = islice(jobs, pool.left), deque[tuple[Job, Future[Result]]]()

    def submit(count: int) -> None:
        for job in islice(batch, count):
            pool.left -= 1
            pending.append((job, pool.executor.submit(function, job)))

    try:
        submit(ahead)  # a job that is begun cannot be cancelled
        while pending:
            job, future = pending.popleft()
            result = future.result()
            submit(at_once)
            yield job, result
            submit(not at_once)
    except BaseException as error:
        if not isinstance(error, Exception | GeneratorExit):  # Ctrl-C
            progress.current().note("stopping: waiting for the scenes in progress")
        raise
    finally:
        wait([future for _, future in pending if not future.cancel()])


def _begin_worker(parent: int, lifeline: Connection) -> None:
    """Leave Ctrl-C to the parent, and outlive neither it nor its pool."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent and not lifeline.poll(1.0):  # nothing is sent: there is only its end
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
