"""Every table and figure, made from the paper's numbers, from an empty study and from a partial one."""

from __future__ import annotations

import contextlib
import io
import re
from functools import cache, cached_property

import numpy as np
import pandas as pd
import pytest
from matplotlib.text import Text

from tests.build.boards import board_of, board_row, leaderboard_section
from tests.build.cells import row
from tests.build.latex import latex_cells
from tests.conftest import ROOT
from traps_pipeline.base.archives import unzip_bytes
from traps_pipeline.cli import main
from traps_pipeline.judging.judging_rows import JUDGE_BIAS, JUDGE_VALIDATION
from traps_pipeline.pipeline.graph import the_graph
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.report import publish
from traps_pipeline.report.catalogue import FIGURE_REPORTS, JUDGED_STAGES, TABLE_REPORTS
from traps_pipeline.report.figures.abstention import doubt_points
from traps_pipeline.report.figures.steering_figures import dose_response
from traps_pipeline.report.published_results import PublishedResults
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.study_results import StudyResults
from traps_pipeline.report.writing import (
    NOT_RUN,
    REFERENCE_ROWS,
    NotRun,
    freeze_layout,
    table_files,
    table_latex,
)
from traps_pipeline.scoring.score_rows import CONTRASTS, LEADERBOARD
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

PAPER = PublishedResults()


@cache  # not as the file is imported, which every worker of a test run does
def by_name():
    return {table.name: table for report in TABLE_REPORTS for table in report.as_printed()}


@cache
def recomputed():
    return {table.name: table for report in TABLE_REPORTS for table in report.tables(PAPER)}


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """A study in which nothing was run."""
    return Workspace.create(tmp_path_factory.mktemp("empty") / "study", Study(scenarios=["plinko-0001"]))


@pytest.fixture(scope="module")
def empty(workspace):
    return StudyResults(workspace)


@pytest.fixture(scope="module")
def partial(tmp_path_factory):
    """One reference model under standard on all datasets, one of the paper's on `chaotic` alone, incomplete."""
    workspace = Workspace.create(tmp_path_factory.mktemp("partial") / "study", Study(scenarios=["plinko-0001"]))
    datasets = ("occlusion", "occlusion_ill_posed", "chaotic", "chaotic_ill_posed", "overall")
    rows = [board_row("oracle", dataset=d, shares=(1, 0, 1), n_runs=1) for d in datasets]
    lost = {"n_missing": 60, "incomplete": True, "answered": 0.9}
    board = board_of(*rows, board_row("gemini-2.5-pro", dataset="chaotic", **lost))
    workspace.tables.write(LEADERBOARD, {}, board, {})
    return StudyResults(workspace)


THINKS, SPEAKS, BROKEN = "qwen3-vl-think", "qwen3-vl-instruct", "gemini-2.5-pro"
NOTHING = {
    **dict.fromkeys(("acc", "abs_rec", "false_abs", "j", "pecs", "naive"), np.nan),
    **{"n_missing": 2808, "n_errors": 2808, "answered": 0.0, "incomplete": True, "pecs_low": 0.0, "pecs_high": 1.0},
}


@pytest.fixture(scope="module")
def broken(tmp_path_factory):
    """Two models whole under standard and guided, and one whose every call failed. Of the first two the overall
    contrast under guided is refused, and of the second one that of its regimes."""
    workspace = Workspace.create(tmp_path_factory.mktemp("broken") / "study", Study(scenarios=["plinko-0001"]))
    board = board_of(
        *(
            board_row(m, regime, d, (0.5, 0.1, 0.6 if m == THINKS else 0.3), **(NOTHING if m == BROKEN else {}))
            | {"n_missing": {THINKS: 2, SPEAKS: 0, BROKEN: 2808}[m], "n_pairs": 1404 if d == "overall" else 351}
            for m in (THINKS, SPEAKS, BROKEN)
            for regime in ("standard", "guided")
            for d in (*DATASETS, "overall")
        )
    )
    overall = {"dataset": "overall", "metric": "pecs", "left_model": SPEAKS, "separable": False}
    guided, standard = ({"left_regime": r, "right_regime": r, "right_model": THINKS} for r in ("guided", "standard"))
    regimes = {"left_regime": "standard", "right_regime": "guided", "right_model": SPEAKS}
    contrasts = [
        row(CONTRASTS, kind="models", **overall, **guided, refused="chaotic: of epoch e1 against epoch e2"),
        row(CONTRASTS, kind="models", difference=-0.1, p=0.01, p_holm=0.02, **overall, **standard),
        row(CONTRASTS, kind="regimes", refused="chaotic: 3 items", **overall, **regimes),
    ]
    validated = dict.fromkeys(("precision", "recall", "f1", "human_kappa"), 0.9)
    workspace.tables.write(LEADERBOARD, {}, board, {})
    workspace.tables.write(CONTRASTS, {}, contrasts, {})
    workspace.tables.write(JUDGE_BIAS, {}, [row(JUDGE_BIAS, dataset="chaotic", task="void_abstention", yes=0.5)], {})
    workspace.tables.write(JUDGE_VALIDATION, {}, [row(JUDGE_VALIDATION, **validated)], {})
    return StudyResults(workspace)


