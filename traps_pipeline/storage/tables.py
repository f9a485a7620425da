"""Declare tables as annotated frozen dataclasses, of which one value is one row.

    @dataclass(frozen=True, kw_only=True)
    class VideoRow:
        '''A clip.'''

        scenario_id: shared.ScenarioId
        side: Annotated[str, "control or void"]
        duration_s: Annotated[float, "n_frames / fps"]

    VIDEOS = Table("videos", VideoRow, partition_by=(), key=("scenario_id", "side"))

Each annotation gives a column's type and, in words, its meaning and unit; `| None` lets values be missing. The columns
keep the order of the fields. Columns that stand beside a metric, such as the bounds of its interval, and columns of a
list, such as the metrics, are declared by a mark (`ExtraColumns`, `EachOf`) under the decorator `with_neighbours`. Each
package declares its tables in a module `..._rows`; columns that several packages share are in `storage.columns`. The
Arrow schema is made from the dataclass, and every file is checked against it on writing and on reading.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from datetime import datetime
from functools import cached_property
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Generic, TypeVar, get_args, get_origin, get_type_hints

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

Row = TypeVar("Row")

# Columns that may differ between two runs of the same study, so data versions ignore them.
VOLATILE = ("created_at", "latency_s", "attempts")
TYPES: tuple[Any, ...] = (str, int, float, bool, datetime, list[str])


@dataclass(frozen=True)
class StoredColumn:
    """A column: name, type (of TYPES), whether values may be missing, meaning, unit."""

    name: str
    type: Any
    nullable: bool
    doc: str

    @property
    def type_name(self) -> str:
        """The type's name: str, list[str], datetime."""
        return str(self.type) if get_origin(self.type) else self.type.__name__


@dataclass(frozen=True)
class ExtraColumns:
    """A mark of a column that has further columns beside it. They have these suffixes, this type and this meaning."""

    suffixes: tuple[str, ...]
    column: Any


@dataclass(frozen=True)
class EachOf:
    """Marks a field of a row that declares several columns at once, of one type and with the same marks.

    `columns` are their names and meanings; the field's own text comes after each meaning.
    """

    columns: Mapping[str, str]


def with_neighbours(row_type: type[Row]) -> type[Row]:
    """Declare the columns that the marks `ExtraColumns` and `EachOf` stand for; place it below `@dataclass`."""
    annotations = dict[str, Any]()
    for name, annotation in row_type.__annotations__.items():
        value_type, doc, *marks = get_args(annotation)
        columns = {name: doc}
        for mark in marks:
            if isinstance(mark, EachOf):
                columns = {key: "; ".join(filter(None, (meaning, doc))) for key, meaning in mark.columns.items()}
        extra_columns = [mark for mark in marks if isinstance(mark, ExtraColumns)]
        for column, meaning in columns.items():
            annotations[column] = Annotated[value_type, meaning]
            annotations |= {f"{column}{suffix}": mark.column for mark in extra_columns for suffix in mark.suffixes}
    row_type.__annotations__ = annotations
    return row_type


@dataclass(frozen=True)
class Table(Generic[Row]):
    """A table's contract: name, row type, partition columns and key.

    Layout: `tables/<table>/<value>/.../<value>.parquet`, one value for each partition column; the file holds these
    columns too. Raises ValueError for a key or partition column that the dataclass lacks.
    """

    name: str
    row_type: type[Row]
    partition_by: tuple[str, ...]
    key: tuple[str, ...]

    def __post_init__(self) -> None:
        unknown_columns = {*self.partition_by, *self.key} - {field.name for field in fields(self.row_type)}  # pyright: ignore[reportArgumentType] - a dataclass
        if unknown_columns:
            raise ValueError(
                f"table {self.name}: {self.row_type.__name__} has no column {', '.join(sorted(unknown_columns))}"
            )

    @property
    def row(self) -> str:
        """The meaning of a row: the dataclass's docstring."""
        words = " ".join((self.row_type.__doc__ or "").split()).removesuffix(".")
        return words[:1].lower() + words[1:]

    @cached_property
    def columns(self) -> tuple[StoredColumn, ...]:
        """The columns by field. Raises TypeError for an annotation without a column type."""
        return tuple(_columns(self.row_type))

    @cached_property
    def names(self) -> list[str]:
        """The names of the columns, without evaluating their annotations."""
        return [field.name for field in fields(self.row_type)]  # pyright: ignore[reportArgumentType] - a dataclass

    def arrow_schema(self) -> pa.Schema:
        """Return the schema of a written file."""
        return self._schema

    @cached_property
    def _schema(self) -> pa.Schema:
        import pyarrow as pa

        arrow = (pa.string(), pa.int64(), pa.float64(), pa.bool_(), pa.timestamp("us", tz="UTC"), pa.list_(pa.string()))
        return pa.schema(
            [
                pa.field(c.name, arrow[TYPES.index(c.type)], nullable=c.nullable, metadata={"doc": c.doc})
                for c in self.columns
            ]
        )


def _columns(row_type: type[Any]) -> Iterator[StoredColumn]:
    for name, annotation in get_type_hints(row_type, include_extras=True).items():
        if get_origin(annotation) is not Annotated:
            raise TypeError(f"{row_type.__name__}.{name}: write Annotated[type, meaning and unit in words]")
        values, doc, *_ = get_args(annotation)
        members = get_args(values) if isinstance(values, UnionType) else (values,)
        types = [member for member in members if member is not NoneType]
        if len(types) != 1 or types[0] not in TYPES or not isinstance(doc, str):
            type_names = ", ".join(map(str, TYPES))
            raise TypeError(f"{row_type.__name__}.{name}: a column holds one of {type_names}, or None, and has a text")
        yield StoredColumn(name, types[0], NoneType in members, doc)


def records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows as JSON values: None for missing values, lists for arrays."""
    rows = frame.astype(object).where(frame.notna(), None).to_dict("records")
    return [{str(k): v.tolist() if hasattr(v, "tolist") else v for k, v in row.items()} for row in rows]
