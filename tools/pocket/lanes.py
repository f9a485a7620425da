"""Two-lane scenes for a pocket model: drawn as released scenarios of two events are, but not certified.

A scene has four clips (`protocol.two_events.CLIPS`), and each of them two questions, one about each lane. Scenes that
are held out have frames like those for training: what a model is asked about them needs no clip.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

from tools.pocket.batches import NAMED, Clips, Look, names_of
from tools.pocket.data import Question, ShardJob, params_digest, write_shard
from tools.pocket.model import PATCH
from tools.pocket.recipe import Recipe, Split
from tools.pocket.words import ABSTENTION, ANSWER, guess, say
from traps_pipeline.base.digests import canonical_json
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.protocol.two_events import CLIPS, LANES
from traps_pipeline.scenes.draw.draw_lanes import draw_worlds
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.parts.wording import LANE_QUESTION, lane_question
from traps_pipeline.scenes.physics.kit import Wording, params_to_dict
from traps_pipeline.scenes.picture.camera import HEIGHT
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.lanes import TwoLanes
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.storage.media import MediaSpec, pick, resize

STREAM: dict[Split, int] = {"train": 201, "held-out": 202}  # as `data.STREAM`, of two-lane scenes
MAX_DRAWS = 20  # for each scene of a shard
STATES = (ABSTENTION, ANSWER, *LANES)  # tokens that name a lane's half: its bench is open, its scene; where it ended
PHRASES = tuple(part.removesuffix("{question}") for part in LANE_QUESTION.split(" {strip}"))  # tokens of their own


@dataclass(frozen=True)
class LaneScene:
    """A two-lane scene. digests: of its left and its right event. strips, answers: of the lanes.

    boxes: of the strips in the picture, as shares from its upper left corner (left, top, right, bottom). open: for each
    lane and each frame shown, whether the board is gone that comes and goes; settled: and the outcome has settled.
    """

    family: str
    digests: tuple[str, str]
    question: str
    labels: tuple[str, ...]
    strips: tuple[str, str]
    answers: tuple[str, str]
    boxes: tuple[tuple[float, ...], ...]
    open: tuple[tuple[bool, ...], ...]
    settled: tuple[tuple[bool, ...], ...]
    times: tuple[float, ...]

    @property
    def line(self) -> str:
        """The scene as a line of JSON."""
        return canonical_json(asdict(self)) + "\n"

    @staticmethod
    def read(line: str) -> LaneScene:
        """Return a scene from its line of JSON."""
        return LaneScene(**{name: _tuples(value) for name, value in json.loads(line).items()})

    @cached_property
    def questions(self) -> tuple[str, ...]:
        """The question about each lane."""
        return tuple(lane_question(strip, self.question) for strip in self.strips)

    @property
    def texts(self) -> Iterator[str]:
        """All that the scene's questions and answers say."""
        yield from (*self.questions, *(side_question(strip)[0] for strip in self.strips))
        yield from (say(answer, form) for answer in (*self.labels, *LANES, None) for form in ("standard", "json"))


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def side_question(strip: str) -> tuple[str, tuple[str, ...]]:
    """Return a question that is used only in training, to teach a model which lane has a strip, and its answers."""
    return f"In which half of the picture is the {strip} strip?", LANES


# --- scenes -----------------------------------------------------------------------------------------------------------


@cache
def released_digests() -> frozenset[str]:
    """Return the digests of the events of all released scenarios of two events, and of their twins."""
    from traps_pipeline.benchmark.records import two_events_lines

    specs = [line.spec for line in two_events_lines().values()]
    lanes = [(spec.family, lane) for spec in specs for lane in spec.lanes]
    return frozenset(params_digest(f, params) for f, lane in lanes for params in (lane.params, lane.twin.params))


def draw_shard(job: ShardJob) -> int:
    """Draw, render and write one shard; return the scenes in it. Raises TrapsError when too many draws fail."""
    family, stream = get_family(job.family), [STREAM[job.split], job.recipe.data_seed, *job.family.encode(), job.number]
    scenes: list[LaneScene] = []
    frames: list[np.ndarray] = []
    for attempt in range(MAX_DRAWS * job.count):
        if len(scenes) == job.count:
            break
        rng = np.random.default_rng([*stream, attempt])
        try:
            (world, *_), wording = draw_worlds(family, attempt + 1, rng, int(rng.integers(2**31)), is_alike=False)
            scene = _scene(world, wording, job.recipe.media)
        except Rejected:
            continue
        if job.banned.intersection(scene.digests):
            continue
        scenes.append(scene)
        frames.append(_clips(world, job.recipe.media))
    if len(scenes) < job.count:
        raise TrapsError(f"{job.family}: {len(scenes)} of {job.count} scenes after {MAX_DRAWS * job.count} draws")
    return write_shard(job, [scene.line for scene in scenes], frames)


