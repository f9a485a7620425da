"""Write the report, and all tables and figures (`traps results export`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from traps_pipeline.base.archives import zip_bytes
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_bytes
from traps_pipeline.benchmark.held_out import begin_publication
from traps_pipeline.report.cards import (
    EXPLORER,
    Card,
    LinkOf,
    Sources,
    explorer_address,
    figure_card,
    paper_card,
    picture_card,
    table_card,
)
from traps_pipeline.report.catalogue import FIGURE_REPORTS, INSIDE, RECOMPUTED, TABLE_REPORTS, TableReport
from traps_pipeline.report.leaderboard_page import leaderboard_markdown
from traps_pipeline.report.page import report_html
from traps_pipeline.report.pair_pictures import pair_pictures
from traps_pipeline.report.printed_tables import audit_table
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.study_findings import study_findings
from traps_pipeline.report.tables.human_tables import people_notes
from traps_pipeline.report.terms import INSIDE_TERMS
from traps_pipeline.report.writing import NotRun, environment, figure_files, table_files
from traps_pipeline.storage.workspace import Workspace

PAGE, MARKDOWN, METRICS, INDEX = "report.html", "leaderboard.md", "metrics.jsonl", "index.html"
PAPER_CHAPTER = "paper"  # the chapter of the paper's cards, which use only `assets/published`


@dataclass(frozen=True)
class Part:
    """A report card that is not built yet: its chapter, its name and the function that builds it.

    reads: its stages; inputs: returns what it shows of them, as JSON; null for all."""

    chapter: str
    name: str
    make: Callable[[], Card]
    reads: tuple[str, ...]
    inputs: Callable[[], Any] | None = None


def report_parts(sources: Sources, address: LinkOf | None = explorer_address) -> list[Part]:
    """Return a report's parts in page order; with `address`, numbers are links."""
    # A study with mechanistic analyses leads with the figures that could refute its claims.
    first = INSIDE if sources.workspace.study.mechanism else ()
    figures = [
        Part(
            "figures",
            report.name,
            lambda report=report: figure_card(report, sources),
            report.reads,
            (lambda report=report: report.inputs(sources.study)) if report.frames else None,
        )
        for report in sorted(FIGURE_REPORTS, key=lambda report: report.name not in first)
    ]
    said = sources.study.certified
    pictures = [
        Part(
            "pictures", each.name, partial(picture_card, each, said), each.reads, lambda each=each: [each.inputs, said]
        )
        for each in pair_pictures(sources.workspace)
    ]
    tables = [
        Part(
            "tables",
            report.name,
            lambda report=report: table_card(report, sources, address),
            report.reads,
            lambda report=report: _contents(report, sources.study),
        )
        for report in TABLE_REPORTS
    ]
    paper = [
        Part(PAPER_CHAPTER, f"{kind}-{report.name}", lambda report=report: paper_card(report, sources), ("published",))
        for kind, reports in (("figure", FIGURE_REPORTS), ("table", TABLE_REPORTS))
        for report in reports
        if report.published
    ]
    return [*figures, *pictures, *tables, *paper]


def _contents(report: TableReport, study: Results) -> list[Any]:
    """Return what a report's tables show; of one that cannot be made, the error, which its card names."""
    try:
        return [table.content for table in report.tables(study)]
    except TrapsError:
        raise
    except Exception as error:  # noqa: BLE001 - one table must not cost the others
        return [repr(error)]


def report_files(
    study: Results, cards: Sequence[tuple[str, Card]], address: LinkOf | None = explorer_address
) -> dict[str, bytes]:
    """Return the report page and the leaderboard (Markdown, JSON lines), content by path, from cards."""
    remarks = people_notes(study.human_row, study.panel_errors, study.certified)
    paper = {card.name: card.html for chapter, card in cards if chapter == PAPER_CHAPTER}
    figures, pictures, tables = (
        [replace(card, paper=paper.get(card.name, "")) for chapter, card in cards if chapter == name]
        for name in ("figures", "pictures", "tables")
    )
    page = report_html(
        study.board, figures, pictures, tables, findings=study_findings(study), address=address,
        explorer=EXPLORER if address else "", two_way=study.two_way, notes=remarks,
        terms=INSIDE_TERMS if study.mechanism else None,
    )  # fmt: skip
    markdown = leaderboard_markdown(study.board, study.two_way, remarks)
    return {PAGE: page.encode(), MARKDOWN: markdown.encode(), METRICS: metrics_lines(study.board).encode()}


def metrics_lines(board: pd.DataFrame) -> str:
    """Return LEADERBOARD rows as JSON lines for trackers, null for missing scores."""
    return str(board.to_json(orient="records", lines=True, double_precision=15))


def export(workspace: Workspace, target: Path, say: Callable[[str], None] = lambda line: None) -> int:
    """Write all tables, available figures and the report page to a folder or a .zip; return the file count.

    Each file is written atomically, `index.html`, which lists them, last. say: receives a line per file.
    """
    begin_publication(workspace.root, "its tables and pictures")
    is_zip, members, paths = target.suffix == ".zip", dict[str, bytes](), list[str]()
    for path, content in _export_reports(Sources(workspace), say):
        paths.append(path)
        if is_zip:
            members[path] = content
        else:
            write_bytes(target / path, content)
    index = _index(paths).encode()
    write_bytes(*((target, zip_bytes(members | {INDEX: index}, level=6)) if is_zip else (target / INDEX, index)))
    return len(paths) + 1


def _export_reports(sources: Sources, say: Callable[[str], None]) -> Iterator[tuple[str, bytes]]:
    for source in (sources.study, sources.paper):
        for report in [r for r in (*TABLE_REPORTS, *FIGURE_REPORTS) if source.is_study or r.published]:
            yield from report.files(source).items()
            say(f"{source.source}: {report.name}")
    yield from ((f"tables/{RECOMPUTED}/{name}", content) for name, content in table_files(audit_table()).items())
    for picture in pair_pictures(sources.workspace):
        with suppress(NotRun):
            figure = picture.figure()
            yield from ((f"figures/{file}", content) for file, content in figure_files(picture.name, figure).items())
    parts = report_parts(sources, None)
    yield from report_files(sources.study, [(part.chapter, part.make()) for part in parts], None).items()


def _index(paths: Sequence[str]) -> str:
    """Return a page of links to all files, by folder and name."""
    folders: dict[str, dict[str, list[str]]] = {}
    for path in paths:
        folder, _, name = path.rpartition("/")
        folders.setdefault(folder or "pages", {}).setdefault(name.rpartition(".")[0], []).append(path)
    return environment().get_template("export_index.html.j2").render(folders=folders, page=PAGE)
