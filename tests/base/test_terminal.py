"""A table is plain text in a pipe, whole however wide; on a terminal it is styled and fits."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.conftest import ROOT
from tests.terminals import run_in_terminal
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


@pytest.mark.parametrize("columns", [40, 400])
def test_a_terminal_gets_headings_with_a_rule_and_the_columns_that_fit(columns: int) -> None:
    code = f"from traps_pipeline.base.terminal import text_table; print(text_table({HEADINGS!r}, {ROWS!r}, (0, 2)))"
    environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "NO_COLOR")}
    returned, screen = run_in_terminal([sys.executable, "-c", code], columns, 24, ROOT, environment)
    assert returned == 0
    lines = screen.text.splitlines()
    assert set(lines[1].rstrip()) == {"─"}
    if columns == 40:
        assert lines[0].split() == ["model", "n"] and lines[3].split() == ["a-model-of-a-long-name", "1234"]
        hidden = " ".join(lines[4:])
        assert "40" in hidden and hidden.endswith(HEADINGS[2])
    else:
        assert lines[0].split() == " ".join(HEADINGS).split()
        assert lines[3].endswith(REFUSED)


def test_lines_of_a_terminal_are_broken_between_words_and_their_rest_is_indented() -> None:
    text = f"stage is not fresh\n    reason: {'words ' * 20}end"
    code = f"from traps_pipeline.base.terminal import wrap_text; print(wrap_text({text!r}))"
    environment = {name: value for name, value in os.environ.items() if name != "COLUMNS"}
    returned, screen = run_in_terminal([sys.executable, "-c", code], 80, 24, ROOT, environment)
    first, reason, *rest = screen.text.splitlines()
    assert returned == 0 and screen.widest <= 80
    assert (first, reason[:18]) == ("stage is not fresh", "    reason: words ") and reason.endswith("words")
    assert rest and all(line.startswith("        w") for line in rest)
    piped = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert piped.stdout == text + "\n"
