"""Lines of each room of the package, and the budget that a room may not pass without a reason.

`python -m tests.room_lines` prints the table with today's lines, and lowers each budget that a room no longer needs.
To raise one, edit `tests/room_lines.csv` in the commit that needs it: the new budget, and why.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "traps_pipeline"
TABLE = Path(__file__).with_suffix(".csv")
TOTAL = 68_470  # lines of the package at 0.3.0; the budgets together may not pass it
UNUSED = 50  # lines that a budget may be above its room


@dataclass(frozen=True, slots=True)
class Budget:
    """The lines that a room may have, beside those that it had at 0.3.0."""

    room: str
    lines_030: int
    lines: int
    reason: str
    """Why the room may have more lines than at 0.3.0; empty if it may not."""


def lines_by_room(package: Path = PACKAGE) -> Counter[str]:
    """Return the lines of the Python files of each room; a module beside the rooms is a room of its own."""
    counts = Counter[str]()
    for path in package.rglob("*.py"):
        counts[path.relative_to(package).parts[0].removesuffix(".py")] += path.read_text(encoding="utf-8").count("\n")
    return counts


def read_budgets(table: Path = TABLE) -> dict[str, Budget]:
    """Return the budget of each room."""
    with table.open(encoding="utf-8", newline="") as file:
        rows = csv.DictReader(file)
        return {
            row["room"]: Budget(row["room"], int(row["lines_030"]), int(row["lines"]), row["reason"]) for row in rows
        }


def excesses(counts: Mapping[str, int], budgets: Mapping[str, Budget]) -> Iterator[str]:
    """Yield a sentence for each rule that the rooms or their budgets break."""
    for room in sorted({*counts} ^ {room for room, budget in budgets.items() if budget.lines}):
        yield f"{room}: {'has no budget' if room in counts else 'is no room'}"
    for room, budget in budgets.items():
        if (lines := counts.get(room, 0)) > budget.lines:
            over = lines - budget.lines
            yield f"{room}: {lines} lines, {over} above its budget; delete as many, or raise it with a reason"
        if lines < budget.lines - UNUSED:
            yield f"{room}: {lines} lines, {budget.lines - lines} below its budget; run python -m tests.room_lines"
        if budget.lines > budget.lines_030 and not budget.reason:
            yield f"{room}: its budget is {budget.lines - budget.lines_030} above 0.3.0 and has no reason"
    if (total := sum(budget.lines for budget in budgets.values())) > TOTAL:
        yield f"all budgets together are {total}, {total - TOTAL} above {TOTAL}"


def main() -> None:
    """Print the table and lower the budgets of rooms that shrank."""
    counts, budgets = lines_by_room(), read_budgets()
    lowered = [replace(budget, lines=min(budget.lines, counts[budget.room])) for budget in budgets.values()]
    with TABLE.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, ["room", "lines_030", "lines", "reason"], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(budget) for budget in lowered)
    for budget in lowered:
        print(f"{budget.room:12} {budget.lines_030:6} {counts[budget.room]:6} {budget.lines:6}  {budget.reason}")
    print(f"{'all':12} {TOTAL:6} {counts.total():6} {sum(budget.lines for budget in lowered):6}")


if __name__ == "__main__":
    main()
