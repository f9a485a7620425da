"""Whether two workspaces hold the same: tables by content and by version, reports byte for byte.

    python bench/equality.py BEFORE AFTER

Run the same experiment with two states of the code, then compare their workspaces: what is moved or renamed in the code
must change none of them. Files are read as Parquet and bytes, not through the package, so that neither state's reader
can hide a difference. Columns that two runs of one state may differ in (`VOLATILE`) are left out. Exit code 1 where
anything differs.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from traps_pipeline.storage.parquet import VOLATILE


def main(before: Path, after: Path) -> int:
    """Print what differs and how much is equal."""
    differences: list[str] = []
    for folder, pattern, compare in (("tables", "*.parquet", _table), ("reports", "*.*", _file)):
        old, new = _files(before / folder, pattern), _files(after / folder, pattern)
        differences += [f"{folder}/{name}: only before" for name in sorted(old.keys() - new.keys())]
        differences += [f"{folder}/{name}: only after" for name in sorted(new.keys() - old.keys())]
        shared = sorted(old.keys() & new.keys())
        found = {name: compare(old[name], new[name]) for name in shared}
        differences += [f"{folder}/{name}: {what}" for name, what in found.items() if what]
        print(f"{folder}: {sum(not what for what in found.values())} of {len(old.keys() | new.keys())} equal")
    print("\n".join(differences))
    return 1 if differences else 0


def _files(folder: Path, pattern: str) -> dict[str, Path]:
    files = (path for path in folder.rglob(pattern) if path.is_file())
    visible = ((path.relative_to(folder), path) for path in files)
    return {str(name): path for name, path in visible if not any(part.startswith(".") for part in name.parts)}


def _table(old: Path, new: Path) -> str:
    """Return what differs between two Parquet files; empty if nothing does."""
    a, b = pq.ParquetFile(old).read(), pq.ParquetFile(new).read()
    if a.schema.names != b.schema.names:
        return f"columns {sorted(set(a.schema.names) ^ set(b.schema.names)) or 'in another order'}"
    differing = [name for name in a.schema.names if name not in VOLATILE and not _same(a[name], b[name])]
    if differing:
        return f"content of {', '.join(differing)}"
    keys = [key for key, value in _footer(a).items() if _footer(b).get(key) != value]
    return f"footer's {', '.join(keys)}" if keys else ""


def _same(a: pa.ChunkedArray, b: pa.ChunkedArray) -> bool:
    return a.type == b.type and a.combine_chunks().equals(b.combine_chunks())


def _footer(table: pa.Table) -> dict[str, Any]:
    return json.loads((table.schema.metadata or {}).get(b"traps", b"{}"))


def _file(old: Path, new: Path) -> str:
    """Return which line of two text files differs first, or that other files do; empty if nothing does."""
    a, b = old.read_bytes(), new.read_bytes()
    if a == b:
        return ""
    pairs = enumerate(zip(a.split(b"\n"), b.split(b"\n"), strict=False), start=1)
    line = next((n for n, (x, y) in pairs if x != y), "end")
    return f"differs ({len(a)} and {len(b)} bytes), at line {line}"


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
