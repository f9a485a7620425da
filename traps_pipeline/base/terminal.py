"""Make hidden characters in untrusted text visible, and format tables."""

import re
import shutil
import sys
import textwrap
import unicodedata
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TextIO

from traps_pipeline.base.redaction import redact

_GAP = 2  # blanks between the columns of a table


# Controls, and what Unicode calls default ignorable, with all marks of direction; as HIDDEN in the explorer's dom.js.
_HIDDEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u034f\u061c\u115f\u1160\u17b4\u17b5\u180b-\u180f\u200b-\u200f\u2028-\u202e"
    "\u2060-\u206f\u3164\ufe00-\ufe0f\ufeff\uffa0\ufff0-\ufffb\U0001bca0-\U0001bca3\U0001d173-\U0001d17a\U000e0000-\U000e0fff]"
    "(?<!\\r(?=\\n))"
)
_JOINER, _EMOJI_STYLE = "\u200d", "\ufe0f"


def escape_invisible(text: str) -> str:
    """Escape invisible and direction-changing characters in a text as `[U+202E]`.

    Line ends and tabs stay, and so do an emoji's variation selector and joiner. Every page and every value for Dagster
    passes through here; the type (`Markup`) is preserved.
    """
    if text.isascii() and text.isprintable():  # most of a page's values, for which no expression need run
        return text
    return type(text)(_HIDDEN.sub(_number, text)) if _HIDDEN.search(text) else text


def _number(match: re.Match[str]) -> str:
    start, end = match.span()
    previous_character, next_character = match.string[max(0, start - 1) : start], match.string[end : end + 1]
    is_emoji = unicodedata.category(previous_character or " ") in ("So", "Sk") or previous_character == _EMOJI_STYLE
    if match[0] == _EMOJI_STYLE and (is_emoji or previous_character in "0123456789#*") and previous_character:
        return match[0]
    if match[0] == _JOINER and is_emoji and unicodedata.category(next_character or " ") == "So":
        return match[0]
    return f"[U+{ord(match[0]):04X}]"


def finalize_value(value: object) -> object:
    """Format an expression's value for a Jinja2 template (its `finalize`)."""
    return escape_invisible(value) if isinstance(value, str) else value


def plain(text: object) -> str:
    """Return text on one line, without terminal control sequences and without keys."""
    return _printable(redact(str(text)))


def _printable(text: str) -> str:
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else " " if c in "\n\t" else "?" for c in text)


def wrap_text(text: str, stream: TextIO | None = None, *, hang: int | None = None) -> str:
    """Return lines for a stream (default: stdout), wrapped at words on a terminal.

    hang: extra indentation of continuation lines, in columns (default: 4 if the line is indented, else 0).
    """
    if not (stream or sys.stdout).isatty():
        return text
    columns = shutil.get_terminal_size().columns
    lines = []
    for line in text.split("\n"):
        indent = len(line) - len(line.lstrip())
        continuation_indent = " " * (indent + (4 if indent else 0) if hang is None else indent + hang)
        options: dict[str, Any] = {
            "break_long_words": False,
            "break_on_hyphens": False,
            "subsequent_indent": continuation_indent,
        }
        lines.append(textwrap.fill(line, columns, **options))
    return "\n".join(lines)


def text_table(headings: Sequence[str], rows: Iterable[Sequence[object]], left: Collection[int] = (0,)) -> str:
    """Return a table as lines of text for standard output; cells are untrusted.

    The columns in `left` (by index) are left-aligned, the others right-aligned. On a terminal the headings are bold
    above a rule, and if it is too narrow the last columns are left out and named. Elsewhere lines are plain, with two
    or more spaces between columns. No cell is wrapped or cut.
    """
    from rich.cells import cell_len

    is_styled = sys.stdout.isatty()
    cells = [[plain(heading) for heading in headings], *([_printable(str(cell)) for cell in row] for row in rows)]
    widths = [max(map(cell_len, column)) for column in zip(*cells, strict=True)]
    count, hidden = len(headings), ""
    if is_styled:
        columns = shutil.get_terminal_size().columns
        while count > 1 and sum(widths[:count]) + _GAP * (count - 1) > columns:
            count -= 1
        names = ", ".join(map(str.strip, cells[0][count:]))
        hidden = "\n" + wrap_text(f"not shown in {columns} columns: {names}") if names else ""
    lines = list[str]()
    for row in cells:
        blanks = [" " * (width - cell_len(cell)) for width, cell in zip(widths, row, strict=True)]
        aligned = [c + b if k in left else b + c for k, (c, b) in enumerate(zip(row, blanks, strict=True))]
        lines.append((" " * _GAP).join(aligned[:count]).rstrip())
    if is_styled:
        lines[:1] = [f"\x1b[1m{lines[0]}\x1b[0m", "─" * (sum(widths[:count]) + _GAP * (count - 1))]
    return redact("\n".join(lines) + hidden)


@dataclass(frozen=True)
class TextTable:
    """A table with its title (one or more lines) and notes before it is laid out; a JSON object holds it.

    absence: is printed instead of rows, unless it is empty. left: the left-aligned columns, by index.
    """

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    left: Sequence[int]
    absence: str
    notes: Sequence[str]

    def text(self) -> str:
        """Return title, table and notes for standard output, like `text_table`."""
        table = wrap_text(plain(self.absence)) if self.absence else text_table(self.headings, self.rows, self.left)
        notes = [wrap_text(plain(note)) for note in self.notes]
        title = [wrap_text(plain(line)) for line in self.title.splitlines()]
        return "\n".join([*title, "", table, *([""] if notes else []), *notes]) + "\n"
