"""How long work tells where it stands. Library code reports to `current()`; the command line installs its own."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TextIO

LIVE_SECONDS = 30.0


@dataclass
class Tally:
    """Work done, by kind."""

    asked: int = 0
    cached: int = 0
    errors: int = 0
    frames: int = 0

    def add(self, other: Tally) -> None:
        """Sum in place."""
        self.asked += other.asked
        self.cached += other.cached
        self.errors += other.errors
        self.frames += other.frames


@dataclass
class Progress:
    """Silent progress: counts only. `totals` is by stage."""

    totals: dict[str, Tally] = field(default_factory=dict)

    def stage(self, name: str, partitions: int) -> None:
        """A stage begins, with so many partitions to do."""

    def partition(self, stage: str, key: str, tally: Tally) -> None:
        """A partition is done."""
        self.totals.setdefault(stage, Tally()).add(tally)

    def tick(self, stage: str, what: str, done: int, total: int) -> None:
        """A unit of a partition (a clip, a call) is done."""

    def note(self, text: str) -> None:
        """Something a person should know."""
        print(text, file=sys.stderr)


class TerminalProgress(Progress):
    """One line a partition with calls, cache hits and time left; a line every 30 s inside a long one."""

    def __init__(self, stream: TextIO | None = None) -> None:
        super().__init__()
        self._stream = stream or sys.stdout
        self._done, self._total, self._began, self._spoke = 0, 0, time.monotonic(), time.monotonic()

    def stage(self, name: str, partitions: int) -> None:
        """See `Progress`."""
        self._done, self._total, self._began = 0, partitions, time.monotonic()
        self._say(f"{name}: {partitions} partition{'s' if partitions != 1 else ''} to do")

    def partition(self, stage: str, key: str, tally: Tally) -> None:
        """See `Progress`."""
        super().partition(stage, key, tally)
        self._done += 1
        counts = [f"{n} {word}" for word, n in vars(tally).items() if n]
        left = (time.monotonic() - self._began) / self._done * max(self._total - self._done, 0)
        what = f"{stage:<12} {key or '-':<52} {', '.join(counts) or 'done':<34}"
        self._say(f"  {what} [{self._done}/{self._total}] {clock(left)} left")

    def tick(self, stage: str, what: str, done: int, total: int) -> None:
        """See `Progress`."""
        if time.monotonic() - self._spoke >= LIVE_SECONDS:
            self._say(f"  {stage:<12} ... {what}: {done} of {total}")

    def note(self, text: str) -> None:
        """See `Progress`."""
        self._say(f"  ! {text}")

    def _say(self, line: str) -> None:
        self._spoke = time.monotonic()
        print(line, file=self._stream, flush=True)


def clock(seconds: float) -> str:
    """m:ss."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"


_current: list[Progress] = [Progress()]


def current() -> Progress:
    """The progress in force."""
    return _current[-1]


@contextmanager
def reporting(progress: Progress) -> Iterator[Progress]:
    """Install a progress for the time of a block."""
    _current.append(progress)
    try:
        yield progress
    finally:
        _current.pop()
