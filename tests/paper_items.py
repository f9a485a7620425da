"""Writes `docs/paper.md` from `docs/paper.csv`: `python -m tests.paper_items`."""

from __future__ import annotations

import csv
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
DATA, PAGE = ROOT / "docs" / "paper.csv", ROOT / "docs" / "paper.md"
STATUSES = ("there", "departs", "missing")
HEAD = """# The paper, item by item

For readers of the paper. After this page you know what is implemented, where, and what differs.

`docs/paper.csv` is the data: each item also has its line in the paper's LaTeX source and the test that walks it.
`python -m tests.paper_items` writes this page. A test fails where a named file or test does not exist.

"""


def items() -> list[dict[str, str]]:
    """The items in order: n, item, line, place, test, status, note."""
    with DATA.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def page() -> str:
    """Return the page: departures with reasons, what is missing, and the other items by file."""
    rows = items()
    counts = Counter(row["status"] for row in rows)
    parts = [f"{HEAD}{len(rows)} items: {', '.join(f'{counts[status]} {status}' for status in STATUSES)}.\n"]
    for status, title in (("departs", "Departures"), ("missing", "Missing")):
        listed = [_line(row) for row in rows if row["status"] == status]
        parts += [f"\n## {title}\n\n", *listed] if listed else []
    places: dict[str, list[str]] = {}
    for row in rows:
        if row["status"] == "there":
            note = f" ({row['note']})" if row["note"] else ""
            places.setdefault(row["place"], []).append(f"**{row['n']}** {row['item']}{note}")
    listed = [f"- `{place}`: {'; '.join(those)}\n" for place, those in places.items()]
    return "".join([*parts, "\n## As in the paper, by file\n\n", *listed])


def _line(row: dict[str, str]) -> str:
    place = f" (`{row['place']}`)" if row["place"] else ""
    note = f": {row['note']}" if row["note"] else ""
    return f"- **{row['n']}** {row['item']}{place}{note}\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE)
