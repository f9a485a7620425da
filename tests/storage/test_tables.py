"""A schema is what a dataclass says, and a folder of tables opens with one line in what people read Parquet with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import duckdb
import pandas as pd
import polars as pl
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest

from tests.tables import TABLES
from traps_pipeline.storage.parquet import TableStore
from traps_pipeline.storage.tables import Table


@dataclass(frozen=True, kw_only=True)
class ParcelRow:
    """A parcel
    on its way."""

    id: Annotated[str, "number on the label"]
    stops: Annotated[list[str], "places, in order"]
    mass_kg: Annotated[float | None, "null where it was not weighed"]
    pieces: Annotated[int, "what it holds"]
    whole: Annotated[bool, "undamaged"]
    sent_at: Annotated[datetime, "when it left"]


PARCELS = Table("parcels", ParcelRow, partition_by=(), key=("id",))


def test_types_nulls_meanings_and_order_are_the_annotations() -> None:
    expected = [
        ("id", pa.string(), False, b"number on the label"),
        ("stops", pa.list_(pa.string()), False, b"places, in order"),
        ("mass_kg", pa.float64(), True, b"null where it was not weighed"),
        ("pieces", pa.int64(), False, b"what it holds"),
        ("whole", pa.bool_(), False, b"undamaged"),
        ("sent_at", pa.timestamp("us", tz="UTC"), False, b"when it left"),
    ]
    schema = PARCELS.arrow_schema()
    assert [(f.name, f.type, f.nullable, f.metadata[b"doc"]) for f in schema] == expected
    types = ["str", "list[str]", "float", "int", "bool", "datetime"]
    assert [column.type_name for column in PARCELS.columns] == types


def test_every_column_of_a_table_says_what_it_holds() -> None:
    for table in TABLES.values():
        assert table.row
        assert [field.name for field in fields(table.row_type)] == table.arrow_schema().names
        assert all(column.doc for column in table.columns), table.name


VALUES: dict[Any, Callable[[int], Any]] = {
    str: lambda n: f"text {n}",
    int: lambda n: n,
    float: lambda n: n / 4,
    bool: lambda n: bool(n % 2),
    datetime: lambda n: datetime(2026, 1, n % 28 + 1, tzinfo=UTC),
    list[str]: lambda n: [f"label {n}", "red"],
}
READERS: dict[str, Callable[[Path], pa.Table]] = {
    "pandas": lambda folder: pa.Table.from_pandas(
        pd.read_parquet(folder, dtype_backend="pyarrow"), preserve_index=False
    ),
    "pyarrow": lambda folder: pq.read_table(folder),
    "pyarrow, hive": lambda folder: ds.dataset(folder, partitioning="hive").to_table(),
    "polars": lambda folder: pl.read_parquet(f"{folder}/**/*.parquet").to_arrow(),
    "duckdb": lambda folder: duckdb.sql(f"from '{folder}/**/*.parquet'").to_arrow_table(),
}


def frame(table: Table, partition: dict[str, Any], first: int) -> pd.DataFrame:
    """Three rows of a partition. In the last one every value is missing that may be."""

    def value(column: Any, n: int) -> Any:
        may_be_missing = column.nullable and column.name not in table.key
        return None if n == 2 and may_be_missing else VALUES[column.type](first + n)

    columns = {column.name: [value(column, n) for n in range(3)] for column in table.columns}
    return pd.DataFrame(columns).assign(**{name: [value] * 3 for name, value in partition.items()})


def two_partitions(table: Table) -> list[dict[str, Any]]:
    """Two partitions that differ in the first column; one of a table that has none."""
    types = {column.name: column.type for column in table.columns}
    chosen = [{name: "gpt-5.5" if types[name] is str else 1 for name in table.partition_by}]
    return [*chosen, chosen[0] | {table.partition_by[0]: "other"}] if table.partition_by else chosen


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> TableStore:
    """Every table of a study, and beside one file what a killed process leaves."""
    store = TableStore(tmp_path_factory.mktemp("study") / "tables")
    for table in TABLES.values():
        for k, partition in enumerate(two_partitions(table)):
            store.write(table, partition, frame(table, partition, 10 * k), {})
            path = store.path(table, partition)
            path.with_name(f".{path.name}.0a1b2c3d.part").write_bytes(b"PAR1 torn")
    return store


@pytest.mark.promise
@pytest.mark.parametrize("reader", READERS)
def test_every_table_opens_with_one_line(store: TableStore, reader: str) -> None:
    for table in TABLES.values():
        expected, opened = store.read_arrow(table), READERS[reader](store.root / table.name)
        assert opened.column_names == expected.column_names
        types = zip(opened.schema.types, expected.schema.types, strict=True)
        assert all(same_kind(*both) for both in types), table.name
        order = [(column, "ascending") for column in dict.fromkeys((*table.partition_by, *table.key))]
        same_types = opened.replace_schema_metadata(None).cast(expected.schema)  # large_string and string are one type
        assert same_types.sort_by(order).to_pylist() == expected.sort_by(order).to_pylist(), table.name


def same_kind(one: pa.DataType, other: pa.DataType) -> bool:
    """Whether two types differ in how they are stored alone."""
    kinds = (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean, pa.types.is_timestamp, pa.types.is_list)
    text = (pa.types.is_string, pa.types.is_large_string)
    if any(is_text(other) for is_text in text):
        return any(is_text(one) for is_text in (*text, pa.types.is_string_view))
    return any(kind(one) and kind(other) for kind in (*kinds, pa.types.is_large_list)) or (
        pa.types.is_large_list(one) and pa.types.is_list(other)
    )
