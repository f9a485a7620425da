"""Define the records of two events: a world of two lanes, its four clips, and the two questions on each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.parts.look import Look
from traps_pipeline.scenes.physics.kit import Physics
from traps_pipeline.scenes.picture.camera import WideCamera
from traps_pipeline.scenes.worlds.lane_event import LaneEvent
from traps_pipeline.scenes.worlds.lane_layout import Lane, Layout
from traps_pipeline.scenes.worlds.lanes import LANES, TwoLanes
from traps_pipeline.scenes.worlds.spec import Slug

CLIPS: dict[str, tuple[bool, bool]] = {  # by the lanes that are hidden in it: whether the left and the right one is
    "neither": (False, False), "left": (True, False), "right": (False, True), "both": (True, True),
}  # fmt: skip


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class LaneTwin(_Record):
    """A lane's other world: what differs, its answer, the digest of the trajectory with it."""

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
    def _answers_and_names_agree(self) -> TwoEventsSpec:
        for record in self.lanes:
            answers = {record.ground_truth, record.twin.ground_truth}
            if len(answers) < 2 or not answers <= {*self.labels}:
                raise ValueError(f"ground truths {sorted(answers)}: a lane and its twin have two of {self.labels}")
        if self.lanes[0].lane.strip == self.lanes[1].lane.strip:
            raise ValueError(f"both lanes have a {self.lanes[0].lane.strip} strip, so no question names one")
        return self

    def world(self, twin_in: int | None = None) -> TwoLanes:
        """Return the world, or that with the twin in a lane."""
        family, physics = get_family(self.family), Physics(**self.physics)
        params = [record.twin.params if k == twin_in else record.params for k, record in enumerate(self.lanes)]
        return TwoLanes(
            [record.lane for record in self.lanes],
            [LaneEvent(family, family.params_from(values), physics) for values in params],
            WideCamera.from_record(self.camera),
            [record.layout for record in self.lanes],
            Look.from_record(self.look),
        )

    def items(self) -> Iterator[LaneItem]:
        """Yield the eight items, four of which can be answered."""
        for (clip, hidden), k in product(CLIPS.items(), range(len(LANES))):
            record = self.lanes[k]
            answer, text = None if hidden[k] else record.ground_truth, lane_question(record.lane.strip, self.question)
            yield LaneItem(self.scenario_id, clip, LANES[k], hidden[k], hidden[1 - k], text, answer)


@dataclass(frozen=True)
class LaneItem:
    """A question on a clip. answer: None where it must be abstained on, since the asked lane is hidden."""

    scenario_id: str
    clip: str
    lane: str
    asked_hidden: bool
    other_hidden: bool
    question: str
    answer: str | None


def lane_question(strip: str, question: str) -> str:
    """Return a family's question about the lane with a strip."""
    return f"In the lane with the {strip} strip, leaving its bench aside: {question[0].lower()}{question[1:]}"
