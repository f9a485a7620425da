"""Translate what Dagster shows: hidden characters become visible, files are named from the study's folder on."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import dagster as dg

from traps_pipeline.base.paths import ROOT
from traps_pipeline.base.progress import Tally
from traps_pipeline.base.terminal import escape_invisible
from traps_pipeline.pipeline.graph import Stage
from traps_pipeline.pipeline.previews import Markdown, Records, StudyFile
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.place import scratch_of
from traps_pipeline.storage.tables import Table
from traps_pipeline.storage.workspace import Workspace

PREVIEWED, SHORT = 5, 24  # rows, and characters of a text that is shown in them
BEGINNINGS = {"text": 60}  # characters of columns of which only the beginning is shown
WORDS = {"asked": "asked", "cached": "known", "errors": "failed", "frames": "frames"}  # of a tally's counts
RANKED = ("pecs", "conjunction")  # columns by which the rows of a table are better or worse


def page_text(text: str) -> str:
    """Return a text for Dagster's pages: nothing hidden, and no folder of this host above study and checkout."""
    place = Workspace.default_place()
    root = scratch_of(place) if isinstance(place, str) else place
    for folder, prefix in ((root, ""), (ROOT, ""), (Path.home(), "~/")):
        if folder != folder.parent:  # the home of a container's user may be /
            text = text.replace(f"{folder}/", prefix).replace(str(folder), folder.name)
    return escape_invisible(text)


@contextmanager
def errors_for_pages() -> Iterator[None]:
    """Escape, for Dagster's pages, the messages of errors raised in the block and of their causes."""
    try:
        yield
    except Exception as error:
        link: BaseException | None = error
        while link is not None:
            link.args = tuple(page_text(arg) if isinstance(arg, str) else arg for arg in link.args)
            if isinstance(link, OSError) and isinstance(link.filename, str):
                link.filename = page_text(link.filename)
            link = link.__cause__ or link.__context__
        raise


def visible_metadata(value: Any) -> Any:
    """Return a metadata value, mapping or list whose texts are for Dagster's pages."""
    if isinstance(value, str):
        return page_text(value)
    if isinstance(value, Markdown | dg.MarkdownMetadataValue):
        return dg.MetadataValue.md(page_text((value.text if isinstance(value, Markdown) else value.md_str) or ""))
    if isinstance(value, Records):
        return dg.MetadataValue.table([dg.TableRecord(visible_metadata(row)) for row in value.rows])
    if isinstance(value, StudyFile):
        return dg.MetadataValue.url(value.url)
    if isinstance(value, dg.TableMetadataValue):
        records = [dg.TableRecord(visible_metadata(record.data)) for record in value.records]
        return dg.MetadataValue.table(records, value.schema)
    if isinstance(value, dg.MetadataValue):  # a path, a number, an asset; some are tuples
        return value
    if isinstance(value, Mapping):
        return {visible_metadata(key): visible_metadata(member) for key, member in value.items()}
    return [visible_metadata(member) for member in value] if isinstance(value, list | tuple) else value


def tally_metadata(stage: Stage, tally: Tally) -> dict[str, int]:
    """Return the calls of a partition (asked, cached, failed) as numbers for Dagster's plots."""
    paid_counts = {"asked", "cached", "errors"} if stage.cost else set()
    return {WORDS[name]: count for name, count in vars(tally).items() if count or name in paid_counts}


def tally_of(metadata: Mapping[str, dg.MetadataValue]) -> Tally:
    """Read a partition's counts of calls back from Dagster's metadata."""
    return Tally(**{name: cast(int, metadata[word].value) for name, word in WORDS.items() if word in metadata})


def partition_metadata(workspace: Workspace, stage: Stage, key: str | None, output: StageOutput) -> dict[str, Any]:
    """Return what Dagster shows of a partition or of files for people; paths are relative to the study."""
    counts = tally_metadata(stage, output.tally)
    if stage.table is None:
        files = cast(Mapping[str, bytes], output.content)
        pages = {path: StudyFile(workspace.relative(workspace.reports / path)) for path in files if "/" not in path}
        return {"files": len(files), **pages, **output.shown, **counts}
    count = "dagster/row_count" if stage.scheme is None else "dagster/partition_row_count"
    file = workspace.relative(workspace.tables.path(stage.table, stage.columns(key)))
    return {count: len(output.content), "file": file, **preview(stage.table, output), **output.shown, **counts}


def preview(table: Table, output: StageOutput) -> dict[str, dg.TableMetadataValue]:
    """Return first rows, or best and worst of a ranked table, without long texts and columns that do not differ."""
    import pandas as pd

    content = cast(Any, output.content)
    if rank_column := next((name for name in RANKED if name in table.names), None):
        frame = content if hasattr(content, "head") else pd.DataFrame(content, columns=pd.Index(table.names))
        ordered = frame.dropna(subset=[rank_column]).sort_values(rank_column, ascending=False, kind="stable")
        best_rows, worst_rows = ordered.head(PREVIEWED), ordered.iloc[PREVIEWED:].tail(PREVIEWED)
        samples = {
            f"best by {rank_column}": best_rows.to_dict("records"),
            f"worst by {rank_column}": worst_rows.to_dict("records"),
        }
    else:
        first = content[:PREVIEWED]
        samples = {
            "first rows": first.to_dict("records") if hasattr(content, "head") else [asdict(row) for row in first]
        }
    preview_rows = [row for rows in samples.values() for row in rows]
    for row in preview_rows:
        row |= {name: row[name][:most] for name, most in BEGINNINGS.items() if isinstance(row.get(name), str)}
    columns = [(column, [row.get(column.name) for row in preview_rows]) for column in table.columns]
    shown_columns = [c.name for c, values in columns if c.name in BEGINNINGS or _is_telling(c.type, values)]
    names = [*table.key, *([rank_column] if rank_column else []), *shown_columns]
    names = [name for name in dict.fromkeys(names) if name not in table.partition_by]
    tables = {
        title: [dg.TableRecord({name: _plain(row.get(name)) for name in names}) for row in rows]
        for title, rows in samples.items()
    }
    return {title: dg.MetadataValue.table(records) for title, records in tables.items() if records}


def _is_telling(kind: Any, values: Sequence[Any]) -> bool:
    """Return whether a column has numbers or short texts that are not all alike."""
    longest = max((len(value) for value in values if isinstance(value, str)), default=0)
    is_shown = kind in (int, float, bool) or 0 < longest <= SHORT
    return is_shown and (len(values) == 1 or len({str(value) for value in values}) > 1)


def _plain(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
