"""Batches of cells: ranges that Dagster expands to exactly the cells asked for."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Sequence

import pytest

from traps_pipeline.defs.common import CELL
from traps_pipeline.driver import batches
from traps_pipeline.lineage import keys_of
from traps_pipeline.models.registry import all_evaluations
from traps_pipeline.partitions import DATASETS, Cell


def expanded(keys: Sequence[str]) -> Counter[str]:
    """What Dagster makes of the batches of some keys: how often each key is run."""
    from dagster import PartitionKeyRange

    ran: Counter[str] = Counter()
    for first, last in batches("responses", list(keys)):
        assert first is not None and last is not None
        ran.update(str(key) for key in CELL.get_partition_keys_in_range(PartitionKeyRange(first, last)))
    return ran


def test_batches_of_any_cells_run_each_once_and_no_other() -> None:
    everything = [str(key) for key in keys_of("responses")]
    rng = random.Random(7)
    for size in [1, 2, 3, 5, 10, 30, len(everything) // 2, len(everything) - 1] * 3:
        keys = rng.sample(everything, size)
        assert expanded(keys) == Counter(keys)


@pytest.mark.parametrize("datasets", [DATASETS, DATASETS[:2], DATASETS[1:3], ("occlusion", "chaotic_ill_posed")])
def test_whole_models_are_few_runs(datasets: Sequence[str]) -> None:
    oracle = [e for e in all_evaluations() if e.model in ("oracle", "always-abstain")]
    keys = [Cell(dataset, e).key for e in oracle for dataset in datasets]
    assert expanded(keys) == Counter(keys)
    neighbours = 1 if datasets != ("occlusion", "chaotic_ill_posed") else 2
    assert len(list(batches("responses", keys))) == neighbours


def test_a_gap_makes_two_ranges() -> None:
    keys = [str(key) for key in keys_of("votes")]
    one_dataset = [key for key in keys if key.startswith("chaotic|")]
    without = one_dataset[:3] + one_dataset[4:]
    assert list(batches("votes", without)) == [(without[0], without[2]), (without[3], without[-1])]


def test_no_cells_are_no_run() -> None:
    assert list(batches("responses", [])) == []


def test_other_stages_take_one_partition_a_run() -> None:
    assert list(batches("items", ["occlusion", "chaotic"])) == [("occlusion", "occlusion"), ("chaotic", "chaotic")]
    assert list(batches("leaderboard", [None])) == [(None, None)]
