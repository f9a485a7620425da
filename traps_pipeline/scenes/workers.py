"""One process a core for work that draws: results in the order of the jobs, workers recycled, nobody left behind."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from itertools import islice
from multiprocessing import get_context
from typing import TypeVar

from traps_pipeline.base.cores import cores

JOBS_A_WORKER = 100  # GL drivers leak: a worker does so many jobs, then another takes over
Job = TypeVar("Job")
Result = TypeVar("Result")


def run_in_order(
    function: Callable[[Job], Result],
    jobs: Iterable[Job],
    workers: int | None = None,
    *,
    ahead: int | None = None,
    least: int = 1,
) -> Iterator[tuple[Job, Result]]:
    """Results of a picklable function over jobs, in their order. Jobs are taken late: a few ahead of what is yielded,
    and no more than `ahead` at a time, for who may want no further result soon. least: of 2, a single worker has its
    next job already while the caller deals with a result.

    A GL context belongs to a process, so each worker keeps its own. Closing the iterator cancels what has not begun.
    """
    workers = workers or cores()
    source = iter(jobs)
    more = True
    while more:  # a fresh pool for each round: recycling inside a pool can deadlock (CPython 3.11)
        batch = islice(source, workers * JOBS_A_WORKER)
        most = max(least, 2 * workers - 1)
        more = yield from _one_pool(function, batch, workers, min(most, ahead or most))


def _one_pool(
    function: Callable[[Job], Result], batch: Iterator[Job], workers: int, ahead: int
) -> Iterator[tuple[Job, Result]]:
    first = list(islice(batch, ahead))  # a job begun cannot be cancelled: one worker runs ahead where that is asked for
    if not first:
        return False
    context = get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_begin_worker, initargs=(os.getpid(),))
    try:
        pending: deque[tuple[Job, Future[Result]]] = deque((job, pool.submit(function, job)) for job in first)
        while pending:
            job, future = pending.popleft()
            yield job, future.result()
            pending.extend((later, pool.submit(function, later)) for later in islice(batch, 1))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    return True


def _begin_worker(parent: int) -> None:
    """Leave Ctrl-C to the parent, and do not outlive it when it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
