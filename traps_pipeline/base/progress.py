"""Hold the state of a run, and the events that change it.

Library code reports to `current()`. A command installs a subclass that prints (`cli/printed_progress.py`), and a
Dagster step adds a listener (`Progress.reporting_to`).
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, TypeVar

from traps_pipeline.base.terminal import plain
from traps_pipeline.base.wording import count_noun

HEARTBEAT_S = 30.0  # between two lines about the same stage
PACE_S = 5.0  # before that a stage's pace is mostly what it loads first, and its first calls in flight


@dataclass
class Tally:
    """Counts of work done, by kind."""

    asked: int = 0
    cached: int = 0
    errors: int = 0
    frames: int = 0

    def add(self, other: Tally) -> None:
        """Add another tally's counts to this one."""
        self.asked += other.asked
        self.cached += other.cached
        self.errors += other.errors
        self.frames += other.frames


@dataclass
class Traffic:
    """A stage's calls to one model or judge, with the last 500 latencies, and when each call in flight was sent, s."""

    wanted: int = 0
    cached: int = 0
    done: int = 0
    errors: int = 0
    retries: int = 0
    dollars: float = 0.0
    began: float = field(default_factory=lambda: time.monotonic())
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=500))
    sent_at: dict[object, float] = field(default_factory=dict)

    @property
    def oldest_s(self) -> float:
        """Age of the oldest call in flight, in seconds; 0 without one."""
        return max((time.monotonic() - sent_at for sent_at in [*self.sent_at.values()]), default=0.0)

    @property
    def per_second(self) -> float:
        """Answers per second since the first call."""
        return self.done / max(time.monotonic() - self.began, 1e-9)

    def latency_s(self, share: float) -> float:
        """Return a quantile (0 to 1) of the last calls' latencies, in seconds."""
        ordered = sorted(self.latencies)
        return ordered[min(int(share * len(ordered)), len(ordered) - 1)] if ordered else 0.0

    def state(self) -> dict[str, float]:
        """Return counts and times by name, for a line of JSON."""
        counts = {name: getattr(self, name) for name in ("done", "wanted", "cached", "errors", "retries")}
        counts["in_flight"] = len(self.sent_at)
        pace = {"oldest_s": self.oldest_s, "per_second": self.per_second}
        pace |= {"p50_s": self.latency_s(0.5), "p95_s": self.latency_s(0.95)}
        return counts | {name: round(value, 3) for name, value in pace.items()} | {"usd": round(self.dollars, 6)}


@dataclass
class StageProgress:
    """The running stage: its partitions, and its calls by model or judge.

    detail: the unit in progress, of which `share` is done. empty: partitions made without rows or files. cells:
    partitions whose calls have been counted.
    """

    name: str
    partitions: int
    done: int = 0
    empty: int = 0
    cells: float = 0.0
    detail: str = ""
    share: float = 0.0
    tally: Tally = field(default_factory=Tally)
    calls: dict[str, Traffic] = field(default_factory=dict)
    began: float = field(default_factory=lambda: time.monotonic())

    @property
    def seconds(self) -> float:
        """Seconds since the stage began."""
        return time.monotonic() - self.began

    @property
    def left_s(self) -> float | None:
        """Seconds until the stage ends at its pace so far; None in its first seconds."""
        total = self.total()
        begun_calls = self.cells * total.done / total.wanted if total.wanted else self.done + self.share
        if not begun_calls or not self.partitions or self.seconds < PACE_S:
            return None
        return self.seconds / begun_calls * max(self.partitions - begun_calls, 0.0)

    def total(self) -> Traffic:
        """Return the sum of all calls."""
        tallies = [*self.calls.values()]
        total = Traffic(began=min((traffic.began for traffic in tallies), default=self.began))
        total.latencies = deque(chain.from_iterable([*traffic.latencies] for traffic in tallies))
        for name in ("wanted", "cached", "done", "errors", "retries", "dollars"):
            setattr(total, name, sum(getattr(traffic, name) for traffic in tallies))
        for traffic in tallies:
            total.sent_at |= traffic.sent_at
        return total

    def work(self) -> list[str]:
        """Return the stage's work so far, in words."""
        words = {"asked": "asked", "cached": "from the ledger", "errors": "failed", "frames": "frames"}
        return [f"{count:,} {words[name]}" for name, count in vars(self.tally).items() if count]


