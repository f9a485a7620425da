"""Look up rows of the published files by their values."""

from __future__ import annotations

from functools import cache
from typing import Any

from traps_pipeline.scoring.published import published


def published_rows(name: str, /, **where: object) -> list[dict[str, Any]]:
    """Return a published file's rows with these values, as numbers and texts."""
    return [dict(row) for row in _records(name) if all(row[column] == value for column, value in where.items())]


@cache
def _records(name: str) -> list[dict[str, Any]]:
    return published(name).to_dict("records")  # pyright: ignore[reportReturnType]
