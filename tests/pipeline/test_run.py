"""Batches of partitions: ranges that Dagster expands to exactly the keys asked for."""

from __future__ import annotations

import random
import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest
from dagster import AssetObservation, PartitionKeyRange

from traps_pipeline.pipeline.graph import the_graph
from traps_pipeline.pipeline.ranges import key_ranges
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.pipeline.schemes import CELL, DATASET
from traps_pipeline.pipeline.translation import partitions_of
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.protocol.cells import Cell
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

CELLS = [str(key) for key in the_graph().keys("responses")]


def expanded(keys: Sequence[str]) -> Counter[str]:
    """What Dagster makes of the batches of some keys: how often each key is run."""
    ran: Counter[str] = Counter()
    for first, last in key_ranges(CELL, list(keys)):
        assert first is not None and last is not None
        ran.update(str(key) for key in partitions_of(CELL).get_partition_keys_in_range(PartitionKeyRange(first, last)))
    return ran


@pytest.mark.slow
def test_batches_of_any_cells_run_each_once_and_no_other() -> None:
    rng = random.Random(7)
    for size in [1, 2, 3, 5, 10, 30, len(CELLS) // 2, len(CELLS) - 1] * 3:
        keys = rng.sample(CELLS, size)
        assert expanded(keys) == Counter(keys)


@pytest.mark.parametrize("datasets", [DATASETS, DATASETS[:2], DATASETS[1:3], ("occlusion", "chaotic_ill_posed")])
def test_whole_models_are_few_runs(datasets: Sequence[str]) -> None:
    oracle = [e for e in StudyPartitions(None).evaluations if e.model in ("oracle", "always-abstain")]
    keys = [Cell(dataset, e).key for e in oracle for dataset in datasets]
    assert expanded(keys) == Counter(keys)
    neighbours = 1 if datasets != ("occlusion", "chaotic_ill_posed") else 2
    assert len(list(key_ranges(CELL, keys))) == neighbours


def test_neighbours_of_one_dimension_are_one_range_and_no_keys_are_no_run() -> None:
    assert list(key_ranges(CELL, [])) == []
    assert list(key_ranges(DATASET, ["occlusion", "occlusion_ill_posed", "chaotic_ill_posed"])) == [
        ("occlusion", "occlusion_ill_posed"),
        ("chaotic_ill_posed", "chaotic_ill_posed"),
    ]
    assert list(key_ranges(None, [None])) == [(None, None)]


@pytest.mark.slow
@pytest.mark.promise
@pytest.mark.parametrize("damage", ["gone", "no database"])
def test_a_history_that_is_lost_begins_anew(
    tmp_path: Path, damage: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    workspace = Workspace.create(tmp_path / "study", Study())
    monkeypatch.setenv("DAGSTER_HOME", str(workspace.dagster_home))
    with dagster_history(workspace) as history:
        history.report_runless_asset_event(AssetObservation("questions", tags={"dagster/data_version": "1"}))
    if damage == "gone":
        shutil.rmtree(workspace.dagster_home)
    else:
        (workspace.dagster_home / "history" / "runs" / "index.db").write_bytes(b"no database" * 500)
    with dagster_history(workspace) as history:
        assert history.all_asset_keys() == [] and history.get_runs_count() == 0
    assert ("broken-" in capsys.readouterr().err) == (damage != "gone")  # the folder that it lies in
