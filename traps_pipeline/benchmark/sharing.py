"""Share the rendering of a category's clips between processes on any hosts.

All processes go through the same rows. Each leases a free row, makes its missing clips, publishes them to the study and
goes on to the next. Leases of dead processes expire. `make_together` returns when every clip exists.
"""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.workers import run_in_order
from traps_pipeline.scenes.worlds.clip_notes import Clip, check_clip, clip_note_path, read_note
from traps_pipeline.storage.leases import POLL_S
from traps_pipeline.storage.store import Lease, Store
from traps_pipeline.video.encode import DamagedClip

Row = Mapping[str, Any]
Job = TypeVar("Job")


@dataclass(frozen=True)
class RenderWork(Generic[Job]):
    """The rendering of the clips of rows of SCENE_SPECS, as functions.

    name: the work's name, the same on every host. missing: returns the rows with missing files. files: the study's
    files of a finished row. job: returns what to draw for a row (None: nothing), after existing files were fetched.
    draw: draws it, in a process of its own, and returns the number of new frames.
    """

    name: str
    missing: Callable[[Sequence[Row]], Sequence[Row]]
    files: Callable[[Row], Iterable[Path]]
    job: Callable[[Row], Job | None]
    draw: Callable[[Job], int]


def make_together(
    store: Store, rows: Sequence[Row], filming: RenderWork[Job], tick: Callable[[int], None], *, wait: bool = True
) -> tuple[int, bool]:
    """Render the missing files of rows, concurrently with other processes.

    Return the number of frames drawn here, and whether all files exist. wait: return only then; otherwise as soon as
    other processes hold everything that is missing. tick: receives the number of finished rows. Raises TrapsError, also
    for a damaged clip.
    """
    try:
        return _Sharing(store, rows, filming, tick).work(wait=wait)
    except DamagedClip as error:
        raise TrapsError(str(error)) from error


class _Sharing(Generic[Job]):
    def __init__(
        self, store: Store, rows: Sequence[Row], filming: RenderWork[Job], tick: Callable[[int], None]
    ) -> None:
        self._store, self._filming, self._tick = store, filming, tick
        missing = {id(row) for row in filming.missing(rows)}
        # By number, which is the same in every process.
        self._pending = {number: row for number, row in enumerate(rows) if id(row) in missing}
        self._finished = len(rows) - len(self._pending)
        self._drawing = deque[tuple[Row, Lease]]()  # in the order of the jobs

    def work(self, *, wait: bool) -> tuple[int, bool]:
        n_frames = 0
        try:
            while self._pending:
                # Draw the next row while files are published, and do not lease it earlier.
                for _, frames in run_in_order(self._filming.draw, self._jobs(), at_once=True):
                    n_frames += frames
                    self._finish(*self._drawing.popleft())
                if not wait:
                    break
                if self._pending:  # wait only without a job in progress, or two processes might wait for each other
                    time.sleep(POLL_S)
        finally:
            for _, lease in self._drawing:
                lease.close()
        return n_frames, not self._pending

    def _jobs(self) -> Iterator[Job]:
        """Yield jobs of unleased rows, each leased when its job is requested."""
        for number in [*self._pending]:
            lease = self._store.lease(f"{self._filming.name}/{number:06d}")
            if lease is None:
                continue
            row = self._pending.pop(number)
            self._drawing.append((row, lease))
            self._store.look()  # another process may have finished it
            job = None
            if self._filming.missing([row]):
                self._store.bring(self._filming.files(row))
                job = self._filming.job(row)
            if job is None:
                self._finish(*self._drawing.pop())
            else:
                yield job

    def _finish(self, row: Row, lease: Lease) -> None:
        """Publish a row's files to the study, and release its lease."""
        with closing(lease):
            self._store.keep(file for file in self._filming.files(row) if file.is_file())
        self._finished += 1
        self._tick(self._finished)


def existing_clips(store: Store, clips: Iterable[Path]) -> dict[Path, Clip]:
    """Return the notes of existing clips by path, without fetching clips. Raises TrapsError if a clip differs."""
    paths = [*clips]
    store.bring(map(clip_note_path, paths))
    digests = store.digests(paths)
    try:
        notes = {path: note for path in digests if (note := read_note(path)) is not None}
        for path, note in notes.items():
            if digests[path] != note.file_sha256:
                store.bring([path])
                check_clip(path, note.file_sha256, note.size_bytes)
    except DamagedClip as error:
        raise TrapsError(str(error)) from error
    return notes
