"""Start a command so that it and all its descendants end together.

A command that starts servers runs as two processes: the second starts the servers and waits for them, the first waits
for the second. Each adopts the orphans below it (PR_SET_CHILD_SUBREAPER), so that it finds and stops what the death of
the other one leaves running. Linux only; elsewhere the command is one process.
"""

import ctypes
import os
import signal
import sys
import time
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36  # linux/prctl.h
_PAUSE_S = 0.05


def fork_worker(wait_s: float) -> int | None:
    """Fork a process that does the command's work; call it before any thread starts.

    Return None in that process, which gets a session of its own (Ctrl-C reaches it through the first process alone) and
    SIGTERM when the first process dies. In the first process, return the child's exit code (negative for the signal
    that killed it) once it and everything below it has ended. KeyboardInterrupt in the first process stops the child by
    SIGTERM, after `wait_s` seconds or a second KeyboardInterrupt by SIGKILL, and then propagates.
    """
    if sys.platform != "linux":
        return None
    parent = os.getpid()
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)
    worker = os.fork()
    if worker == 0:
        os.setsid()
        _prctl(_PR_SET_CHILD_SUBREAPER, 1)
        _prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:  # the parent died before the call
            raise KeyboardInterrupt
        return None
    try:
        code = wait_for([worker])[1]
        stop_descendants(wait_s)
        return code
    except KeyboardInterrupt:
        try:
            with suppress(ProcessLookupError):
                os.kill(worker, signal.SIGTERM)
            _reap_until_gone([worker], wait_s)
        finally:
            stop_descendants(0)
        raise


def wait_for(children: Collection[int]) -> tuple[int, int]:
    """Return id and exit code (-N: signal N) of the first child to end; reap orphans."""
    while True:
        pid, status = os.wait()
        if pid in children:
            return pid, os.waitstatus_to_exitcode(status)


def stop_descendants(wait_s: float) -> None:
    """Stop every process below: SIGTERM, then SIGKILL after `wait_s` s or Ctrl-C."""
    try:
        pids = descendants()
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGTERM)
        _reap_until_gone(pids, wait_s)
    finally:
        while pids := descendants():
            for pid in pids:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            _reap_until_gone(pids, _PAUSE_S)


def descendants() -> list[int]:
    """Return the ids of all processes below this one, grandchildren included."""
    children: dict[int, list[int]] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # the process has ended meanwhile
            parent = int((folder / "stat").read_text(errors="replace").rpartition(")")[2].split()[1])
            children.setdefault(parent, []).append(int(folder.name))
    ids = list(children.get(os.getpid(), ()))
    for pid in ids:  # grows while it is read
        ids += children.get(pid, ())
    return ids


def _reap_until_gone(pids: Collection[int], wait_s: float) -> None:
    deadline = time.monotonic() + wait_s
    while True:
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        if not {*pids} & {*descendants()} or time.monotonic() >= deadline:
            return
        time.sleep(_PAUSE_S)


def _prctl(option: int, value: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(option, ctypes.c_ulong(value), 0, 0, 0):
        raise OSError(ctypes.get_errno(), f"prctl({option}, {value})")
