"""Let people label clips and answers blindly, one a screen (`people annotate`).

Only the server knows the identity of the shown unit. A browser gets a question, a clip or an answer, and a handle made
for one person and one unit: no model, regime, side, dataset or scenario is ever sent, and no address names a file.
"""

import time
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd
from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, Response
from pydantic import BaseModel, ConfigDict, ValidationError

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.webguard import TOKEN_OWNER
from traps_pipeline.base.yamlfile import faults_of
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.people.judge_validation import sheet_rows
from traps_pipeline.people.label_units import TASKS, TaskName, annotation_protocol, personal_order, require_task, sample
from traps_pipeline.people.labels import LABELS
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.servers.labelstore import LabelStore, NotWaiting
from traps_pipeline.servers.server import Conflict, NotFound, Refused, new_app, page_html, script, study_file
from traps_pipeline.storage.benchmark_tables import ITEMS, VIDEOS
from traps_pipeline.storage.workspace import Workspace

SCRIPTS = ("dom.js", "keys.js", "search.js", "player.js", "listening.js", "annotate.js")
TITLES: Mapping[TaskName, str] = {
    "answerability": "Clips: what happens?",
    "abstention": "Answers: do they answer?",
    "correctness": "Answers: are they right?",
    "confabulation": "Wrong answers: what went wrong?",
}


class SubmittedLabel(BaseModel):
    """A label from a browser; `label` is validated by the task's own model."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    handle: str
    label: dict[str, Any]


class Reopen(BaseModel):
    """A request to label the last unit of a task again."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    task: str


