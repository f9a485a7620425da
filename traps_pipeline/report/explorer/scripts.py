"""Data as classic scripts, which a page that was opened from disk may load where it may not fetch.

A data script calls the page's `TRAPS_DATA` with its name, the version of the whole site, and JSON or Parquet files in
base64. The version keeps a page from mixing files of two sites.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Mapping
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

_PAGE_BYTES = 1 << 24  # a column of a shard is one page, since what repeats in it is then stored once


def parquet_text(table: pa.Table, level: int = 9) -> str:
    """Return a table as a Parquet file (zstd) in base64."""
    stream = io.BytesIO()
    pq.write_table(
        table.replace_schema_metadata(None), stream, compression="zstd", compression_level=level,
        data_page_size=_PAGE_BYTES, dictionary_pagesize_limit=_PAGE_BYTES, row_group_size=max(len(table), 1),
        write_statistics=False, store_schema=False,
    )  # fmt: skip
    return base64.b64encode(stream.getvalue()).decode("ascii")


def data_script(name: str, version: str, content: Mapping[str, Any]) -> bytes:
    """Return the script of one data file. content: JSON values; Parquet files are `parquet_text`."""
    # "<" cannot close a script element, should a host inline the file; JSON knows the escape.
    body = json.dumps(content, ensure_ascii=True, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return f"TRAPS_DATA({json.dumps(name)},{json.dumps(version)},{body});\n".encode()
