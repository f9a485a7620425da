"""CSV files that a spreadsheet opens."""

from __future__ import annotations

import csv

import pandas as pd

from traps_pipeline.base.sheets import csv_bytes


def test_a_text_that_a_spreadsheet_would_execute_is_a_text_and_numbers_stay_numbers() -> None:
    texts = ["=HYPERLINK(1)", "+1", "-1", "@SUM(A1)", "\t=1", "left", ""]
    table = pd.DataFrame({"text": texts, "value": [-1.5] * len(texts), "n": pd.array([-2] * len(texts), "Int64")})
    rows = list(csv.reader(csv_bytes(table).decode().splitlines()))[1:]
    assert [row[0] for row in rows] == ["'=HYPERLINK(1)", "'+1", "'-1", "'@SUM(A1)", "'\t=1", "left", ""]
    assert all((float(row[1]), int(row[2])) == (-1.5, -2) for row in rows)
