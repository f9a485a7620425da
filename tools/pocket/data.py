"""Scenes for the pocket model: drawn by the families' own samplers, simulated, and rendered in the few frames it sees.

A scene costs a fraction of a released one, since nothing is certified: it has no ensemble, twin or ablation. Its label
follows the same rules: the simulator gives the outcome, the occluder must hide it, and a cut comes before it. Only the
frames that the model is shown are drawn, by the benchmark's own renderer at its own size.

Shards are independent, and each has its own stream of random numbers. So several processes can share the work, a
stopped rendering can continue, and the same seed gives the same scenes.
"""

from __future__ import annotations

import hashlib
import importlib
import io
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from tools.pocket.recipe import Recipe, Split
from tools.pocket.shots import Shot, draw_shot, render_decoy, render_shot
from tools.pocket.words import guess, place_question, say
from traps_pipeline.base.digests import canonical_json, digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import replace_file, write_text
from traps_pipeline.base.workers import run_in_order
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.physics.kit import params_to_dict
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.storage.media import pick, resize
from traps_pipeline.video.encode import encode

Record = TypeVar("Record")
SHARD = 50  # scenes
_MAX_DRAWS = 20  # for each scene of a shard
STREAM: dict[Split, int] = {"train": 101, "held-out": 102}  # first word of a stream's seed; released draws have none


@dataclass(frozen=True)
class Question:
    """A question and the answer that the model is trained to give: a label, a guess, or None for an abstention.

    draw: of a question whose label depends on the prompt, a number in [0, 1); under a prompt with a larger share of
    abstentions the label is an abstention, and else `answer`: of a void a guess. hint: a token that training asks for
    behind the question's second and third token too, so that a model learns what decides where that is named.
    """

    question: str
    answer: str | None
    draw: float | None = None
    hint: str | None = None

    def label(self, share: float) -> str | None:
        """Return the answer under a prompt with that share of abstentions."""
        return None if self.draw is not None and self.draw < share else self.answer


@dataclass(frozen=True)
class SceneRecord:
    """A scene of the pocket model's data. params_digest: digest of family and parameters, from `params_digest`.

    cut_frame: number of frames of the void (None for occlusion: as many as the control). asked: the control's question;
    visual: the same question about the void clip; ill_posed: about the control clip; answerable: a question that both
    clips answer. ball: the colour of the ball in the question. places: the ball's place in the `first` frame of the
    control's clip, in the `last` one before an occluder closes it, and in the last one before the cut (`cut`; chaotic),
    as shares of the picture's width and height from its upper left corner. n_frames: of the control, of which its clip
    may be a part. closes_frame: the frame of the control from which on an occluder closes it, and a void that is held
    so long (None: nothing closes it). control_from, control_until: first frame of the control's clip, and the one
    behind its last (None: to the end); void_length: frames of the void's clip, of which those from cut_frame on repeat
    the one before (None: as many as cut_frame says). decoy: whether there is a third clip, the control with an occluder
    that hides nothing, which nothing closes.
    """

    family: str
    params_digest: str
    labels: tuple[str, ...]
    aliases: dict[str, str]
    answer_type: str
    cut_frame: int | None
    asked: Question
    visual: Question
    ill_posed: Question
    answerable: Question
    ball: str
    places: dict[str, tuple[float, float]]
    n_frames: int
    closes_frame: int | None
    control_from: int = 0
    control_until: int | None = None
    void_length: int | None = None
    decoy: bool = False

    def length(self, side: int) -> int:
        """Return the frames of the clip of a side (0 control, 1 void, 2 decoy)."""
        if side == 1 and self.cut_frame is not None:
            return self.void_length or self.cut_frame
        return (self.control_until or self.n_frames) - self.control_from

    @property
    def line(self) -> str:
        """The record as a line of JSON, without what the scene does not have."""
        values = asdict(self)
        unused = {"control_from": 0, "control_until": None, "void_length": None, "decoy": False}
        kept = {name: value for name, value in values.items() if name not in unused or value != unused[name]}
        return canonical_json(kept) + "\n"

    @property
    def texts(self) -> Iterator[str]:
        """All that the scene's questions and answers say."""
        for one in (self.asked, self.visual, self.ill_posed, self.answerable):
            yield one.question
            yield from (say(one.answer, form) for form in ("standard", "json"))
        for axis in (0, 1):
            yield place_question(self.ball, self.places["last"], axis)[0]

    @staticmethod
    def read(line: str) -> SceneRecord:
        """Return a record from its line of JSON."""
        values = json.loads(line)
        for name in ("asked", "visual", "ill_posed", "answerable"):
            values[name] = Question(**values[name])
        places = {name: tuple(place) for name, place in values["places"].items()}
        return SceneRecord(**values | {"labels": tuple(values["labels"]), "places": places})


