"""Metadata of Dagster's events, in which nothing that a model or a provider wrote can hide."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import dagster as dg

from traps_pipeline.base.terminal import visible


def visible_metadata(value: Any) -> Any:
    """Return a value of an event's metadata, or a mapping or list of them, with hidden characters made visible."""
    if isinstance(value, str):
        return visible(value)
    if isinstance(value, dg.MarkdownMetadataValue):
        return dg.MetadataValue.md(visible(value.md_str or ""))
    if isinstance(value, dg.TableMetadataValue):
        records = [dg.TableRecord(visible_metadata(record.data)) for record in value.records]
        return dg.MetadataValue.table(records, value.schema)
    if isinstance(value, dg.MetadataValue):  # a path, a number, an asset; some are tuples
        return value
    if isinstance(value, Mapping):
        return {visible_metadata(key): visible_metadata(each) for key, each in value.items()}
    return [visible_metadata(each) for each in value] if isinstance(value, list | tuple) else value
