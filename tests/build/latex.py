"""Cells of a table in LaTeX."""

from __future__ import annotations

import re


def latex_cells(text):
    """Cells of the body rows of a booktabs table, split at unescaped ampersands; a table that breaks over pages has
    heads and feet for its further pages."""
    further, last = r"\endfoot", r"\endlastfoot"
    rows = text.split(last)[1] if last in text else text.split(further)[-1].split(r"\midrule")[1]
    body = rows.split(r"\bottomrule")[0].split(r"\end{longtable}")[0].strip().splitlines()
    return [re.split(r"(?<!\\)&", line.removesuffix(r"\\")) for line in body]
