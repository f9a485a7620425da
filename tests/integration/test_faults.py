"""Kills and failing disks at chosen system calls, all through a study from items to the leaderboard: the tables at the
end are those of an undisturbed study, and no call is made twice.

`TRAPS_FAULTS=100` tries so many of each kind in place of the few that the test run affords, and then through every
stage, from records to the report and into a model.
"""

from __future__ import annotations

import os
import random
import re
import shutil
import signal
import sqlite3
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.build.inside import with_mechanism
from tests.build.studies import ONE_REGIME, assert_same_tables
from tests.conftest import Checkout, Finished, copied, copy_workspace, forget_answers

pytestmark = pytest.mark.slow
MANY = os.environ.get("TRAPS_FAULTS")
FAULTS = int(MANY or 5)
HELD_US = 10**9  # longer than any test
# How a file gets its content, its name and its place on the disk; SQLite writes by pwrite64 and fdatasync.
CALLS = "fsync,fdatasync,rename,ftruncate,pwrite64"
ERRORS = ("ENOSPC", "EIO", "EROFS", "EDQUOT")


@dataclass(frozen=True)
class Campaign:
    """A study to be disturbed: its command, what it is set back to, what it comes to if it is left alone, and how often
    the busiest thread of a whole run makes each of `CALLS`."""

    study: Checkout
    command: tuple[str, ...]
    start: Callable[[Checkout], object]
    undisturbed: Path
    calls: dict[str, int]

    def traced(self, *more: str) -> Finished:
        return traced(self.study, self.command, "/dev/null", *more)

    def drawn(self, draw: random.Random) -> tuple[str, int]:
        """One of the calls of a whole run, by name and number, each name as likely as the others."""
        call = draw.choice(sorted(self.calls))
        return call, draw.randint(1, self.calls[call])

    def assert_whole(self) -> None:
        self.study.traps(*self.command).ok()
        for kind in ("answers", "votes"):
            found, wanted = keys(self.study.workspace, kind), keys(self.undisturbed, kind)
            assert len(found) == len(set(found))
            assert set(found) == set(wanted)
        assert_same_tables(self.study.workspace, self.undisturbed)


def keys(workspace: Path, kind: str) -> list[str]:
    """The key of every row of a study's ledger."""
    join = "traps_rows r join traps_evaluations e on r.evaluation = e.id"
    with closing(sqlite3.connect(workspace / "ledger" / "ledger.sqlite")) as opened:
        return [key for (key,) in opened.execute(f"select r.key from {join} where e.kind = ?", [kind])]


def traced(study: Checkout, command: Sequence[str], log: Path | str, *more: str) -> Finished:
    """A command of `traps` under strace, which stops it at `CALLS` alone."""
    return study.run(*strace(log, *more), sys.executable, "-m", "traps_pipeline.cli", *command)


def strace(log: Path | str, *more: str) -> tuple[str | Path, ...]:
    return ("strace", "-f", "--seccomp-bpf", "-qq", "-o", log, "-e", f"trace={CALLS}", *more)


def killed_at(study: Checkout, command: Sequence[str], call: str, number: int, when: str) -> Finished:
    """A command of `traps` that is killed before or behind a thread's so manieth call of a name. Under --seccomp-bpf
    strace injects no signal, so the call is held (`delay_enter`, `delay_exit`) until the process is killed from here,
    and then strace, which would hold the dead one as long."""
    log = study.root / "killed"
    log.unlink(missing_ok=True)
    held = strace(log, "-e", f"inject={call}:delay_{when}={HELD_US}:when={number}")
    process = study.start(*held, sys.executable, "-m", "traps_pipeline.cli", *command)
    with ThreadPoolExecutor(1) as reader:  # what is printed is read, or the command would wait for a reader
        said, begun, thread = reader.submit(process.communicate), Begun(log, call), None
        while not said.done() and (thread := begun.reached(number)) is None:
            wait([said], timeout=0.02)
        if not said.done() and thread is not None:
            os.kill(thread, signal.SIGKILL)
            process.kill()
        out, err = said.result()
    return Finished(process.returncode, out, err)


