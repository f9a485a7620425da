"""Chunks of a piece of work in a folder, shared by the processes that are at it: each chunk is leased by one of them.

A lease is a lock on a file, so a process that dies gives its chunk back at once, and the others do what is left of it.
"""

from __future__ import annotations

import fcntl
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from traps_pipeline.errors import TrapsError
from traps_pipeline.files import remedy

LEASES = "leases"


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Lock a folder, which is made unless it is there; a second one waits. A kill releases the lock. Raises TrapsError
    where nothing can be written."""
    with _file(folder / ".lock") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def leased(folder: Path, items: int, size: int) -> Iterator[range]:
    """Ranges of items, at most `size` each: first those that no other process holds, then the others as they are given
    back, finished or not. The lease of a range ends when the next one is asked for. Raises TrapsError where nothing can
    be written."""
    chunks = [range(first, min(first + size, items)) for first in range(0, items, size)]
    held = list[tuple[Path, range]]()
    for number, chunk in enumerate(chunks):
        path = folder / LEASES / f"chunk-{number:05d}"
        with _file(path) as lease:
            try:
                fcntl.flock(lease, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                held.append((path, chunk))
                continue
            yield chunk
    for path, chunk in held:
        with _file(path) as lease:
            fcntl.flock(lease, fcntl.LOCK_EX)
            yield chunk


def end_leases(folder: Path) -> None:
    """Remove the leases of work that is finished."""
    shutil.rmtree(folder / LEASES, ignore_errors=True)


@contextmanager
def writable(folder: Path) -> Iterator[None]:
    """Raises TrapsError where nothing can be written in a folder."""
    try:
        yield
    except OSError as error:
        raise TrapsError(f"{folder}: cannot be written ({error.strerror or error}); {remedy(error)}") from error


def _file(path: Path) -> IO[str]:
    with writable(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("w")
