"""A study whose tiny model is extracted, with directions: fixtures to import."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from tests.mechanism.study import PAIRS, make_study, register, tiny_entry
from traps_pipeline.mechanism import stages
from traps_pipeline.mechanism.mechanism_rows import DIRECTIONS, HIDDEN_STATES, PROBE_ITEMS
from traps_pipeline.mechanism.probe_items import probe_items
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.protocol.cells import Extraction, StatesCell
from traps_pipeline.protocol.datasets import ANSWERABLE, DATASETS
from traps_pipeline.storage.workspace import Workspace

STANDARD = Extraction("tiny", "standard")


@pytest.fixture(scope="module")
def patch() -> Iterator[pytest.MonkeyPatch]:
    with pytest.MonkeyPatch.context() as patch:
        yield patch


@pytest.fixture(scope="module")
def entry(patch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> ModelEntry:
    made = tiny_entry(tmp_path_factory.mktemp("tiny") / "checkpoint")
    register(patch, made)
    return made


def extract_all(
    workspace: Workspace,
    datasets: Sequence[str] = (*DATASETS, ANSWERABLE),
    extraction: Extraction = STANDARD,
) -> int:
    made = 0
    for dataset in datasets:
        workspace.tables.write(PROBE_ITEMS, {"dataset": dataset}, probe_items(workspace, dataset), {})
        cell = StatesCell(dataset, extraction)
        rows, new = stages.extract_states(workspace, cell)
        workspace.tables.write(HIDDEN_STATES, cell.partition, rows, {})
        made += new
    return made


@pytest.fixture(scope="module")
def study(entry: ModelEntry, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """Extracted, with directions."""
    workspace = make_study(tmp_path_factory.mktemp("study"))
    assert extract_all(workspace) == 4 * 2 * PAIRS + PAIRS
    workspace.tables.write(DIRECTIONS, STANDARD.partition, stages.direction_rows(workspace, STANDARD), {})
    return workspace


@pytest.fixture
def own(study: Workspace, tmp_path: Path) -> Workspace:
    """A copy to be changed."""
    shutil.copytree(study.root, tmp_path / "study", symlinks=True)
    return Workspace.open(tmp_path / "study")
