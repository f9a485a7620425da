"""How a table of `assets/published` becomes a printed table without any arithmetic on its figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from traps_pipeline.report.writing import Column, PrintedTable
from traps_pipeline.scoring.published import as_printed

if TYPE_CHECKING:
    import pandas as pd


def of_paper(name: str, rows: pd.DataFrame, columns: Sequence[Column]) -> PrintedTable:
    """Return the paper's table `name` of `tables.csv`, which has its title, its place in the paper and its notes."""
    (about,) = as_printed("tables").query("name == @name").to_dict("records")
    where = f"as the paper prints it, line {about['line']} of its source"
    notes = [where, *([str(about["note"])] if about["note"] else [])]
    return PrintedTable(
        name,
        str(about["title"]),
        rows.reset_index(drop=True),
        columns,
        notes,
        dash="not given in the paper",
        deviation="± standard deviation over three runs",
    )


def figures(names: Mapping[str, str]) -> list[Column]:
    """Return columns of figures (field: heading), which are shown as the paper prints them."""
    return [Column(field, heading, "range") for field, heading in names.items()]


def with_spread(rows: pd.DataFrame, fields: Iterable[str], spreads: Iterable[str]) -> pd.DataFrame:
    """Return the rows with `field ± spread` in place of each field whose spread is printed."""
    changed = {}
    for field, spread in zip(fields, spreads, strict=True):
        pairs = zip(rows[field], rows[spread], strict=True)
        changed[field] = [f"{value} ± {deviation}" if deviation else value for value, deviation in pairs]
    return rows.assign(**changed)


def in_text(card: str) -> list[PrintedTable]:
    """Return the figures that stand only in the paper's text and belong to this card; no table if there are none."""
    rows = as_printed("other").query("card == @card")
    columns = [
        Column("model", "Model"), Column("quantity", "Quantity"), Column("printed", "Value", "range"),
        Column("line", "Line", "range"),
    ]  # fmt: skip
    table = PrintedTable(f"{card}_text", "In the paper’s text", rows.reset_index(drop=True), columns)
    return [table] if len(rows) else []
