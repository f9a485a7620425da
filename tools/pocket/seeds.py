"""The CSVs beside the weights: rows of several training seeds; all rows of a seed are replaced together."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import ClassVar, TypeVar

from pydantic import TypeAdapter

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import replace_file

Row = TypeVar("Row", bound="SeedRow")


@dataclass(frozen=True)
class SeedRow:
    """A row of one training seed, and the command of `python -m tools.pocket` that writes its table."""

    COMMAND: ClassVar[str]
    seed: int


@dataclass(frozen=True)
class Figure(SeedRow):
    """What a claim of the report comes to in the model of one training seed, or in one of its controls."""

    COMMAND = "card --mechanism"
    weights: str
    claim: str
    subject: str
    value: float


def write_seeds(path: Path, rows: Sequence[SeedRow]) -> None:
    """Write rows as CSV; they replace the rows of the same seeds."""
    seeds = {row.seed for row in rows}
    kept = [row for row in (read_seeds(path, type(rows[0])) if path.is_file() else []) if row.seed not in seeds]
    with replace_file(path) as part, part.open("w", encoding="utf-8", newline="") as stream:
        table = csv.DictWriter(stream, [field.name for field in fields(rows[0])], lineterminator="\n")
        table.writeheader()
        table.writerows(asdict(row) for row in sorted([*kept, *rows], key=lambda row: row.seed))


def read_seeds(path: Path, kind: type[Row]) -> list[Row]:
    """Return the rows of a CSV of `write_seeds`. Raises TrapsError."""
    rows = TypeAdapter(kind)
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            return [rows.validate_python(row) for row in csv.DictReader(stream)]
    except (OSError, ValueError) as error:
        raise TrapsError(
            f"{path}: is not a table of `python -m tools.pocket {kind.COMMAND}` ({error}); write it again"
        ) from error
