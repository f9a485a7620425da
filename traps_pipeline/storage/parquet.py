"""Read and write a workspace's Parquet tables: schema-checked, atomic, joined."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from zlib import crc32

from traps_pipeline.base.digests import digest_of_list
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_bytes
from traps_pipeline.base.progress import Tally
from traps_pipeline.storage.store import FolderStore, Store
from traps_pipeline.storage.tables import VOLATILE, Row, Table

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


_FOOTER, _SUFFIX = b"traps", ".parquet"
# How a footer begins, and what stands before the names of the columns beside it: both are read from a file's bytes,
# since Parquet's own reader takes longer for a footer than all else that `traps status` does with it.
_STATE, _COLUMNS = b'{"version": "', b"traps-columns:"
# Marks the digest of a file's own bytes in its footer, computed with zeros in the digest's place.
_SUM, _MARK, _ZEROS = b"traps-sum", b"traps-sum:", b"0" * 8
_SMALL_BYTES = 2**20  # handing a smaller file to threads takes twice as long as reading it
_ROWS_AT_ONCE = 1000  # rows converted to Python values at a time
_VERIFIED: dict[Path, str] = {}  # files whose digest this process has verified, with their stamp
_FOOTERS: dict[Path, tuple[str, State, list[str]]] = {}  # footers by file, with its stamp
# Small tables by file, with the file's stamp: a dozen stages of one run read the same hundreds of files.
_TABLES: dict[str, tuple[str, pa.Table]] = {}
_KEPT_TABLES, _KEPT_BYTES = 1024, 2**16  # at most: 64 MB together


@dataclass(frozen=True)
class State:
    """The footer of a partition: versions of data, inputs and code, and row counts."""

    version: str
    inputs: dict[str, str]
    rows: int
    failed: int
    code: str = "1"


@dataclass(frozen=True)
class StageOutput:
    """What a stage built for a partition before it is written: rows or files, call counts and previews."""

    content: Sequence[Any] | pd.DataFrame | Mapping[str, bytes]
    tally: Tally = field(default_factory=Tally)
    shown: Mapping[str, Any] = field(default_factory=dict)
    beside: Any = None

    def rows(self, table: Table[Row]) -> Sequence[Row]:
        """Return the built rows, objects of the table's row type."""
        return cast("Sequence[Row]", self.content)

    @property
    def frame(self) -> pd.DataFrame:
        """The built rows as a frame, for a stage that builds one."""
        return cast("pd.DataFrame", self.content)


