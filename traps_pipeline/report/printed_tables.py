"""Show the paper's tables as printed (`assets/published`), without arithmetic.

`tables.csv` gives each table's card, file and columns. A column is `FIELD=HEADING`, or a field of `COLUMNS`; `#` in
front of the field says that it is a number, a `%` or `×` behind it is printed after each value, and `|TEXT` in place of
an empty one. The files `arranged_*.csv` hold tables that the paper prints across (`tools/paper_audit/arranged.py`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

from traps_pipeline.report.tables.table_columns import DATASET, MODEL, with_titles
from traps_pipeline.report.writing import Column, PrintedTable
from traps_pipeline.scoring.published import as_printed

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = {
    column.field: column
    for column in (
        *(MODEL, DATASET, Column("regime", "Regime", look="tag"), Column("sub_scenario", "Sub-scenario")),
        *(Column("path", "Source → target"), Column("transfer_type", "Transfer type")),
    )
}
_DECLARED = re.compile(r"(?P<number>#?)(?P<field>[\w.-]+)(?P<unit>[%×]?)(?:\|(?P<empty>[^=]+))?(?:=(?P<heading>.+))?")
# The rows whose model is marked, since they are of another evaluation or read from other evidence.
_DAGGERS = {"visual_vs_textual": ("epoch", "verification"), "confabulation_taxonomy": ("doubt_read_from", "trace")}


def paper_tables(card: str) -> list[PrintedTable]:
    """Return the paper's tables of a card, and its scores that only the paper's text states, if any."""
    tables = [_paper_table(place) for place in as_printed("tables").query("card == @card").to_dict("records")]
    rows = as_printed("other").query("card == @card").reset_index(drop=True)
    columns = [Column("model", "Model"), Column("quantity", "Quantity")]
    columns += numbers({"printed": "Value", "line": "Line"})
    return [*tables, *([PrintedTable(f"{card}_text", "In the paper’s text", rows, columns)] if len(rows) else [])]


def _paper_table(place: Mapping[Any, str]) -> PrintedTable:
    """Return the table of a row of `tables.csv`."""
    rows, columns = _as_declared(place["file"], place["columns"])
    notes = [f"as the paper prints it (line {place['line']} of its LaTeX source)", *filter(None, [place["note"]])]
    return PrintedTable(
        place["name"], place["title"], rows.reset_index(drop=True), columns, notes,
        dash="not given in the paper", deviation="± standard deviation over three runs",
    )  # fmt: skip


def _as_declared(file: str, declared: str) -> tuple[pd.DataFrame, list[Column]]:
    """Return a file's rows as printed, and their columns."""
    rows, columns = titled_rows(file), list[Column]()
    for text in declared.split("; "):
        found = _DECLARED.fullmatch(text)
        assert found, f"tables.csv: {text!r} declares no column"
        field, unit, empty = found["field"], found["unit"], found["empty"] or ""
        rows[field] = ["∞" if value == "inf" else value + unit if value else empty for value in rows[field]]
        kind = "range" if found["number"] else "text"
        columns.append(Column(field, found["heading"], kind) if found["heading"] else COLUMNS[field])
    return rows, columns


def titled_rows(file: str) -> pd.DataFrame:
    """Return the rows of a published file, with printed titles of datasets, paths and marks."""
    rows: pd.DataFrame = as_printed(file)
    if file.startswith("arranged_"):
        return rows
    if "dataset" in rows:
        rows = with_titles(rows)
    if {"source", "target"} <= {*rows}:
        rows = rows.assign(path=rows["source"] + " → " + rows["target"])
    if "same_target" in rows:
        rows = rows.assign(target="→ " + rows["same_target"] + " / → " + rows["cross_target"])
    if file in _DAGGERS:
        column, marked = _DAGGERS[file]
        rows["model"] = rows["model"] + ["†" if value == marked else "" for value in rows[column]]
    return rows


def numbers(names: Mapping[str, str]) -> list[Column]:
    """Return table columns of metrics (field: heading), formatted as in the paper."""
    return [Column(field, heading, "range") for field, heading in names.items()]


@cache
def audit_table() -> PrintedTable:
    """Return the table of the paper's statements that differ from its tables, with line and arithmetic."""
    from traps_pipeline.scoring.audit import DECLARED, DIFFERS, audit, counts_text  # pandas takes long to import

    findings = audit()
    rows = findings.loc[findings["verdict"].isin([DIFFERS, DECLARED])].reset_index(drop=True)
    columns = [
        Column("line", "Line"), Column("group", "Group"), Column("statement", "Statement"),
        Column("published", "Published"), Column("recomputed", "Recomputed, or elsewhere"),
        Column("verdict", "Verdict"), Column("reason", "Why"),
    ]  # fmt: skip
    return PrintedTable(
        "audit", "Statements that the paper’s tables do not give", rows, columns, [counts_text(findings)]
    )
