"""Metadata of Dagster's events, in which nothing that a model or a provider wrote can hide."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, cast

import dagster as dg

from traps_pipeline.base.terminal import visible
from traps_pipeline.orchestration.previews import Markdown, Records, StudyFile
from traps_pipeline.storage.parquet import Made
from traps_pipeline.storage.tables import Table

PREVIEWED = 5  # rows


def visible_metadata(value: Any) -> Any:
    """Return a value of an event's metadata, or a mapping or list of them, with hidden characters made visible."""
    if isinstance(value, str):
        return visible(value)
    if isinstance(value, Markdown):
        return dg.MetadataValue.md(visible(value.text))
    if isinstance(value, Records):
        return dg.MetadataValue.table([dg.TableRecord(visible_metadata(row)) for row in value.rows])
    if isinstance(value, StudyFile):
        return dg.MetadataValue.path(value.path)
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


def preview(table: Table, made: Made) -> dg.TableMetadataValue | None:
    """The first rows without long texts: what a model wrote is shown on the report's pages, where it is escaped."""
    content = cast(Any, made.content)
    first = content[:PREVIEWED]
    rows = first.to_dict("records") if hasattr(content, "head") else [asdict(row) for row in first]
    names = [c.name for c in table.columns if c.name in table.key or c.type in (int, float, bool)]
    records = [dg.TableRecord({n: str(row.get(n)) for n in names}) for row in rows]
    return dg.MetadataValue.table(records) if records else None
