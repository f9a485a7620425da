"""Reads the tables of the paper's LaTeX source into test data.

    python -m tests.report.latex_tables PAPER.tex

This writes `paper_tables.json` beside this file: for each label the line of its caption's label and the rows of its
table as a reader sees them, without headings. The data is committed, and the tests read nothing else.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

DATA = Path(__file__).with_suffix("").with_name("paper_tables.json")
_TABULAR = re.compile(r"\\begin\{tabular\}\{(?P<columns>.*?)\}\s*\n(?P<body>.*?)\\end\{tabular\}", re.DOTALL)
_LABEL = re.compile(r"\\label\{(tab:[\w-]+)\}")
_RULES = re.compile(r"\\(?:toprule|midrule|bottomrule|cmidrule(?:\([lr]+\))?\{[\d-]+\})")
_SPAN = re.compile(r"\\multicolumn\{(\d+)\}\{.*?\}(?=\{)")
_SYMBOLS = {
    r"\times": "×", r"\pm": "±", r"\to": "→", r"\infty": "∞", r"\dagger": "†", r"\approx": "≈", r"\alpha": "α",
    r"\kappa": "κ", r"\downarrow": "↓", r"\uparrow": "↑", r"\cap": "∩", r"\leq": "≤", r"\quad": " ", r"\_": "_",
    r"\%": "%", r"\&": "&", r"\,": "", "{,}": ",", r"\ ": " ", "~": " ", "---": "–", "--": "–",
}  # fmt: skip


def tables(source: str) -> dict[str, dict[str, Any]]:
    """The tables of a LaTeX source by label; a second tabular under one label has the suffix `#2`."""
    found: dict[str, dict[str, Any]] = {}
    for tabular in _TABULAR.finditer(source):
        labels = [*_LABEL.finditer(source, 0, tabular.start())]
        if not labels:
            continue
        name = labels[-1].group(1)
        line = source.count("\n", 0, labels[-1].start()) + 1
        name = f"{name}#2" if name in found else name
        found[name] = {"line": line, "rows": rows(tabular["body"])}
    return found


def rows(body: str) -> list[list[str]]:
    """The rows between the headings and the footnotes, cell by cell, without headings of parts and empty columns."""
    below = body.split(r"\midrule", 1)[1].rsplit(r"\bottomrule", 1)[0]
    plain = _RULES.sub("", below).replace("%\n", "\n")
    lines = (line.strip() for line in re.split(r"\\\\(?:\[[^\]]*\])?", plain))
    split = [[text(cell) for cell in re.split(r"(?<!\\)&", line)] for line in lines if line]
    cells = [row for row in split if len(row) > 1]
    spacers = {k for k in range(len(cells[0])) if all(k < len(row) and not row[k] for row in cells)}
    return [[cell for k, cell in enumerate(row) if k not in spacers] for row in cells]


def text(cell: str) -> str:
    """A cell as a reader sees it: symbols in place of commands, and no emphasis."""
    cell = re.sub(r" \(App\.~\\ref\{[^}]*\}\)", "", _SPAN.sub("", cell))
    cell = re.sub(r"\\(?:text(?:bf|it|tt|subscript)?|underline|emph|scriptsize|footnotesize|tiny)(?![a-z])", "", cell)
    for command in sorted(_SYMBOLS, key=len, reverse=True):
        cell = cell.replace(command, _SYMBOLS[command])
    cell = cell.replace("$-$", "−")
    cell = re.sub(r"[{}$^]", "", cell).replace("\\", "")
    cell = re.sub(r"\s*±\s*", " ± ", cell)
    return " ".join(cell.split())


def main() -> None:
    """Write the data file from the source that is named on the command line."""
    found = tables(Path(sys.argv[1]).read_text(encoding="utf-8"))
    parts = [
        f' "{name}": {{"line": {table["line"]}, "rows": [\n'
        + ",\n".join("  " + json.dumps(row, ensure_ascii=False) for row in table["rows"])
        + "\n ]}"
        for name, table in found.items()
    ]
    DATA.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")
    cells = sum(len(row) for table in found.values() for row in table["rows"])
    print(f"{DATA.name}: {len(found)} tables, {cells} cells")


if __name__ == "__main__":
    main()
