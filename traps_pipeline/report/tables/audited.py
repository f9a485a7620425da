"""The statements of the paper that its own tables and text do not bear out (`traps results audit`)."""

from __future__ import annotations

from functools import cache

from traps_pipeline.report.writing import Column, PrintedTable
from traps_pipeline.scoring.audit import DECLARED, DIFFERS, audit, counts_text


@cache
def audit_table() -> PrintedTable:
    """Return every statement that differs from what the paper's tables give, with its line and the arithmetic."""
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
