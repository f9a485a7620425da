"""Define the records of `two_events`: a world of two lanes, its four clips, and the two questions on each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from traps_pipeline.base.files import replace_file
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.parts.look import Look
from traps_pipeline.scenes.physics.kit import Box, Physics
from traps_pipeline.scenes.picture.camera import Occluder, WideCamera
from traps_pipeline.scenes.worlds.lanes import LANES, PLACES, Event, Lane, Layout, TwoLanes
from traps_pipeline.scenes.worlds.spec import Slug, trajectory_digest
from traps_pipeline.scenes.worlds.timetable import Timetable

Hidden = tuple[bool, bool]  # which lanes of a clip are hidden: left, right
CLIPS: dict[str, Hidden] = {
    "neither": (False, False), "right": (False, True), "left": (True, False), "both": (True, True),
}  # fmt: skip

DRAWN = (
    "strip",
    "bench_above",
    "bench_at",
    "mirrored",
    "rests_at",
    "sets_out_s",
    "size",
)  # of a lane, as records store it


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class LaneTwin(_Record):
    """A lane's other world: what differs, its answer, the digest of the trajectory of both lanes."""

    params: dict[str, Any]
    ground_truth: str
    trajectory_sha256: str


class LaneRecord(_Record):
    """A lane: its event, what is drawn of it (`lanes.Lane`), where it stands (`lanes.Layout`), and its twin."""

    params: dict[str, Any]
    strip: str
    bench_above: bool
    bench_at: float
    mirrored: bool
    rests_at: float
    sets_out_s: float
    size: float
    spans: list[tuple[int, int]]
    layout: dict[str, Any]
    ground_truth: str
    twin: LaneTwin

    @property
    def lane(self) -> Lane:
        """The lane, without the family's parameters read."""
        fields = {name: getattr(self, name) for name in DRAWN}
        return Lane(params=self.params, timetable=Timetable(tuple(self.spans)), **fields)


class TwoEventsSpec(_Record):
    """A scenario of two lanes, resolved. question: the family's own, for both lanes."""

    scenario_id: str = Field(pattern=Slug, max_length=80)
    category: str
    family: str
    seed: int
    physics: dict[str, Any]
    camera: dict[str, Any]
    look: dict[str, Any]
    lanes: list[LaneRecord] = Field(min_length=2, max_length=2)
    question: str = Field(min_length=1)
    labels: list[str] = Field(min_length=2)
    aliases: dict[str, str]
    answer_type: str
    trajectory_sha256: str
    evidence: dict[str, Any]

    @model_validator(mode="after")
    def _labels_agree(self) -> TwoEventsSpec:
        for lane in self.lanes:
            for answer in (lane.ground_truth, lane.twin.ground_truth):
                if answer not in self.labels:
                    raise ValueError(f"ground_truth {answer!r} is not one of the labels {self.labels}")
        if self.lanes[0].strip == self.lanes[1].strip:
            raise ValueError(f"both lanes have a {self.lanes[0].strip} strip, so no question names one")
        return self

    def world(self, twin_in: int | None = None) -> TwoLanes:
        """Return the world, or that with the twin in a lane."""
        family, physics = get_family(self.family), Physics(**self.physics)
        params = [record.twin.params if k == twin_in else record.params for k, record in enumerate(self.lanes)]
        left, right = (Event(family, family.params_from(values), physics) for values in params)
        first, second = (record.lane for record in self.lanes)
        layouts = tuple(layout_from(record.layout) for record in self.lanes)
        return TwoLanes(
            (first, second), (left, right), WideCamera.from_record(self.camera), layouts, Look.from_record(self.look)
        )

    def items(self) -> Iterator[Item]:
        """Yield the eight items, four of which can be answered."""
        for (clip, hidden), lane in product(CLIPS.items(), range(len(LANES))):
            record = self.lanes[lane]
            answer = None if hidden[lane] else record.ground_truth
            yield Item(self.scenario_id, clip, LANES[lane], hidden[lane], hidden[1 - lane], self.asked(lane), answer)

    def asked(self, lane: int) -> str:
        """Return the question about a lane."""
        return lane_question(self.lanes[lane].strip, self.question)


@dataclass(frozen=True)
class Item:
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


def layout_from(record: dict[str, Any]) -> Layout:
    """Return the layout of a stored lane."""
    boards = {place: Occluder.from_record(record["boards"][place]) for place in PLACES}
    strip = Box(*(tuple(record["strip"][end]) for end in ("low", "high")))
    shift, bench = (tuple(record[name]) for name in ("shift", "bench"))
    paths = tuple(np.array(path) for path in record["paths"])
    return Layout(shift, bench, tuple(record["bench_half"]), strip, boards, paths)


def layout_record(layout: Layout) -> dict[str, Any]:
    """Return a layout as records store it."""
    return {**asdict(layout), "paths": [path.tolist() for path in layout.paths]}


def save_lane_trajectories(folder: Path, scenario_id: str, worlds: dict[str, np.ndarray]) -> dict[str, str]:
    """Write the trajectories of a scenario's three worlds; return their digests."""
    arrays = {name: np.ascontiguousarray(qpos, dtype="<f4") for name, qpos in worlds.items()}
    with replace_file(folder / f"{scenario_id}.npz") as part, part.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)
    return {name: trajectory_digest(qpos) for name, qpos in arrays.items()}
