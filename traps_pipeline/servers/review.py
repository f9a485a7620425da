"""Serve `traps people review`, and append decisions to the corrections."""

import json
import shlex
from collections.abc import Mapping
from datetime import date
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any, Literal

from fastapi import FastAPI
from fastapi.responses import FileResponse, HTMLResponse, RedirectResponse, Response
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.yamlfile import faults_of
from traps_pipeline.benchmark.corrections import WORDS, Correction, load_scenarios, load_two_events, read_corrections
from traps_pipeline.benchmark.decisions import DecidedMeanwhile, decisions_on, is_reviewed, save_decision, undo_decision
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.pipeline.experiment import EXPERIMENTS
from traps_pipeline.protocol.datasets import TWO_EVENTS
from traps_pipeline.protocol.two_events import CLIPS, LANES, lane_items
from traps_pipeline.report.explorer.scenario_words import answer_of_control, certificate_phrases, intervention
from traps_pipeline.scenes.worlds.lane_records import TwoEventsSpec
from traps_pipeline.servers.correction_cost import CorrectionEffect, correction_effect
from traps_pipeline.servers.queue import MEANINGS, QUEUES, QueueName, flags, queue
from traps_pipeline.servers.server import Conflict, NotFound, Refused, new_app, page_html, script, study_file
from traps_pipeline.storage.benchmark_tables import ARMS, SCENE_SPECS, VIDEOS
from traps_pipeline.storage.workspace import Workspace

SCRIPTS = ("dom.js", "keys.js", "search.js", "player.js", "listening.js", "review.js")
OBSERVED_LANES = ("left.neither", "left.both")  # items of two events of which the page has the observer's answer
Record = Mapping[str, Any]


class Decision(BaseModel):
    """A reviewer's decision about a scenario, as the page sends it.

    seen: the number of decisions about the scenario on the page. `add` creates a new scenario of the same family, with
    this one's parameters and the changes.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    scenario_id: str
    action: Literal["keep", "correct", "discard", "add"]
    changes: dict[str, Any] = {}
    why: str = Field(min_length=1, max_length=2000)
    seen: int = Field(ge=0)


class Undo(BaseModel):
    """A request to take back the last decision."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    scenario_id: str
    why: str = Field(min_length=1, max_length=2000)
    seen: int = Field(ge=0)


