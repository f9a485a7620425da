"""Metrics of two events on the printed leaderboard, in their own table and among the findings."""

from __future__ import annotations

from typing import Any

import pandas as pd
import pytest

from tests.build.boards import board_of, board_row
from tests.build.two_events import lane_verdicts, reader
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.report.figures.two_way_figure import two_way as slopes
from traps_pipeline.report.leaderboard_page import LEGEND, leaderboard_markdown, leaderboard_text, leaderboards
from traps_pipeline.report.page import report_html
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.study_findings import study_findings
from traps_pipeline.report.tables.two_way_table import two_way_table
from traps_pipeline.report.terms import TITLE_OF
from traps_pipeline.report.writing import NotRun, table_text
from traps_pipeline.scoring.score_rows import TWO_WAY
from traps_pipeline.scoring.two_way import two_way

BOARD = board_of(*(board_row(model, dataset=d) for model in ("asked", "alone") for d in ("overall", *DATASETS)))
HEADINGS = ("Conjunction %", "Specificity")
EMPTY = pd.DataFrame(columns=pd.Index(TWO_WAY.names))


@pytest.fixture(scope="module")
def rows() -> pd.DataFrame:
    """TWO_WAY rows of `asked`, which looks where it is asked in 3 of 4 scenarios, and of `shy`, which abstains."""
    asked = lane_verdicts(lambda item: reader(item) or item.scenario_id.endswith("3"), 4, model="asked")
    return two_way(pd.concat([asked, lane_verdicts(lambda item: True, 4, model="shy")], ignore_index=True), 200)


def shown(events: pd.DataFrame | None) -> list[str]:
    return [leaderboard_text(BOARD, events), leaderboard_markdown(BOARD, events), report_html(BOARD, two_way=events)]


@pytest.mark.slow
def test_without_two_events_the_leaderboard_is_what_it_was_byte_for_byte(rows: pd.DataFrame) -> None:
    before = [leaderboard_text(BOARD), leaderboard_markdown(BOARD), report_html(BOARD)]
    inferred_alone = rows.assign(n_scenarios=0, conjunction=None, specificity=None)
    assert shown(None) == shown(EMPTY) == shown(inferred_alone) == before
    assert not [text for text in before if any(heading in text for heading in HEADINGS)]


def test_an_entry_that_was_asked_has_its_metrics_and_another_a_dash(rows: pd.DataFrame) -> None:
    assert [_columns(rows)[heading] for heading in HEADINGS] == [["–", "75.0"], ["–", "0.75"]]
    assert all("0.75" in text for text in shown(rows))


def test_metrics_of_two_campaigns_are_dashes_with_the_reason(rows: pd.DataFrame) -> None:
    verdicts = [lane_verdicts(reader, 2, model="asked"), lane_verdicts(reader, 2, model="asked", run=2, epoch="e2")]
    refused = two_way(pd.concat(verdicts, ignore_index=True), 20)
    assert [_columns(refused)[heading] for heading in HEADINGS] == [["–", "–"]] * 2
    for text in (*shown(refused), table_text(two_way_table(refused)).text()):
        assert "epochs e1 and e2" in text


def _columns(events: pd.DataFrame) -> dict[str, list[str]]:
    """The cells of the overall table by heading."""
    table = leaderboards(BOARD, events)[0]
    return {column.heading: [cells[k] for cells in table.cells] for k, column in enumerate(table.columns)}


def test_every_column_of_the_ranking_is_in_the_legend(rows: pd.DataFrame) -> None:
    own_words = {"Model", "Regime", "Runs", *(f"PECS {TITLE_OF[dataset]}" for dataset in DATASETS)}
    assert {*_columns(rows)} - {*LEGEND} == own_words


class Events(Results):
    """Results of a study that asked two events alone."""

    is_study = True
    overall = cells = rates = EMPTY

    def __init__(self, rows: pd.DataFrame) -> None:
        super().__init__()
        self.two_way = rows


def test_two_events_without_pairs_have_a_table_slopes_and_a_finding(rows: pd.DataFrame) -> None:
    table = two_way_table(rows)
    cells: list[dict[str, Any]] = [dict(zip([c.heading for c in table.columns], r, strict=True)) for r in table.cells]
    assert [(row["Model"], row["the asked"], row["Acc %"]) for row in cells] == [
        ("asked", "100.0", "75.0"), ("shy", "100.0", "0.0"),
    ]  # fmt: skip
    panels = [axes for axes in slopes(Events(rows)).axes if axes.get_visible()]
    drawn = [[float(y) for line in axes.lines for y in line.get_ydata()] for axes in panels]  # pyright: ignore
    assert drawn == [[25, 100, 25, 100], [100, 100, 100, 100]]  # other event seen: asked seen, hidden; then hidden
    (finding,) = study_findings(Events(rows))
    assert finding.card == "figure-two_way" and "+75.0" in finding.text and "asked under standard" in finding.text


def test_a_study_without_two_events_says_how_to_ask_them() -> None:
    with pytest.raises(NotRun, match="two_events"):
        slopes(Events(EMPTY))
    assert "two_events" in two_way_table(EMPTY).absence and study_findings(Events(EMPTY)) == []
