"""What a stage wants people to see of a partition beside its rows; `metadata` puts it into Dagster's words.

A `StageOutput.shown` holds plain values, texts and these.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

STUDY_URL = "/study"  # where `traps ui` serves the study's report, site and clips


@dataclass(frozen=True)
class Markdown:
    """Text that is rendered. Use it only for figures and ids, never for text that a model wrote."""

    text: str


@dataclass(frozen=True)
class Records:
    """Rows of a small table."""

    rows: Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class StudyFile:
    """A file of the study that a browser opens. path: below the workspace's root, so that it is right in a copy; view:
    the part of its address after #."""

    path: str
    view: str = ""

    @property
    def url(self) -> str:
        """Its address on the server of `traps ui`."""
        return f"{STUDY_URL}/{quote(self.path)}" + (f"#{self.view}" if self.view else "")