class Preview(BaseModel):
    """Changes whose cost a reviewer wants to see before deciding."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    scenario_id: str
    changes: dict[str, Any]


class Review:
    """A study under review by one person."""

    def __init__(self, workspace: Workspace, who: str) -> None:
        self.workspace, self.who = workspace, who

    @cached_property
    def specs(self) -> dict[str, Record]:
        """SCENE_SPECS rows by scenario, and rows like them of two events. Raises TrapsError without any."""
        rows = self.workspace.tables.read_all(SCENE_SPECS).sort_values("scenario_id").to_dict("records")
        pairs = {str(row["scenario_id"]): {str(k): v for k, v in row.items()} for row in rows}
        lanes = load_two_events(self.workspace.study).items()
        scenarios = pairs | {id_: _lane_row(each.spec) for id_, each in lanes if (id_, "neither") in self.clips}
        if not scenarios:
            raise TrapsError(f"{self.workspace.root}: has no scenes yet; run `traps run EXPERIMENT` in it first")
        return scenarios

    @cached_property
    def clips(self) -> dict[tuple[str, str], Record]:
        """VIDEOS rows by scenario and side, and path and rate of clips of two events by scenario and clip."""
        rows = self.workspace.tables.read_all(VIDEOS).to_dict("records")
        clips: dict[tuple[str, str], Record] = {
            (str(row["scenario_id"]), str(row["side"])): {str(k): v for k, v in row.items()} for row in rows
        }
        arms = self.workspace.tables.read_all(ARMS, ["scenario_id", "arm", "item", "clip", "n_frames", "duration_s"])
        for row in arms.loc[arms["arm"] == TWO_EVENTS].to_dict("records"):
            key = str(row["scenario_id"]), str(row["item"]).partition(".")[2]
            clips[key] = {"path": row["clip"], "fps": row["n_frames"] / row["duration_s"]}
        return clips

    @cached_property
    def flags(self) -> Any:
        """Judges' and models' disagreement by scenario, as of the review's start."""
        return flags(self.workspace)

    @cached_property
    def observed(self) -> dict[str, str]:
        """The observer's answers under its first regime, by item."""
        rows = self.workspace.tables.read_all(RESPONSES, ["item_id", "model", "regime", "run", "text"])
        observer_rows = rows.loc[rows["model"] == "observer"].sort_values(["item_id", "regime", "run"])
        first = observer_rows.dropna(subset=["text"]).drop_duplicates("item_id")
        return {str(item): str(text) for item, text in zip(first["item_id"], first["text"], strict=True)}

    def spec(self, scenario_id: str) -> Record:
        """Return the row of a scenario. Raises NotFound."""
        if scenario_id not in self.specs:
            raise NotFound(f"{scenario_id}: not a scenario of this study")
        return self.specs[scenario_id]

    def reviewed(self) -> frozenset[str]:
        """Return the scenarios with a valid decision."""
        last = {correction.scenario_id: correction for _, correction in read_corrections()}
        return frozenset(id_ for id_, correction in last.items() if is_reviewed([correction]))

    def queue(self, name: QueueName) -> list[str]:
        """Return the scenarios that a queue of the review pages offers, in order."""
        return queue(name, list(self.specs), self.reviewed(), self.flags)

    def decide(self, sent: Decision) -> None:
        """Append a reviewer's decision about a scenario to the corrections. Raises NotFound, Refused and Conflict."""
        spec = self.spec(sent.scenario_id)
        correction, decision_count = self._correction(sent.scenario_id, sent.action, sent.changes, sent.why), sent.seen
        if sent.action == "add":
            if spec["taxonomy"] == TWO_EVENTS:
                raise Refused(f"{sent.scenario_id}: scenarios of two events are drawn, not added")
            params = json.loads(spec["params"]) | (correction.params or {})
            new = {"scenario_id": self._free_id(spec["family"]), "family": spec["family"], "params": params}
            correction, decision_count = correction.model_copy(update=new), 0
        try:
            save_decision(correction, decision_count)
        except DecidedMeanwhile as error:
            raise Conflict(str(error)) from error

    def _free_id(self, family: str) -> str:
        """Return the first id from 9001 on that no scenario has ever had."""
        used_ids = {*load_released(), *(correction.scenario_id for _, correction in read_corrections())}
        return next(name for k in count(9001) if (name := f"{family}-{k}") not in used_ids)

    def undo(self, sent: Undo) -> None:
        """Take back the last decision. Raises NotFound, Refused and Conflict."""
        self.spec(sent.scenario_id)
        try:
            undo_decision(sent.scenario_id, sent.seen, who=self.who, why=sent.why)
        except DecidedMeanwhile as error:
            raise Conflict(str(error)) from error

    def preview(self, sent: Preview) -> dict[str, Any]:
        """Return changed words, and the cost to ask again. Raises NotFound and Refused."""
        spec = self.spec(sent.scenario_id)
        correction = self._correction(sent.scenario_id, "correct", sent.changes, "preview")
        cost = correction_effect(self.workspace, spec, correction)
        return {"question": cost.question, "cost": cost.sentence()}

    def _correction(self, scenario_id: str, action: str, changes: Mapping[str, Any], why: str) -> Correction:
        allowed_fields = {*WORDS, "answer", "params"}
        if set(changes) - allowed_fields:
            raise Refused(f"changes: {', '.join(sorted(set(changes) - allowed_fields))} cannot be corrected here")
        fields = {**changes, "scenario_id": scenario_id, "action": action, "why": why}
        try:
            return Correction.model_validate({**fields, "who": self.who, "when": date.today()})
        except ValidationError as error:
            raise Refused(f"{scenario_id}: {faults_of(error)}") from error

    def summary(self) -> CorrectionEffect:
        """Return the effect of the decisions that the study's tables do not contain yet."""
        scenarios = load_scenarios(self.workspace.study)
        total = CorrectionEffect(added=sorted({*scenarios} - {*self.specs}))
        lanes = load_two_events(self.workspace.study)
        for scenario_id, spec in self.specs.items():
            scenario = lanes.get(scenario_id) or scenarios.get(scenario_id)
            params = getattr(scenario, "params", None)
            if scenario is None:
                total.gone.append(scenario_id)
            elif scenario.words or params is not None:
                changes = dict(scenario.words) | ({"params": dict(params)} if params else {})
                correction = self._correction(scenario_id, "correct", changes, "summary")
                total = total.plus(correction_effect(self.workspace, spec, correction))
        return total

    # --- pages --------------------------------------------------------------------------------------------------------

    def scenario_page(self, scenario_id: str, name: QueueName) -> str:
        """Return the page of one scenario."""
        spec, scenarios = self.spec(scenario_id), self.queue(name)
        decisions = decisions_on(scenario_id)
        place = scenarios.index(scenario_id) if scenario_id in scenarios else -1
        captions = _captions(spec)
        items = {side: f"{spec['taxonomy']}:{scenario_id}:{side}" for side in ("control", "void")}
        if spec["taxonomy"] == TWO_EVENTS:
            items = {item.side: item.item_id for item in lane_items(scenario_id) if item.name in OBSERVED_LANES}
        fields = {
            "scenario_id": scenario_id,
            "seen": len(decisions),
            "queue": name,
            "fps": self.clips.get((scenario_id, next(iter(captions))), {}).get("fps"),
            "clips": [side for side in captions if (scenario_id, side) in self.clips],
            "before": scenarios[place - 1] if place > 0 else "",
            "after": next((scenario for scenario in scenarios[place + 1 :] if scenario != scenario_id), ""),
            "params": json.loads(spec["params"]),
            "words": {word: _as_json(spec[word]) for word in ("question", "ill_posed_question", "labels")}
            | {"answer": spec["ground_truth"]},
            "captions": captions,
        }
        return page_html(
            "review.html.j2",
            shown=fields,
            queue=name,
            spec=spec,
            labels=", ".join(spec["labels"]),
            certificate=[words for _, words in certificate_phrases(json.loads(spec["evidence"]))],
            observed={side: self.observed.get(item, "not asked") for side, item in items.items()},
            decisions=decisions,
            is_reviewed=is_reviewed(decisions),
            queues={queue_name: (MEANINGS[queue_name], len(self.queue(queue_name))) for queue_name in QUEUES},
            reviewed=len(self.reviewed() & set(self.specs)),
            total=len(self.specs),
            flags=self.flags.loc[scenario_id].to_dict() if scenario_id in self.flags.index else {},
            who=self.who,
        )

    def done_page(self, name: QueueName) -> str:
        """Return a queue's last page: the decisions' effect, and the next commands."""
        return page_html(
            "review_done.html.j2",
            effect=self.summary(),
            queue=name,
            queues={queue_name: (MEANINGS[queue_name], len(self.queue(queue_name))) for queue_name in QUEUES},
            reviewed=len(self.reviewed() & set(self.specs)),
            total=len(self.specs),
            commands=[command for name in self.workspace.study.experiments for command in self._commands(name)],
            who=self.who,
        )

    def _commands(self, experiment: str) -> list[str]:
        """Return the commands that plan and run an experiment after the changes."""
        name = experiment if (EXPERIMENTS / f"{experiment}.yaml").is_file() else f"{experiment}.yaml"
        target = f"{shlex.quote(name)} --workspace {shlex.quote(str(self.workspace.root))}"
        return [f"traps status {target}", f"traps run {target}"]

    def clip(self, scenario_id: str, side: str) -> Path:
        """Return the file of a clip. Raises NotFound if the study has none."""
        row = self.clips.get((scenario_id, side))
        if row is None:
            raise NotFound(f"{scenario_id}: the study has no {side} clip of it")
        return study_file(self.workspace, row["path"])


