"""What Dagster shows of a table: short texts, and the best rows of one that ranks, be they rows or a frame."""

from __future__ import annotations

import dagster as dg
import pandas as pd
import pytest

from tests.build.cells import row
from tests.mechanism.study import filled
from traps_pipeline.base.progress import Tally
from traps_pipeline.mechanism.control_rows import GATE
from traps_pipeline.pipeline.graph import the_graph
from traps_pipeline.pipeline.metadata import preview, tally_metadata, tally_of
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.parquet import StageOutput

ROWS = [filled(GATE, target=name, pecs=pecs) for name, pecs in (("low", 0.1), ("high", 0.9), ("none", None))]


@pytest.mark.parametrize("content", [ROWS, pd.DataFrame(ROWS)], ids=["rows", "frame"])
def test_the_best_rows_of_a_table_that_ranks_are_shown_first(content: list | pd.DataFrame) -> None:
    shown = preview(GATE, StageOutput(content))["best by pecs"]
    assert [record.data["target"] for record in shown.records] == ["high", "low"]


def test_rows_are_shown_with_their_short_texts_and_without_long_ones() -> None:
    items = [row(ITEMS, item_id=f"chaotic:a:{side}", side=side, question="What? " * 20) for side in ("control", "void")]
    shown = preview(ITEMS, StageOutput(items))["first rows"]
    assert [record.data["side"] for record in shown.records] == ["control", "void"]
    assert not shown.records[0].data.keys() & {"question", "labels", "dataset"}  # long; a list; the partition's own


def test_work_is_numbers_that_dagster_plots_and_that_are_read_back() -> None:
    event = dg.AssetMaterialization("responses", metadata=tally_metadata(the_graph()["responses"], Tally(cached=4)))
    assert event.metadata == {n: dg.MetadataValue.int(v) for n, v in (("asked", 0), ("known", 4), ("failed", 0))}
    assert tally_of(event.metadata) == Tally(cached=4)
    assert tally_metadata(the_graph()["videos"], Tally(frames=9)) == {"frames": 9}
