"""The lineage that decides what is stale is the one that Dagster draws."""

from __future__ import annotations

import random

import dagster as dg
import pytest

from traps_pipeline.definitions import defs
from traps_pipeline.lineage import PARTITIONED_BY, REPORTS, SOURCES, STAGES, keys_of, partition_of, upstream
from traps_pipeline.tables import TABLES

GRAPH = defs.get_repository_def().asset_graph


def parents(stage: str, key: str | None) -> set[tuple[str, str | None]]:
    """Dagster's parents of a partition. A parent without partitions is one node; a child without takes every key."""
    asset = dg.AssetKey(stage)
    found: set[tuple[str, str | None]] = set()
    definition = GRAPH.get(asset).partitions_def
    subset = definition.subset_with_partition_keys([key]) if definition is not None and key is not None else None
    for parent in GRAPH.get(asset).parent_keys:
        name, above = parent.to_user_string(), GRAPH.get(parent).partitions_def
        if above is None:
            found.add((name, None))
            continue
        mapping = GRAPH.get_partition_mapping(asset, parent)
        mapped = mapping.get_upstream_mapped_partitions_result_for_partitions(subset, definition, above)
        assert not mapped.required_but_nonexistent_subset.get_partition_keys()
        found |= {(name, str(k)) for k in mapped.partitions_subset.get_partition_keys()}
    return found


@pytest.mark.parametrize("stage", STAGES)
def test_a_partition_is_made_from_what_dagster_says(stage: str) -> None:
    keys = keys_of(stage)
    for key in random.Random(3).sample(keys, min(len(keys), 8)):
        nodes = upstream(stage, key)
        assert len(nodes) == len(set(nodes))
        assert set(nodes) == parents(stage, key)


@pytest.mark.parametrize("name", [*STAGES, *SOURCES])
def test_keys_are_the_assets_partitions(name: str) -> None:
    definition = GRAPH.get(dg.AssetKey(name)).partitions_def
    expected = [None] if definition is None else sorted(str(key) for key in definition.get_partition_keys())
    assert keys_of(name) == expected if definition is None else sorted(map(str, keys_of(name))) == expected


def test_stages_stand_in_an_order_in_which_each_finds_its_inputs_made() -> None:
    made = set(SOURCES)
    for stage in STAGES:
        assert {name for name, _ in upstream(stage, keys_of(stage)[0])} <= made
        made.add(stage)


def test_every_stage_is_a_table_or_a_report_and_its_keys_are_the_tables_partitions() -> None:
    assert {*TABLES, *REPORTS} == set(STAGES)
    for stage, table in TABLES.items():
        assert tuple(partition_of(stage, keys_of(stage)[0])) == table.partition_by
    assert set(PARTITIONED_BY) <= {*STAGES, *SOURCES}


def test_an_unknown_stage_is_answered_with_the_known_ones() -> None:
    with pytest.raises(KeyError, match=r"unknown stage 'stages'; known: scene_specs, videos"):
        upstream("stages", None)
