"""How partitions are cut into runs for several hosts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import dagster as dg
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from traps_cluster.run_shares import WORTH_S, cut_keys, shared_out
from traps_pipeline.pipeline.partitioning import Partitioning
from traps_pipeline.pipeline.schemes import CATEGORY, CELL, DATASET
from traps_pipeline.pipeline.translation import partitions_of


def keys_of(scheme: Partitioning, ranges: Sequence[Any]) -> list[str]:
    """Every key of every range, as Dagster reads it."""
    read = partitions_of(scheme).get_partition_keys_in_range
    return [key for first, last in ranges for key in read(dg.PartitionKeyRange(str(first), str(last)))]


def grid_of(n_datasets: int, n_evaluations: int) -> Partitioning:
    """Cells of so many datasets, and of models with nine runs each."""
    datasets = [f"d{n:02d}" for n in range(n_datasets)]
    evaluations = [f"model-{n // 9}__standard__run{n % 9}" for n in range(n_evaluations)]
    return Partitioning({"dataset": datasets, "evaluation": evaluations}, lambda _: {}, lambda _: [])


GRID = grid_of(6, 20)


@settings(deadline=None)  # a busy machine takes any time
@given(keys=st.sets(st.sampled_from(sorted(GRID.keys)), min_size=1), most=st.integers(1, 50))
def test_whatever_is_missing_no_more_runs_than_asked_have_each_key_once(keys: set[str], most: int) -> None:
    ranges = cut_keys(GRID, sorted(keys), most)
    held = Counter(keys_of(GRID, ranges))  # and others beside them, which are made
    assert len(ranges) == min(most, len(keys))
    assert keys <= held.keys() and max(held.values()) == 1
    assert all(keys & {*keys_of(GRID, [one])} for one in ranges)


@pytest.mark.parametrize(("n_datasets", "n_evaluations"), [(28, 195), (28, 30), (12, 100), (4, 195), (28, 1), (4, 3)])
def test_a_study_of_whole_models_is_cut_into_as_many_runs_of_one_size(n_datasets: int, n_evaluations: int) -> None:
    grid = grid_of(n_datasets, n_evaluations)
    keys = sorted(grid.keys)
    ranges = cut_keys(grid, keys, 40)
    assert sorted(keys_of(grid, ranges)) == keys
    assert len(ranges) == min(40, len(keys))
    sizes = [len(keys_of(grid, [one])) for one in ranges]
    assert max(sizes) <= 2 * min(sizes)


def test_fewer_runs_than_models_load_each_model_once() -> None:
    evaluations = [f"model-{n // 9}__standard__run{n % 9}" for n in range(90)]
    scheme = Partitioning({"evaluation": evaluations}, lambda _: {}, lambda _: [])
    parts = [keys_of(scheme, [one]) for one in cut_keys(scheme, evaluations, 7)]
    models = [model for part in parts for model in {key.partition("__")[0] for key in part}]
    assert len(parts) == 7 and sorted(models) == sorted({*models})


def test_cells_of_one_model_stay_together() -> None:
    datasets = DATASET.keys[:4]
    every = CELL.keys
    evaluations = [*dict.fromkeys(key.partition("|")[2] for key in every)][:4]
    keys = [f"{dataset}|{evaluation}" for dataset in datasets for evaluation in evaluations]
    ranges = cut_keys(CELL, keys, 4)  # 16 cells in 4 runs: one of each model, all its datasets
    assert len(ranges) == 4
    for one in ranges:
        assert len({key.partition("|")[2] for key in keys_of(CELL, [one])}) == 1
    assert len(cut_keys(CELL, keys, 1)) == 1


# --- runs that share what they make -----------------------------------------------------------------------------------


def runs_of(seconds: dict[str | None, float], most: int) -> list[Any]:
    return shared_out(CATEGORY, list(seconds), seconds, most)


def test_little_work_is_one_run_and_much_is_as_many_as_asked_at_most() -> None:
    every = dict.fromkeys(sorted(CATEGORY.keys), WORTH_S / 100)
    whole = [*CATEGORY.keys]
    order: dict[str | None, float] = {key: every[key] for key in whole}
    assert runs_of(order, 40) == [(whole[0], whole[-1])]
    assert runs_of(dict.fromkeys(order, 1e6), 3) == [(whole[0], whole[-1])] * 3  # who shares all stays busy


def test_a_large_category_is_made_by_more_runs_than_a_small_one() -> None:
    first, second, *_ = CATEGORY.keys
    ranges = runs_of({first: 10 * WORTH_S, second: 2 * WORTH_S}, 40)
    assert Counter(ranges) == {(first, first): 10, (second, second): 2}
    assert ranges[:2] == [(first, first), (second, second)]  # with few hosts, each category is begun early
    assert Counter(runs_of({first: 10 * WORTH_S, second: 2 * WORTH_S}, 6)) == {
        (first, first): 5, (second, second): 1
    }  # fmt: skip


@settings(deadline=None)  # a busy machine takes any time
@given(corners=st.tuples(st.sampled_from(GRID.keys), st.sampled_from(GRID.keys)))
def test_a_range_has_the_keys_that_dagster_reads_in_it(corners: tuple[str, str]) -> None:
    assert [*GRID.between(*corners)] == keys_of(GRID, [corners])
