"""What Dagster shows of a table: short texts, and the best rows of one that ranks, be they rows or a frame."""

from __future__ import annotations

from pathlib import Path

import dagster as dg
import pandas as pd
import pytest

from tests.build.cells import row
from tests.conftest import ROOT
from tests.mechanism.study import filled
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.progress import Tally
from traps_pipeline.mechanism.control_rows import GATE
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.pipeline.graph import the_graph
from traps_pipeline.pipeline.metadata import errors_for_pages, preview, tally_metadata, tally_of, visible_metadata
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


def test_the_beginning_of_each_answer_is_shown() -> None:
    answers = [row(RESPONSES, item_id=str(n), text=text) for n, text in enumerate(["It falls. " * 20, "Left.", None])]
    shown = preview(RESPONSES, StageOutput(answers))["first rows"]
    assert [record.data["text"] for record in shown.records] == ["It falls. " * 6, "Left.", "None"]
    assert answers[0].text == "It falls. " * 20


def test_work_is_numbers_that_dagster_plots_and_that_are_read_back() -> None:
    event = dg.AssetMaterialization("responses", metadata=tally_metadata(the_graph()["responses"], Tally(cached=4)))
    assert event.metadata == {n: dg.MetadataValue.int(v) for n, v in (("asked", 0), ("known", 4), ("failed", 0))}
    assert tally_of(event.metadata) == Tally(cached=4)
    assert tally_metadata(the_graph()["videos"], Tally(frames=9)) == {"frames": 9}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A study's folder, in the folder of a user."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("TRAPS_WORKSPACE", str(tmp_path / "studies" / "mine"))
    return tmp_path / "studies" / "mine"


def test_files_are_named_from_the_study_the_checkout_and_the_home_on(place: Path) -> None:
    named = {
        "why": f"{place}/tables/votes.parquet and {ROOT}/assets/models.yaml",
        "more": [f"{place}: full, {place.parent}/a"],
    }
    assert visible_metadata(named) == {
        "why": "tables/votes.parquet and assets/models.yaml",
        "more": ["mine: full, ~/studies/a"],
    }


def test_an_error_and_its_causes_show_no_folder_of_the_host(place: Path) -> None:
    def fail() -> None:
        with errors_for_pages():
            try:
                (place / "study.yaml").read_bytes()
            except FileNotFoundError as error:
                raise TrapsError(f"{place}/study.yaml: is gone") from error

    with pytest.raises(TrapsError) as raised:
        fail()
    assert str(raised.value) == "study.yaml: is gone"
    assert str(place) not in str(raised.value.__cause__) and "study.yaml" in str(raised.value.__cause__)


def test_a_user_whose_home_is_the_root_sees_texts_as_they_are(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/")
    assert visible_metadata("https://a.org/b and /etc/x") == "https://a.org/b and /etc/x"
