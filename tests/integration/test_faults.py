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
from collections import Counter
from pathlib import Path

import pytest

from tests.conftest import Checkout, Finished, copied, forget_answers
from tests.integration.test_crashes import ANSWERS, ONE_REGIME, VOTES, assert_same_tables

pytestmark = pytest.mark.slow
FAULTS = int(os.environ.get("TRAPS_FAULTS", "3"))
# How a file gets its content, its name and its place on the disk; SQLite writes by pwrite64 and fdatasync.
CALLS = "fsync,fdatasync,rename,ftruncate,pwrite64"
ERRORS = ("ENOSPC", "EIO", "EROFS", "EDQUOT")


def traced(study: Checkout, log: Path | str, *more: str) -> Finished:
    """`traps run` under strace. (With --seccomp-bpf, strace would be faster and inject no signal.)"""
    strace = ("strace", "-f", "-qq", "-o", log, "-e", f"trace={CALLS}", *more)
    traps = (sys.executable, "-m", "traps_pipeline.cli", "run", ONE_REGIME, "--until", "leaderboard")
    return study.run(*strace, *traps)


@pytest.fixture(scope="module")
def calls(small: Checkout, tmp_path_factory: pytest.TempPathFactory) -> dict[str, int]:
    """How often the busiest thread of a whole run makes each of `CALLS`: strace counts by thread and call."""
    if shutil.which("strace") is None:
        pytest.skip("strace is not installed (make test installs it)")
    folder = tmp_path_factory.mktemp("counted")
    finished = traced(forget_answers(copied(small, folder)), folder / "calls")
    assert finished.code == 0, finished.err
    found = Counter(re.findall(r"^(\d+) +(\w+)\(", (folder / "calls").read_text(), re.MULTILINE))
    return {call: max(n for (_, name), n in found.items() if name == call) for call in {name for _, name in found}}


def drawn(draw: random.Random, calls: dict[str, int], fault: str) -> str:
    """A fault at one of the calls of a whole run, each kind of call as likely as the others."""
    call = draw.choice(sorted(calls))
    return f"inject={call}:{fault}:when={draw.randint(1, calls[call])}"


def assert_whole(study: Checkout, undisturbed: Checkout) -> None:
    finished = study.score(ONE_REGIME)
    assert finished.code == 0, finished.err
    for kind, wanted in (("answers", ANSWERS), ("votes", VOTES)):
        keys = [row["key"] for row in study.ledger_rows(kind)]
        assert len(keys) == len(set(keys)) == wanted
    assert_same_tables(study.workspace, undisturbed.workspace)


def test_kills_at_system_calls_lose_nothing_and_ask_nothing_twice(
    calls: dict[str, int], unasked: Checkout, one_regime: Checkout
) -> None:
    draw, killed = random.Random(20261122), 0
    for _ in range(FAULTS):
        finished = traced(unasked, "/dev/null", "-e", drawn(draw, calls, "signal=KILL"))
        assert "Traceback" not in finished.err, finished.err
        killed += finished.code != 0
        if finished.code == 0:  # so much was there already that it came to its end
            assert_whole(unasked, one_regime)
            forget_answers(unasked)
    assert killed > FAULTS / 3
    assert_whole(unasked, one_regime)


def test_a_disk_that_fails_at_a_system_call_is_named_and_nothing_is_lost(
    calls: dict[str, int], unasked: Checkout, one_regime: Checkout
) -> None:
    draw, failed = random.Random(20261123), 0
    for _ in range(FAULTS):
        error = draw.choice(ERRORS)
        finished = traced(unasked, "/dev/null", "-e", drawn(draw, calls, f"error={error}"))
        assert "Traceback" not in finished.err + finished.out, finished.err
        failed += finished.code != 0
        if finished.code == 0:
            assert_whole(unasked, one_regime)
            forget_answers(unasked)
        else:
            assert str(unasked.workspace) in finished.err + finished.out, (error, finished.err)
    assert failed > FAULTS / 3
    assert_whole(unasked, one_regime)