class Annotation:
    """A study whose clips and answers people label, as it was at creation."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace = workspace
        self.samples = {task: self._sample(task) for task in TASKS}
        if all(sample.empty for sample in self.samples.values()):
            raise TrapsError(f"{workspace.root}: has no clips yet; run `traps run EXPERIMENT` in it first")
        self.store = LabelStore(workspace.labels)

    def _sample(self, task: TaskName) -> pd.DataFrame:
        units_drawn = sample(self.workspace, task)
        if task == "answerability":  # leave out clips that were not copied with the study
            has_clip = [self.workspace.resolve(self.items[item]["clip"]).is_file() for item in units_drawn["item_id"]]
            units_drawn = units_drawn.loc[has_clip]
        return units_drawn.set_index("unit", drop=False)

    @cached_property
    def items(self) -> dict[str, dict[str, Any]]:
        """Question, ground truth and clip by item."""
        rows = self.workspace.tables.read_all(ITEMS, ["item_id", "question", "ground_truth", "clip"])
        return {str(row["item_id"]): {str(k): v for k, v in row.items()} for row in rows.to_dict("records")}

    @cached_property
    def fps(self) -> dict[str, int]:
        """Frames per second of each clip."""
        rows = self.workspace.tables.read_all(VIDEOS, ["path", "fps"])
        return {str(path): int(fps) for path, fps in zip(rows["path"], rows["fps"], strict=True)}

    @cached_property
    def failures(self) -> dict[str, dict[str, str]]:
        """The answers that people are asked to label for confabulation, by unit."""
        return {row["sample_id"]: row for row in sheet_rows(self.workspace)}

    def progress(self, who: str, task: TaskName) -> tuple[int, int]:
        """Return the numbers of units that a person has labelled and has to label."""
        sample = self.samples[task]
        return sum(unit in sample.index for unit in self.store.labelled(who, task)), len(sample)

    def next_unit(self, who: str, task: TaskName) -> str | None:
        """Return a person's next unit, and record it as shown.

        It is the unit that waits for a label, else the first of their queue. None if all are labelled, or if the rest
        belong to scenarios that they met in this sitting.
        """
        while (unit := self._open_unit(who, task)) is not None:
            if self.store.show(who, task, unit, str(self.samples[task].loc[unit, "scenario_id"])):
                break  # otherwise it was labelled in another window since the queue was read
        return unit

    def _open_unit(self, who: str, task: TaskName) -> str | None:
        sample, shown_units = self.samples[task], self.store.shown(who)
        of_task = [shown_unit for shown_unit in shown_units if shown_unit.task == task]
        waiting = [shown_unit.unit for shown_unit in of_task if shown_unit.waits and shown_unit.unit in sample.index]
        if waiting:
            return waiting[-1]
        finished = {shown_unit.unit for shown_unit in of_task} | {*self.store.labelled(who, task)}
        met = set[str]()  # scenarios whose clips the person should not judge now
        if task == "answerability":  # a clip or an answer of any task reveals the scenario
            sitting_start = time.time() - 3600 * annotation_protocol().sitting_hours
            met = {shown_unit.scenario_id for shown_unit in shown_units if shown_unit.at > sitting_start}
        open_units = (unit for unit in personal_order(who, sample) if unit not in finished)
        return next((unit for unit in open_units if sample.loc[unit, "scenario_id"] not in met), None)

    def find(self, who: str, handle: str) -> tuple[TaskName, str]:
        """Return a person's task and unit behind a handle. Raises NotFound."""
        for shown_unit in self.store.shown(who):
            task = require_task(shown_unit.task)
            if (
                self.store.handle(who, shown_unit.task, shown_unit.unit) == handle
                and shown_unit.unit in self.samples[task].index
            ):
                return task, shown_unit.unit
        raise NotFound("nothing of this name is shown to you")

    def record(self, who: str, sent: SubmittedLabel) -> None:
        """Store a label. Raises NotFound, Refused and Conflict."""
        task, unit = self.find(who, sent.handle)
        try:
            label = LABELS[task].model_validate(sent.label)
        except ValidationError as error:
            raise Refused(faults_of(error)) from error
        try:
            self.store.record(who, task, unit, label.model_dump())
        except NotWaiting as error:
            raise Conflict(str(error)) from error

    def reopen(self, who: str, name: str) -> None:
        """Show a task's last labelled unit again. Raises NotFound without one."""
        task = require_task(name)
        labelled_units = [unit for unit in self.store.labelled(who, task) if unit in self.samples[task].index]
        if not labelled_units:
            raise NotFound("you have labelled nothing here yet")
        unit = labelled_units[-1]
        self.store.show(who, task, unit, str(self.samples[task].loc[unit, "scenario_id"]), again=True)

    def clip(self, who: str, handle: str) -> Path:
        """Return the clip behind a handle. Raises NotFound."""
        task, unit = self.find(who, handle)
        if task != "answerability":
            raise NotFound("nothing of this name is shown to you")
        return study_file(self.workspace, self.items[str(self.samples[task].loc[unit, "item_id"])]["clip"])

    def shown(self, who: str, task: TaskName, unit: str) -> dict[str, Any]:
        """Return everything that a browser gets of a unit."""
        row = self.samples[task].loc[unit]
        handle = self.store.handle(who, task, unit)
        if task == "confabulation":
            failure = self.failures[unit]
            texts = {"question": failure["question"], "answer": failure["response"]}
            texts |= {"why": failure["why_unanswerable"], "trace": failure["reasoning_trace"]}
            return {"task": task, "handle": handle, **texts}
        item = self.items[str(row["item_id"])]
        fields = {"task": task, "handle": handle, "question": item["question"]}
        if task == "answerability":
            return fields | {"fps": self.fps.get(item["clip"])}
        cell = Cell(row["dataset"], Evaluation(row["model"], row["regime"], int(row["run"])))
        answers = self.workspace.tables.read(RESPONSES, cell.partition, ["item_id", "text"]).set_index("item_id")
        truth = {"truth": item["ground_truth"]} if task == "correctness" else {}
        return fields | truth | {"answer": str(answers.loc[row["item_id"], "text"])}

    # --- pages --------------------------------------------------------------------------------------------------------

    def start_page(self, who: str) -> str:
        """Return the page with a person's choice of tasks."""
        return page_html("annotate_start.html.j2", who=who, tasks=self._tasks(who))

    def unit_page(self, who: str, task: TaskName) -> str:
        """Return the page of the next unit, or one that says why there is none now."""
        unit = self.next_unit(who, task)
        finished, total = self.progress(who, task)
        page_values = {"who": who, "tasks": self._tasks(who), "task": task, "title": TITLES[task], "done": finished}
        if unit is None:
            hours = annotation_protocol().sitting_hours
            return page_html("annotate_done.html.j2", **page_values, total=total, hours=f"{hours:g}")
        return page_html("annotate.html.j2", **page_values, total=total, shown=self.shown(who, task, unit))

    def _tasks(self, who: str) -> dict[TaskName, tuple[str, int, int]]:
        """Return title, labelled and total units of each task."""
        return {task: (title, *self.progress(who, task)) for task, title in TITLES.items()}


def annotation_app(annotation: Annotation) -> FastAPI:
    """Return the app of the labelling pages, behind a guard that identifies people."""
    app = new_app()

    def who(request: Request) -> str:
        return str(request.scope[TOKEN_OWNER])

    @app.get("/")
    def start(request: Request) -> Response:
        return HTMLResponse(annotation.start_page(who(request)))

    @app.get("/task/{name}")
    def unit(request: Request, name: str) -> Response:
        if name not in TASKS:
            raise NotFound(f"{name}: no task of this name")
        return HTMLResponse(annotation.unit_page(who(request), require_task(name)))

    @app.get("/clip/{handle}")
    def clip(request: Request, handle: str) -> Response:
        # Not as a file response, which would send its times and name.
        return Response(annotation.clip(who(request), handle).read_bytes(), media_type="video/mp4")

    @app.get("/annotate.js")
    def code() -> Response:
        return Response(script(*SCRIPTS), media_type="text/javascript")

    @app.post("/label")
    def label(request: Request, sent: SubmittedLabel) -> dict[str, bool]:
        annotation.record(who(request), sent)
        return {"kept": True}

    @app.post("/reopen")
    def reopen(request: Request, sent: Reopen) -> dict[str, bool]:
        annotation.reopen(who(request), sent.task)
        return {"reopened": True}

    return app
