"""Studies compared by all of their tables."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from tests.tables import TABLES
from traps_pipeline.storage.tables import VOLATILE
from traps_pipeline.storage.workspace import Workspace

ONE_REGIME = "tests/experiments/one_regime.yaml"


def tables(root: Path) -> dict[str, pd.DataFrame]:
    store = Workspace.open(root).tables
    return {name: store.read_all(table).drop(columns=list(VOLATILE), errors="ignore") for name, table in TABLES.items()}


def assert_same_tables(one: Path, other: Path) -> None:
    ours, theirs = tables(one), tables(other)
    assert ours.keys() == theirs.keys()
    for name, frame in ours.items():
        pd.testing.assert_frame_equal(frame, theirs[name], obj=name)
