"""Progress on a terminal: one line a partition, with calls, cache hits and the time left."""

from __future__ import annotations

import io
import time

import pytest

from traps_pipeline.base.progress import Tally
from traps_pipeline.cli.progress import LIVE_SECONDS, TerminalProgress


def test_each_partition_is_a_line_with_its_counts_and_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    out = io.StringIO()
    live = TerminalProgress(out)
    live.stage("responses", 4)
    now[0] = 30.0
    live.partition("responses", "chaotic|oracle__json__run1", Tally(asked=10, cached=6))
    now[0] = 60.0
    live.partition("responses", "chaotic|prior__json__run1", Tally(cached=16))
    live.partition("leaderboard", "", Tally())
    first, second, third, fourth = out.getvalue().splitlines()
    assert first == "responses: 4 partitions to do"
    said = [" ".join(line.split()) for line in (second, third, fourth)]
    assert said == [
        "responses chaotic|oracle__json__run1 10 asked, 6 cached [1/4] 1:30 left",
        "responses chaotic|prior__json__run1 16 cached [2/4] 1:00 left",
        "leaderboard - done [3/4] 0:20 left",
    ]
    assert live.totals == {"responses": Tally(asked=10, cached=22), "leaderboard": Tally()}


def test_a_long_partition_speaks_every_half_minute_and_no_oftener(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    out = io.StringIO()
    live = TerminalProgress(out)
    for second in range(100):
        now[0] = float(second)
        live.tick("responses", "a cell", second, 100)
    lines = out.getvalue().splitlines()
    assert [line.split(": ")[1] for line in lines] == ["30 of 100", "60 of 100", "90 of 100"]
    assert LIVE_SECONDS == 30


def test_calls_are_told_every_half_minute_with_pace_latency_money_and_time_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    out = io.StringIO()
    live = TerminalProgress(out)
    live.asking("responses", "gpt", wanted=100, cached=7)
    for second in range(1, 41):
        now[0] = float(second)
        live.called("responses", "gpt", failed=second == 5, latency_s=second / 10, dollars=0.25)
    (line,) = out.getvalue().splitlines()  # at 30 s
    said = " ".join(line.split())
    # p50 and p95 of 0.1 .. 3.0 s; 70 of 100 are left at one a second
    assert said == ("responses gpt: 30 of 100, 7 cached, 1 errors, 1.0/s, p50 1.6 s, p95 2.9 s, $7.50, 1:10 left")


def test_a_terminal_shows_who_is_asked_as_a_live_table(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    out = io.StringIO()
    monkeypatch.setattr(out, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    live = TerminalProgress(out)
    live.asking("responses", "gpt", wanted=10, cached=0)
    for second in range(1, 6):
        now[0] = float(second)
        live.called("responses", "gpt", failed=False, latency_s=0.5, dollars=0.0)
    live.close()
    shown = out.getvalue()
    assert "gpt" in shown and "5 of 10" in shown and "p95" in shown