@pytest.fixture(scope="module")
def broken_tables(broken):
    return {table.name: table for report in TABLE_REPORTS for table in report.tables(broken)}


def shown(table, **values):
    """The one row of a table with these values, by heading."""
    [at] = [k for k, row in enumerate(table.records) if all(row[name] == value for name, value in values.items())]
    return dict(zip([column.heading for column in table.columns], table.cells[at], strict=True))


@pytest.mark.slow
def test_a_model_whose_every_call_failed_is_a_row_of_dashes_and_breaks_no_page(broken, broken_tables):
    uplift = broken_tables["guided_uplift"]
    row = shown(uplift, model=BROKEN)
    assert (row["Ratio"], row["PECS, guided"], row["Missing"]) == ("– ‡", "– ‡", "5616")
    assert shown(uplift, model=THINKS)["Ratio"] == "1.00 †"
    assert BROKEN not in set(broken_tables["frontier"].rows["model"])
    page = publish.report_files(broken, [])["report.html"].decode()
    assert '– <span class="mark">‡</span>' in page
    assert not re.search(r"\bnan\b", page)
    for table in broken_tables.values():
        assert table_latex(table).isascii(), table.name


@pytest.mark.promise
@pytest.mark.parametrize("name", ["pecs_landscape", "abs_rec", "visual_textual", "reasoning_arrows"])
def test_a_model_whose_every_call_failed_breaks_no_figure(broken, name):
    figure = next(report for report in FIGURE_REPORTS if report.name == name).make(broken)
    assert overhang(figure) < 0.01


def test_comparisons_say_how_many_pairs_they_rest_on_and_what_is_missing(broken_tables):
    reasoning = shown(broken_tables["reasoning_pairs"], regime="standard", dataset="overall")
    assert (reasoning["Δ AbsRec %"], reasoning["Δ PECS"]) == ("30.0", "0.150 †")
    assert [reasoning[name] for name in ("n", "Runs", "Missing")] == ["1404", "3", "2"]
    contrast = shown(broken_tables["contrasts"], left_regime="standard", right_regime="standard")
    assert [contrast[name] for name in ("Δ PECS", "n", "Missing")] == ["−0.100 †", "1404", "2"]
    gap = shown(broken_tables["visual_textual"], model=THINKS)
    assert [gap[name] for name in ("Pooled gap", "n", "Runs", "Missing")] == ["1.0 †", "1404", "3", "8"]
    for name in ("frontier", "guided_uplift", "zero_boundary", "degenerate_strategies", "leave_one_judge_out"):
        assert {"n_pairs", "n_missing"} <= {column.field for column in broken_tables[name].columns}, name


def test_what_the_contrasts_refuse_item_by_item_is_in_no_other_comparison(broken_tables):
    reasoning, uplift = broken_tables["reasoning_pairs"], broken_tables["guided_uplift"]
    overall = reasoning.rows[reasoning.rows["dataset"] == "overall"]
    assert overall["regime"].tolist() == ["standard"]
    assert "chaotic: of epoch e1 against epoch e2" in reasoning.notes
    assert set(uplift.rows["model"]) == {THINKS, BROKEN}
    assert f"{SPEAKS}: chaotic: 3 items" in uplift.notes


