"""The graph that decides what is stale and in which order things are made is the one that Dagster draws."""

from __future__ import annotations

import random
from pathlib import Path

import dagster as dg
import pytest

from tests.build.errors import raises
from tests.tables import TABLES
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.definitions import defs
from traps_pipeline.pipeline.graph import JOB_GROUPS, the_graph
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

DAGSTER = defs.get_repository_def().asset_graph
GRAPH = the_graph()
STAGES = [stage.name for stage in GRAPH.stages]


def parents(stage: str, key: str | None) -> set[tuple[str, str | None]]:
    """Dagster's parents of a partition. A parent without partitions is one node; a child without takes every key."""
    asset = dg.AssetKey(stage)
    found: set[tuple[str, str | None]] = set()
    definition = DAGSTER.get(asset).partitions_def
    subset = definition.subset_with_partition_keys([key]) if definition is not None and key is not None else None
    for parent in DAGSTER.get(asset).parent_keys:
        name, above = parent.to_user_string(), DAGSTER.get(parent).partitions_def
        if above is None:
            found.add((name, None))
            continue
        mapping = DAGSTER.get_partition_mapping(asset, parent)
        mapped = mapping.get_upstream_mapped_partitions_result_for_partitions(subset, definition, above)
        assert not mapped.required_but_nonexistent_subset.get_partition_keys()
        found |= {(name, str(k)) for k in mapped.partitions_subset.get_partition_keys()}
    return found


@pytest.mark.slow
@pytest.mark.promise
def test_a_partition_is_made_from_what_dagster_says() -> None:
    for stage in STAGES:
        keys = GRAPH.keys(stage)
        for key in random.Random(3).sample(keys, min(len(keys), 8)):
            ours = [(parent, k) for parent, above in GRAPH.parents(stage, key).items() for k in above]
            assert len(ours) == len(set(ours))
            assert set(ours) == parents(stage, key), (stage, key)


def test_dagster_knows_the_stages_and_sources_that_are_declared_and_no_others() -> None:
    assert {key.to_user_string() for key in DAGSTER.get_all_asset_keys()} == {*STAGES, *GRAPH.sources}


def test_a_description_tells_what_an_asset_is_and_not_what_its_function_does() -> None:
    for name in STAGES:
        assert not GRAPH[name].doc.startswith("Return") and GRAPH[name].doc[:1].isupper(), name


def test_a_run_works_in_the_study_of_the_environment_also_in_a_copy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("study", "copy"):
        Workspace.create(tmp_path / name, Study())
        monkeypatch.setenv("TRAPS_WORKSPACE", str(tmp_path / name))
        assert (defs.resources or {})["workspace"].open().root == tmp_path / name


def test_a_block_shares_its_partitions_and_blocks_are_few() -> None:
    for block in GRAPH.blocks():
        assert len({id(stage.scheme) for stage in block}) == 1
    without = [name for name in STAGES if GRAPH[name].group != "mechanism"]
    named = [[stage.name for stage in block] for block in GRAPH.blocks(without)]
    assert named[:4] == [["scene_specs", "videos", "arms"], ["items"], ["responses", "votes", "verdicts"], ["metrics"]]
    assert len(named) == 5  # what has no partitions is one run


def test_tables_are_partitioned_as_their_stages_keys_say() -> None:
    tables = {stage.table.name: stage for stage in GRAPH.stages if stage.table is not None}
    assert tables.keys() <= {*TABLES}
    for name, stage in tables.items():
        assert tuple(stage.columns(GRAPH.keys(name)[0])) == TABLES[name].partition_by


def test_what_can_cost_money_is_marked() -> None:
    paid = {"responses", "votes", "confabulation", "steering_votes"}
    assert {s.name for s in GRAPH.stages if s.cost == "money"} == paid
    assert {s.name for s in GRAPH.stages if s.cost == "machine"} == {
        *("hidden_states", "steering", "steering_fluency"),
        *("probe_baselines", "gate", "leads", "interaction", "lens", "item_scores", "sentences", "patching"),
    }


@pytest.mark.parametrize(("name", "known"), [("vidoes", "videos"), ("xyz", "scene_specs, videos")])
def test_an_unknown_stage_is_answered_with_those_that_it_may_mean(name: str, known: str) -> None:
    with raises(TrapsError, "pipeline.graph", name, known):
        _ = GRAPH[name]


def test_every_stage_is_made_by_one_job_and_by_the_job_of_everything() -> None:
    groups = [group for groups in JOB_GROUPS.values() for group in groups]
    assert len(groups) == len(set(groups))
    assert {stage.group for stage in GRAPH.stages} == set(groups)
    assert {job.name for job in defs.jobs or ()} == {*JOB_GROUPS, "everything"}
