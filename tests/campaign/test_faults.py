"""Kills and failing disks at chosen system calls, all through a study from items to the leaderboard: the tables at the
end are those of an undisturbed study, and no call is made twice.

`TRAPS_FAULTS=100` tries so many of each kind in place of the few that the test run affords.
"""

from __future__ import annotations

import os
import random
import re
import shutil
import sys

import pytest

from tests.conftest import Checkout, Finished
from tests.integration.test_crashes import ANSWERS, ONE_REGIME, VOTES, assert_same_tables

pytestmark = pytest.mark.slow
FAULTS = int(os.environ.get("TRAPS_FAULTS", "3"))
# How a file gets its content, its name and its place on the disk; SQLite writes by pwrite64 and fdatasync.
CALLS = "fsync,fdatasync,rename,ftruncate,pwrite64"
ERRORS = ("ENOSPC", "EIO", "EROFS", "EDQUOT")


def run_with(study: Checkout, fault: str, when: int) -> Finished:
    """`traps run` with a fault at the n-th of `CALLS`."""
    traced = ("strace", "-f", "-qq", "-o", "/dev/null", "--seccomp-bpf", "-e", f"trace={CALLS}")
    traps = (sys.executable, "-m", "traps_pipeline.cli", "run", ONE_REGIME, "--until", "leaderboard")
    return study.run(*traced, "-e", f"inject={CALLS}:{fault}:when={when}", *traps)


def assert_whole(study: Checkout, undisturbed: Checkout) -> None:
    finished = study.score(ONE_REGIME)
    assert finished.code == 0, finished.err
    for kind, wanted in (("answers", ANSWERS), ("votes", VOTES)):
        keys = [row["key"] for row in study.ledger_rows(kind)]
        assert len(keys) == len(set(keys)) == wanted
    assert_same_tables(study.workspace, undisturbed.workspace)


@pytest.fixture
def traced() -> None:
    if shutil.which("strace") is None:
        pytest.skip("strace is not installed (make test installs it)")


def test_kills_at_system_calls_lose_nothing_and_ask_nothing_twice(
    traced: None, unasked: Checkout, one_regime: Checkout
) -> None:
    draw, killed = random.Random(20261122), 0
    while killed < FAULTS:
        finished = run_with(unasked, "signal=KILL", draw.randint(1, 2000 // FAULTS + 20))
        if finished.code == 0:  # it came to its end before the call
            shutil.rmtree(unasked.workspace / "tables" / "verdicts")
            continue
        assert "Traceback" not in finished.err, finished.err
        killed += 1
    assert_whole(unasked, one_regime)


def test_a_disk_that_fails_at_a_system_call_is_named_and_nothing_is_lost(
    traced: None, unasked: Checkout, one_regime: Checkout
) -> None:
    draw, failed = random.Random(20261123), 0
    while failed < FAULTS:
        error = draw.choice(ERRORS)
        finished = run_with(unasked, f"error={error}", draw.randint(1, 2000 // FAULTS + 20))
        assert "Traceback" not in finished.err + finished.out, finished.err
        if finished.code == 0:
            shutil.rmtree(unasked.workspace / "tables" / "verdicts")
            continue
        assert finished.code == 1, (error, finished.err)
        assert re.search(rf"{re.escape(str(unasked.workspace))}[^\n]*\(", finished.err + finished.out), finished.err
        failed += 1
    assert_whole(unasked, one_regime)
