"""Cut the partitions of a group of stages into ranges, one per run.

In two dimensions a range is a rectangle of neighbours, as Dagster defines it by a first and a last key.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from traps_pipeline.pipeline.partitioning import Partitioning

Range = tuple[str | None, str | None]  # first and last key


@dataclass(frozen=True)
class Grid:
    """The partition keys of a scheme in rows and columns: one for each dimension, or a single row."""

    rows: Sequence[str]
    columns: Sequence[str]

    @staticmethod
    def of(scheme: Partitioning) -> Grid:
        """Return the grid of a scheme."""
        *rows, columns = scheme.dimensions.values()
        return Grid(rows[0] if rows else [""], columns)

    def cells(self, keys: Iterable[str | None]) -> Iterator[tuple[int, int]]:
        """Yield row and column of each key."""
        row_of, column_of = ({name: n for n, name in enumerate(names)} for names in (self.rows, self.columns))
        for key in keys:
            row, _, column = str(key).rpartition("|")
            yield row_of[row], column_of[column]

    def range(self, top: int, bottom: int, left: int, right: int) -> Range:
        """Return the range between two corners of a rectangle, both inclusive."""
        first, last = (self.rows[top], self.columns[left]), (self.rows[bottom], self.columns[right])
        return "|".join(filter(None, first)), "|".join(filter(None, last))


def key_ranges(scheme: Partitioning | None, keys: Sequence[str | None]) -> Iterator[Range]:
    """Yield the fewest ranges that together contain exactly the keys."""
    if scheme is None or not keys:
        yield from ((key, key) for key in keys)
        return
    grid, columns_by_row = Grid.of(scheme), dict[int, list[int]]()
    for row, column in grid.cells(keys):
        columns_by_row.setdefault(row, []).append(column)
    spans = sorted((span, row) for row, numbers in columns_by_row.items() for span in _spans(numbers))
    for (left, right), group in groupby(spans, key=lambda pair: pair[0]):
        for top, bottom in _spans([row for _, row in group]):
            yield grid.range(top, bottom, left, right)


def _spans(numbers: Sequence[int]) -> list[tuple[int, int]]:
    """Return maximal runs of neighbouring numbers, as (first, last)."""
    spans: list[tuple[int, int]] = []
    for number in sorted(numbers):
        if spans and spans[-1][1] == number - 1:
            spans[-1] = spans[-1][0], number
        else:
            spans.append((number, number))
    return spans
