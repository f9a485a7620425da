"""A terminal of a given size: runs a command in a pseudo-terminal and shows what a person would see on it."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import termios
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

_CONTROL = re.compile(rb"\x1b\[([?0-9;]*)([A-Za-z])|\r\n|[\r\n]|[^\x1b\r\n]+")


@dataclass
class Screen:
    """The lines that a program has printed, with the cursor's moves obeyed; `frames` are the lines after each feed."""

    columns: int
    lines: list[str] = field(default_factory=lambda: [""])
    row: int = 0
    column: int = 0
    frames: list[list[str]] = field(default_factory=list)
    widest: int = 0

    def feed(self, data: bytes) -> None:
        """Obey what a program has printed."""
        for match in _CONTROL.finditer(data):
            if match[2]:
                self._control(match[1], match[2])
            elif match[0] in (b"\r\n", b"\n"):
                self.row, self.column = self.row + 1, 0
                if self.row == len(self.lines):
                    self.lines.append("")
            elif match[0] == b"\r":
                self.column = 0
            else:
                text, line = match[0].decode("utf-8", "replace"), self.lines[self.row]
                self.lines[self.row] = line[: self.column] + text + line[self.column + len(text) :]
                self.column += len(text)
                self.widest = max(self.widest, len(self.lines[self.row]))
        self.frames.append([*self.lines])

    def _control(self, numbers: bytes, command: bytes) -> None:
        if command == b"A":
            self.row = max(0, self.row - int(numbers or 1))
        elif command == b"K":
            self.lines[self.row], self.column = "", 0

    @property
    def text(self) -> str:
        """What stands on the screen and above it."""
        return "\n".join(self.lines).rstrip()


@contextlib.contextmanager
def terminal(columns: int, rows: int) -> Iterator[tuple[int, int]]:
    """Open a pseudo-terminal; yield the file descriptors of its two ends: the person's and the program's."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
    try:
        yield ours, theirs
    finally:
        for end in (ours, theirs):
            with contextlib.suppress(OSError):
                os.close(end)


def read_all(end: int, wait_s: float = 0.2) -> bytes:
    """Return what a program has printed, once it prints nothing for a moment."""
    parts = list[bytes]()
    while select.select([end], [], [], wait_s)[0]:
        parts.append(os.read(end, 1 << 16))
    return b"".join(parts)


def run_in_terminal(
    command: Sequence[str],
    columns: int,
    rows: int,
    folder: Path,
    environment: Mapping[str, str],
    limit_s: float = 600,
    typed: Mapping[str, str] | None = None,
) -> tuple[int, Screen]:
    """Run a command in a terminal of this size; return its exit code and what it showed.

    typed: by a prompt, what a person types once it is shown.
    """
    screen, answers = Screen(columns), dict(typed or {})
    variables = {**environment, "TERM": "xterm-256color"}
    with terminal(columns, rows) as (ours, theirs):
        process = subprocess.Popen(
            command, stdin=theirs, stdout=theirs, stderr=theirs, cwd=folder, env=variables, start_new_session=True
        )
        until = time.monotonic() + limit_s
        while time.monotonic() < until:
            if select.select([ours], [], [], 0.2)[0]:
                screen.feed(os.read(ours, 1 << 16))
                for prompt in [prompt for prompt in answers if prompt in screen.text]:
                    os.write(ours, answers.pop(prompt).encode())
            elif process.poll() is not None:
                return process.returncode, screen
        process.kill()
    raise AssertionError(f"{' '.join(command)} did not end within {limit_s:.0f} s:\n{screen.text}")
