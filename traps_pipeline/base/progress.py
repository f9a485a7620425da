"""How long work tells where it stands. Library code reports to `current()`; the command line installs its own."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from traps_pipeline.base.terminal import plain


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
class Traffic:
    """Calls to one model or judge in a stage, while they are made. Latencies (s) are the last 500."""

    cached: int = 0
    wanted: int = 0
    done: int = 0
    errors: int = 0
    dollars: float = 0.0
    began: float = field(default_factory=lambda: time.monotonic())
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=500))

    def called(self, failed: bool, latency_s: float, dollars: float) -> None:
        """A call has come back."""
        self.done, self.errors, self.dollars = self.done + 1, self.errors + failed, self.dollars + dollars
        self.latencies.append(latency_s)

    @property
    def per_second(self) -> float:
        """Answers a second since the first call."""
        return self.done / max(time.monotonic() - self.began, 1e-9)

    def latency_s(self, share: float) -> float:
        """The latency that this share of the last calls did not exceed."""
        ordered = sorted(self.latencies)
        return ordered[min(int(share * len(ordered)), len(ordered) - 1)] if ordered else 0.0

    @property
    def left_s(self) -> float:
        """Seconds until what is wanted so far is done."""
        return (self.wanted - self.done) / self.per_second if self.done else 0.0

    def line(self) -> str:
        """The same in words, for where there is no table."""
        done, cached, errors, pace, p50, p95, dollars, left = self.cells()
        return f"{done}, {cached} cached, {errors} errors, {pace}, p50 {p50}, p95 {p95}, {dollars}, {left}"

    def cells(self) -> list[str]:
        """done, cached, errors, calls a second, p50 and p95 latency, dollars, time left."""
        return [
            f"{self.done:,} of {self.wanted:,}",
            f"{self.cached:,}",
            f"{self.errors:,}",
            f"{self.per_second:.1f}/s",
            f"{self.latency_s(0.5):.1f} s",
            f"{self.latency_s(0.95):.1f} s",
            f"${self.dollars:,.2f}",
            f"{clock(self.left_s)} left",
        ]


@dataclass
class Progress:
    """Silent progress: counts only. `totals` is by stage, `traffic` by stage and by who is asked."""

    totals: dict[str, Tally] = field(default_factory=dict)
    traffic: dict[tuple[str, str], Traffic] = field(default_factory=dict)

    def stage(self, name: str, partitions: int) -> None:
        """A stage begins, with so many partitions to do."""

    def partition(self, stage: str, key: str, tally: Tally) -> None:
        """A partition is done."""
        self.totals.setdefault(stage, Tally()).add(tally)

    def helped(self, stage: str, tally: Tally) -> None:
        """So much was done for a partition that another run has made."""
        self.totals.setdefault(stage, Tally()).add(tally)

    def tick(self, stage: str, what: str, done: int, total: int) -> None:
        """A unit of a partition (a clip, a call) is done."""

    def asking(self, stage: str, who: str, wanted: int, cached: int) -> None:
        """So many more calls are about to be made, so many were in the ledger."""
        traffic = self.traffic.setdefault((stage, who), Traffic())
        traffic.wanted, traffic.cached = traffic.wanted + wanted, traffic.cached + cached

    def called(self, stage: str, who: str, failed: bool, latency_s: float, dollars: float) -> None:
        """A call has come back."""
        self.traffic[stage, who].called(failed, latency_s, dollars)

    def close(self) -> None:
        """No more is coming."""

    def note(self, text: str) -> None:
        """Something a person should know."""
        print(plain(text), file=sys.stderr)


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
        progress.close()