def _scene(world: TwoLanes, wording: Wording, media: MediaSpec) -> LaneScene:
    """Return a world's scene. Raises Rejected if a lane's settled outcome is in no frame shown."""
    every = np.arange(len(world.qpos)) / world.physics.fps
    shown = pick(every, media)
    is_open = [lane.timetable.away(len(every))[shown] == 1 for lane in world.lanes]
    outcomes = [world.outcome(k) for k in range(len(LANES))]
    settled = [gone & (shown >= outcome.commit_frame) for gone, outcome in zip(is_open, outcomes, strict=True)]
    if not all(frames.any() for frames in settled):
        raise Rejected("no frame shown has the settled outcome")
    family, boxes = world.events[0].family.name, []
    digests = [params_digest(family, params_to_dict(event.params)) for event in world.events]
    for layout in world.layouts:
        corners = world.camera.project(layout.strip.corners()) / (world.camera.width, HEIGHT)
        boxes.append(tuple(round(float(at), 4) for at in (*corners.min(axis=0), *corners.max(axis=0))))
    return LaneScene(
        family=family,
        digests=(digests[0], digests[1]),
        question=wording.question,
        labels=tuple(wording.labels),
        strips=(world.lanes[0].strip, world.lanes[1].strip),
        answers=(outcomes[0].answer, outcomes[1].answer),
        boxes=tuple(boxes),
        open=tuple(tuple(map(bool, frames)) for frames in is_open),
        settled=tuple(tuple(map(bool, frames)) for frames in settled),
        times=tuple(every[shown].tolist()),
    )


def _clips(world: TwoLanes, media: MediaSpec) -> np.ndarray:
    """Return the frames shown of the four clips, uint8 (4, N, H, W, 3)."""
    shown = pick(np.arange(len(world.qpos)) / world.physics.fps, media)
    with Renderer(world.model, world.camera, supersample=1) as renderer:
        clips = [np.stack([*renderer.frames(world.clip(hidden)[shown])]) for hidden in CLIPS.values()]
    return np.stack([resize(clip, media.size) for clip in clips])


# --- what a model is trained on ---------------------------------------------------------------------------------------


class LaneScenes(Clips[LaneScene]):
    """The scenes of a split; a side is the number of a clip."""

    words, phrases = STATES, PHRASES

    def __init__(self, recipe: Recipe, folder: Path, split: Split = "train") -> None:
        super().__init__(recipe, folder, split, LaneScene.read)

    def times(self, scene: int, side: int) -> list[float]:
        """Return the seconds into the clip of each frame."""
        return [*self.records[scene].times]

    def _named(self, scene: int, side: int) -> np.ndarray:
        """Return the names of a clip's tokens, (pairs, tokens, words)."""
        record, frames, hidden = self.records[scene], self.frames(scene, side), [*CLIPS.values()][side]
        rows, columns = (length // (2 * PATCH) for length in frames.shape[1:3])
        named = names_of(frames, slice(None)).reshape(len(frames) // 2, rows, columns, -1)
        for strip, (left, top, right, bottom) in zip(record.strips, record.boxes, strict=True):
            across = slice(int(left * columns + 0.3), int(np.ceil(right * columns - 0.3)))
            named[:, int(top * rows + 0.2) : int(np.ceil(bottom * rows - 0.2)) or 1, across, NAMED.index(strip)] = 1
        states = np.zeros((*named.shape[:3], len(STATES)), np.uint8)
        halves = (slice(0, columns // 2), slice(columns // 2, None))
        for k, half in enumerate(halves):
            states[_of_pairs(record.open[k]), :, half, int(not hidden[k])] = 1
            if not hidden[k] and record.answers[k] in LANES:
                states[_of_pairs(record.settled[k]), :, half, STATES.index(record.answers[k])] = 1
        return np.concatenate([named, states], axis=-1).reshape(len(named) * rows * columns, -1)

    def pairs(self, scene: int, side: int, count: int | None, rng: np.random.Generator) -> tuple[int, ...] | None:
        """Return so many pairs of a clip's frames, None for all: for each lane one that shows its settled outcome (or
        would, if it were not hidden), and others at random."""
        record = self.records[scene]
        every = len(record.times) // 2
        if count is None or count >= every:
            return None
        telling = [np.flatnonzero(_of_pairs(frames)) for frames in record.settled]
        first = dict.fromkeys(int(rng.choice(pairs)) for pairs in telling)
        order = [*first, *(int(pair) for pair in rng.permutation(every) if int(pair) not in first)]
        return tuple(sorted(order[:count]))

    def label(self, look: Look, question: Question, prompt_name: str) -> str | None:
        """Return the answer to train under a prompt, None for an abstention."""
        return question.label(self._recipe.share(prompt_name, "", void=question.draw is not None))

    def look(self, rng: np.random.Generator, void_share: float) -> Look:
        """Return a random clip with both its questions, and one for the place of a strip. void_share: of clips that
        hide exactly one lane; the others hide none or both."""
        scene, one = int(rng.integers(len(self.records))), rng.random() < void_share
        sides = [n for n, hidden in enumerate(CLIPS.values()) if (sum(hidden) == 1) == one]
        side = sides[int(rng.integers(len(sides)))]
        record, hidden = self.records[scene], [*CLIPS.values()][side]
        known = [
            Question(text, answer, hint=ANSWER) for text, answer in zip(record.questions, record.answers, strict=True)
        ]
        unknown = [
            Question(text, guess(text, record.labels, rng), rng.random(), ABSTENTION) for text in record.questions
        ]
        asked = [(unknown if hidden[k] else known)[k] for k in range(len(LANES))]
        half = int(rng.integers(len(LANES)))
        asked.append(Question(side_question(record.strips[half])[0], LANES[half]))
        return Look(scene, side, tuple(asked))


def _of_pairs(frames: Sequence[bool]) -> np.ndarray:
    """Return for each pair of frames whether either of them is so, (N / 2,) bool."""
    return np.array([any(pair) for pair in zip(frames[::2], frames[1::2], strict=True)])