@pytest.mark.slow
def test_figures_over_all_datasets_are_of_the_runs_that_have_them_all(tmp_path):
    # A second run of `chaotic` alone moves that cell, and no figure that is overall.
    workspace = Workspace.create(tmp_path / "study", Study(scenarios=["plinko-0001"]))
    rows = [board_row(THINKS, r, d, (0.5, 0.1, 0.6)) for r in ("standard", "guided") for d in (*DATASETS, "overall")]
    for cell in rows:
        if (cell["dataset"], cell["regime"]) == ("chaotic", "guided"):
            cell |= board_row(THINKS, "guided", "chaotic", (0.9, 0.1, 1.0), n_runs=4)
    workspace.tables.write(LEADERBOARD, {}, board_of(*rows), {})
    tables = {table.name: table for report in TABLE_REPORTS for table in report.tables(StudyResults(workspace))}
    assert shown(tables["guided_uplift"], model=THINKS)["Ratio"] == "1.00"
    assert shown(tables["per_dataset"], regime="guided")["Mean"] == "0.250 ± 0.010"
    assert shown(tables["frontier"], regime="guided")["Acc %"] == "50.0 ± 1.0"


def test_every_number_of_a_study_leads_to_the_items_behind_it(broken_tables):
    without_items = {"models", "hyperparameters", "composition"}  # settings, and counts of the benchmark itself
    expected = {"acc", "abs_rec", "false_abs", "j", "naive", "pecs"}  # of degenerate strategies, by arithmetic
    for table in broken_tables.values():
        numbers = [column.field for column in table.columns if column.is_number]
        for record in table.records if table.name not in without_items else ():
            assert table.trace is not None, table.name
            lost = {field for field in numbers if table.trace(record, field) is None}
            assert lost <= (expected if table.name == "degenerate_strategies" else {"published_pecs"}), table.name


def texts(table):
    return [" ".join(row) for row in table.cells]


@pytest.mark.slow
def test_the_published_analyses_are_the_papers():
    uplift = {row[0]: row for row in recomputed()["guided_uplift"].cells}
    assert uplift["gpt-5-mini"][1:4] == ["3.1", "34.0", "11.07"]
    assert texts(recomputed()["hidden_sub_scenarios"]) == ["hidden 3 27.0 67.9", "other 12 4.9 34.9"]
    gaps = {row[0]: row for row in recomputed()["visual_textual"].cells}
    assert gaps["gpt-5-mini"][4:7] == ["0.0", "9.1", "∞"]
    assert any("22 of 64 cells" in note for note in recomputed()["pecs_naive"].notes)
    assert by_name()["composition"].cells[-1] == ["Total", "", "", "1,404", ""]
    assert recomputed()["frontier"].rows.query("regime == 'guided'")["model"].tolist() == [
        "gemini-3.1-pro",
        "gemini-3.1-pro-r-low",
    ]


@pytest.mark.slow
@pytest.mark.promise
def test_every_published_table_is_well_formed_in_every_medium():
    assert len([name for name in by_name() if name.startswith("expanded_")]) == 12
    for table in (*by_name().values(), *recomputed().values()):
        files = table_files(table)
        width = 1 if table.absence else len(table.columns)
        assert files[f"{table.name}.tex"].isascii()  # else pdflatex stops at the sign
        assert {len(row) for row in latex_cells(files[f"{table.name}.tex"].decode())} == {width}
        assert len(pd.read_csv(io.BytesIO(files[f"{table.name}.csv"]))) == len(table.rows)
        assert not re.search(r"\bnan\b|<NA>", files[f"{table.name}.md"].decode())


@pytest.mark.slow
def test_an_empty_study_says_not_run_and_never_zero(empty):
    for report in TABLE_REPORTS:
        for table in report.tables(empty):
            if table.name == "degenerate_strategies":  # expectations, which need no run
                assert {row[-1] for row in table.cells} == {"–"}
            else:
                assert table.absence.startswith(NOT_RUN), table.name


