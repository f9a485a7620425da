"""Text and tables for a terminal, and for whatever standard output is where it is none."""

from __future__ import annotations

import io
import sys
from collections.abc import Collection, Iterable, Sequence

from traps_pipeline.base.redaction import redact

_WIDE = 100_000  # columns: no table is wrapped or cut to the width of the screen


def plain(text: object) -> str:
    """Return text on one line that cannot steer a terminal and holds no key."""
    return _printable(redact(str(text)))


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else " " if c in "\n\t" else "?" for c in text)


def text_table(headings: Sequence[str], rows: Iterable[Sequence[object]], left: Collection[int] = (0,)) -> str:
    """A table as lines of text for standard output; cells are untrusted.

    The columns `left` (by place) are aligned to the left, the others to the right. On a terminal the headings are bold
    with a rule below; elsewhere lines are plain, with two spaces or more between columns. No cell is wrapped or cut.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    styled = sys.stdout.isatty()
    box, gap = (SIMPLE_HEAD, 1) if styled else (None, 2)  # a box adds a blank of its own between columns
    table = Table(box=box, padding=(0, gap, 0, 0), show_edge=False, pad_edge=False, header_style="bold")
    for place, heading in enumerate(headings):
        table.add_column(Text(plain(heading)), justify="left" if place in left else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(Text(_printable(str(cell))) for cell in row))
    lines = io.StringIO()
    Console(file=lines, width=_WIDE, force_terminal=styled).print(table)
    return redact("\n".join(line.rstrip() for line in lines.getvalue().splitlines()))
