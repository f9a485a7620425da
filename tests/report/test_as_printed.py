"""The published side of the report page has every value of the paper's tables, as the paper prints it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests.build.boards import Rows
from traps_pipeline.report.catalogue import TABLE_REPORTS
from traps_pipeline.report.published_results import PublishedResults
from traps_pipeline.report.writing import table_html
from traps_pipeline.scoring.published import as_printed

# The rows of the paper's tables by label, with the line of the label in its LaTeX source, without headings.
PAPER = json.loads(Path(__file__).with_name("paper_tables.json").read_text(encoding="utf-8"))
PRINTED = {table.name: table for report in TABLE_REPORTS for table in report.as_printed()}
PLACES = as_printed("tables").set_index("label").to_dict("index")
# The cells at the beginning of a row that name it, in the project's own words on the page; one where not listed.
NAMES = {
    "tab:xarch_behavioral": 2, "tab:xarch_per_dataset": 2, "tab:steering_regime": 2, "tab:judge_agreement": 2,
    "tab:pecs_vs_naive": 2, "tab:cosine_sim#2": 1,
}  # fmt: skip
TOTAL = ["Total", "1,404", ""]  # the one row of the paper that spans columns


@pytest.mark.parametrize("label", PAPER)
def test_a_table_of_the_page_has_the_papers_values_digit_by_digit(label: str) -> None:
    named = NAMES.get(label, 1)
    expected = [row[named:] if row != TOTAL else ["", "1,404", ""] for row in PAPER[label]["rows"]]
    shown = Rows(table_html(PRINTED[PLACES[label]["name"]]).partition("<tbody>")[2]).rows
    assert [row[-len(values) :] for row, values in zip(shown, expected, strict=True)] == expected


def test_every_table_of_the_paper_is_compared_and_says_where_it_stands() -> None:
    assert set(PLACES) == set(PAPER)
    assert {label: int(place["line"]) for label, place in PLACES.items()} == {k: t["line"] for k, t in PAPER.items()}
    assert {place["name"] for place in PLACES.values()} | _of_text() == set(PRINTED)
    assert all(f"line {place['line']}" in PRINTED[place["name"]].notes[0] for place in PLACES.values())
    cells = [cell for table in PAPER.values() for row in table["rows"] for cell in row[1:]]
    assert sum(len(re.findall(r"\d*\.?\d+", cell)) for cell in cells) == 2758


def test_every_figure_of_the_papers_text_stands_on_some_card_with_its_line() -> None:
    shown = [cells for name in _of_text() for cells in PRINTED[name].cells]
    assert sorted(cells[-1] for cells in shown) == sorted(as_printed("other")["line"])
    assert ["", "agreement of the two annotators pooled over the axes", "375/400 = 93.8%", "1784"] in shown


@pytest.mark.slow
def test_recomputed_tables_stand_apart_from_the_printed_ones() -> None:
    paper = PublishedResults()
    recomputed = {table.name: table for report in TABLE_REPORTS for table in report.tables(paper)}
    (report,) = (report for report in TABLE_REPORTS if report.name == "replication_overall")
    assert {path.rpartition(".")[0] for path in report.files(paper)} == {
        "tables/published/replication_overall",
        "tables/recomputed/replication_overall",
    }
    assert not [name for name, table in recomputed.items() if table.absence]
    # The paper prints .025; the mean of its four cells is 0.023.
    row = next(row for row in recomputed["replication_overall"].cells if row[:2] == ["llava-next-video-7b", "json"])
    assert row[2] == "0.023"
    assert ["llava-next-video-7b", "json", "29.8", "14.6", "5.0", ".025"] in PRINTED["replication_overall"].cells


def _of_text() -> set[str]:
    return {f"{card}_text" for card in as_printed("other")["card"]}