class TableStore:
    """The tables under one folder of a study's files, one file per partition."""

    def __init__(self, root: Path, store: Store | None = None) -> None:
        self.root, self._store = root, store or FolderStore(root)
        self._paths: dict[tuple[str, ...], Path] = {}  # a run asks for each a hundred times

    def path(self, table: Table, partition: Mapping[str, Any]) -> Path:
        """Return a partition's file: `<table>/<value>/.../<value or table>.parquet`.

        No name is `column=value`: a file holds its partition columns, and readers would add them once more.
        """
        if tuple(partition) != table.partition_by:
            raise ValueError(f"table {table.name} is partitioned by {table.partition_by}, not {tuple(partition)}")
        names = (table.name, *map(str, partition.values() or [table.name]))
        if (path := self._paths.get(names)) is None:
            path = self._paths[names] = self.root.joinpath(*names[:-1], names[-1] + _SUFFIX)
        return path

    def write(
        self,
        table: Table[Row],
        partition: Mapping[str, Any],
        rows: Sequence[Row] | pd.DataFrame,
        inputs: Mapping[str, str],
        *,
        failed: int = 0,
        code: str = "1",
    ) -> str:
        """Write a partition and return its version, a digest without volatile columns.

        Rows are values of the table's dataclass, or a frame. They are sorted by the table's key. The footer records
        `inputs` (versions of upstream partitions), `failed` (answers to ask again in the next run), the data version
        and code, the version of the code that made the rows. Raises TrapsError if a row breaks the schema, a key
        repeats or the disk is full; the partition's former file is then unchanged.
        """
        data = self._arrow_of(table, partition, rows)
        version = content_version(data)
        state = State(version, dict(inputs), len(data), failed, code)
        footer, path = json.dumps(asdict(state)), self.path(table, partition)
        note = _note(footer, data.schema.names)
        columns = _COLUMNS + json.dumps(data.schema.names).encode()
        content = seal_table(data, {_FOOTER: footer.encode(), _COLUMNS.rstrip(b":"): columns})
        self._store.write({path: content}, note=note, durable=True)
        return version

    def _arrow_of(
        self, table: Table[Row], partition: Mapping[str, Any], rows: Sequence[Row] | pd.DataFrame
    ) -> pa.Table:
        import pyarrow as pa

        schema = table.arrow_schema()
        row_list = rows if isinstance(rows, Sequence) else None
        kinds = () if row_list is None else {cast("Any", type(row)) for row in row_list}
        names = {*map(str, rows)} if row_list is None else {member.name for kind in kinds for member in fields(kind)}
        try:
            if names - set(schema.names):
                raise ValueError(f"unknown columns {sorted(names - set(schema.names))}")
            if row_list is not None:  # a column at a time: a dictionary a row would be a copy of all
                data = pa.table([_column(row_list, field) for field in schema], schema=schema)
            else:
                data = pa.Table.from_pandas(rows, schema=schema, preserve_index=False, safe=True)
                data = data.replace_schema_metadata(None).cast(schema)
        except (pa.ArrowException, ValueError, KeyError, TypeError) as error:
            raise TrapsError(f"table {table.name} {dict(partition)}: rows do not fit the schema ({error})") from error
        for column in schema:
            if not column.nullable and data[column.name].null_count:
                raise TrapsError(f"table {table.name} {dict(partition)}: column {column.name} has missing values")
        for column, value in partition.items():
            if strays := {*data[column].unique().to_pylist()} - {value}:
                raise TrapsError(
                    f"table {table.name} {dict(partition)}: column {column} also holds {sorted(map(str, strays))}"
                )
        if not len(data):
            return data
        data = data.sort_by([(name, "ascending") for name in table.key])
        previous_key = None
        for batch in data.select([*table.key]).to_batches(_ROWS_AT_ONCE):
            for key in zip(*(column.to_pylist() for column in batch.columns), strict=True):
                if key == previous_key:
                    key_values = dict(zip(table.key, key, strict=True))
                    raise TrapsError(f"table {table.name} {dict(partition)}: key {key_values} repeats")
                previous_key = key
        return data

    def state(self, table: Table, partition: Mapping[str, Any]) -> State | None:
        """Return the footer of a partition.

        None if it was never written, or written with other columns (it is then rebuilt). Raises TrapsError if it is
        unreadable.
        """
        path = self.path(table, partition)
        try:
            if (note := self._store.note(path)) is not None:
                noted = json.loads(note)
                footer, names = noted["state"], noted["columns"]
                state = State(**json.loads(footer))
            else:
                state, names = _footer_of(self._store.here(path))
            return state if names == table.names else None
        except FileNotFoundError:
            return None
        except (OSError, KeyError, ValueError, TypeError) as error:
            raise _unreadable(path, table, error) from error

    def damage(self, table: Table, partition: Mapping[str, Any], *, thorough: bool = False) -> str:
        """Return what is wrong with a partition's file; empty if intact or missing.

        The bytes of a file are compared with the digest in it. thorough: do not trust what a store has noted of it.
        """
        path = self.path(table, partition)
        if not thorough and self._store.note(path) is not None:
            return ""  # the database's row vouches for it, and every reader compares it with the row's digest
        try:
            _footer_of(self._store.here(path))  # reads the bytes; whoever finds no damage asks for the footer next
        except FileNotFoundError:
            return ""
        except (TrapsError, OSError) as error:
            return str(error)
        except (KeyError, ValueError, TypeError):
            return ""  # the bytes are those that were written; `state` says what is wrong with the footer
        return ""

    def read(self, table: Table, partition: Mapping[str, Any], columns: Sequence[str] | None = None) -> pd.DataFrame:
        """Return one partition. Raises TrapsError naming a missing file and its stage."""
        return self.arrow(table, partition, columns).to_pandas()

    def arrow(self, table: Table, partition: Mapping[str, Any], columns: Sequence[str] | None = None) -> pa.Table:
        """Read one partition as an Arrow table."""
        return self._load(table, self.path(table, partition), columns)

    def records(
        self, table: Table, partition: Mapping[str, Any], columns: Sequence[str] | None = None
    ) -> Iterator[dict[str, Any]]:
        """Yield a partition's rows as mappings, few at once. Raises TrapsError."""
        for batch in self._load(table, self.path(table, partition), columns).to_batches(_ROWS_AT_ONCE):
            yield from batch.to_pylist()

    def read_all(self, table: Table, columns: Sequence[str] | None = None, **equal: Any) -> pd.DataFrame:
        """Read partitions with these column values (a list: any of them); may be empty."""
        return self.read_arrow(table, columns, **equal).to_pandas()

    def read_arrow(self, table: Table, columns: Sequence[str] | None = None, **equal: Any) -> pa.Table:
        """Read all partitions with given column values as one Arrow table."""
        import pyarrow as pa

        unknown_columns = sorted(set(equal) - set(table.partition_by))
        if unknown_columns:
            raise ValueError(f"table {table.name} is partitioned by {table.partition_by}, not by {unknown_columns}")
        values = {c: v if isinstance(v, tuple | list) else [v] for c, v in equal.items()}
        parts = product(*(values.get(column, "*") for column in table.partition_by))
        patterns = ["/".join(map(str, part or [table.name])) + _SUFFIX for part in parts]
        paths = {path for pattern in patterns for path in self._store.below(self.root / table.name, pattern)}
        pieces = [self._load(table, path, columns) for path in sorted(paths)]
        pieces = [piece.replace_schema_metadata(None) for piece in pieces]
        return pa.concat_tables(pieces) if pieces else _schema_of(table, columns).empty_table()

    def partitions(self, table: Table) -> list[dict[str, str]]:
        """Return a table's existing partitions, sorted by path, with the path's values."""
        root = self.root / table.name
        paths = self._store.below(root, "/".join("*" * max(1, len(table.partition_by))) + _SUFFIX)
        values = [str(path)[len(str(root)) + 1 :].removesuffix(_SUFFIX).split("/") for path in paths]
        return [dict(zip(table.partition_by, each, strict=False)) for each in values]

    def _load(self, table: Table, path: Path, columns: Sequence[str] | None) -> pa.Table:
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            names, file = _schema_of(table, columns), self._store.here(path)
            stamp, kept = _stamp(file.stat()), _TABLES.get(str(file))
            if kept is not None and kept[0] == stamp:
                data = kept[1]
            else:
                content = _sound_bytes(file)
                is_small = content.size() <= _SMALL_BYTES  # then all columns cost no more than some of them
                data = pq.ParquetFile(content).read(None if is_small else names.names, use_threads=not is_small)
                if is_small and data.nbytes <= _KEPT_BYTES:
                    if len(_TABLES) >= _KEPT_TABLES:
                        _TABLES.clear()
                    _TABLES[str(file)] = stamp, data
            there = {*data.schema.names}
            data = data.select([name for name in names.names if name in there])
            if not data.schema.equals(names):
                raise pa.ArrowInvalid("its columns are not those of this version")
            return data
        except FileNotFoundError:
            raise TrapsError(f"{path}: not there yet; materialize {table.name} for this partition first") from None
        except (pa.ArrowException, OSError) as error:
            raise _unreadable(path, table, error) from error


