"""Tables are written whole or not at all, and only as their schema says."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow.parquet as pq
import pytest

from tests.build.errors import raises
from tests.build.video_rows import PARTITION, clip
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.asking.answer_rows import RESPONSES, ResponseRow
from traps_pipeline.storage.benchmark_tables import VIDEOS, VideoRow
from traps_pipeline.storage.parquet import State, TableStore, write_sealed

CELL = {"dataset": "chaotic", "model": "m", "regime": "standard", "run": 1}


def answer(item: str, **changes: Any) -> ResponseRow:
    """A row of the responses table."""
    row: dict[str, Any] = dict.fromkeys(RESPONSES.names) | {"item_id": item, "pair_id": item, "side": "void"}
    row |= {"outcome": "answer", "text": "left", "latency_s": 1.0}
    row |= {"attempts": 1, "request_key": "k", "epoch": "1", "created_at": datetime(2026, 1, 1, tzinfo=UTC)}
    return ResponseRow(**(row | CELL | {"benchmark_version": "0.1.0"} | changes))


@pytest.fixture
def store(tmp_path: Path) -> TableStore:
    return TableStore(tmp_path / "tables")


def leftovers(folder: Path) -> list[str]:
    return [path.name for path in folder.rglob("*") if path.is_file() and path.suffix != ".parquet"]


ROW, OTHER = clip("plinko-0001"), clip("plinko-0002")


@pytest.mark.parametrize(
    ("rows", "names"),
    [
        (pd.DataFrame([ROW]).assign(colour="red"), ["colour"]),
        ([answer("a")], ["request_key"]),
        ([ROW, clip("plinko-0002", path=None)], ["path"]),
        (pd.DataFrame([ROW, clip("plinko-0002", path=None)]), ["path"]),
        (pd.DataFrame([ROW]).drop(columns="fps"), []),
        ([clip("plinko-0001", fps="ten")], []),
        ([ROW, OTHER, clip("plinko-0001", path="elsewhere")], []),
        ([ROW, clip("hidden_race-0001", category="hidden")], ["category", "['hidden']"]),
    ],
    ids=["stranger", "other rows", "null", "null in a frame", "lacking", "type", "repeated key", "other partition"],
)
def test_rows_that_are_not_of_the_table_are_refused_and_nothing_is_written(
    store: TableStore, rows: Any, names: list[str]
) -> None:
    with raises(TrapsError, "storage.parquet.TableStore._arrow_of", "videos", *names):
        store.write(VIDEOS, PARTITION, rows, {})
    assert store.state(VIDEOS, PARTITION) is None


def test_a_table_is_sorted_by_its_key_and_comes_back_as_it_was_written(store: TableStore) -> None:
    rows = [clip("plinko-0002"), clip("plinko-0001", "void"), clip("plinko-0001")]
    store.write(VIDEOS, PARTITION, rows, {})
    read = store.read(VIDEOS, PARTITION)
    assert [VideoRow(**row) for row in read.to_dict("records")] == [rows[2], rows[1], rows[0]]


def test_the_version_does_not_depend_on_times_attempts_or_row_order(store: TableStore) -> None:
    first = store.write(RESPONSES, CELL, [answer("a"), answer("b")], {})
    later = {"created_at": datetime(2027, 1, 1, tzinfo=UTC), "latency_s": 9.0, "attempts": 4}
    assert store.write(RESPONSES, CELL, [answer("b", **later), answer("a")], {"x": "another input"}) == first


@pytest.mark.parametrize("change", [{"text": "right"}, {"text": None}, {"cost_usd": 0.1}, {"epoch": "2"}])
def test_the_version_changes_with_any_other_content(store: TableStore, change: dict[str, Any]) -> None:
    first = store.write(RESPONSES, CELL, [answer("a"), answer("b")], {})
    assert store.write(RESPONSES, CELL, [answer("a"), answer("b", **change)], {}) != first


def test_a_table_of_no_rows_is_a_table(store: TableStore) -> None:
    store.write(VIDEOS, PARTITION, [], {})
    assert len(store.read(VIDEOS, PARTITION)) == 0
    assert list(store.read(VIDEOS, PARTITION).columns) == VIDEOS.names


def test_a_disk_that_is_really_full_leaves_the_former_file(tiny_disk: Path) -> None:
    store = TableStore(tiny_disk)
    store.write(VIDEOS, PARTITION, [clip("plinko-0001")], {})
    noise = [clip(f"plinko-{n:04d}", path=os.urandom(500).hex()) for n in range(200)]
    with raises(TrapsError, "base.files.replace_file", "plinko.parquet"):
        store.write(VIDEOS, PARTITION, noise, {})
    assert leftovers(tiny_disk) == []
    assert list(store.read(VIDEOS, PARTITION)["scenario_id"]) == ["plinko-0001"]


@pytest.mark.parametrize("damage", [b"", b"PAR1 no table", None])
def test_an_unreadable_file_is_named_with_the_remedy(store: TableStore, damage: bytes | None) -> None:
    store.write(VIDEOS, PARTITION, [clip("plinko-0001")], {})
    path = store.path(VIDEOS, PARTITION)
    path.write_bytes(path.read_bytes()[:-20] if damage is None else damage)
    for look in (store.read, store.state):
        with raises(TrapsError, "storage.parquet", "plinko.parquet"):
            look(VIDEOS, PARTITION)
    with raises(TrapsError, "storage.parquet", "plinko.parquet"):
        store.read_all(VIDEOS)


def test_a_missing_partition_names_its_file_and_the_stage_to_materialize(store: TableStore) -> None:
    assert store.state(VIDEOS, PARTITION) is None
    with raises(TrapsError, "storage.parquet.TableStore._load", "videos/plinko.parquet", "videos"):
        store.read(VIDEOS, PARTITION)


def test_partitions_are_read_together_and_by_column(store: TableStore) -> None:
    assert len(store.read_all(RESPONSES)) == 0
    for dataset in ("chaotic", "occlusion"):
        for run in (1, 2):
            cell = CELL | {"dataset": dataset, "run": run}
            store.write(RESPONSES, cell, [answer(f"{dataset}:{n}", **cell) for n in range(run)], {})
    assert len(store.read_all(RESPONSES)) == 6
    assert len(store.read_all(RESPONSES, dataset="chaotic", run=2)) == 2
    assert list(store.read_all(RESPONSES, ["item_id"], run=1)["item_id"]) == ["chaotic:0", "occlusion:0"]
    chosen = store.read_all(RESPONSES, ["item_id"], run=1, dataset=("occlusion", "length_matched"))
    assert list(chosen["item_id"]) == ["occlusion:0"]
    assert len(store.read_all(RESPONSES, dataset=[])) == 0


def test_a_misspelt_partition_column_is_refused(store: TableStore) -> None:
    store.write(VIDEOS, PARTITION, [clip("plinko-0001")], {})
    with raises(ValueError, "storage.parquet.TableStore.read_arrow", "videos", "category", "['catgory"):
        store.read_all(VIDEOS, catgory="hidden")


def test_a_partition_written_by_another_version_of_the_schema_is_named(store: TableStore) -> None:
    store.write(VIDEOS, PARTITION, [clip("plinko-0001")], {})
    store.write(VIDEOS, {"category": "hidden"}, [clip("hidden_race-0001", category="hidden")], {})
    path = store.path(VIDEOS, PARTITION)
    table = pq.read_table(path, partitioning=None).drop_columns(["fps"])
    write_sealed(path, table, {b"traps": table.schema.metadata[b"traps"]})
    with raises(TrapsError, "storage.parquet.TableStore._load"):
        store.read_all(VIDEOS)


def test_no_bit_of_a_file_can_flip_unseen(store: TableStore) -> None:
    """Bits all over a file: what is read is what was written, or the file is named."""
    store.write(VIDEOS, PARTITION, [clip("plinko-0001"), clip("plinko-0002")], {"a": "1"})
    path = store.path(VIDEOS, PARTITION)
    written, whole, state = path.read_bytes(), store.read(VIDEOS, PARTITION), store.state(VIDEOS, PARTITION)
    silent = 0
    for place in range(0, 8 * len(written), 8 * len(written) // 500 | 1):
        flipped = bytearray(written)
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        named = store.damage(VIDEOS, PARTITION)
        try:
            same = store.read(VIDEOS, PARTITION).equals(whole) and store.state(VIDEOS, PARTITION) == state
        except TrapsError as error:
            same = False
            assert str(path) in str(error)
        silent += not same and str(path) not in named
    assert silent == 0


@pytest.mark.parametrize("path", ["clips/a.mp4", 'traps-columns:["a"] {"version": "0"}'])
def test_a_footer_is_read_whatever_a_row_says(store: TableStore, path: str) -> None:
    version = store.write(VIDEOS, PARTITION, [clip("plinko-0001", path=path)], {"scene_specs/plinko": "1"}, failed=2)
    assert store.state(VIDEOS, PARTITION) == State(version, {"scene_specs/plinko": "1"}, 1, 2)


def test_a_file_with_other_columns_is_made_again(store: TableStore) -> None:
    store.write(VIDEOS, PARTITION, [clip("plinko-0001")], {})
    file = store.path(VIDEOS, PARTITION)
    data = pq.read_table(file)
    footer, names = (data.schema.metadata[key] for key in (b"traps", b"traps-columns"))
    write_sealed(file, data.drop_columns(["fps"]), {b"traps": footer, b"traps-columns": names.replace(b'"fps", ', b"")})
    assert store.state(VIDEOS, PARTITION) is None
