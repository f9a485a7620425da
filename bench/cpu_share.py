"""A fixed share of this machine's CPU for some processes, so that each group of them stands for a host of its own.

The kernel's control groups give it: at most so many cores, and those before everybody else, whatever else runs. Needs
root, and control groups that may be made (version 2, or the `cpu` controller of version 1).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path("/sys/fs/cgroup")
PERIOD_US = 100_000
FIRST = 100  # times the weight of others


def is_there() -> bool:
    """Return whether this process may give shares."""
    return os.geteuid() == 0 and _version() != 0


@contextmanager
def of_cores(name: str, cores: float) -> Iterator[list[str]]:
    """A group that gets so many cores, until the block's end; the words before a command that is to run in it."""
    version = _version()
    folder = (ROOT if version == 2 else ROOT / "cpu") / f"traps-{os.getpid()}-{name}"
    folder.mkdir()
    try:
        quota = round(cores * PERIOD_US)
        if version == 2:
            (folder / "cpu.max").write_text(f"{quota} {PERIOD_US}")
            (folder / "cpu.weight").write_text(f"{100 * FIRST}")
        else:
            (folder / "cpu.cfs_period_us").write_text(f"{PERIOD_US}")
            (folder / "cpu.cfs_quota_us").write_text(f"{quota}")
            (folder / "cpu.shares").write_text(f"{1024 * FIRST}")
        yield ["sh", "-c", f'echo $$ > {folder}/cgroup.procs && exec "$@"', "sh"]
    finally:
        for pid in (folder / "cgroup.procs").read_text().split():  # those that did not end with their node
            (folder.parent / "cgroup.procs").write_text(pid)
        folder.rmdir()


def _version() -> int:
    """Return of the control groups that limit CPU and may be made here; 0 where none."""
    controllers, delegated = ROOT / "cgroup.controllers", ROOT / "cgroup.subtree_control"
    if controllers.is_file() and "cpu" in controllers.read_text().split() and os.access(delegated, os.W_OK):
        delegated.write_text("+cpu")
        return 2
    return 1 if (ROOT / "cpu" / "cpu.shares").is_file() and os.access(ROOT / "cpu", os.W_OK) else 0