def write_sealed(path: Path, data: pa.Table, metadata: Mapping[bytes, bytes]) -> None:
    """Write a Parquet file atomically, with metadata and its digest in the footer."""
    write_bytes(path, seal_table(data, metadata), durable=True)


def seal_table(data: pa.Table, metadata: Mapping[bytes, bytes]) -> bytes:
    """Return a Parquet file's bytes, with metadata and their digest in the footer."""
    import pyarrow.parquet as pq

    buffer = io.BytesIO()
    pq.write_table(data.replace_schema_metadata({**metadata, _SUM: _MARK + _ZEROS}), buffer, compression="zstd")
    content = buffer.getvalue()
    buffer.seek(content.rfind(_MARK) + len(_MARK))
    buffer.write(_sum_of(content))
    return buffer.getvalue()


def read_sealed(path: Path) -> pa.Table:
    """Return a Parquet file after verifying its bytes.

    Raises TrapsError if they have changed, FileNotFoundError, and OSError or ArrowException if it is no Parquet file.
    """
    import pyarrow.parquet as pq

    return pq.ParquetFile(_sound_bytes(path)).read()


def partition_note(path: Path) -> str:
    """Return the text that a store notes beside a partition (footer, columns). Raises TrapsError."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        schema = pq.ParquetFile(_sound_bytes(path)).schema_arrow
        return _note((schema.metadata or {})[_FOOTER].decode(), schema.names)
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:
        raise TrapsError(f"{path}: is not a table as it was written ({error})") from error


def _note(footer: str, names: Sequence[str]) -> str:
    return json.dumps({"state": footer, "columns": [*names]})


def _sum_of(content: bytes) -> bytes:
    """Return the digest that belongs behind the last mark of a file's bytes.

    It is a CRC-32, which finds every flipped bit at a fifteenth of the time of reading the table. Deliberate edits are
    found by the rows' version.
    """
    place, view = content.rfind(_MARK) + len(_MARK), memoryview(content)
    return b"%08x" % crc32(view[place + len(_ZEROS) :], crc32(_ZEROS, crc32(view[:place])))


def _sound_bytes(path: Path) -> pa.BufferReader:
    """Return a file's verified bytes for Arrow's threads, which need no Python then.

    With a file object of Python's they may meet an interpreter that is ending, and abort or hang
    (https://github.com/apache/arrow/issues/50482). Raises TrapsError.
    """
    import pyarrow as pa

    return pa.BufferReader(_verified_bytes(path))


def _verified_bytes(path: Path) -> bytes:
    """Return a file's bytes, verified once until they change. Raises TrapsError."""
    with path.open("rb") as stream:
        content, stamp = stream.read(), _stamp(os.fstat(stream.fileno()))
    place = content.rfind(_MARK) + len(_MARK)
    if _VERIFIED.get(path) != stamp:
        if place < len(_MARK) or content[place : place + len(_ZEROS)] != _sum_of(content):
            remedy = "`traps status` names the command that makes it again, and asks nothing that is in the ledger"
            raise TrapsError(f"{path}: is not what was written (it was altered); {remedy}")
        _VERIFIED[path] = stamp
    return content


def _footer_of(path: Path) -> tuple[State, list[str]]:
    """Return a file's footer and column names, cached until the file changes.

    A run reads each of hundreds of footers dozens of times. Raises as `_verified_bytes`, or KeyError without a footer.
    """
    stamp = _stamp(path.stat())
    if (cached := _FOOTERS.get(path)) is None or cached[0] != stamp:
        content = _verified_bytes(path)
        names, state = _json_behind(content, _COLUMNS), State(**_json_behind(content, _STATE, len(_STATE)))
        cached = _FOOTERS[path] = stamp, state, names
    return cached[1], cached[2]


def _json_behind(content: bytes, mark: bytes, within: int = 0) -> Any:
    """Return the JSON behind the last mark in a file, with `within` bytes of the mark."""
    if (place := content.rfind(mark)) < 0:
        raise KeyError(mark)
    text = content[place + len(mark) - within :].decode("latin-1")  # JSON is ASCII here, what follows is not
    return json.JSONDecoder().raw_decode(text)[0]


def bytes_damage(path: Path) -> str:
    """Return what is wrong with the bytes of a table's file; empty if intact."""
    try:
        _sound_bytes(path)
    except (TrapsError, OSError) as error:
        return str(error)
    return ""


def _stamp(status: os.stat_result) -> str:
    return f"{status.st_mtime_ns} {status.st_size} {status.st_ino}"


def _column(rows: Sequence[Any], field: pa.Field) -> pa.Array:
    """Return a column of rows, with NaN as a missing value, as in a data frame."""
    import pyarrow as pa

    return pa.array([getattr(row, field.name, None) for row in rows], field.type, from_pandas=True)


def _schema_of(table: Table, columns: Sequence[str] | None) -> pa.Schema:
    """Return the table's schema, or some columns of it in the schema's order."""
    import pyarrow as pa

    schema = table.arrow_schema()
    return pa.schema([field for field in schema if columns is None or field.name in columns])


def _unreadable(path: Path, table: Table, error: Exception) -> TrapsError:
    return TrapsError(f"{path}: not a readable {table.name} table ({error}); delete it and materialize again")


def content_version(data: pa.Table) -> str:
    """Return the digest of a table's content without volatile columns."""
    lasting = data.drop_columns([c for c in VOLATILE if c in data.column_names])
    rows = (row for batch in lasting.to_batches(max_chunksize=_ROWS_AT_ONCE) for row in batch.to_pylist())
    return digest_of_list(rows)[:16]
