"""Test that the hidden element is independent of everything that a void shows.

The test runs over draws: the index of the drawn world among the scene's possible ones (it and its twins, in a fixed
order) must be independent of each parameter that they share, and of each two. How a family makes twins is irrelevant.
"""

from collections.abc import Mapping
from itertools import combinations
from typing import Any

import numpy as np

from traps_pipeline.scenes.physics.kit import Family, params_to_dict

DRAWS = 600
CHANCE = 1e-8  # a table of counts that chance gives more rarely than this is no chance: thousands are looked at
MAX_WORLDS = 64
MIN_EXPECTED = 5  # draws of each world in a row of a table; rarer values share a row


def dependence(family: Family) -> str | None:
    """Return in words how the hidden element depends on visible things; None if it does not."""
    if family.twins is None:
        return None
    scenes = [_worlds(family, family.draw(np.random.default_rng(seed))) for seed in range(DRAWS)]
    hidden = sorted({name for scene, *twins in scenes for twin in twins for name in scene if twin[name] != scene[name]})
    keys = [[[world[name] for name in hidden] for world in worlds] for worlds in scenes]
    drawn_index = np.array([sorted(world_keys).index(world_keys[0]) for world_keys in keys])
    numbers = np.array([len(worlds) for worlds in scenes])
    for number in np.unique(numbers):  # which of three lanes, which of four: each number of worlds by itself
        draw_indices = np.flatnonzero(numbers == number)
        if number < 2 or len(draw_indices) < 4 * MIN_EXPECTED * number:
            continue
        columns = _rows([_flatten({k: v for k, v in scenes[i][0].items() if k not in hidden}) for i in draw_indices])
        tables = [((name,), rows) for name, rows in columns.items()]
        tables += [((a, b), columns[a] * (columns[b].max() + 1) + columns[b]) for a, b in combinations(columns, 2)]
        for names, rows in tables:
            if _is_associated(drawn_index[draw_indices], _pool_rare(rows, MIN_EXPECTED * int(number))):
                return f"`{', '.join(hidden)}` goes with {' and '.join(f'`{name}`' for name in names)}"
    return None


def _worlds(family: Family, params: Any) -> list[dict[str, Any]]:
    """Return a scene, its twins, their twins and so on, each once, up to MAX_WORLDS."""
    assert family.twins is not None
    worlds, queue = [], [params]
    while queue and len(worlds) < MAX_WORLDS:
        world = queue.pop(0)
        if world not in worlds:
            worlds.append(world)
            queue += family.twins(world)
    return [params_to_dict(world) for world in worlds]


def _flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return numbers and names by their place: tuples by length and index."""
    fields: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, list | tuple):
            fields[f"len({prefix}{name})"] = len(value)
            fields |= _flatten({f"{name}[{i}]": item for i, item in enumerate(value)}, prefix)
        else:
            fields[prefix + name] = value
    return fields


def _rows(scenes: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Return the row of each scene for every varying parameter: its value or quarter."""
    columns = {}
    for name in sorted(set().union(*scenes)):
        values = [scene.get(name) for scene in scenes]
        distinct_values = sorted(set(values), key=repr)
        if len(distinct_values) > 8 and not any(isinstance(value, str) for value in distinct_values):
            numbers = np.array([np.nan if value is None else value for value in values], float)
            rows = np.searchsorted(np.nanquantile(numbers, [0.25, 0.5, 0.75]), numbers)
        else:
            rows = np.array([distinct_values.index(value) for value in values])
        if rows.any():
            columns[name] = rows
    return columns


def _pool_rare(rows: np.ndarray, least: int) -> np.ndarray:
    """Return rows from 0 on, those with fewer scenes than `least` pooled in one."""
    _, rows, counts = np.unique(rows, return_inverse=True, return_counts=True)
    return np.unique(np.where(counts[rows] < least, -1, rows), return_inverse=True)[1]


def _is_associated(worlds: np.ndarray, rows: np.ndarray) -> bool:
    """Return whether a table of counts fails Pearson's chi-square test at CHANCE."""
    from scipy.special import chdtrc

    table = np.zeros((worlds.max() + 1, rows.max() + 1))
    np.add.at(table, (worlds, rows), 1)
    table = table[table.any(axis=1)]
    if 1 in table.shape:
        return False
    expected = table.sum(axis=1, keepdims=True) * table.sum(axis=0) / table.sum()
    freedom, chi_square = (table.shape[0] - 1) * (table.shape[1] - 1), ((table - expected) ** 2 / expected).sum()
    return bool(chdtrc(freedom, chi_square) < CHANCE)
