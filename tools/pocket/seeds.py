"""The CSVs beside the weights: rows of several training seeds; all rows of a seed are replaced together."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from traps_pipeline.base.files import replacing


@dataclass(frozen=True)
class Figure:
    """A figure of one training seed; columns that do not apply to it are empty.

    figure: transfer_best and transfer_chosen (AUROC of a pair at the layer that is best on the target, and at the
    one chosen without it), held_out_best and held_out_chosen (the same, fitted without the scored scenario), shuffled,
    answerable_void, answerable_control (at the chosen layer), abstention (over all paths and regimes), planted
    (kind: its name in `planted.TRUTHS`), claim (kind: its name in `claims.CLAIMS`). low, high: 95 % interval from
    resampled scenarios. answers: number of distinct answers.
    """

    seed: int
    weights: str
    figure: str
    source: str = ""
    target: str = ""
    kind: str = ""
    layer: int | None = None
    alpha: float | None = None
    side: str = ""
    value: float = 0.0
    low: float | None = None
    high: float | None = None
    answers: int | None = None
    scenarios: int | None = None


def write_seeds(path: Path, rows: Sequence[Any], read: Callable[[Path], Sequence[Any]]) -> None:
    """Write rows (dataclasses with a field `seed`) as CSV; they replace the rows of the same seeds.

    read: reads such a file, and raises TrapsError if it cannot.
    """
    seeds = {row.seed for row in rows}
    kept = [row for row in (read(path) if path.is_file() else []) if row.seed not in seeds]
    with replacing(path) as part, part.open("w", encoding="utf-8", newline="") as stream:
        table = csv.DictWriter(stream, [field.name for field in fields(rows[0])], lineterminator="\n")
        table.writeheader()
        table.writerows(asdict(row) for row in sorted([*kept, *rows], key=lambda row: row.seed))
