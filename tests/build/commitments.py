"""A sampled benchmark with its commitment: a fixture to import."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conftest import once
from traps_pipeline.cli import main


@pytest.fixture(scope="module")
def committed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a sampled benchmark of one pair and one scenario of two events, its commitment and its reveal."""
    from traps_pipeline.benchmark.composition import sample_benchmark

    def make(folder: Path) -> str:
        drawn = {"hidden_drop": 1}, 4702163958821407365, "private"
        sample_benchmark(folder / "private", *drawn, look=["size"], two_events=1, workers=1)
        files = ("--out", folder / "commitment.json", "--reveal", folder / "reveal.json")
        assert main(["benchmark", "commit", *map(str, (folder / "private", *files))]) == 0
        return ""

    return once(tmp_path_factory, "committed", make)
