"""Pieces of a work that several processes share: each is leased by one of them, wherever the study's files lie.

A process that dies gives its pieces back, and the others make them.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager

from traps_pipeline.storage.store import Store

POLL_S = 0.2


@contextmanager
def alone(store: Store, name: str) -> Iterator[None]:
    """Hold a piece of work for the time of the block; a second process waits. Raises TrapsError where no lease can be
    had."""
    while (lease := store.lease(name)) is None:
        time.sleep(POLL_S)
    with closing(lease):
        yield


def leased(store: Store, work: str, items: int, size: int) -> Generator[range]:
    """Yield ranges of items, at most `size` each: first those that no other process has, then the others as they are
    given back, finished or not. The lease of a range ends when the next one is asked for. Raises TrapsError where no
    lease can be had."""
    leases = list[tuple[str, range]]()
    for first in range(0, items, size):
        name, chunk = f"{work}/{first:07d}", range(first, min(first + size, items))
        lease = store.lease(name)
        if lease is None:
            leases.append((name, chunk))
            continue
        with closing(lease):
            yield chunk
    for name, chunk in leases:
        with alone(store, name):
            yield chunk
