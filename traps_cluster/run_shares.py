"""Cut the partitions of a group of stages into ranges of about equal work, one per run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from traps_pipeline.pipeline.partitioning import Partitioning
from traps_pipeline.pipeline.ranges import Grid, Range

WORTH_S = 120.0  # minimum work per run, since each takes 12 to 20 s to start


def cut_keys(scheme: Partitioning | None, keys: Sequence[str | None], most: int) -> list[Range]:
    """Return up to `most` ranges of about equally many keys, none twice.

    A range may contain other keys. Cells of one model stay together if there are fewer runs than models, since each run
    loads its models anew; otherwise cells of one evaluation do.
    """
    if scheme is None or not keys:
        return [(key, key) for key in keys]
    grid = Grid.of(scheme)
    is_wanted = np.zeros((len(grid.rows), len(grid.columns)), bool)
    for row, column in grid.cells(keys):
        is_wanted[row, column] = True
    model_names = np.array([name.partition("__")[0] for name in grid.columns])
    is_by_model = most < len({*model_names[is_wanted.any(axis=0)]})
    return [grid.range(*corners) for corners in _parts(is_wanted, model_names, 0, 0, most, by_model=is_by_model)]


def _parts(
    wanted: np.ndarray, heads: np.ndarray, top: int, left: int, count: int, *, by_model: bool
) -> Iterator[tuple[int, int, int, int]]:
    """Yield rectangles around wanted cells: first and last row, first and last column.

    top, left: the first cell. heads: the model of each column; by_model: cut between models if there are enough.
    """
    rows, columns = np.flatnonzero(wanted.any(axis=1)), np.flatnonzero(wanted.any(axis=0))
    down, across = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    wanted, heads, top, left = wanted[down, across], heads[across], top + int(rows[0]), left + int(columns[0])
    count = min(count, int(wanted.sum()))
    height, width = wanted.shape
    if count == 1:
        yield top, top + height - 1, left, left + width - 1
        return
    cuts = np.arange(1, width)
    changes = cuts[heads[1:] != heads[:-1]]
    if by_model and count <= len(changes):
        cuts = changes
    if width > 1:
        at, share = _halves(wanted.sum(axis=0), cuts, {*changes.tolist()}, count)
        yield from _parts(wanted[:, :at], heads[:at], top, left, share, by_model=by_model)
        yield from _parts(wanted[:, at:], heads[at:], top, left + at, count - share, by_model=by_model)
    else:
        at, share = _halves(wanted.sum(axis=1), np.arange(1, height), set[int](), count)
        yield from _parts(wanted[:at], heads, top, left, share, by_model=by_model)
        yield from _parts(wanted[at:], heads, top + at, left, count - share, by_model=by_model)


def _halves(sizes: np.ndarray, cuts: np.ndarray, better: set[int], count: int) -> tuple[int, int]:
    """Return where to cut, and how many parts come before: prefer equal parts, then `better`, then the middle."""
    total = int(sizes.sum())
    first = np.cumsum(sizes)[cuts - 1]
    shares = np.clip(np.rint(count * first / total), 1, count - 1).astype(int)
    larger_load = np.maximum(first / shares, (total - first) / (count - shares))
    best = min(range(len(cuts)), key=lambda n: (larger_load[n], int(cuts[n]) not in better, abs(2 * first[n] - total)))
    return int(cuts[best]), int(shares[best])


def shared_out(
    scheme: Partitioning | None, keys: Sequence[str | None], seconds: Mapping[str | None, float], most: int
) -> list[Range]:
    """Return at most `most` ranges that share the keys' work and keep each run busy.

    Up to the number of keys, each run works through all of them; beyond that, the runs of a range share one key.
    """
    count = max(1, min(most, int(sum(seconds.values()) / WORTH_S)))
    if scheme is None or count <= len(keys):
        return cut_keys(scheme, keys, 1) * count
    runs = dict.fromkeys(keys, 1)
    for _ in range(count - len(keys)):
        busiest_key = max(keys, key=lambda key: seconds[key] / runs[key])
        runs[busiest_key] += 1
    return [(key, key) for turn in range(max(runs.values())) for key in keys if runs[key] > turn]
