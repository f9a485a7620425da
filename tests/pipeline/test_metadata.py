"""What Dagster shows of a table: the best rows of one that ranks, whether it was made row by row or as a frame."""

from __future__ import annotations

import pandas as pd
import pytest

from tests.mechanism.study import filled
from traps_pipeline.mechanism.control_rows import GATE
from traps_pipeline.pipeline.metadata import preview
from traps_pipeline.storage.parquet import StageOutput

ROWS = [filled(GATE, target=name, pecs=pecs) for name, pecs in (("low", 0.1), ("high", 0.9), ("none", None))]


@pytest.mark.parametrize("content", [ROWS, pd.DataFrame(ROWS)], ids=["rows", "frame"])
def test_the_best_rows_of_a_table_that_ranks_are_shown_first(content: list | pd.DataFrame) -> None:
    shown = preview(GATE, StageOutput(content))["best by pecs"]
    assert [record.data["target"] for record in shown.records] == ["high", "low"]
