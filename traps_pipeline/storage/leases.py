"""Lease pieces of work that processes share; a lease expires with its process."""

import time
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager

from traps_pipeline.storage.store import Store

POLL_S = 0.2


@contextmanager
def hold_lease(store: Store, name: str) -> Iterator[None]:
    """Hold a lease within the block; other processes wait. Raises TrapsError."""
    while (lease := store.lease(name)) is None:
        time.sleep(POLL_S)
    with closing(lease):
        yield


def leased_ranges(store: Store, work: str, items: int, size: int) -> Generator[range]:
    """Yield ranges of up to `size` items, each leased until the next is requested.

    Ranges that no other process holds come first, then the others as they are released, finished or not. Raises
    TrapsError if no lease can be had.
    """
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
        with hold_lease(store, name):
            yield chunk
