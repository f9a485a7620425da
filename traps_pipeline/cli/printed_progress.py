"""Print a run's progress to standard error: a live region, text lines or JSON."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TextIO

from typing_extensions import override

from traps_pipeline.base.progress import HEARTBEAT_S, Progress, StageProgress, Tally, as_clock
from traps_pipeline.base.terminal import plain
from traps_pipeline.base.wording import count_noun

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table

Form = Literal["auto", "plain", "json"]
MAX_ROWS = 12  # models and judges in the live region
_OF_CALLS, _WIDE = 64, 100  # columns of the live table beside the name; of a terminal that shows the pace, too


def make_progress(form: Form = "auto", stream: TextIO | None = None) -> PrintedProgress:
    """Start and return a progress printer; `auto` is live on a terminal, else text."""
    output: TextIO = stream or sys.stderr or Path(os.devnull).open("w")  # noqa: SIM115 - None where closed (`2>&-`)
    is_terminal = output.isatty() and os.environ.get("TERM", "dumb") not in ("dumb", "unknown")
    kind = LiveProgress if form == "auto" and is_terminal else PrintedProgress
    report = JsonProgress(output) if form == "json" else kind(output)
    report.start()
    return report


class PrintedProgress(Progress):
    """Progress as text: a line per long stage, one for all others, and one every 30 s of the running stage."""

    beat_s = HEARTBEAT_S

    def __init__(self, stream: TextIO) -> None:
        super().__init__()
        self._stream, self._is_gone = stream, False
        self._printing = threading.RLock()  # a signal handler may add a note while its own thread prints
        self._tables, self._tables_s = 0, 0.0
        self._closed = threading.Event()

    def start(self) -> None:
        """Start printing the state of the running stage."""
        threading.Thread(target=self._beat, daemon=True).start()

    @override
    def end_stage(self) -> None:
        stage = self.current_stage
        super().end_stage()
        if stage is None or not stage.partitions:
            return
        if stage.work() or stage.seconds >= HEARTBEAT_S or (self.is_stopping and stage.calls):
            self.write(self.summary(stage))
        else:
            self._tables, self._tables_s = self._tables + stage.done - stage.empty, self._tables_s + stage.seconds

    @override
    def expect(self, stage: str, calls: Mapping[str, tuple[int, int]], cells: float) -> None:
        super().expect(stage, calls, cells)
        if any(missing for missing, _ in calls.values()):
            with self._printing:
                self.beat()

    @override
    def close(self) -> None:
        super().close()
        self._closed.set()
        if self._tables and not self.is_stopping:
            tables = count_noun(self._tables, "table or figure", "tables and figures")
            self.write(f"{tables}, {self._tables_s:.0f} s")
            self._tables, self._tables_s = 0, 0.0

    @override
    def note(self, text: str) -> None:
        self.write(f"! {plain(text)}")

    def tell(self, text: str) -> None:
        """Print a result that the user waits for."""
        self.write(text)

    def beat(self) -> None:
        """Print the state of the running stage; called every 30 s."""
        if self.current_stage is not None:
            self.write(self.line())

    def write(self, text: str) -> None:
        """Print untrusted text; a closed stream ends the run as SIGTERM would."""
        try:
            with self._printing:
                for line in text.split("\n"):
                    self.print_line(plain(line))
        except OSError:
            if self._is_gone:
                return
            self._is_gone, self._stream = True, Path(os.devnull).open("w")  # noqa: SIM115 - until the process ends
            signal.raise_signal(signal.SIGTERM)

    def print_line(self, line: str) -> None:
        """Print a line of printable text."""
        print(line, file=self._stream, flush=True)

    def _beat(self) -> None:
        while not self._closed.wait(self.beat_s):
            with self._printing:
                if not self._closed.is_set():
                    self.beat()


class JsonProgress(PrintedProgress):
    """Progress as JSON lines: `begin`, `end` (stages), `progress`, `note`, `finish`."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream)
        self._began = time.monotonic()

    @override
    def stage(self, name: str, partitions: int) -> None:
        super().stage(name, partitions)
        self._event("begin", self.state())

    @override
    def end_stage(self) -> None:
        if self.current_stage is not None:
            self._event("end", self.state() | vars(self.current_stage.tally))
        Progress.end_stage(self)

    @override
    def note(self, text: str) -> None:
        self._event("note", {"text": plain(text)})

    tell = note

    @override
    def close(self) -> None:
        super().close()
        total = Tally()
        for tally in self.totals.values():
            total.add(tally)
        self._event("finish", {"seconds": round(time.monotonic() - self._began, 1), **self.state(), **vars(total)})

    @override
    def beat(self) -> None:
        if self.current_stage is not None:
            self._event("progress", self.state())

    def _event(self, name: str, values: dict[str, Any]) -> None:
        at = datetime.now(UTC).isoformat(timespec="seconds")
        self.write(json.dumps({"event": name, "at": at, **values}, ensure_ascii=False))


