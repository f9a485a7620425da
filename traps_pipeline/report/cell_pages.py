"""The items behind every number: a page per cell (several where it is large), with each answer, vote and verdict, and
an index of the cells.

Pages are made one cell at a time, and only if the cell's tables changed, so that a study with hundreds of cells of a
thousand items each stays feasible. Answers are untrusted text: Jinja2 escapes everything.
"""

from __future__ import annotations

import glob
import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from traps_pipeline.base.files import write_bytes
from traps_pipeline.judging.judged_answers import UNREAD
from traps_pipeline.judging.judging_rows import VERDICTS, VOTES
from traps_pipeline.models.request import JUDGED
from traps_pipeline.models.tables import RESPONSES
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.protocol.datasets import BESIDE, DATASETS
from traps_pipeline.protocol.regimes import REGIMES
from traps_pipeline.report.terms import ARM_TITLES, TITLES
from traps_pipeline.report.writing import TEMPLATES, Behind, environment
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.workspace import Workspace

FOLDER = "items"
MADE = "made.json"  # digest of what each page was made from
PER_PAGE = 500  # pairs
_PER_CELL = (RESPONSES, VOTES, VERDICTS)
_SHOWN = {
    ITEMS: ["item_id", "scenario_id", "sub_scenario", "side", "clip", "question", "ground_truth"],
    RESPONSES: ["item_id", "outcome", "text", "reasoning", "error"],
    VERDICTS: ["item_id", "outcome", "abstained", "correct"],
    VOTES: [
        *("item_id", "task", "judge", "valid", "invalid_reason", "abstained", "confidence", "rationale"),
        *("correct", "extracted_value"),
    ],
}
_DATASETS, _TITLES = (*DATASETS, *BESIDE), TITLES | ARM_TITLES  # the items of arms have pages, too


def cells_with_items(workspace: Workspace) -> list[Cell]:
    """The cells that have answers, in the benchmark's order."""
    found = [
        Cell(part["dataset"], Evaluation(part["model"], part["regime"], int(part["run"])))
        for part in workspace.tables.partitions(RESPONSES)
    ]
    return sorted(found, key=_place)


def _place(cell: Cell) -> tuple[Any, ...]:
    e = cell.evaluation
    return e.model, REGIMES.index(e.regime), _DATASETS.index(cell.dataset), e.run


def page_name(cell: Cell, number: int = 1) -> str:
    """The file name of a cell's page, or of a further one."""
    return f"{cell.dataset}__{cell.evaluation.key}{f'__page{number}' if number > 1 else ''}.html"


def addresses(cells: Sequence[Cell]) -> Callable[[Behind], str]:
    """The address of the items behind a number, relative to the report page; empty if there are none.

    For a number of a single cell this is the cell's page, at the number's side. Otherwise it is the index, at the model
    and regime (and dataset), with a link to each run.
    """
    pages: dict[tuple[str, str, str], list[Cell]] = {}
    for cell in cells:
        pages.setdefault((cell.dataset, cell.evaluation.model, cell.evaluation.regime), []).append(cell)
    anchors = {_anchor(*key) for key in pages} | {_anchor("", m, r) for _, m, r in pages} | {m for _, m, _ in pages}

    def address(behind: Behind) -> str:
        found = pages.get((behind.dataset, behind.model, behind.regime), [])
        if len(found) == 1:
            return f"{FOLDER}/{page_name(found[0])}" + (f"#{behind.side}" if behind.side else "")
        anchor = _anchor(behind.dataset, behind.model, behind.regime)
        if not cells or (behind.model and anchor not in anchors):
            return ""
        return f"{FOLDER}/index.html" + (f"#{anchor}" if anchor in anchors else "")

    return address


def _anchor(dataset: str, model: str, regime: str) -> str:
    return "__".join(part for part in (dataset, model, regime) if part)


def write_item_pages(workspace: Workspace, folder: Path, clips: str | None) -> list[Cell]:
    """Write the pages of all cells and their index to `folder`; returns the cells. A page whose tables did not change
    is not written again.

    clips is the relative path from a page to the workspace, for links to clips; None if there are no clips.
    """
    cells = cells_with_items(workspace)
    made_file = folder / MADE
    made: dict[str, str] = json.loads(made_file.read_text(encoding="utf-8")) if made_file.is_file() else {}
    wanted = {page_name(cell): _made_from(workspace, cell, clips) for cell in cells}
    for cell in cells:
        name = page_name(cell)
        if made.get(name) != wanted[name] or not (folder / name).is_file():
            _remove(folder, name)
            for number, page in enumerate(item_pages(workspace, cell, clips), start=1):
                write_bytes(folder / page_name(cell, number), page.encode())
    for stray in set(made) - set(wanted):
        _remove(folder, stray)
    write_bytes(folder / "index.html", index_page(cells).encode())
    write_bytes(made_file, json.dumps(wanted, indent=0).encode())
    return cells


