"""Progress of a run: lines for a log, lines of JSON for a program, a live region for a person at a terminal."""

from __future__ import annotations

import io
import json
import os
import time

import pytest

from tests.terminals import Screen, read_all, terminal
from traps_pipeline.base.progress import HEARTBEAT_S, Progress, Tally, use_progress
from traps_pipeline.cli import main
from traps_pipeline.cli.printed_progress import LiveProgress, make_progress

WORDS = "a provider's words that are longer than the eighty columns of a terminal, so that they stand on two lines"


class Clock:
    """The seconds that the package's clock shows."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        monkeypatch.setattr(time, "monotonic", lambda: self.now)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def ask(report: Progress, clock: Clock) -> None:
    """Ask a model for forty seconds: two of four cells, a call each second, the fifth of which fails."""
    report.money(1.0, 50.0)
    report.stage("responses", 4)
    for cell in range(2):
        report.asking("responses", {"gpt": (20, 7)})
        for _ in range(20):
            clock.now += 1.0
            report.called("gpt", clock.now == 5, latency_s=clock.now / 10, dollars=0.25)
        if cell == 0:
            report.partition("responses", "a", Tally(asked=20, cached=7, errors=1))
    report.retried("gpt")


def test_a_line_has_pace_latency_failures_money_and_time_left(clock: Clock) -> None:
    report = Progress()
    ask(report, clock)
    # 40 calls in 40 s, whose median took 2.1 s; all calls of 2 of 4 cells are made, so as long again is left
    line = "responses: 1 of 4 made, 40 of 40 calls, 1.0/s at 2.1 s, 1 error, 1 retry, $11.00 of $50.00, 0:40 left"
    assert report.line() == line


def test_the_time_left_of_a_large_cell_is_that_of_the_slices_to_come(clock: Clock) -> None:
    report = Progress()
    report.stage("votes", 1)
    for _ in range(3):  # of five
        report.asking("votes", {"judge": (10, 0)}, share=1 / 5)
        for _ in range(10):
            clock.now += 1.0
            report.called("judge", False, latency_s=1.0, dollars=0.0)
    assert report.line() == "votes: 0 of 1 made, 30 of 30 calls, 1.0/s at 1.0 s, 0:20 left"


def test_a_listener_hears_of_a_stage_every_half_minute_and_at_its_end(clock: Clock) -> None:
    report, lines = Progress(), list[str]()
    with report.reporting_to(lines.append):
        report.stage("videos", 1)
        for second in range(100):
            clock.now = float(second)
            report.tick("videos", "scenarios", second, 100)
        report.partition("videos", "plinko", Tally(frames=50))
        report.end_stage()
    assert [line.split(": ")[2].split(",")[0] for line in lines[:3]] == ["30 of 100", "60 of 100", "90 of 100"]
    assert lines[3:] == ["videos: 1 of 1 made, 50 frames, 1:39"]
    assert HEARTBEAT_S == 30


def test_a_log_has_a_line_for_each_stage_that_worked_and_one_for_all_tables(clock: Clock) -> None:
    out = io.StringIO()
    report = make_progress("auto", out)
    ask(report, clock)
    for name in ("verdicts", "metrics", "figure_patching"):
        report.stage(name, 2)
        clock.now += 3.0
        report.partition(name, "a", Tally())
        report.partition(name, "b", Tally(), is_empty=name == "figure_patching")
    report.note("something\x1b[2J odd")
    report.tell("ok   gpt\n     note its price is unknown")
    report.close()
    assert out.getvalue().splitlines() == [
        "responses: 1 of 4 made, 20 asked, 7 from the ledger, 1 failed, 1 retried, $10.00, 0:40",
        "! something?[2J odd",
        "ok   gpt",
        "     note its price is unknown",
        "5 tables and figures, 9 s",
    ]
    assert report.totals["responses"] == Tally(asked=20, cached=7, errors=1)


def test_a_partition_that_became_stale_after_its_stage_began_counts_as_one_to_make(clock: Clock) -> None:
    out = io.StringIO()
    report = make_progress("auto", out)
    report.stage("votes", 1)
    clock.now = 4.0
    for key in ("a", "b"):
        report.partition("votes", key, Tally(asked=3))
    report.close()
    assert out.getvalue().splitlines() == ["votes: 2 of 2 made, 6 asked, 0:04"]


def test_no_time_is_said_to_be_left_before_a_stage_has_a_pace(clock: Clock) -> None:
    report = make_progress("auto", io.StringIO())
    report.stage("votes", 4)
    report.partition("votes", "a", Tally(asked=3))
    clock.now = 4.0  # its judges' libraries are loaded, and little else
    assert report.line() == "votes: 1 of 4 made, 0:04 so far"
    clock.now = 10.0
    assert report.line() == "votes: 1 of 4 made, 0:30 left"


def test_lines_of_json_have_the_same_numbers(clock: Clock) -> None:
    out = io.StringIO()
    report = make_progress("json", out)
    ask(report, clock)
    report.beat()
    report.note("slow")
    report.tell("ok   gpt")
    report.close()
    begin, progress, note, result, end, finish = map(json.loads, out.getvalue().splitlines())
    assert (begin["event"], begin["stage"], begin["done"], begin["partitions"]) == ("begin", "responses", 0, 4)
    assert (progress["event"], progress["spent_usd"], progress["budget_usd"]) == ("progress", 11.0, 50.0)
    assert progress["left_s"] == 40.0
    gpt = {"done": 40, "wanted": 40, "cached": 14, "errors": 1, "retries": 1, "in_flight": 0, "oldest_s": 0.0}
    assert progress["calls"] == {"gpt": gpt | {"per_second": 1.0, "p50_s": 2.1, "p95_s": 3.9, "usd": 10.0}}
    assert (note["event"], note["text"], result["text"]) == ("note", "slow", "ok   gpt")
    assert (end["event"], end["asked"], end["errors"]) == ("end", 20, 1)
    assert (finish["event"], finish["asked"], finish["spent_usd"]) == ("finish", 20, 11.0) and "stage" not in finish


def test_the_calls_of_all_cells_and_those_in_flight_are_told_from_the_first_line(clock: Clock) -> None:
    out = io.StringIO()
    report = make_progress("json", out)
    report.money(0.0, 20.0)
    report.stage("responses", 8)
    report.expect("responses", {"gpt": (32, 4), "known": (0, 36)}, 8)
    with report.in_flight("gpt"), report.in_flight("gpt"):
        clock.now = 41.0
        report.called("gpt", False, latency_s=41.0, dollars=0.0)
        # two in flight, one done of 32 calls in 41 s: as much again 31 times
        line = "1 of 32 calls, 2 in flight (the oldest 0:41), 0.0/s at 41.0 s, $0.00 of $20.00, 21:11 left"
        assert report.line() == f"responses: 0 of 8 made, {line}"
        report.beat()
    begin, first, later = map(json.loads, out.getvalue().splitlines())
    assert begin["budget_usd"] == first["budget_usd"] == 20.0
    assert (first["event"], first["calls"]["gpt"]["wanted"], first["calls"]["gpt"]["done"]) == ("progress", 32, 0)
    assert (later["calls"]["gpt"]["in_flight"], later["calls"]["gpt"]["oldest_s"]) == (2, 41.0)
    assert report.state()["calls"]["gpt"]["in_flight"] == 0


def test_a_stopped_run_says_how_many_calls_it_waits_for_and_nothing_of_what_it_would_have_made(clock: Clock) -> None:
    out = io.StringIO()
    with pytest.raises(KeyboardInterrupt), use_progress(make_progress("plain", out)) as report:
        report.stage("metrics", 1)
        report.partition("metrics", "a", Tally())
        report.stage("responses", 8)
        report.expect("responses", {"gpt": (32, 0)}, 8)
        report.called("gpt", False, latency_s=1.0, dollars=0.25)
        with report.in_flight("gpt"):
            clock.now = 8.0
            report.is_stopping = True
            report.beat()
        raise KeyboardInterrupt
    assert out.getvalue().splitlines()[1:] == [
        "responses: stopping: waiting for 1 call in flight, the oldest for 0:08",
        "responses: 0 of 8 made, 1 of 32 calls, $0.25, 0:08",
    ]


def test_a_failure_among_lines_of_json_is_one_of_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "no-such-experiment", "--progress", "json"]) == 1
    (failure,) = map(json.loads, capsys.readouterr().err.splitlines())
    assert failure["event"] == "failure" and "'no-such-experiment'" in failure["text"]


@pytest.mark.parametrize(("columns", "rows"), [(80, 24), (160, 50)])
def test_a_terminal_has_one_region_at_its_bottom_that_leaves_nothing_behind(
    columns: int, rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"TERM": "xterm-256color", "COLUMNS": str(columns), "LINES": str(rows)}.items():
        monkeypatch.setenv(name, value)
    screen = Screen(columns)
    with terminal(columns, rows) as (ours, theirs), os.fdopen(os.dup(theirs), "w") as stream:
        report = make_progress("auto", stream)
        assert isinstance(report, LiveProgress)
        screen.feed(read_all(ours))
        assert screen.text.startswith("starting  0:0")  # imports take seconds
        screen.frames.clear()
        report.money(1234.5, 5000.0)
        report.stage("confabulation_votes", 32)
        report.asking("responses", {f"a-model-with-a-rather-long-name-{n}": (12345, 0) for n in range(30)})
        report.called("a-model-with-a-rather-long-name-7", True, 12.3, 1000.0)
        report.note(WORDS)
        report.beat()
        screen.feed(read_all(ours))
        report.partition("confabulation_votes", "a", Tally(asked=1))
        report.close()
        screen.feed(read_all(ours))
    shown = [line for line in screen.frames[0] if line]
    note = shown.index(next(line for line in shown if line.startswith("! a provider")))
    assert "$2,234.50 of $5,000.00" in shown[note + (2 if columns == 80 else 1)]
    row = next(line for line in shown if "12.3 s" in line)
    assert row.split()[1:] == ["1/12,345", *row.split()[2:]] and "$1,000.00" in row
    assert len(shown) < rows and shown[-1].strip().startswith("and ")
    assert screen.widest <= columns
    assert screen.text.splitlines()[-1].startswith("confabulation_votes: 1 of 32 made, 1 asked")
    assert "p95" not in screen.text  # the region is gone
