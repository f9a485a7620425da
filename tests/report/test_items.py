"""The items behind a number: every answer, vote and verdict as text, one page per cell, rewritten only if needed."""

from __future__ import annotations

import pandas as pd
import pytest

from tests.build.cells import CELL, write_cell
from traps_pipeline.judging.judging_rows import VERDICTS, VOTES
from traps_pipeline.models.tables import RESPONSES
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.report import cell_pages
from traps_pipeline.report.cell_pages import addresses, index_page, item_pages, page_name, write_item_pages
from traps_pipeline.report.writing import Behind
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


@pytest.fixture
def workspace(tmp_path):
    return Workspace.create(tmp_path / "study", Study(scenarios=["plinko-0001"]))


def test_a_page_shows_question_answer_votes_verdict_and_clip_as_text(workspace):
    write_cell(workspace)
    page = "".join(item_pages(workspace, CELL, "../.."))
    assert "<script" not in page
    assert "<img" not in page
    assert (
        page.count("&lt;script&gt;alert(1)&lt;/script&gt; \\textbf{bold} $x$") == 5
    )  # 2 questions, answer, trace, vote
    assert "rule-1</b>, abstention: answered, high" in page
    assert "invalid (not JSON)" in page
    assert 'answered, <span class="none">undecided</span>' in page  # the control: abstention decided, correctness not
    assert '<span class="none">refused</span>' in page
    assert page.count("undecided") == 1
    assert '<td><span class="none">not judged</span></td>' in page  # the refused void: nobody was asked to judge it
    assert '<a href="../../clips/plinko-0001/void.mp4">clip</a>' in page
    assert "default-src 'none'" in page
    assert '<a href="../../clips' not in "".join(item_pages(workspace, CELL, None))


def test_a_page_says_that_an_answer_is_unread(workspace):
    write_cell(workspace)
    verdicts = workspace.tables.read(VERDICTS, CELL.partition)
    verdicts.loc[verdicts["side"] == "control", ["outcome", "abstained"]] = ["unread", None]
    workspace.tables.write(VERDICTS, CELL.partition, verdicts, {})
    page = "".join(item_pages(workspace, CELL, None))
    assert '<td><span class="none">unread</span></td>' in page and "undecided" not in page


def test_a_page_shows_hidden_characters_of_an_answer_by_their_numbers(workspace):
    write_cell(workspace, text="left \u202ethgir\u2066\x1b[2J")
    page = "".join(item_pages(workspace, CELL, None))
    assert "left [U+202E]thgir[U+2066][U+001B][2J" in page and "\u202e" not in page


def test_a_page_is_made_anew_only_where_its_tables_changed(workspace, tmp_path):
    other = Cell("chaotic", Evaluation("oracle", "standard", 2))
    for cell in (CELL, other):
        write_cell(workspace, cell)
    assert write_item_pages(workspace, tmp_path, None) == [CELL, other]
    before = {cell: (tmp_path / page_name(cell)).stat().st_mtime_ns for cell in (CELL, other)}
    write_cell(workspace, CELL, "another answer")
    write_item_pages(workspace, tmp_path, None)
    assert "another answer" in (tmp_path / page_name(CELL)).read_text()
    assert (tmp_path / page_name(CELL)).stat().st_mtime_ns > before[CELL]
    assert (tmp_path / page_name(other)).stat().st_mtime_ns == before[other]
    workspace.tables.path(RESPONSES, other.partition).unlink()
    write_item_pages(workspace, tmp_path, None)
    assert sorted(file.name for file in tmp_path.glob("*.html")) == [page_name(CELL), "index.html"]


def test_a_large_cell_has_pages_that_lead_to_each_other_with_both_sides_on_each(workspace, tmp_path, monkeypatch):
    """Five pairs, two a page: the sides' anchors stand on the first page, and no item is lost or shown twice."""
    monkeypatch.setattr(cell_pages, "PER_PAGE", 2)
    write_cell(workspace)
    for table, part in ((ITEMS, {"dataset": "chaotic"}), *((t, CELL.partition) for t in (RESPONSES, VOTES, VERDICTS))):
        rows, copies = workspace.tables.read(table, part), []
        for n in range(1, 6):
            copy = rows.assign(item_id=rows["item_id"].str.replace("0001", f"000{n}"))
            copies.append(copy.assign(scenario_id=f"plinko-000{n}") if "scenario_id" in rows else copy)
        workspace.tables.write(table, part, pd.concat(copies), {})
    write_item_pages(workspace, tmp_path, None)
    names = [page_name(CELL), page_name(CELL, 2), page_name(CELL, 3)]
    assert sorted(file.name for file in tmp_path.glob("chaotic*.html")) == sorted(names)
    pages = [(tmp_path / name).read_text() for name in names]
    for n in range(1, 6):
        for side in ("control", "void"):
            shown = [page.count(f'id="plinko-000{n}-{side}"') for page in pages]
            assert shown == [int(k == (n - 1) // 2) for k in range(3)]
    assert [f"Page {k} of 3" in page for k, page in enumerate(pages, start=1)] == [True] * 3
    assert all('id="void"' in page and f'href="{names[2]}"' in page for page in pages[:2])
    assert "Controls: can be answered (5 to 5 of 5)" in pages[2]
    write_cell(workspace)  # one pair again: the pages that it does not fill go
    write_item_pages(workspace, tmp_path, None)
    assert [file.name for file in tmp_path.glob("chaotic*.html")] == names[:1]


def test_cells_of_arms_have_pages_behind_those_of_the_pairs(workspace, tmp_path):
    arm = Cell("crossed", CELL.evaluation)
    for cell in (arm, CELL):
        write_cell(workspace, cell)
    assert write_item_pages(workspace, tmp_path, None) == [CELL, arm]
    assert "Arm: crossed" in (tmp_path / page_name(arm)).read_text()
    index = (tmp_path / "index.html").read_text()
    assert index.index("<th>Chaotic</th>") < index.index("<th>Arm: crossed</th>")
    assert page_name(arm) in index


def test_a_number_leads_to_the_one_run_behind_it_else_to_the_index():
    twice = Cell("occlusion", Evaluation("oracle", "guided", 1)), Cell("occlusion", Evaluation("oracle", "guided", 2))
    address = addresses([CELL, *twice])
    assert address(Behind("chaotic", "oracle", "standard", "void")) == "items/chaotic__oracle__standard__run1.html#void"
    assert address(Behind("occlusion", "oracle", "guided")) == "items/index.html#occlusion__oracle__guided"
    assert address(Behind("", "oracle", "guided", "void")) == "items/index.html#oracle__guided"
    assert address(Behind("chaotic")) == "items/index.html"
    assert address(Behind("chaotic", "prior", "standard")) == ""
    assert addresses([])(Behind()) == ""
    page = index_page([CELL, *twice])
    for anchor in ("oracle", "oracle__guided", "occlusion__oracle__guided"):
        assert f'id="{anchor}"' in page
    assert page.count("not run") == 2  # standard has no occlusion, guided no chaotic