def _made_from(workspace: Workspace, cell: Cell, clips: str | None) -> str:
    tables = [(ITEMS, {"dataset": cell.dataset}), *((table, cell.partition) for table in _PER_CELL)]
    states = [workspace.tables.state(table, part) for table, part in tables]
    template = (TEMPLATES / "items.html.j2").read_text(encoding="utf-8")
    parts = [template, str(clips), *(state.version if state else "" for state in states)]
    return hashlib.sha256("\x00".join(parts).encode()).hexdigest()[:16]


def _remove(folder: Path, first: str) -> None:
    """Remove a cell's first page and those behind it."""
    for page in (folder / first, *folder.glob(f"{glob.escape(Path(first).stem)}__page*.html")):
        page.unlink(missing_ok=True)


def item_pages(workspace: Workspace, cell: Cell, clips: str | None) -> Iterator[str]:
    """HTML of one cell, `PER_PAGE` pairs a page: controls, then voids; each with question, answer, votes, verdict and
    clip. Rows become Python values a page at a time."""
    items, answers, verdicts, votes = _frames(workspace, cell)
    items = items.loc[items["item_id"].isin(answers["item_id"])].sort_values(by=["sub_scenario", "scenario_id"])
    sides = {side: items.loc[items["side"] == side] for side in ("control", "void")}
    count = max(1, *(math.ceil(len(rows) / PER_PAGE) for rows in sides.values()))
    template = environment().get_template("items.html.j2")
    for number in range(1, count + 1):
        place = (number - 1) * PER_PAGE
        shown = {side: rows.iloc[place : place + PER_PAGE] for side, rows in sides.items()}
        yield template.render(
            cell=cell,
            title=_TITLES[cell.dataset],
            sides={side: list(_item_rows(rows, answers, verdicts, votes)) for side, rows in shown.items()},
            totals={side: len(rows) for side, rows in sides.items()},
            first=place + 1,
            pages=[page_name(cell, n) for n in range(1, count + 1)],
            number=number,
            clips=clips,
            judged=JUDGED,
            unread=UNREAD,
        )


def _frames(workspace: Workspace, cell: Cell) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """What is shown of a cell's items, and of their answers, verdicts and votes."""
    items = workspace.tables.read(ITEMS, {"dataset": cell.dataset}, _SHOWN[ITEMS])
    answers, verdicts, votes = (
        workspace.tables.read_all(table, _SHOWN[table], **cell.partition) for table in (RESPONSES, VERDICTS, VOTES)
    )
    return items, answers, verdicts, votes


def _item_rows(
    items: pd.DataFrame, answers: pd.DataFrame, verdicts: pd.DataFrame, votes: pd.DataFrame
) -> Iterator[Mapping[str, Any]]:
    """One row per item: its columns, `answer`, `verdict` and `votes`."""
    ids = items["item_id"]
    answer, verdict = (_by_item(rows.loc[rows["item_id"].isin(ids)]) for rows in (answers, verdicts))
    cast: dict[str, list[Mapping[str, Any]]] = {}
    for vote in _records(votes.loc[votes["item_id"].isin(ids)]):
        cast.setdefault(vote["item_id"], []).append(vote)
    for item in _records(items):
        name = item["item_id"]
        yield {**item, "answer": answer[name], "verdict": verdict.get(name), "votes": cast.get(name, [])}


def _by_item(rows: pd.DataFrame) -> dict[str, Mapping[str, Any]]:
    return {row["item_id"]: row for row in _records(rows)}


def _records(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows as mappings, with None for missing values."""
    return rows.astype(object).where(rows.notna(), None).to_dict("records")


def index_page(cells: Sequence[Cell]) -> str:
    """HTML of all cells: one row per model and regime, one column per dataset, one link per run."""
    models: dict[str, dict[str, dict[str, list[tuple[int, str]]]]] = {}
    for cell in cells:
        e = cell.evaluation
        by_dataset = models.setdefault(e.model, {}).setdefault(e.regime, {})
        by_dataset.setdefault(cell.dataset, []).append((e.run, page_name(cell)))
    datasets = [name for name in _DATASETS if any(cell.dataset == name for cell in cells)]
    return (
        environment()
        .get_template("items_index.html.j2")
        .render(models=models, datasets=datasets, titles=_TITLES, anchor=_anchor)
    )
