"""Share an evaluation's answers among processes; only one writes the ledger.

The others generate answers meanwhile, in chunks from the end of the calls, and store them in the study; the writer
takes these and generates the rest. A chunk is leased while it is generated, so none is made twice; leases of dead
processes expire.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from traps_pipeline.base.digests import digest
from traps_pipeline.ledger.ledger import Ledger, LockGivenUp
from traps_pipeline.models.request import Outcome, Request
from traps_pipeline.storage.leases import POLL_S
from traps_pipeline.storage.store import Lease, Store

Make = Callable[[Sequence[Request], Callable[[], bool]], list[Outcome]]  # (calls, is stopped) -> outcomes


@dataclass(frozen=True)
class Chunk:
    """Calls that a process answers together; all processes name equal calls alike."""

    name: str
    calls: Mapping[str, Request]


class SharedAnswers:
    """The stored answers of a study, and the chunks of the calls wanted here."""

    def __init__(self, store: Store, folder: Path, size: int) -> None:
        self._store, self._folder, self._size = store, folder, size
        self._of: dict[str, Chunk] = {}

    def chunks(self, requests: Sequence[Request]) -> list[Chunk]:
        """Split a cell's calls into chunks, register these, and return them."""
        calls = list({request.key: request for request in requests}.values())
        parts = [calls[first : first + self._size] for first in range(0, len(calls), self._size)]
        result = [Chunk(digest([call.key for call in part])[:16], {call.key: call for call in part}) for part in parts]
        for chunk in result:
            self._of |= dict.fromkeys(chunk.calls, chunk)
        return result

    def outcomes(self, requests: Sequence[Request], make: Make, stopped: Callable[[], bool]) -> list[Outcome]:
        """Return outcomes of calls in known chunks, generated here or elsewhere.

        Waits while another process generates some of them, unless it is stopped.
        """
        chunks = {chunk.name: chunk for request in requests if (chunk := self._of.get(request.key))}
        with ExitStack() as leases:
            outcome_of: dict[str, Outcome] = {}
            for chunk in chunks.values():
                while (lease := self._lease(chunk)) is None and not stopped():
                    time.sleep(POLL_S)
                if lease is not None:
                    leases.enter_context(closing(lease))
                outcome_of |= self._read(chunk)
            missing = [request for request in requests if request.key not in outcome_of]
            if missing:
                outcome_of |= zip([call.key for call in missing], make(missing, stopped), strict=True)
        return [outcome_of[request.key] for request in requests]

    def fill(self, chunk: Chunk, settled_among: Callable[[Sequence[str]], set[str]], make: Make) -> int | None:
        """Generate a chunk's unknown answers; return their number, None if it is leased."""
        lease = self._lease(chunk)
        if lease is None:
            return None
        with closing(lease):
            chunk_outcomes = self._read(chunk)
            settled_keys = settled_among(list(chunk.calls)) | {*chunk_outcomes}
            missing = [request for key, request in chunk.calls.items() if key not in settled_keys]
            if missing:
                outcomes = make(missing, lambda: False)
                chunk_outcomes |= zip([call.key for call in missing], outcomes, strict=True)
                content = json.dumps({key: asdict(call) for key, call in chunk_outcomes.items()})
                self._store.write({self._path(chunk): content.encode()})
            return len(missing)

    def forget(self, requests: Sequence[Request]) -> None:
        """Remove the answers to calls that the ledger holds by now."""
        chunks = {chunk.name: chunk for request in requests if (chunk := self._of.get(request.key))}
        self._store.remove(map(self._path, chunks.values()))
        with suppress(OSError):  # unless there are others
            self._folder.rmdir()

    def _path(self, chunk: Chunk) -> Path:
        return self._folder / f"{chunk.name}.json"

    def _read(self, chunk: Chunk) -> dict[str, Outcome]:
        try:
            rows = json.loads(self._store.here(self._path(chunk)).read_text(encoding="utf-8"))
            return {key: Outcome(**row) for key, row in rows.items() if key in chunk.calls}
        except FileNotFoundError:
            return {}
        except (ValueError, TypeError, AttributeError):  # damaged: generate it again
            return {}

    def _lease(self, chunk: Chunk) -> Lease | None:
        lease = self._store.lease(f"{self._folder.name}/{chunk.name}")
        if lease is not None:
            self._store.look()  # remains of the former holder
        return lease


def is_written(ledger: Ledger, evaluation: str) -> bool:
    """Return whether another process is writing an evaluation now."""

    async def try_it() -> bool:
        try:
            async with ledger.writing(evaluation, lambda _: None, lambda: True):
                return False
        except LockGivenUp:
            return True

    return asyncio.run(try_it())


def make_meanwhile(
    shared: SharedAnswers,
    ledger: Ledger,
    evaluation: str,
    wanted: Sequence[Request],
    make: Make,
    tick: Callable[[int, int], None],
) -> int:
    """Generate answers from the end while another process writes; return how many.

    tick: receives the chunks done and their number.
    """
    chunks, count = shared.chunks(wanted), 0
    for n_finished, chunk in enumerate(reversed(chunks), start=1):
        count += shared.fill(chunk, lambda keys: {*ledger.read(evaluation, keys).settled}, make) or 0
        tick(n_finished, len(chunks))
        if not is_written(ledger, evaluation):
            break
    return count
