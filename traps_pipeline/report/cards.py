"""Build the report page's cards: tables, figures and pictures beside the paper's."""

from __future__ import annotations

import json
import traceback
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.explorer_link import EXPLORER, answers_view
from traps_pipeline.base.sheets import csv_bytes
from traps_pipeline.report.catalogue import FigureReport, TableReport
from traps_pipeline.report.pair_pictures import Picture
from traps_pipeline.report.published_results import PublishedResults
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.study_results import StudyResults
from traps_pipeline.report.writing import (
    COLUMN_IN,
    NotRun,
    PrintedTable,
    SourceItems,
    environment,
    figure_bytes,
    table_html,
    table_latex,
)
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MEDIA = {"svg": "image/svg+xml", "webp": "image/webp", "csv": "text/csv", "tex": "application/x-tex"}
LinkOf = Callable[[SourceItems], str]


@dataclass(frozen=True)
class Card:
    """A section of the report page: the study's tables, figure or picture, beside the paper's.

    It holds the study's tables or figures (`html`, escaped), or `why` it was not run.

    shows: a description of the figures.
    """

    name: str
    title: str
    html: str = ""
    why: str = ""
    shows: str = ""
    paper: str = ""

    @classmethod
    def read(cls, data: bytes) -> Card:
        """Return the report card that `data` stores as JSON."""
        return cls(**json.loads(data))

    @property
    def data(self) -> bytes:
        """The report card as JSON."""
        return json.dumps(asdict(self)).encode()


class Sources:
    """The results of a study and of the paper, each read when it is first used."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace = workspace

    @cached_property
    def study(self) -> Results:
        """The study's results."""
        return StudyResults(self.workspace)

    @cached_property
    def paper(self) -> Results:
        """The paper's results."""
        return PublishedResults()


@lru_cache(4096)  # cells of one row share it, and so do tables
def explorer_address(behind: SourceItems) -> str:
    """Return the URL, relative to the report, of the explorer's view of the answers behind a number."""
    return f"{EXPLORER}#{answers_view(**vars(behind))}"


def table_card(report: TableReport, sources: Sources, address: LinkOf | None = explorer_address) -> Card:
    """Return a report card that holds one or more tables of a study."""
    name = _name(report)
    try:
        tables = report.tables(sources.study)
    except TrapsError:
        raise
    except Exception as error:  # noqa: BLE001 - one table must not cost the others
        return Card(name, report.title or report.name, why=_failure(f"table {report.name}", sources, error))
    title = report.title or tables[0].title
    run = [table for table in tables if len(table.rows) or table.none]
    if not run:
        return Card(name, title, why=tables[0].why)
    absences = [f"{table.title}: {table.absence}" for table in tables if table not in run]
    return Card(name, title, _fragment("tables", own=tables_html(run, title, address), absent=absences, published={}))


def paper_card(report: TableReport | FigureReport, sources: Sources) -> Card:
    """Return the card of the paper's tables or figure, empty if it has none."""
    if isinstance(report, FigureReport):
        try:
            pictures = {"The paper’s": _picture(f"{report.name}_published", report.figure(sources.paper))}
        except NotRun:
            pictures = {}
        return Card(_name(report), report.title, _fragment("figures", pictures=pictures, alt=report.title))
    published = {"As the paper prints it": printed_tables} if (printed_tables := report.as_printed()) else {}
    if report.recomputed:
        published["Recomputed from the published tables"] = report.tables(sources.paper)
    tables = {words: tables_html(table_group, "", None) for words, table_group in published.items()}
    return Card(_name(report), report.title, _fragment("tables", own=[], absent=[], published=tables))


def tables_html(tables: Sequence[PrintedTable], title: str, address: LinkOf | None) -> list[Mapping[str, object]]:
    """Return the HTML of a card's tables, each with its title and downloads by name."""
    return [
        {
            "title": table.title if table.title != title else "",
            "html": table_html(table, address),
            "files": {
                f"{table.name}.csv": data_address("csv", csv_bytes(table.data)),
                f"{table.name}.tex": data_address("tex", table_latex(table).encode()),
            },
        }
        for table in tables
    ]


def figure_card(report: FigureReport, sources: Sources) -> Card:
    """Return the card of a study's figure."""
    name = _name(report)
    try:
        pictures = {"": _picture(report.name, report.figure(sources.study))}
        shows = report.note(sources.study)
    except NotRun as reason:
        return Card(name, report.title, why=str(reason))
    except TrapsError:
        raise
    except Exception as error:  # noqa: BLE001 - one figure must not cost the others
        return Card(name, report.title, why=_failure(f"figure {report.name}", sources, error))
    return Card(name, report.title, _fragment("figures", pictures=pictures, alt=report.title), shows=shows)


def _failure(what: str, sources: Sources, error: Exception) -> str:
    """Note, and return, that a card cannot be made, of which models, and where the code failed."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    models = ", ".join(dict.fromkeys(map(str, sources.study.overall["model"]))) or "no model"
    message = f"{type(error).__name__} {error}".strip()
    reason = f"{what} of {models}: cannot be made ({message}, {place.filename.rpartition('/')[2]}:{place.lineno})"
    progress.current().note(f"{reason}; the rest of the report is written: report it with the tables that it reads")
    return reason


def picture_card(picture: Picture, shows: str) -> Card:
    """Return the card of a picture made of clips' frames. shows: its caption."""
    try:
        pictures = {"": _picture(picture.name, picture.figure(), "webp")}
    except NotRun as reason:
        return Card(picture.name, picture.title, why=str(reason))
    return Card(picture.name, picture.title, _fragment("figures", pictures=pictures, alt=picture.title), shows=shows)


def _name(report: TableReport | FigureReport) -> str:
    return f"{'table' if isinstance(report, TableReport) else 'figure'}-{report.name}"


def _picture(name: str, figure: Figure, kind: str = "svg") -> Mapping[str, str]:
    width = "column" if figure.get_figwidth() <= COLUMN_IN else "page"
    return {"name": name, "kind": kind, "width": width, "src": data_address(kind, figure_bytes(figure, kind))}


def data_address(kind: str, content: bytes) -> str:
    """Return a data URL of a file."""
    return f"data:{MEDIA[kind]};base64,{b64encode(content).decode('ascii')}"


def _fragment(kind: str, **values: object) -> str:
    return environment().get_template(f"{kind}.html.j2").render(**values)
