"""Processes that carry a mark in their environment."""

from __future__ import annotations

import time
from pathlib import Path

MARK = "TRAPS_TEST_TREE"


def marked(mark: str) -> set[int]:
    """Processes that run with this mark in their environment, zombies left out."""
    pids = set[int]()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if f"{MARK}={mark}".encode() in (folder / "environ").read_bytes().split(b"\0"):
                pids.add(int(folder.name))
        except OSError:
            continue
    return pids


def wait_until_gone(mark: str, seconds: float) -> None:
    until = time.monotonic() + seconds
    while pids := marked(mark):
        assert time.monotonic() < until, f"still there after {seconds} s: {pids}"
        time.sleep(0.05)
