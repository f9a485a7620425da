"""Define the records of two events: a world of two lanes, its four clips, and the two questions on each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from traps_pipeline.base.digests import digest
from traps_pipeline.protocol.two_events import CLIPS, LANES, LaneItem, lane_items
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.parts.look import Look
from traps_pipeline.scenes.parts.wording import lane_question
from traps_pipeline.scenes.physics.kit import Physics
from traps_pipeline.scenes.picture.camera import WideCamera
from traps_pipeline.scenes.worlds.lane_event import LaneEvent
from traps_pipeline.scenes.worlds.lane_layout import Lane, Layout
from traps_pipeline.scenes.worlds.lanes import TwoLanes
from traps_pipeline.scenes.worlds.spec import Footage, Slug, check_camera_and_physics, check_labels, checked


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class LaneTwin(_Record):
    """The other world of a lane: what differs, its answer, the digest of the trajectory with it."""

    params: dict[str, Any]
    ground_truth: str
    trajectory_sha256: str


class LaneRecord(_Record):
    """A lane: its event, what is drawn of it, where it stands, and its twin."""

    params: dict[str, Any]
    lane: Lane
    layout: Layout
    ground_truth: str
    twin: LaneTwin


class TwoEventsSpec(_Record):
    """A scenario of two lanes, resolved. question: the family's own, of both lanes."""

    scenario_id: str = Field(pattern=Slug, max_length=80)
    category: str
    family: str
    seed: int
    physics: dict[str, Any]
    camera: dict[str, Any]
    look: dict[str, Any]
    lanes: tuple[LaneRecord, LaneRecord]
    question: str = Field(min_length=1)
    labels: list[str] = Field(min_length=2)
    aliases: dict[str, str]
    answer_type: str
    trajectory_sha256: str
    evidence: dict[str, Any]

    @model_validator(mode="after")
    def _parts_agree(self) -> TwoEventsSpec:
        check_camera_and_physics(self.camera, self.physics)
        for record in self.lanes:
            answers = {record.ground_truth, record.twin.ground_truth}
            check_labels(self.labels, self.aliases, answers)
            if len(answers) < 2:
                raise ValueError(f"ground truths {sorted(answers)}: a lane and its twin have two of {self.labels}")
        if self.lanes[0].lane.strip == self.lanes[1].lane.strip:
            raise ValueError(f"both lanes have a {self.lanes[0].lane.strip} strip, so no question names one")
        return self

    @property
    def scene_hash(self) -> str:
        """Digest of the clips' content; a corrected question does not change it."""
        parts = {"family", "physics", "camera", "look", "lanes", "trajectory_sha256"}
        return digest(self.model_dump(mode="json", include=parts))

    @property
    def spec_hash(self) -> str:
        """The digest of the whole record as JSON."""
        return digest(self.model_dump(mode="json"))

    def world(self, qpos: np.ndarray | None = None, twin_in: int | None = None) -> TwoLanes:
        """Return the world, or that with the twin in a lane. qpos: its frozen trajectory; None: to be simulated."""
        family, physics = get_family(self.family), Physics(**self.physics)
        params = [record.twin.params if k == twin_in else record.params for k, record in enumerate(self.lanes)]
        return TwoLanes(
            [record.lane for record in self.lanes],
            [LaneEvent(family, family.params_from(values), physics) for values in params],
            WideCamera.from_record(self.camera),
            [record.layout for record in self.lanes],
            Look.from_record(self.look),
            qpos,
        )

    def questions(self) -> Iterator[LaneQuestion]:
        """Yield the eight items' questions, four of which can be answered."""
        for item in lane_items(self.scenario_id):
            record = self.lanes[LANES.index(item.lane)]
            yield LaneQuestion(item, _asked(self.question, record), record.ground_truth)


class RecordedLane(_Record):
    """One of two recorded events: its name in the question, its answer, and between which frames a board stands.

    cover: the board (px): x, y, width, height. hides: where the event is hidden; stands: where it is seen, maybe never.
    """

    name: str
    ground_truth: str
    cover: list[int] = Field(min_length=4, max_length=4)
    hides: list[tuple[int, int]]
    stands: list[tuple[int, int]]


class RecordedEvents(TwoEventsSpec):
    """Two events of a recording, which nobody simulated (docs/recorded.md).

    kind: the table's category. clips: their digests. question: of both events; {} stands for the name of one.
    """

    seed: int = 0
    camera: dict[str, Any] = {}
    look: dict[str, Any] = {}
    kind: str
    clips: dict[str, str]
    lanes: tuple[RecordedLane, RecordedLane]  # pyright: ignore[reportIncompatibleVariableOverride]

    @model_validator(mode="after")
    def _parts_agree(self) -> RecordedEvents:
        check_labels(self.labels, self.aliases, [lane.ground_truth for lane in self.lanes])
        checked(Footage, "physics", self.physics)
        if "{}" not in self.question or {*self.clips} != {*CLIPS}:
            raise ValueError(f"question: needs {{}} for the name of an event, and clips: each of {', '.join(CLIPS)}")
        return self


def _asked(question: str, record: LaneRecord | RecordedLane) -> str:
    is_recorded = isinstance(record, RecordedLane)
    return question.replace("{}", record.name) if is_recorded else lane_question(record.lane.strip, question)


@dataclass(frozen=True)
class LaneQuestion:
    """The question of an item of two events, and what its lane ends in, hidden or not."""

    item: LaneItem
    text: str
    outcome: str

    @property
    def answer(self) -> str | None:
        """The right answer; None where it must be abstained on."""
        return None if self.item.asked_hidden else self.outcome