def _lane_row(spec: TwoEventsSpec) -> Record:
    fields = {name: getattr(spec, name) for name in ("scenario_id", "family", "category", "question", "labels")}
    truths = "; ".join(f"{lane}: {record.ground_truth}" for lane, record in zip(LANES, spec.lanes, strict=True))
    empty = {"ill_posed_question": "", "params": "{}", "evidence": "{}"}
    return fields | {"sub_scenario": "two events", "taxonomy": TWO_EVENTS, "ground_truth": truths} | empty


def _captions(spec: Record) -> dict[str, str]:
    """Return title and note of each clip of a scenario, in their order."""
    if spec["taxonomy"] == TWO_EVENTS:
        return {clip: f"Hidden, {clip}: {spec['ground_truth']}" for clip in CLIPS}
    void = "another" if json.loads(spec["evidence"]).get("twin_px") else "same"
    return {
        "control": f"Control: {answer_of_control(spec)}",
        "void": f"Void: {intervention(spec)}",
        "twin": f"Twin, {void} void: {json.loads(spec['twin'])['ground_truth']}",
    }


def _as_json(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else value


def review_app(review: Review) -> FastAPI:
    """Return the app of a review, to be placed behind the guard."""
    app = new_app()

    @app.get("/")
    def start(queue: QueueName = "unreviewed") -> Response:
        waiting = review.queue(queue)
        return RedirectResponse(f"/scenario/{waiting[0]}?queue={queue}" if waiting else f"/done?queue={queue}", 303)

    @app.get("/scenario/{scenario_id}")
    def one(scenario_id: str, queue: QueueName = "unreviewed") -> Response:
        return HTMLResponse(review.scenario_page(scenario_id, queue))

    @app.get("/done")
    def done(queue: QueueName = "unreviewed") -> Response:
        return HTMLResponse(review.done_page(queue))

    @app.get("/clip/{scenario_id}/{side}")
    def clip(scenario_id: str, side: str) -> Response:
        return FileResponse(review.clip(scenario_id, side), media_type="video/mp4")

    @app.get("/review.js")
    def code() -> Response:
        return Response(script(*SCRIPTS), media_type="text/javascript")

    @app.post("/decide")
    def decide_(sent: Decision) -> dict[str, int]:
        review.decide(sent)
        return {"seen": len(decisions_on(sent.scenario_id))}

    @app.post("/undo")
    def undo_(sent: Undo) -> dict[str, int]:
        review.undo(sent)
        return {"seen": len(decisions_on(sent.scenario_id))}

    @app.post("/preview")
    def preview(sent: Preview) -> dict[str, Any]:
        return review.preview(sent)

    return app
