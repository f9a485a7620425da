"""Write the dataset card (with the hub's header) and data dictionary from tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from traps_pipeline.release.released_rows import HELD_OUT_ITEMS, PAIRS, RELEASED_ITEMS
from traps_pipeline.storage.tables import Table

# Tables whose rows have clips. The hub's loader reads all configurations of a folder with one builder, for videos;
# the other tables are read with its builder for JSON.
_WITH_CLIPS = (PAIRS.name, RELEASED_ITEMS.name, HELD_OUT_ITEMS.name)


@cache
def environment() -> Environment:
    """Return a release's template environment: plain text, undefined names are errors."""
    folder = Path(__file__).parent / "templates"
    return Environment(loader=FileSystemLoader(folder), undefined=StrictUndefined, keep_trailing_newline=True)


def card(manifest: Mapping[str, Any], tables: Sequence[Table[Any]], places: Mapping[str, str]) -> str:
    """Return the README of a released folder."""
    recorded = manifest.get("recorded", False)
    header = {
        "pretty_name": f"{manifest['name']} {manifest['version']}",
        "language": ["en"],
        "license": ["other" if recorded else "cc-by-4.0", "cc-by-nc-4.0"],
        "task_categories": ["video-text-to-text", "visual-question-answering"],
        "tags": ["abstention", "benchmark", "video", "croissant", *([] if recorded else ["mujoco"])],
        "size_categories": [_size(max(manifest["rows"].values()))],
        "annotations_creators": ["expert-generated" if recorded else "machine-generated"],
        "source_datasets": ["original"],
        "configs": [_config(table, places) for table in tables if table.name in _WITH_CLIPS],
    }
    front_matter = yaml.safe_dump(header, sort_keys=False, allow_unicode=True)
    fields = {"header": front_matter, "tables": tables, "places": places, **manifest, "recorded": recorded}
    return environment().get_template("card.md.j2").render(fields)


def _config(table: Table[Any], places: Mapping[str, str]) -> dict[str, Any]:
    files = [places[table.name], "clips/*/*.mp4"]
    first = {"default": True} if table.name == PAIRS.name else {}
    return {"config_name": table.name, **first, "data_files": [{"split": "test", "path": files}]}


def _size(rows: int) -> str:
    edges = {1_000: "n<1K", 10_000: "1K<n<10K", 100_000: "10K<n<100K", 1_000_000: "100K<n<1M"}
    return next((name for edge, name in edges.items() if rows < edge), "n>1M")


def dictionary(tables: Sequence[Table[Any]], places: Mapping[str, str], canary: str) -> str:
    """Return the data dictionary in Markdown: tables, keys, column types and meanings."""
    parts = [f"<!-- {canary} -->\n\n# Data dictionary\n"]
    for table in tables:
        parts.append(f"\n## {table.name}\n\nOne row is {table.row}. File: `{places[table.name]}`, JSON lines. ")
        parts.append(f"Key: {', '.join(f'`{name}`' for name in table.key)}.\n\n")
        parts.append("| column | type | may be null | meaning |\n| --- | --- | --- | --- |\n")
        for column in table.columns:
            nullable_word = "yes" if column.nullable else "no"
            parts.append(f"| `{column.name}` | {column.type_name} | {nullable_word} | {column.doc} |\n")
    return "".join(parts)