@dataclass(frozen=True)
class ShardJob:
    """One shard to draw: `count` scenes of a family, in `folder`/<stem>.*; `banned` are digests of released scenes."""

    family: str
    split: Split
    number: int
    count: int
    recipe: Recipe
    folder: Path
    banned: frozenset[str]

    @property
    def lines(self) -> Path:
        """The file of the records; it is written last, so that a shard with records is complete."""
        return self.folder / self.split / self.family / f"{self.number:03d}.jsonl"

    @property
    def drawn(self) -> int:
        """The number of existing scenes. If an earlier recipe had more than `count`, the first `count` are the same."""
        return len(self.lines.read_bytes().splitlines()) if self.lines.is_file() else 0

    @property
    def pixels(self) -> Path:
        """Frames of a training shard, uint8 (count, 2 sides, frames, height, width, 3)."""
        return self.lines.with_suffix(".npy")

    def clip(self, place: int, side: str) -> Path:
        """Return the clip of a held-out scene."""
        return self.lines.parent / "clips" / f"{self.number:03d}-{place:02d}_{side}.mp4"


def params_digest(family: str, params: Any) -> str:
    """Return the digest of a scene's family and parameters, which is equal for equal scenes."""
    return digest({"family": family, "params": json.loads(json.dumps(params))})


@cache
def released_digests() -> frozenset[str]:
    """Return `params_digest` of every released scene and of its twin."""
    from traps_pipeline.benchmark.records import load_released

    specs = load_released().values()
    twins = {params_digest(s.family, s.twin.params) for s in specs if s.twin.params is not None}
    return frozenset({params_digest(s.family, s.params) for s in specs} | twins)


# --- labels -----------------------------------------------------------------------------------------------------------


def _record(shot: Shot, decoy: bool, rng: np.random.Generator) -> SceneRecord:
    """Return the scene's questions with their answers, the truth or of a void a guess, and the number that decides
    under which prompts the label is an abstention instead."""

    def void(question: str, labels: Sequence[str]) -> Question:
        draw = rng.random()
        return Question(question, guess(question, labels, rng), draw)

    def known(question: str, answer: str) -> Question:
        return Question(question, answer, rng.random())

    wording, both = shot.wording, shot.wording.answerable_question
    family, params, closing = shot.control.family, shot.control.params, shot.control.closing
    first, end = shot.control_span
    return SceneRecord(
        family=family.name,
        params_digest=params_digest(family.name, params_to_dict(params)),
        labels=tuple(wording.labels),
        aliases=dict(wording.aliases),
        answer_type=family.answer_type,
        cut_frame=shot.cut_frame,
        asked=known(wording.question, shot.outcome.answer),
        visual=void(wording.question, wording.labels),
        ill_posed=void(shot.ill_posed_question, ()),
        answerable=known(both.question, both.answer),
        ball=params.ball_colours[0] if hasattr(params, "ball_colours") else params.ball_colour,
        places=shot.places,
        n_frames=len(shot.control.qpos),
        closes_frame=None if closing is None else closing.frame,
        control_from=first,
        control_until=end if end < len(shot.control.qpos) else None,
        void_length=shot.void_length,
        decoy=decoy,
    )


# --- shards -----------------------------------------------------------------------------------------------------------


def draw_shard(job: ShardJob) -> int:
    """Draw, render and write one shard; returns the scenes in it. Raises TrapsError when too many draws fail."""
    family = get_family(job.family)
    rng = np.random.default_rng([STREAM[job.split], job.recipe.data_seed, *job.family.encode(), job.number])
    records: list[SceneRecord] = []
    frames: list[np.ndarray] = []
    for _ in range(_MAX_DRAWS * job.count):
        if len(records) == job.count:
            break
        try:
            shot = draw_shot(family, rng, job.recipe.jitter)
            sides = [*render_shot(shot, job.recipe.media)]
            decoy = render_decoy(shot, job.recipe.media) if job.split == "train" else None
        except Rejected:
            continue
        record = _record(shot, decoy is not None, rng)
        if record.params_digest in job.banned:
            continue
        if job.split == "train":
            if shot.control.occluder is not None:
                sides.append(decoy or sides[0])  # an array has one shape; without a decoy its place is never looked at
            frames.append(np.stack([resize(np.stack(side), job.recipe.media.size) for side in sides]))
        else:
            _write_clips(job, record, len(records), sides)
        records.append(record)
    if len(records) < job.count:
        raise TrapsError(f"{job.family}: {len(records)} of {job.count} scenes after {_MAX_DRAWS * job.count} draws")
    return write_shard(job, [record.line for record in records], frames)


