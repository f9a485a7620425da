"""Processes that end together: trees of real processes, ended in each way, leave nobody behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.build.processes import MARK, marked, wait_until_gone
from traps_pipeline.base.process_tree import fork_worker

END_S = 60  # more than nine times what it takes
# A command of two processes. Below the second one: a program that ends at SIGTERM, which has started one in a session
# of its own that ignores it. The last to start writes the second process's id.
COMMAND = '''
import os, signal, subprocess, sys, time
from traps_pipeline.base.process_tree import fork_worker, stop_descendants, wait_for
from traps_pipeline.cli import _stop_on_signals

SLEEPS = """
import signal, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
open(sys.argv[1], "w").write(sys.argv[2])
time.sleep(600)
"""
STARTS = """
import subprocess, sys
subprocess.Popen([sys.executable, "-c", *sys.argv[1:]], start_new_session=True).wait()
"""
with _stop_on_signals():
    if (code := fork_worker(3)) is not None:
        sys.exit(code % 256)
    child = subprocess.Popen([sys.executable, "-c", STARTS, SLEEPS, sys.argv[1], str(os.getpid())])
    try:
        wait_for([child.pid])
    finally:
        stop_descendants(0.5)
'''


@pytest.fixture
def tree(tmp_path: Path) -> tuple[subprocess.Popen[bytes], int]:
    """The first process of COMMAND, started where SIGINT is ignored, and the id of the second one."""
    ready, mark = tmp_path / "ready", str(tmp_path)
    script = f'trap "" INT; exec {sys.executable} -c "$0" "$1"'
    process = subprocess.Popen(["sh", "-c", script, COMMAND, ready], env=os.environ | {MARK: mark})
    until = time.monotonic() + END_S
    while not ready.exists() or not ready.read_text():
        assert process.poll() is None and time.monotonic() < until
        time.sleep(0.05)
    assert len(marked(mark)) == 4
    return process, int(ready.read_text())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("which", "stop"),
    [("first", signal.SIGTERM), ("first", signal.SIGKILL), ("second", signal.SIGHUP), ("second", signal.SIGKILL)],
)
def test_a_stop_of_either_process_ends_all_that_both_started(
    tree: tuple[subprocess.Popen[bytes], int], tmp_path: Path, which: str, stop: signal.Signals
) -> None:
    first, second = tree
    os.kill(first.pid if which == "first" else second, stop)
    assert first.wait(END_S) != 0
    wait_until_gone(str(tmp_path), END_S)


def test_the_first_process_ends_with_the_code_of_the_second() -> None:
    script = (
        "import sys; from traps_pipeline.base.process_tree import fork_worker; code = fork_worker(5); "
        "sys.exit(7 if code is None else code)"
    )
    assert subprocess.run([sys.executable, "-c", script]).returncode == 7


def test_another_system_gets_one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    assert fork_worker(1) is None
