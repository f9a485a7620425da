"""One released folder of the demo, shared by the tests of releases."""

from __future__ import annotations

from pathlib import Path

import pytest

import traps_pipeline.definitions  # noqa: F401 - declares the graph
from tests.conftest import Checkout, once


@pytest.fixture(scope="session")
def released(demo: Checkout, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `traps publish release` writes of the demo. Read only."""

    def make(folder: Path) -> str:
        finished = demo.traps("publish", "release", folder, "--date", "2026-11-22")
        assert finished.code == 0, finished.err
        return finished.out

    return once(tmp_path_factory, "released", make)
