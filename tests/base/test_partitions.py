"""Keys are formatted and parsed back, and hold nothing that Dagster forbids."""

from __future__ import annotations

import pytest

from tests.build.errors import raises
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.protocol.cells import Cell, Evaluation, SteeringCell
from traps_pipeline.protocol.datasets import (
    ALL_CATEGORIES,
    CATEGORIES,
    DATASETS,
    EXTENSION_CATEGORIES,
    RECORDED_CATEGORIES,
    UNPAIRED,
    datasets_of_category,
    is_ill_posed,
    taxonomy_of,
)


def test_every_key_of_the_registry_is_parsed_back_and_legal_in_dagster() -> None:
    every = StudyPartitions(None).evaluations
    cells = [Cell(dataset, e) for dataset in DATASETS for e in every]
    assert all(Cell.parse(cell.key) == cell for cell in cells)
    assert all(Evaluation.parse(e.key) == e for e in every)
    assert not any(set(key) & set("|,[]") for key in (*CATEGORIES, *DATASETS, *(e.key for e in every)))
    assert len({cell.key for cell in cells}) == len(cells)


def test_steering_keys_of_a_study_with_arms_are_read_though_no_arm_is_steered() -> None:
    cells = [SteeringCell.make(dataset, "pocket", "standard", "guided") for dataset in (*DATASETS, *UNPAIRED)]
    assert all(SteeringCell.parse(cell.key) == cell for cell in cells)
    with raises(ValueError, "protocol.cells.SteeringCell.parse"):
        SteeringCell.parse("pachinko|pocket__standard__guided")


def test_a_cell_reads_as_the_design_says() -> None:
    cell = Cell("occlusion", Evaluation("gemini-2.5-pro", "guided", 1))
    assert cell.key == "occlusion|gemini-2.5-pro__guided__run1"
    assert cell.partition == {"dataset": "occlusion", "model": "gemini-2.5-pro", "regime": "guided", "run": 1}
    assert list(cell.partition) == ["dataset", "model", "regime", "run"]


SHAPES = ["m__guided", "m__guided__1", "m__guided__runx", "m__guided__run", "m__guided__run0", "m__guided__run01"]
SHAPES += ["m__guided__run²", "m__warm__run1", "__guided__run1", "m__guided__run1__x", "m__guided__run-1", ""]
SHAPES += ["m__guided__run1\n"]
NAMES = ["M__guided__run1", "a b__guided__run1", "a__b__guided__run1"]
CELLS = ["pachinko|m__guided__run1", "m__guided__run1", "occlusion", "|m__guided__run1", ""]


@pytest.mark.parametrize(
    ("of", "by", "keys"),
    [
        (Evaluation, "protocol.cells", SHAPES),
        (Evaluation, "base.names.check_name", NAMES),
        (Cell, "protocol.cells", CELLS),
    ],
)
def test_a_wrong_key_is_refused(of: type[Cell | Evaluation], by: str, keys: list[str]) -> None:
    for key in keys:
        with raises(ValueError, by):
            of.parse(key)


def test_an_extension_is_no_category_of_the_benchmark_and_its_voids_are_those_of_a_panel() -> None:
    assert not {*EXTENSION_CATEGORIES, *RECORDED_CATEGORIES} & {*CATEGORIES}
    assert (*CATEGORIES, *EXTENSION_CATEGORIES, *RECORDED_CATEGORIES) == ALL_CATEGORIES
    assert {datasets_of_category(name) for name in EXTENSION_CATEGORIES} == {("occlusion", "occlusion_ill_posed")}
    assert datasets_of_category("hidden") == ("occlusion", "occlusion_ill_posed")
    assert datasets_of_category("plinko") == ("chaotic", "chaotic_ill_posed")
    assert [taxonomy_of(d) for d in DATASETS] == ["occlusion", "occlusion", "chaotic", "chaotic"]
    assert [is_ill_posed(d) for d in DATASETS] == [False, True, False, True]