class Progress:
    """The state of a run; prints nothing but notes. `totals` holds the work by stage."""

    def __init__(self) -> None:
        self.totals = dict[str, Tally]()
        self.current_stage: StageProgress | None = None
        self.spent_usd, self.budget_usd = 0.0, 0.0
        self.is_stopping = False
        self._listeners = list[Callable[[str], None]]()
        self._heard_at = time.monotonic()

    # --- events -------------------------------------------------------------------------------------------------------

    def stage(self, name: str, partitions: int) -> None:
        """Begin a stage with this number of partitions to make."""
        self.end_stage()
        self.current_stage = StageProgress(name, partitions)
        self._heard_at = time.monotonic()

    def partition(self, stage: str, key: str, tally: Tally, *, is_empty: bool = False) -> None:
        """Count a partition as made. is_empty: it has neither rows nor files."""
        self.totals.setdefault(stage, Tally()).add(tally)
        if (now := self.current_stage) is not None:
            now.tally.add(tally)
            now.done, now.empty = now.done + 1, now.empty + is_empty
            if now.partitions:  # one that was fresh when the stage began may be stale by now
                now.partitions = max(now.partitions, now.done)
            now.share, now.detail = 0.0, ""
        self.changed()

    def helped(self, stage: str, tally: Tally) -> None:
        """Count this run's share of a partition that another run finished."""
        self.totals.setdefault(stage, Tally()).add(tally)

    def tick(self, stage: str, unit: str, done: int, total: int) -> None:
        """Count units (clips, layers) of the partition in progress."""
        if (now := self.current_stage) is not None:
            now.detail, now.share = f"{unit}: {done:,} of {total:,}", done / max(total, 1)
        self.changed()

    def asking(self, stage: str, calls: Mapping[str, tuple[int, int]], share: float = 1.0) -> None:
        """Count new and recorded calls of a share of a cell, by model or judge, before sending any."""
        if self.current_stage is None:
            self.current_stage = StageProgress(stage, 0)
        self.current_stage.cells += share
        self.current_stage.detail, self.current_stage.share = "", 0.0
        for participant, (missing, recorded_calls) in calls.items():
            traffic = self.current_stage.calls.setdefault(participant, Traffic())
            traffic.wanted, traffic.cached = traffic.wanted + missing, traffic.cached + recorded_calls
        self.changed()

    def expect(self, stage: str, calls: Mapping[str, tuple[int, int]], cells: float) -> None:
        """Count the calls of all cells of a stage at once, as `asking` counts those of one."""
        self.asking(stage, calls, cells)

    @contextmanager
    def in_flight(self, who: str) -> Iterator[None]:
        """Count an attempt of a call as being in flight within the block."""
        traffic, call = self._traffic(who) or Traffic(), object()
        traffic.sent_at[call] = time.monotonic()
        try:
            yield
        finally:
            del traffic.sent_at[call]

    def called(self, who: str, failed: bool, latency_s: float, dollars: float) -> None:
        """Count a call that has finished, after its last retry."""
        self.spent_usd += dollars
        if traffic := self._traffic(who):
            traffic.done, traffic.errors = traffic.done + 1, traffic.errors + failed
            traffic.dollars += dollars
            traffic.latencies.append(latency_s)
        self.changed()

    def retried(self, who: str) -> None:
        """Count a failed call that is retried."""
        if traffic := self._traffic(who):
            traffic.retries += 1
        self.changed()

    def money(self, spent_usd: float, budget_usd: float) -> None:
        """Set the study's spending so far, and its budget (0: none)."""
        self.spent_usd, self.budget_usd = spent_usd, budget_usd

    def end_stage(self) -> None:
        """End the running stage, if any."""
        if (stage := self.current_stage) is not None:
            self.current_stage = None
            if stage.work():
                for listener in self._listeners:
                    listener(self.summary(stage))

    def close(self) -> None:
        """End the run: report the stage that is open."""
        self.end_stage()

    def note(self, text: str) -> None:
        """Tell the user something about the run."""
        print(plain(text), file=sys.stderr)

    def changed(self) -> None:
        """Notify the stage's listeners, at most every 30 s; called after each event."""
        if self._listeners and time.monotonic() - self._heard_at >= HEARTBEAT_S:
            self._heard_at = time.monotonic()
            for listener in self._listeners:
                listener(self.line())

    # --- state --------------------------------------------------------------------------------------------------------

    @contextmanager
    def reporting_to(self, listener: Callable[[str], None]) -> Iterator[None]:
        """Call a listener with a progress line, every 30 s and at a stage's end."""
        self._listeners.append(listener)
        try:
            yield
        finally:
            self._listeners.remove(listener)

    def state(self) -> dict[str, Any]:
        """Return the state by name, for a line of JSON."""
        money = {"spent_usd": round(self.spent_usd, 6), "budget_usd": self.budget_usd}
        if (now := self.current_stage) is None:
            return money
        times = {"seconds": round(now.seconds, 1), "left_s": None if now.left_s is None else round(now.left_s, 1)}
        calls = {participant: traffic.state() for participant, traffic in [*now.calls.items()]}
        counts = {"stage": now.name, "done": now.done, "partitions": now.partitions, "detail": now.detail}
        return {**counts, **times, **money, "calls": calls}

    def line(self) -> str:
        """Return the state on one line."""
        if (now := self.current_stage) is None:
            return "between two stages"
        if self.is_stopping:
            return f"{now.name}: {self.waiting()}"
        total, parts = now.total(), [f"{now.done:,} of {now.partitions:,} made"] if now.partitions else []
        parts += [now.detail] if now.detail else []
        if total.wanted:
            parts.append(f"{total.done:,} of {count_noun(total.wanted, 'call')}")
            if total.sent_at:
                parts.append(f"{len(total.sent_at):,} in flight (the oldest {as_clock(total.oldest_s)})")
            parts += [f"{total.per_second:.1f}/s at {total.latency_s(0.5):.1f} s"] if total.done else []
            parts += [count_noun(total.errors, "error")] if total.errors else []
            parts += [count_noun(total.retries, "retry", "retries")] if total.retries else []
            parts += [self.spent()] if self.budget_usd else []
        parts.append(f"{as_clock(now.seconds)} so far" if now.left_s is None else f"{as_clock(now.left_s)} left")
        return f"{now.name}: {', '.join(parts)}"

    def waiting(self) -> str:
        """Return which calls a run that was stopped waits for, in words."""
        total = self.current_stage.total() if self.current_stage else Traffic()
        if not total.sent_at:
            return "stopping: no call is in flight"
        calls = f"{count_noun(len(total.sent_at), 'call')} in flight, the oldest for {as_clock(total.oldest_s)}"
        return f"stopping: waiting for {calls}"

    def summary(self, stage: StageProgress) -> str:
        """Return a stage's work on one line; of a run that was stopped, all calls, also of partitions not made."""
        total = stage.total()
        calls = f"{total.done:,} of {count_noun(total.wanted, 'call')}"
        work = [calls] if self.is_stopping and total.wanted else stage.work()
        retries = [f"{total.retries:,} retried"] if total.retries else []
        dollars = [f"${total.dollars:,.2f}"] if total.dollars else []
        made = f"{stage.done:,} of {stage.partitions:,} made"
        return f"{stage.name}: {', '.join([made, *work, *retries, *dollars, as_clock(stage.seconds)])}"

    def spent(self) -> str:
        """Return the money spent and the budget, in words."""
        return f"${self.spent_usd:,.2f} of ${self.budget_usd:,.2f}"

    def _traffic(self, who: str) -> Traffic | None:
        return self.current_stage.calls.get(who) if self.current_stage else None


def as_clock(seconds: float) -> str:
    """Return a duration as m:ss."""
    minutes, seconds_left = divmod(round(seconds), 60)
    return f"{minutes}:{seconds_left:02d}"


AnyProgress = TypeVar("AnyProgress", bound=Progress)
_current: list[Progress] = [Progress()]


def current() -> Progress:
    """Return the progress to which this process reports now."""
    return _current[-1]


@contextmanager
def use_progress(progress: AnyProgress) -> Iterator[AnyProgress]:
    """Make a progress the active one within the block."""
    _current.append(progress)
    try:
        yield progress
    except KeyboardInterrupt:
        progress.is_stopping = True
        raise
    finally:
        _current.pop()
        progress.close()