class Begun:
    """How many calls of a name each thread has begun, from a log that grows: of each look only what is new is read."""

    def __init__(self, log: Path, call: str) -> None:
        self._log, self._call, self._at = log, re.compile(rf"^(\d+) +{call}\(", re.MULTILINE), 0
        self._counts = Counter[str]()

    def reached(self, number: int) -> int | None:
        """The thread that has begun so many, None if none has. A call that is held is a line without its end."""
        if not self._log.exists():
            return None
        with self._log.open("rb") as stream:
            stream.seek(self._at)
            whole, end, last = stream.read().rpartition(b"\n")
        self._at += len(whole + end)
        self._counts.update(self._call.findall(whole.decode()))
        counts = self._counts + Counter(self._call.findall(last.decode()))
        return next((int(thread) for thread, n in counts.items() if n >= number), None)


def begun(
    study: Checkout, command: tuple[str, ...], start: Callable[[Checkout], object], undisturbed: Path
) -> Campaign:
    """A campaign against a study, which is run once for the number of its calls."""
    if shutil.which("strace") is None:
        pytest.skip("strace is not installed (make campaign installs it)")
    start(study)
    log = study.root / "calls"
    traced(study, command, log).ok()
    found = Counter(re.findall(r"^(\d+) +(\w+)\(", log.read_text(), re.MULTILINE))
    calls = {call: max(n for (_, name), n in found.items() if name == call) for call in {name for _, name in found}}
    if not undisturbed.exists():
        copy_workspace(study.workspace, undisturbed)
    start(study)
    return Campaign(study, command, start, undisturbed, calls)


@pytest.fixture(scope="module")
def answering(small: Checkout, one_regime: Checkout, tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """From items to the leaderboard."""
    study, command = copied(small, tmp_path_factory.mktemp("answering")), ("run", ONE_REGIME, "--until", "leaderboard")
    return begun(study, command, forget_answers, one_regime.workspace)


@pytest.fixture(scope="module")
def everything(small: Checkout, tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """From records to the report, with a look into a tiny model."""
    if MANY is None:
        pytest.skip("faults through every stage take an hour: TRAPS_FAULTS=100 asks for them")
    folder = tmp_path_factory.mktemp("everything")
    study = copied(small, folder)
    return begun(study, ("run", with_mechanism(study)), forget_everything, folder / "undisturbed")


def forget_everything(study: Checkout) -> None:
    """Leave the clips of eleven scenarios, with nothing else: rendering one takes long enough."""
    kept = study.workspace / "clips"
    for path in study.workspace.iterdir():
        if path.name in ("study.yaml", "dagster", "media", "clips"):
            continue
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    for name in ("media", "clips/domino_chain-0001"):
        shutil.rmtree(study.workspace / name, ignore_errors=True)
    assert kept.is_dir()


def killed(campaign: Campaign) -> None:
    """Kill a study at so many calls, and see that it comes to the same."""
    draw, count = random.Random(20261122), 0
    for _ in range(FAULTS):
        finished = killed_at(campaign.study, campaign.command, *campaign.drawn(draw), draw.choice(("enter", "exit")))
        assert "Traceback" not in finished.err, finished.err
        count += finished.code != 0
        if finished.code == 0:  # so much was there already that it came to its end
            campaign.assert_whole()
            campaign.start(campaign.study)
    assert count > FAULTS / 3
    campaign.assert_whole()


def failed(campaign: Campaign) -> None:
    """Let so many calls fail, and see that each is named and that the study comes to the same."""
    draw, count = random.Random(20261123), 0
    for _ in range(FAULTS):
        error = draw.choice(ERRORS)
        call, number = campaign.drawn(draw)
        finished = campaign.traced("-e", f"inject={call}:error={error}:when={number}")
        assert "Traceback" not in finished.err + finished.out, finished.err
        count += finished.code != 0
        if finished.code == 0:
            campaign.assert_whole()
            campaign.start(campaign.study)
        else:
            assert str(campaign.study.workspace) in finished.err + finished.out, (error, finished.err)
    assert count > FAULTS / 3
    campaign.assert_whole()


def test_kills_at_system_calls_lose_nothing_and_ask_nothing_twice(answering: Campaign) -> None:
    killed(answering)


def test_a_disk_that_fails_at_a_system_call_is_named_and_nothing_is_lost(answering: Campaign) -> None:
    answering.start(answering.study)
    failed(answering)


def test_kills_through_every_stage_lose_nothing_and_ask_nothing_twice(everything: Campaign) -> None:
    killed(everything)


def test_a_disk_that_fails_in_any_stage_is_named_and_nothing_is_lost(everything: Campaign) -> None:
    everything.start(everything.study)
    failed(everything)
