"""Previews of tables for Dagster's UI."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from traps_pipeline.pipeline.previews import Markdown
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.tables import Table

if TYPE_CHECKING:
    import pandas as pd


def made_of(name: str, table: Table, rows: "pd.DataFrame | Sequence[Any]") -> StageOutput:
    """Return a table without partitions, from a frame or from values of its dataclass, with its first rows under a
    name."""
    import pandas as pd

    frame = rows if isinstance(rows, pd.DataFrame) else pd.DataFrame(list(rows), columns=pd.Index(table.names))
    return StageOutput(frame, shown={name: rows_shown(frame)})


def rows_shown(frame: "pd.DataFrame", rows: int = 60) -> Markdown | str:
    """Return the first rows as a Markdown table. Use it only for figures and ids, never for text that a model wrote."""
    if frame.empty:
        return "not run"
    head = frame.head(rows)
    lines = [[str(name) for name in head.columns], ["---"] * len(head.columns)]
    lines += [[_plain(value) for value in row] for row in head.itertuples(index=False)]
    return Markdown("\n".join("| " + " | ".join(line) + " |" for line in lines))


def _plain(value: object) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.4g}"
    return "" if value is None else str(value).replace("|", "\\|")
