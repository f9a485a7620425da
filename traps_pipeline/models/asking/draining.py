"""Stop asking on Ctrl-C, SIGTERM and SIGHUP, once the calls in flight are answered."""

import asyncio
import os
import signal
import threading
from typing import Any

from traps_pipeline.base import progress

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
GRACE_S = 30.0  # grace period of calls in flight after SIGTERM or SIGHUP
END_S = 1.5  # grace period after the second signal
INTERRUPTED = 130  # the exit code of a stopped run


class drain_on_interrupt:  # noqa: N801 - reads as a verb where it is used
    """A guard that routes stop signals to the stop event while a loop works.

    A person who presses Ctrl-C can press it again; a sender of SIGTERM or SIGHUP will kill the process some time later,
    so calls in flight get GRACE_S to finish. A call given up stays reserved with its worst case.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, stop: asyncio.Event) -> None:
        self._loop, self._stop = loop, stop
        self._main = threading.current_thread() is threading.main_thread()
        self._former: dict[signal.Signals, Any] = {}

    def __enter__(self) -> None:
        for signal_number in STOP_SIGNALS if self._main else ():
            handler = signal.getsignal(signal_number)
            if (
                signal_number is signal.SIGINT or handler is not signal.SIG_IGN
            ):  # `nohup` lets a run outlive its terminal
                self._former[signal_number] = handler
                signal.signal(signal_number, lambda number, _: self._interrupt(signal.Signals(number)))

    def _interrupt(self, by: signal.Signals) -> None:
        if self._stop.is_set():
            # Calls cancelled now are in the ledger or stay reserved: do not report how they end.
            self._loop.set_exception_handler(lambda *_: None)
            self._loop.call_soon_threadsafe(self._cancel)
            end = threading.Timer(END_S, os._exit, (INTERRUPTED,))  # whatever still holds the process then
            end.daemon = True
            end.start()
            return
        self._stop.set()
        wait_text, advice = "", "Ctrl-C again stops at once"
        if by is not signal.SIGINT:
            wait_text, advice = f", {GRACE_S:.0f} s at most", f"{by.name} again stops at once"
            self._loop.call_soon_threadsafe(self._loop.call_later, GRACE_S, self._cancel)
        self._loop.call_soon_threadsafe(lambda: None)  # wakes the loop from its select
        report = progress.current()
        report.is_stopping = True
        report.note(f"{by.name}: {report.waiting()}{wait_text} ({advice})")

    def _cancel(self) -> None:
        for task in asyncio.all_tasks(self._loop):
            task.cancel()

    def __exit__(self, *_: object) -> None:
        for signal_number, handler in self._former.items():
            signal.signal(signal_number, handler or signal.SIG_DFL)
        self._former.clear()