@pytest.mark.slow
def test_a_partial_study_says_what_is_missing(partial):
    tables = {table.name: table for report in TABLE_REPORTS for table in report.tables(partial)}
    assert [row[0] for row in tables["overall"].cells] == [REFERENCE_ROWS, "oracle"]
    by_dataset = {row[0]: row[2:] for row in tables["per_dataset"].cells}
    assert by_dataset["gemini-2.5-pro"] == ["–", "–", "0.250 ± 0.010 ‡", "–", "–"]
    assert by_dataset["oracle"] == ["1.000"] * 5
    assert any(note.startswith("‡ incomplete") for note in tables["per_dataset"].notes)
    missing = tables["guided_uplift"]
    assert not missing.cells and "standard" in missing.absence and "guided" in missing.absence
    assert {row[0]: row[1] for row in tables["expanded_chaotic_standard"].cells}["gemini-2.5-pro"] == "50.0 ± 1.0"


def test_a_study_of_the_papers_models_shows_the_published_pecs_beside_its_own(tmp_path):
    workspace = Workspace.create(tmp_path / "study", Study(scenarios=["plinko-0001"]))
    workspace.tables.write(LEADERBOARD, {}, board_of(board_row("gemini-3.1-pro", "guided")), {})
    (table,) = next(report for report in TABLE_REPORTS if report.name == "overall").tables(StudyResults(workspace))
    assert table.cells[0][2] == "0.250 ± 0.010"
    assert dict(zip([c.heading for c in table.columns], table.cells[0], strict=True))["published PECS"] == "0.564"


def overhang(figure):
    """How far (in) what is drawn reaches beyond the figure's edge."""
    freeze_layout(figure)
    drawn, (width, height) = figure.get_tightbbox(), figure.get_size_inches()
    return max(-drawn.x0, -drawn.y0, drawn.x1 - width, drawn.y1 - height)


def overlapping_titles(figure):
    """Pairs of panels whose titles run into each other."""
    texts = [(text, ax.get_title(loc="left")) for ax in figure.axes for text in ax.findobj(Text)]
    titles = [text for text, title in texts if title and text.get_text() == title]
    boxes = [(title.get_text(), title.get_window_extent()) for title in titles]
    return [(a, b) for k, (a, box) in enumerate(boxes) for b, other in boxes[:k] if box.overlaps(other)]


@pytest.mark.slow
@pytest.mark.parametrize("report", FIGURE_REPORTS, ids=lambda report: report.name)
def test_no_text_of_a_figure_is_clipped_or_under_six_points(report, partial, empty):
    for results in (PAPER, partial, empty):
        try:
            figure = report.make(results)
        except NotRun as why:
            assert str(why)
            continue
        assert overhang(figure) < 0.01
        assert not overlapping_titles(figure)
        assert min(text.get_fontsize() for text in figure.findobj(Text) if text.get_text()) >= 6


@pytest.mark.slow
def test_titles_of_panels_with_their_numbers_of_answers_do_not_overlap():
    class Counted(PublishedResults):
        effects = cached_property(lambda _: PAPER.effects.assign(n=np.resize([44, 44, 100], len(PAPER.effects))))

    figure = dose_response(Counted())
    freeze_layout(figure)
    assert all("n 44 to 100" in ax.get_title(loc="left") for ax in figure.axes)
    assert not overlapping_titles(figure)


def test_the_doubt_figure_refuses_to_mix_epochs():
    class Mixed(PublishedResults):
        confabulation = cached_property(lambda _: PAPER.confabulation.assign(epoch="corrected"))

    points, refused = doubt_points(Mixed())
    assert not len(points)
    (of_flash,) = [reason for reason in refused.split("; ") if reason.startswith("gemini-2.5-flash: ")]
    assert "corrected" in of_flash and "original" in of_flash
    points, refused = doubt_points(PAPER)
    assert not refused
    flash = points[points["thinking"] == "gemini-2.5-flash"]
    assert np.allclose(sorted(100 * flash["gain"]), [4.1, 5.0, 10.2, 12.6])  # 24.5 - 20.4, 16.6 - 11.6, ...
    assert set(flash["doubt"]) == {0.20}


def test_the_report_page_depends_on_all_that_its_tables_and_figures_read():
    graph = the_graph()
    reads = {stage for report in (*TABLE_REPORTS, *FIGURE_REPORTS) for stage in report.reads}
    assert (reads & graph.declared.keys()) | {"published", "verdicts"} <= graph.parents("report_page", None).keys()


