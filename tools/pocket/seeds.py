"""The CSVs beside the weights: rows of several training seeds; all rows of a seed are replaced together."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from traps_pipeline.base.files import replace_file


@dataclass(frozen=True)
class Figure:
    """What a claim of `claims.CLAIMS` comes to in the model of one training seed."""

    seed: int
    weights: str
    claim: str
    value: float


def write_seeds(path: Path, rows: Sequence[Any], read: Callable[[Path], Sequence[Any]]) -> None:
    """Write rows (dataclasses with a field `seed`) as CSV; they replace the rows of the same seeds.

    read: reads such a file, and raises TrapsError if it cannot.
    """
    seeds = {row.seed for row in rows}
    kept = [row for row in (read(path) if path.is_file() else []) if row.seed not in seeds]
    with replace_file(path) as part, part.open("w", encoding="utf-8", newline="") as stream:
        table = csv.DictWriter(stream, [field.name for field in fields(rows[0])], lineterminator="\n")
        table.writeheader()
        table.writerows(asdict(row) for row in sorted([*kept, *rows], key=lambda row: row.seed))
