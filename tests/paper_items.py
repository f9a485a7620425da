"""Writes `docs/paper.md` from `docs/paper.csv`: `python -m tests.paper_items`."""

from __future__ import annotations

import csv
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
DATA, PAGE = ROOT / "docs" / "paper.csv", ROOT / "docs" / "paper.md"
STATUSES = ("there", "departs", "missing")
HEAD = """# The paper, item by item

Every item of the paper that this project was compared with: where it stands in the paper (line of its LaTeX source),
where it stands here, which test walks it, and its status. `docs/paper.csv` is the data, `python -m tests.paper_items`
writes this page, and `tests/test_paper_items.py` fails where a named file or test does not exist or the page is not
what the data give.

**there**: as the paper has it. **departs**: otherwise, for the reason in the note, which also says where a reader is
told. **missing**: not built.

"""


def items() -> list[dict[str, str]]:
    """The items in order: n, item, line, place, test, status, note."""
    with DATA.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def page() -> str:
    """The page."""
    rows = items()
    counts = Counter(row["status"] for row in rows)
    lines = ["| # | item | line | here | test | status | note |", "| ---: | --- | ---: | --- | --- | --- | --- |"]
    for row in rows:
        place = f"`{row['place']}`" if row["place"] else ""
        test = f"`{row['test'].removeprefix('tests/').replace('::test_', ': ')}`" if row["test"] else ""
        cells = [row["n"], row["item"], row["line"], place, test, row["status"], row["note"]]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    total = ", ".join(f"{counts[status]} {status}" for status in STATUSES)
    return f"{HEAD}{len(rows)} items: {total}.\n\n" + "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE)