@pytest.mark.promise
@pytest.mark.parametrize("report", [report for report in FIGURE_REPORTS if report.frames], ids=lambda r: r.name)
def test_a_figure_reads_the_frames_that_decide_whether_it_is_drawn_again(report, partial):
    frames = {name for name, value in vars(Results).items() if isinstance(value, cached_property)}
    read = set()

    class Watched:
        def __init__(self, results):
            self.results = results

        def __getattr__(self, name):
            read.add(name)
            return getattr(self.results, name)

    for results in (PAPER, partial):
        with contextlib.suppress(NotRun):
            report.figure(Watched(results))
    assert set() < read & frames <= {*report.frames}


def test_whatever_reads_figures_that_the_panel_decided_says_who_judged():
    below, new = set(), {"verdicts", "steering_votes"}
    while new := {child for name in new for child in the_graph().below(name)} - below:
        below |= new
    not_the_panels = {"confabulation_prevalence", "human_row", "human_agreement", "panel_errors"}
    not_the_panels |= {"probes", "probe_baselines", "leads", "interaction"}  # verdicts choose the items of Cf->Cf
    reads = {stage for report in (*TABLE_REPORTS, *FIGURE_REPORTS) for stage in report.reads}
    assert (reads & below) - not_the_panels == JUDGED_STAGES


def test_a_caption_says_what_is_shown_and_not_what_a_function_does():
    captions = [report.doc for report in (*TABLE_REPORTS, *FIGURE_REPORTS)]
    assert [text for text in captions if not text or text.startswith(("Return", "Yield")) or text[0].islower()] == []


def test_the_page_of_the_docs_names_every_table_and_figure():
    rows = re.findall(r"^\| (.+?) \|(.*)\|$", (ROOT / "docs" / "report.md").read_text(), re.MULTILINE)
    for column, reports in enumerate((TABLE_REPORTS, FIGURE_REPORTS)):
        named = {name for row in rows for name in re.findall(r"\w+", row[column])}
        assert [report.name for report in reports if report.name not in named] == []


@pytest.mark.slow
@pytest.mark.promise
def test_export_writes_everything_with_an_index(workspace, tmp_path, monkeypatch, capsys):
    chosen = [next(r for r in FIGURE_REPORTS if r.name == "doubt_conversion")]
    monkeypatch.setattr(publish, "FIGURE_REPORTS", chosen)
    monkeypatch.setattr(publish, "TABLE_REPORTS", TABLE_REPORTS[:2])
    assert main(["results", "export", str(tmp_path), "--workspace", str(workspace.root)]) == 0
    files = {str(file.relative_to(tmp_path)) for file in tmp_path.rglob("*") if file.is_file()}
    assert {f"tables/published/overall.{kind}" for kind in ("csv", "md", "tex")} <= files
    assert {file for file in files if "doubt" in file} == {
        f"figures/published/doubt_conversion.{kind}" for kind in ("pdf", "svg", "png")
    }
    assert re.search(rf"\b{len(files)} .*{re.escape(str(tmp_path))}\n", capsys.readouterr().out)
    index = (tmp_path / "index.html").read_text()
    linked = set(re.findall(r'href="([^"]+)"', index))
    assert {path for path in files if path.split("/")[0] in ("tables", "figures")} <= linked
    assert all((tmp_path / path).is_file() for path in linked)
    assert '<p class="absent">' in leaderboard_section((tmp_path / "report.html").read_text())
    out = tmp_path / "one.zip"
    assert main(["results", "export", str(out), "--workspace", str(workspace.root)]) == 0
    packed = {name: content for name, content in unzip_bytes(out.read_bytes()).items() if not name.endswith(".pdf")}
    assert packed == {name: (tmp_path / name).read_bytes() for name in packed} and {*packed} <= files


@pytest.mark.slow
def test_numbers_are_numbers_in_every_exported_file(partial):
    number = re.compile(r"[+−-]?(\d+(\.\d*)?|\.\d+)%?")
    for results in (partial, PAPER):
        tables = [t for report in TABLE_REPORTS for t in (*report.as_printed(), *report.tables(results))]
        for table in tables:
            words = {column.field for column in table.columns if column.unit == "text"}
            data = table.data  # of which both the Parquet and the CSV file are made
            for name in {*data.columns} - words:
                texts = [text for text in data[name] if isinstance(text, str) and text != "–"]
                assert not texts or not all(map(number.fullmatch, texts)), (table.name, name, texts[:3])
