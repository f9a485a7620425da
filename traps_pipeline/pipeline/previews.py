"""Show extra content of a partition beside its rows.

A `StageOutput.shown` holds plain values, texts and these classes; `metadata` translates them for Dagster.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

if TYPE_CHECKING:
    import pandas as pd

STUDY_URL = "/study"  # route of `traps ui` to the study's report, site and clips


@dataclass(frozen=True)
class Markdown:
    """A text in Markdown for Dagster's pages, for numbers and ids, never for text that a model wrote."""

    text: str


@dataclass(frozen=True)
class Records:
    """A small table that Dagster's pages show with a partition."""

    rows: Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class StudyFile:
    """A file below the workspace's root that a browser opens; view: address after #."""

    path: str
    view: str = ""

    @property
    def url(self) -> str:
        """The file's address on the server of `traps ui`."""
        return f"{STUDY_URL}/{quote(self.path)}" + (f"#{self.view}" if self.view else "")


def rows_shown(frame: pd.DataFrame) -> Markdown | str:
    """Return the first rows as a Markdown table; never use it for text that a model wrote."""
    if frame.empty:
        return "not run"
    lines = [[*map(str, frame.columns)], ["---"] * len(frame.columns)]
    lines += [[_plain(value) for value in row] for row in frame.head(60).itertuples(index=False)]
    return Markdown("\n".join("| " + " | ".join(line) + " |" for line in lines))


def _plain(value: object) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.4g}"
    return "" if value is None else str(value).replace("|", "\\|")