class LiveProgress(PrintedProgress):
    """A live region at the terminal's bottom, below scrolling lines of stages."""

    beat_s = 0.3

    def __init__(self, stream: TextIO) -> None:
        from rich.console import Console
        from rich.live import Live

        super().__init__(stream)
        self._idle, self._idle_since = "starting", time.monotonic()
        self._console = Console(file=stream, highlight=False, markup=False, emoji=False)
        self._live = Live(
            console=self._console,
            get_renderable=self._region,
            auto_refresh=False,  # rich's own thread and a print of this one would erase each other's lines
            transient=True,
            redirect_stdout=sys.stdout.isatty(),
        )

    @override
    def start(self) -> None:
        self._live.start(refresh=True)
        super().start()

    @override
    def end_stage(self) -> None:
        super().end_stage()
        self._idle, self._idle_since = "looking for what is left to make", time.monotonic()

    @override
    def close(self) -> None:
        with self._printing:
            self._closed.set()
            self._live.stop()
        super().close()

    def beat(self) -> None:
        """Draw the live region of the terminal again."""
        self._live.refresh()

    @override
    def print_line(self, line: str) -> None:
        from rich.text import Text

        self._console.print(Text(line))

    def _region(self) -> Group:
        from rich.console import Group
        from rich.text import Text

        if (now := self.current_stage) is None:
            idle = "stopping" if self.is_stopping else self._idle
            return Group(Text(f"{idle}  {as_clock(time.monotonic() - self._idle_since)}", style="dim"))
        lines: list[Any] = [Text(self._heading(now), style="bold", no_wrap=True, overflow="ellipsis")]
        if now.detail and not self.is_stopping:
            lines.append(Text(plain(f"  {now.detail}"), no_wrap=True, overflow="ellipsis"))
        return Group(*lines, *([self._calls(now)] if now.calls else []))

    def _heading(self, now: StageProgress) -> str:
        """Return the stage, partitions, times and money, within 80 columns."""
        if self.is_stopping:
            return f"{now.name}  {self.waiting()}"
        counts = f"  {now.done:,} of {now.partitions:,} made" if now.partitions else ""
        time_left = "" if now.left_s is None else f", {as_clock(now.left_s)} left"
        money = f"  {self.spent()}" if self.budget_usd and now.calls else ""
        return f"{now.name}{counts}  {as_clock(now.seconds)}{time_left}{money}"

    def _calls(self, now: StageProgress) -> Table:
        from rich.table import Table
        from rich.text import Text

        table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False, header_style="dim")
        table.add_column("")
        width = self._console.width
        pace_heading = ("pace",) if width >= _WIDE else ()
        for heading in ("done", "in flight", *pace_heading, "p50", "p95", "errors", "retries", "spent"):
            table.add_column(heading, justify="right", no_wrap=True)
        rows = sorted(now.calls.items(), key=lambda pair: pair[1].done >= pair[1].wanted)
        max_rows = max(1, min(MAX_ROWS, self._console.height - 6))
        for participant, traffic in rows[:max_rows]:
            name = Text(plain(participant), no_wrap=True)
            name.truncate(max(10, width - _OF_CALLS), overflow="ellipsis")
            in_flight = f"{len(traffic.sent_at):,}, {traffic.oldest_s:.0f} s" if traffic.sent_at else "-"
            cells = [f"{traffic.done:,}/{traffic.wanted:,}", in_flight]
            cells += [f"{traffic.per_second:.1f}/s"] if pace_heading else []
            cells += [f"{traffic.latency_s(share):.1f} s" if traffic.done else "-" for share in (0.5, 0.95)]
            table.add_row(name, *cells, f"{traffic.errors:,}", f"{traffic.retries:,}", f"${traffic.dollars:,.2f}")
        if len(rows) > max_rows:
            table.add_row(f"and {len(rows) - max_rows} more")
        return table
