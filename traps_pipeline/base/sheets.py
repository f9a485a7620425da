"""Write CSV files that a spreadsheet opens without executing their cells."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd


def no_formula(value: object) -> object:
    """Prefix a text with `'` if a spreadsheet would execute it as a formula."""
    return f"'{value}" if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r") else value


def csv_bytes(table: pd.DataFrame) -> bytes:
    """Return a table as CSV with a header, with spreadsheet formulas escaped."""
    escaped = table.copy(deep=False)
    for place, kind in enumerate(table.dtypes):
        if kind.kind not in "biuf":  # numbers are no formulas, and a table has thousands
            escaped.isetitem(place, table.iloc[:, place].map(no_formula))
    return escaped.to_csv(index=False).encode()
