"""A table is plain text in a pipe and styled on a terminal, and whole in both, however narrow."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys

import pytest

from tests.conftest import ROOT
from traps_pipeline.base.terminal import text_table

HEADINGS = ("model", "n", "what was refused")
REFUSED = "[red]calls[/red] " + "after a time-out " * 8 + "end"
ROWS = (("oracle", 7, "nothing"), ("a-model-of-a-long-name", 1234, REFUSED))


def test_columns_of_a_pipe_are_apart_by_blanks_alone_and_numbers_stand_to_the_right() -> None:
    lines = text_table(HEADINGS, ROWS, left=(0, 2)).splitlines()
    assert lines[0] == "model                      n  what was refused"
    assert lines[1] == "oracle                     7  nothing"
    assert [len(line) for line in lines[:2]] == [len(line.rstrip()) for line in lines[:2]]


def test_no_cell_is_wrapped_cut_or_taken_for_markup_in_a_narrow_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    lines = text_table(HEADINGS, ROWS, left=(0, 2)).splitlines()
    assert len(lines) == 3
    assert lines[2].endswith(REFUSED)


def test_a_cell_cannot_steer_a_terminal_or_break_its_line() -> None:
    (_, line) = text_table(["id"], [["a\x1b[2Jb\nc\rd"]]).splitlines()
    assert line == "a?[2Jb c?d"


def test_wide_characters_keep_the_columns_below_each_other() -> None:
    lines = text_table(["id", "n"], [["日本", 1], ["abcd", 2]]).splitlines()
    assert lines[1:] == ["日本  1", "abcd  2"]


def test_a_terminal_gets_bold_headings_and_a_rule_and_every_cell_whole() -> None:
    code = f"from traps_pipeline.base.terminal import text_table; print(text_table({HEADINGS!r}, {ROWS!r}, (0, 2)))"
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "40"}
    environment.pop("NO_COLOR", None)
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, cwd=ROOT, env=environment, stdout=theirs) as process:
        os.close(theirs)
        shown = b""
        while chunk := _read(ours):
            shown += chunk
    os.close(ours)
    assert process.returncode == 0
    text = shown.decode().replace("\r\n", "\n")
    assert "\x1b[1m" in text.splitlines()[0]
    lines = re.sub(r"\x1b\[[0-9;]*m", "", text).splitlines()
    assert lines[0].split() == " ".join(HEADINGS).split()
    assert set(lines[1]) == {"─"}
    assert lines[3].endswith(REFUSED)


def _read(terminal: int) -> bytes:
    """What a process has written to its terminal; empty at its end, of which Linux tells by an error."""
    try:
        return os.read(terminal, 65536)
    except OSError:
        return b""