def write_shard(job: ShardJob, lines: Sequence[str], frames: Sequence[np.ndarray]) -> int:
    """Write the lines of a shard's scenes and their frames, if there are any; return how many scenes there are."""
    if frames:
        with replace_file(job.pixels) as part, part.open("wb") as stream:
            np.save(stream, np.stack(frames), allow_pickle=False)
    write_text(job.lines, "".join(lines))
    return len(lines)


def _write_clips(job: ShardJob, record: SceneRecord, place: int, sides: Sequence[list[np.ndarray]]) -> None:
    """Write the clips with the benchmark's length, rate, size and codec. Frames that the model is not shown are copies
    of the frame before, which need no drawing."""
    fps = get_family(job.family).physics.fps
    for side, (name, drawn) in enumerate(zip(("control", "void"), sides, strict=True)):
        times = np.arange(record.length(side)) / fps
        latest = np.searchsorted(pick(times, job.recipe.media), np.arange(len(times)), side="right") - 1
        encode([drawn[i] for i in latest], job.clip(place, name), fps)


def kind_of(recipe: Recipe) -> ModuleType:
    """Return the module that draws a recipe's scenes."""
    return importlib.import_module("tools.pocket.lanes" if recipe.two_events else __name__)


def shard_jobs(recipe: Recipe, split: Split, folder: Path) -> list[ShardJob]:
    """Return all shards of a split, in an order that alternates between families."""
    banned = kind_of(recipe).released_digests()
    jobs = []
    for family in recipe.scenes:
        total = recipe.count(family, split)
        for number in range(-(-total // SHARD)):
            count = min(SHARD, total - number * SHARD)
            jobs.append(ShardJob(family, split, number, count, recipe, folder, banned))
    return sorted(jobs, key=lambda job: job.number)  # so that a stopped rendering has scenes of every family


def render(
    recipe: Recipe,
    split: Split,
    folder: Path,
    *,
    workers: int | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> None:
    """Draw the missing scenes of a split, one process per core. The folder keeps its recipe and refuses another."""
    _check_recipe(recipe, folder)
    jobs = shard_jobs(recipe, split, folder)
    todo = [job for job in jobs if job.drawn < job.count]
    scenes, done = sum(job.count for job in jobs), sum(job.count for job in jobs) - sum(job.count for job in todo)
    for _, count in run_in_order(kind_of(recipe).draw_shard, todo, workers):
        done += count
        report(f"{split}: {done} of {scenes} scenes")


def _check_recipe(recipe: Recipe, folder: Path) -> None:
    """Raise TrapsError when the folder holds scenes of another recipe."""
    # The numbers of scenes may change: a shard's first scenes do not depend on how many there are. So may the shares by
    # prompt: a scene keeps the numbers that are compared with them.
    expected = digest(recipe.content("data_seed", "media", "jitter", "decoys", "two_events"))
    note = folder / "recipe.sha256"
    if not note.is_file():
        write_text(note, expected + "\n")
    elif note.read_text(encoding="utf-8").strip() != expected:
        raise TrapsError(f"{folder}: holds scenes of another recipe; give another folder, or delete it")


def read_shards(
    recipe: Recipe, split: Split, folder: Path, read: Callable[[str], Record] = SceneRecord.read
) -> Iterator[tuple[ShardJob, list[Record]]]:
    """Yield every shard of a split with its records, read from lines. Raises TrapsError when scenes are missing."""
    for job in shard_jobs(recipe, split, folder):
        if job.drawn < job.count:
            raise TrapsError(
                f"{job.lines}: has {job.drawn} of {job.count} scenes; run `python -m tools.pocket render "
                f"--data {folder}`"
            )
        lines = job.lines.read_text(encoding="utf-8").splitlines()[: job.count]
        yield job, [read(line) for line in lines]


def data_digest(recipe: Recipe, split: Split, folder: Path) -> str:
    """Return SHA-256 over the digests of all files of a split that training reads, in the order of the shards. For a
    shard with more scenes than in the recipe, the digest is that of files with only the recipe's scenes."""
    hasher = hashlib.sha256()
    for job, _ in read_shards(recipe, split, folder, str):
        for path in (job.lines, job.pixels) if split == "train" else (job.lines,):
            of_file = file_digest(path) if job.drawn == job.count else hashlib.sha256(_first(job, path)).hexdigest()
            hasher.update(of_file.encode())
    return hasher.hexdigest()


def _first(job: ShardJob, path: Path) -> bytes:
    """Return the content that a file of a shard would have if only `count` scenes had been drawn."""
    if path == job.lines:
        return b"".join(path.read_bytes().splitlines(keepends=True)[: job.count])
    stream = io.BytesIO()
    np.save(stream, np.load(path, mmap_mode="r", allow_pickle=False)[: job.count], allow_pickle=False)
    return stream.getvalue()
