"""Progress on a terminal, or as lines if there is no terminal."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from traps_pipeline.base.progress import Progress, Tally, clock
from traps_pipeline.base.terminal import plain

if TYPE_CHECKING:
    from rich.live import Live
    from rich.table import Table

LIVE_SECONDS = 30.0
REDRAW_SECONDS, SLOW_CALL_SECONDS = 0.25, 0.2


class TerminalProgress(Progress):
    """Prints one line per partition with calls, cache hits and time left. During a long partition it shows the models
    and judges that are asked: on a terminal as a live table, elsewhere as a line for each every 30 s."""

    def __init__(self, stream: TextIO | None = None) -> None:
        super().__init__()
        self._stream = stream or sys.stdout
        self._live: Live | None = None
        self._done, self._total, self._began, self._spoke = 0, 0, time.monotonic(), time.monotonic()
        self._drawn = 0.0
        self._deaf = False

    def stage(self, name: str, partitions: int) -> None:
        """See `Progress`."""
        self.close()
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

    def called(self, stage: str, who: str, failed: bool, latency_s: float, dollars: float) -> None:
        """See `Progress`."""
        super().called(stage, who, failed, latency_s, dollars)
        if self._stream.isatty():
            self._show(stage)
        elif time.monotonic() - self._spoke >= LIVE_SECONDS:
            for (of, name), traffic in self.traffic.items():
                if of == stage and traffic.done < traffic.wanted:
                    self._say(f"  {stage:<12} {name}: {traffic.line()}")

    def close(self) -> None:
        """Remove the live table from the terminal."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def _show(self, stage: str) -> None:
        """Draw the live table, at most a few times per second, and only once a call has taken noticeably long."""
        now = time.monotonic()
        if self._live is None:
            if max(traffic.latency_s(1.0) for traffic in self.traffic.values()) < SLOW_CALL_SECONDS:
                return
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(file=self._stream), auto_refresh=False, transient=True)
            self._live.start()
        if now - self._drawn >= REDRAW_SECONDS:
            self._drawn = now
            self._live.update(self._table(stage), refresh=True)

    def _table(self, stage: str) -> Table:
        from rich.table import Table

        table = Table("asked", "done", "cached", "errors", "calls", "p50", "p95", "spent", "left", title=stage)
        for (of, name), traffic in self.traffic.items():
            if of == stage:
                table.add_row(name, *traffic.cells())
        return table

    def note(self, text: str) -> None:
        """See `Progress`."""
        self._say(f"  ! {text}")

    def _say(self, line: str) -> None:
        self._spoke, line = time.monotonic(), plain(line)  # a provider's or a file's words may be in it
        try:
            if self._live is not None:
                self._live.console.print(line, markup=False, highlight=False)
            else:
                print(line, file=self._stream, flush=True)
        except OSError:
            if self._deaf:
                return
            # Nobody listens any more: a closed pipe, a terminal that is gone. The run ends as after SIGTERM.
            self._deaf, self._stream = True, Path(os.devnull).open("w")  # noqa: SIM115 - until the process ends
            self._live = None
            signal.raise_signal(signal.SIGTERM)
