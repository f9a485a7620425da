"""Writes `docs/paper.md` from `docs/paper.csv`: `python -m tools.paper_items`."""

from __future__ import annotations

import csv
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
DATA, PAGE = ROOT / "docs" / "paper.csv", ROOT / "docs" / "paper.md"
STATUSES = ("there", "departs", "missing")
HEAD = """# The paper, item by item

For readers of the paper: what differs here. [paper.csv](paper.csv) lists all items: line in the paper's LaTeX source,
file, test, status, note. A test fails where a named file or test does not exist; `python -m tools.paper_items` writes
this page.

"""


def items() -> list[dict[str, str]]:
    """The items in order: n, item, line, place, test, status, note."""
    with DATA.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def page() -> str:
    """Return the page: the departures with their reasons, then what is missing."""
    rows = items()
    counts = Counter(row["status"] for row in rows)
    summary = "{there} as in the paper, {departs} depart, {missing} are missing".format(
        **{s: counts[s] for s in STATUSES}
    )
    parts = [f"{HEAD}{len(rows)} items: {summary}.\n"]
    for status, title in (("departs", "Departures"), ("missing", "Missing")):
        listed = [_line(row) for row in rows if row["status"] == status]
        parts += [f"\n## {title}\n\n", *listed] if listed else []
    return "".join(parts)


def _line(row: dict[str, str]) -> str:
    note = f": {row['note']}" if row["note"] else ""
    return f"- **{row['n']}** {row['item']}{note}\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE)
