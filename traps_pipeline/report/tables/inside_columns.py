"""Columns, marks and notes that tables of what is found inside models share."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from traps_pipeline.mechanism.transfer_paths import path_name
from traps_pipeline.protocol.datasets import SHORT
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.writing import Column

if TYPE_CHECKING:
    import pandas as pd

PATH, TYPE = Column("path", "Path"), Column("transfer_type", "Transfer")
DIRECTIONS, INFERENCE = Column("directions", "Directions"), Column("regime", "Inference")
LAYER, ALPHA = Column("layer", "Layer", "count"), Column("alpha", "α", "count")
SIDES = (Column("n_voids", "Voids", "count"), Column("n_controls", "Controls", "count"))
DRAWS = "± standard deviation over draws of noise"
NO_MECHANISM = "the experiment has no `mechanism` section, so no local model's states were read"
FEW = 10  # items of a side, or answers of a cell, below which a value is marked
FEW_MARK = "†"


def why(results: Results, of_paper: str = "") -> str:
    """Return why a frame of what is found inside models has no rows. of_paper: the reason for the paper's."""
    if of_paper and not results.is_study:
        return of_paper
    return NO_MECHANISM if results.is_study and results.mechanism is None else results.why("probes")


def few(rows: pd.DataFrame, *counts: str) -> list[str]:
    """Return the mark of each row: a dagger where one of the counts is below FEW; none where a count is not known."""
    import pandas as pd

    numbers = [pd.to_numeric(rows[name], errors="coerce") for name in counts]
    return [FEW_MARK if any(value < FEW for value in values) else "" for values in zip(*numbers, strict=True)]


def few_note(rows: pd.DataFrame, *marks: str, of: str = "controls or voids") -> list[str]:
    """Return the meaning of the mark, if a row has it in one of these columns. of: what is counted."""
    used = any((rows[name] == FEW_MARK).any() for name in marks or ("mark",) if name in rows)
    return [f"{FEW_MARK} fewer than {FEW} {of}: the value says little"] if used else []


def interval(prefix: str = "", unit: str = "fraction", digits: int | None = None) -> list[Column]:
    """Return the columns of the ends of an interval, `low` and `high` with a prefix."""
    return [
        Column(f"{prefix}{end}", word, unit, digits)  # pyright: ignore[reportArgumentType] - a Unit
        for end, word in (("low", "from"), ("high", "to"))
    ]


def short_names(names: Iterable[str]) -> list[str]:
    """Return the datasets' short names; of anything else its own name, where it is stated."""
    return [SHORT.get(name, name) if isinstance(name, str) and name else "not stated" for name in names]


def path_names(rows: pd.DataFrame) -> list[str]:
    """Return the path of each row, from its source to its target."""
    return [path_name(source, target) for source, target in zip(rows["source"], rows["target"], strict=True)]
