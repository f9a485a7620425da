"""How partitions are cut into runs for several hosts."""

from __future__ import annotations

from typing import Any

import dagster as dg
import pytest

from traps_pipeline.orchestration.runs import batches
from traps_pipeline.orchestration.schemes import CELL, DATASET, Scheme


def keys_of(scheme: Scheme, ranges: list[Any]) -> list[str]:
    """Every key of every range, as Dagster reads it."""
    return [key for first, last in ranges for key in scheme.definition.get_partition_keys_in_range(
        dg.PartitionKeyRange(str(first), str(last)))]  # fmt: skip


@pytest.mark.parametrize("most", [1, 3, 40])
def test_ranges_hold_each_key_once(most: int) -> None:
    keys = [str(key) for key in CELL.definition.get_partition_keys()][::2][:60]
    ranges = [*batches(CELL, keys, most)]
    assert sorted(keys_of(CELL, ranges)) == sorted(keys)
    assert len(ranges) >= min(most, len(keys))


@pytest.mark.parametrize(("n_datasets", "n_evaluations"), [(28, 195), (28, 30), (12, 100), (4, 195), (28, 1), (4, 3)])
def test_a_study_of_whole_models_is_cut_into_as_many_runs_as_asked_and_no_more(
    n_datasets: int, n_evaluations: int
) -> None:
    datasets = [f"d{n:02d}" for n in range(n_datasets)]
    evaluations = [f"model-{n // 9}__standard__run{n % 9}" for n in range(n_evaluations)]
    definition = dg.MultiPartitionsDefinition(
        {"dataset": dg.StaticPartitionsDefinition(datasets), "evaluation": dg.StaticPartitionsDefinition(evaluations)}
    )
    grid = Scheme(definition, lambda _: {}, lambda _: [])
    keys = [f"{dataset}|{evaluation}" for evaluation in evaluations for dataset in datasets]
    ranges = [*batches(grid, keys, 40)]
    assert sorted(keys_of(grid, ranges)) == sorted(keys)
    assert min(40, len(keys)) * 0.7 <= len(ranges) <= 40
    sizes = [len(keys_of(grid, [one])) for one in ranges]
    assert max(sizes) <= 2 * min(sizes)


def test_fewer_runs_than_models_load_each_model_once() -> None:
    evaluations = [f"model-{n // 9}__standard__run{n % 9}" for n in range(90)]
    scheme = Scheme(dg.StaticPartitionsDefinition(evaluations), lambda _: {}, lambda _: [])
    parts = [keys_of(scheme, [one]) for one in batches(scheme, evaluations, 7)]
    models = [model for part in parts for model in {key.partition("__")[0] for key in part}]
    assert len(parts) == 7 and sorted(models) == sorted({*models})


def test_cells_of_one_model_stay_together() -> None:
    datasets = [str(key) for key in DATASET.definition.get_partition_keys()][:4]
    every = [str(key) for key in CELL.definition.get_partition_keys()]
    evaluations = [*dict.fromkeys(key.partition("|")[2] for key in every)][:4]
    keys = [f"{dataset}|{evaluation}" for dataset in datasets for evaluation in evaluations]
    ranges = [*batches(CELL, keys, 4)]  # 16 cells in 4 runs: one of each model, all its datasets
    assert len(ranges) == 4
    for one in ranges:
        assert len({key.partition("|")[2] for key in keys_of(CELL, [one])}) == 1
    assert len([*batches(CELL, keys)]) == 1  # which one process makes in one
