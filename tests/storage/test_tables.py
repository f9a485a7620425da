"""A table's schema is what its annotated dataclass says, and an annotation that says no column is named."""

from __future__ import annotations

from dataclasses import dataclass, fields
from datetime import datetime
from typing import Annotated

import pyarrow as pa

from tests.tables import TABLES
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
