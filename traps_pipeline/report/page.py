"""The report page: leaderboards, then figures and tables of the study beside the paper's (docs/spec.md 10)."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import pandas as pd

from traps_pipeline.report.leaderboard_page import leaderboards, legend, provenance
from traps_pipeline.report.writing import Behind, PrintedTable, environment, table_html

WIDE_PX = 1300  # a picture with more pixels across gets the width of the page


@dataclass(frozen=True)
class Block:
    """One side of a card: the source of the results, and a PNG (base64) or tables (title, escaped HTML)."""

    source: str
    png: str = ""
    tables: Sequence[tuple[str, str]] = ()
    size: str = "column"


@dataclass(frozen=True)
class Card:
    """A figure, or tables, of the study beside the paper's. note: what it shows."""

    name: str
    title: str
    blocks: Sequence[Block]
    note: str = ""


def report_html(
    board: pd.DataFrame,
    figures: Mapping[str, bytes] | None = None,
    chapters: Sequence[tuple[str, Sequence[Card]]] = (),
    address: Callable[[Behind], str] | None = None,
    title: str = "TRAPSBench report",
    robust: pd.DataFrame | None = None,
    said: Sequence[str] = (),
    terms: Mapping[str, str] | None = None,
) -> str:
    """The page: leaderboard, figures (title -> PNG bytes, inlined), legend, one table per dataset, then the chapters.

    robust: ROBUST rows, whose figures the leaderboard shows; said: further notes below it; terms: further words
    of the legend. With `address`, every number is a link to the items behind it. The page opens from disk and makes no
    network request; its content policy forbids any.
    """
    return (
        environment()
        .get_template("report.html.j2")
        .render(
            title=title,
            provenance=provenance(board),
            boards=[(table.title, table_html(table, address)) for table in leaderboards(board, robust, said)],
            figures={name: base64.b64encode(png).decode() for name, png in (figures or {}).items()},
            chapters=chapters,
            all_items=address(Behind()) if address else "",
            legend={**legend(board, robust), **(terms or {})},
        )
    )


def picture_block(source: str, png: bytes, full: bool = False) -> Block:
    """A picture as a card's block, one column or one page wide, which depends on the PNG's own width. full: as wide as
    the screen allows."""
    size = "full" if full else "page" if int.from_bytes(png[16:20], "big") > WIDE_PX else "column"
    return Block(source, base64.b64encode(png).decode(), size=size)


def table_block(source: str, tables: Sequence[PrintedTable], address: Callable[[Behind], str] | None) -> Block:
    """Tables as a card's block."""
    return Block(source, tables=[(table.title, table_html(table, address)) for table in tables])
