"""Processes that draw: who does which job, when jobs are taken, and what ends them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool
from itertools import count

import pytest

from traps_pipeline.base import workers
from traps_pipeline.base.workers import keep_workers, run_in_order


def who(job: int) -> int:
    """The process that does a job; a negative one is its end."""
    if job < 0:
        os._exit(1)
    return os.getpid()


@pytest.mark.slow
def test_a_worker_gives_way_after_so_many_jobs_also_where_it_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "JOBS_A_WORKER", 3)
    with keep_workers():
        pids = [pid for jobs in (2, 5) for _, pid in run_in_order(who, range(jobs), 1)]
    assert pids == [pids[0]] * 3 + [pids[3]] * 3 + [pids[6]] and len(set(pids)) == 3


@pytest.mark.promise
def test_after_a_worker_died_the_next_call_has_others_and_after_an_early_stop_the_same() -> None:
    with keep_workers():
        with pytest.raises(BrokenProcessPool):
            list(run_in_order(who, [0, -1, 0], 1))
        results = run_in_order(who, count(), 1)
        _, one = next(results)
        results.close()  # type: ignore[attr-defined]
        assert {pid for _, pid in run_in_order(who, range(2), 1)} == {one}


def test_ctrl_c_says_what_it_waits_for(capsys: pytest.CaptureFixture[str]) -> None:
    results = run_in_order(who, count(), 1)
    next(results)
    with pytest.raises(KeyboardInterrupt):
        results.throw(KeyboardInterrupt())  # type: ignore[attr-defined]
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.promise
def test_ctrl_c_while_a_worker_is_started_leaves_no_process_waiting() -> None:
    """The executor never learns of such a worker, and Python waits at its end for every child."""
    script = """
import os, signal, time
from multiprocessing.context import SpawnProcess
from traps_pipeline.base.workers import run_in_order

start = SpawnProcess.start

def interrupted(self):
    start(self)
    SpawnProcess.start = start
    time.sleep(3)  # the worker waits for a job by then
    os.kill(os.getpid(), signal.SIGINT)

SpawnProcess.start = interrupted
if __name__ == "__main__":
    list(run_in_order(abs, range(3), 1))
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert "KeyboardInterrupt" in result.stderr and result.returncode == -signal.SIGINT
