"""The report page of all its parts and `traps results export`, which writes all tables, figures, pages to a folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import pandas as pd

from traps_pipeline.base.files import write_bytes
from traps_pipeline.protocol.cells import Cell
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.report.cases import cases_files
from traps_pipeline.report.catalogue import FIGURES, INSIDE, RECOMPUTED, TABLES
from traps_pipeline.report.cell_pages import FOLDER, addresses, write_item_pages
from traps_pipeline.report.contact_sheet import PAGE as SIX_PAIRS
from traps_pipeline.report.contact_sheet import pairs_figure, six_pairs
from traps_pipeline.report.leaderboard_page import leaderboard_markdown
from traps_pipeline.report.page import (
    Block,
    Card,
    picture_block,
    report_html,
    table_block,
)
from traps_pipeline.report.published_results import PublishedResults
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.study_results import StudyResults
from traps_pipeline.report.tables.audited import audit_table
from traps_pipeline.report.tables.human_tables import said_by_people
from traps_pipeline.report.terms import INSIDE_TERMS
from traps_pipeline.report.writing import Behind, environment, figure_files, table_files
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.workspace import Workspace

PAGE, MARKDOWN, METRICS, INDEX = "report.html", "leaderboard.md", "metrics.jsonl", "index.html"
SHEETS = {
    "shortcuts.png": "How well one cue alone separates control from void (0.5 is chance)",
    "worked_example.png": "Worked example: a pair, the answers, the panel’s reading, the verdicts",
    "contact_sheet.png": "Pairs: control above, void below",
    "arms_occlusion.png": "Arms of a scenario with a panel",
    "arms_chaotic.png": "Arms of a scenario with a cut",
    "panels_occlusion.png": "Looks of the panel of a scenario, from its pair to panels that let the outcome through",
}
FROM_PAPER = "recomputed from the published tables"  # the heading of what the paper does not print
# Shown as wide as the screen allows.
FULL = ("contact_sheet.png", "arms_occlusion.png", "arms_chaotic.png", "panels_occlusion.png")
Pictures = Mapping[str, bytes]  # PNG by path below the reports folder


def report_files(study: Results, paper: Results, cells: Sequence[Cell], pictures: Pictures) -> dict[str, bytes]:
    """The report page and the leaderboard as Markdown, by path. cells: the cells with pages in `items/`; pictures: the
    existing PNG files of the catalogue and of SHEETS."""
    address = addresses(cells)
    landscape = FIGURES[0]
    first = {landscape.title: pictures[landscape.path(study)]} if landscape.path(study) in pictures else {}
    said = said_by_people(study.human_row, study.panel_errors)
    chapters = _chapters(study, paper, address, pictures)
    terms = INSIDE_TERMS if study.mechanism else None
    page = report_html(study.board, first, chapters, address, robust=study.robust, said=said, terms=terms)
    markdown = leaderboard_markdown(study.board, study.robust, said)
    return {PAGE: page.encode(), MARKDOWN: markdown.encode(), METRICS: metrics_lines(study.board).encode()}


def metrics_lines(board: pd.DataFrame) -> str:
    """LEADERBOARD rows as JSON lines, which experiment trackers read; a figure that is null is null there."""
    return str(board.to_json(orient="records", lines=True, double_precision=15))


def _chapters(
    study: Results, paper: Results, address: Callable[[Behind], str], pictures: Pictures
) -> list[tuple[str, list[Card]]]:
    figures = []
    # A study that looked inside models leads with what can refute its claims.
    first = INSIDE if study.mechanism else ()
    for report in sorted(FIGURES, key=lambda report: report.name not in first):
        paths = [(r.source, path) for r in (study, paper) for path in [report.path(r)] if path in pictures]
        blocks = [picture_block(source, pictures[path]) for source, path in paths]
        figures.append(Card(f"figure-{report.name}", report.title, blocks, report.note(study)))
    tables = []
    for report in TABLES:
        own = report.tables(study)
        blocks: list[Block] = [table_block(study.source, own, address)]
        blocks += [table_block(paper.source, report.as_printed(), None)] if report.paper else []
        blocks += [table_block(FROM_PAPER, report.tables(paper), None)] if report.recomputed else []
        tables.append(Card(f"table-{report.name}", report.title or own[0].title, blocks))
    tables.append(Card("table-audit", "Audit of the paper", [table_block(FROM_PAPER, [audit_table()], None)]))
    sheets = [
        Card(name.removesuffix(".png"), title, [picture_block(study.source, pictures[name], name in FULL)])
        for name, title in SHEETS.items()
        if name in pictures
    ]
    return [("Figures", figures), ("Tables", tables), ("Pairs", sheets)]


def export(workspace: Workspace, target: Path, say: Callable[[str], None] = lambda line: None) -> int:
    """Write every table (CSV, LaTeX, Markdown, Parquet), every figure (PDF, SVG, PNG), the report page and the items'
    pages to `target`, made again from the workspace's tables and the published numbers; returns the number of files.

    Each file is written whole or not at all, and last `index.html`, which lists them. say gets one line per table and
    figure.
    """
    study, paper, written, pictures = StudyResults(workspace), PublishedResults(), list[str](), dict[str, bytes]()
    for source in (study, paper):
        for report in [r for r in (*TABLES, *FIGURES) if source.is_study or r.published]:
            files = report.files(source)
            for path, content in files.items():
                write_bytes(target / path, content)
            written += files
            pictures |= {path: content for path, content in files.items() if path.endswith(".png")}
            say(f"{source.source}: {report.name}")
    for name, content in table_files(audit_table()).items():
        write_bytes(target / "tables" / RECOMPUTED / name, content)
        written.append(f"tables/{RECOMPUTED}/{name}")
    for path, content in _sheets(workspace):
        write_bytes(target / path, content)
        written.append(path)
        pictures |= {path: content} if path.endswith(".png") else {}
    for path, content in cases_files(workspace, clips=None).items():
        write_bytes(target / path, content)
        written.append(path)
    cells = write_item_pages(workspace, target / FOLDER, clips=None)
    say(f"items of {len(cells)} cells")
    pages = report_files(study, paper, cells, pictures)
    for path, content in pages.items():
        write_bytes(target / path, content)
    written += [*pages, f"{FOLDER}/{INDEX}"]
    write_bytes(target / INDEX, _index(written).encode())
    return len(written) + len(cells) + 1


def _sheets(workspace: Workspace) -> Iterator[tuple[str, bytes]]:
    """The pictures made from clips: the figure of six pairs, if their clips exist; others as the workspace has them."""
    shown = {Path(name).stem for name in SHEETS}
    for path in workspace.store.below(workspace.reports, "*.*"):
        if path.stem in shown and not path.name.endswith(".state.json"):
            yield path.name, workspace.store.here(path).read_bytes()
    pairs = six_pairs(workspace.tables.read_all(ITEMS, dataset=DATASETS))
    if len(pairs) and workspace.sizes(pairs["clip"]).keys() == {*pairs["clip"]}:
        files = figure_files("six_pairs", pairs_figure(pairs, workspace.bring(pairs["clip"]), None, 3, SIX_PAIRS))
        yield from ((f"figures/{name}", content) for name, content in files.items())


def _index(paths: Sequence[str]) -> str:
    """A page of links to all files, by folder and name."""
    folders: dict[str, dict[str, list[str]]] = {}
    for path in paths:
        folder, _, name = path.rpartition("/")
        folders.setdefault(folder or "pages and pictures of pairs", {}).setdefault(name.rpartition(".")[0], []).append(
            path
        )
    return environment().get_template("export_index.html.j2").render(folders=folders, page=PAGE)


def study_pictures(workspace: Workspace) -> dict[str, bytes]:
    """The PNG files below the workspace's reports that the page shows."""
    results: tuple[Results, ...] = (StudyResults(workspace), PublishedResults())
    paths = [report.path(r) for report in FIGURES for r in results] + [*SHEETS]
    store, root = workspace.store, workspace.reports
    return {path: store.here(root / path).read_bytes() for path in paths if store.has(root / path)}
