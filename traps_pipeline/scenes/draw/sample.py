"""Sample a family's scenarios into records until its quotas are full.

Draws are numbered and independent, so they run on all cores; acceptance goes through them in order, so that the same
seed gives the same scenarios. Every accepted scenario is written at once: a sampling that was stopped goes on.
"""

import json
import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_text
from traps_pipeline.base.workers import run_in_order
from traps_pipeline.scenes.certification.certificates import settled_outcome
from traps_pipeline.scenes.draw.likeness import excess_lookalike, frame_hash
from traps_pipeline.scenes.draw.resolve import Resolved, resolve
from traps_pipeline.scenes.family_registry import family_digest, family_names, fit_to_sample, get_family
from traps_pipeline.scenes.parts.difficulty import (
    DEFAULT_DIFFICULTY,
    Difficulty,
    SceneDifficulty,
    draw_distractors,
    unsupported_settings,
)
from traps_pipeline.scenes.parts.look import look_of_draw
from traps_pipeline.scenes.parts.wording import draw_ill_posed
from traps_pipeline.scenes.physics.kit import Family, Physics, Scene, Wording
from traps_pipeline.scenes.physics.simulate import replay
from traps_pipeline.scenes.worlds.outcome import Rejected, compile_scene, simulated
from traps_pipeline.scenes.worlds.pace import LATEST_SHARE, out_of_pace, settles_share
from traps_pipeline.scenes.worlds.shot import shown_points
from traps_pipeline.scenes.worlds.spec import SceneSpec, load_trajectory, save_trajectory

MAX_DRAWS = 40  # for each scenario wanted; a family that needs more is not worth its time
DRAWS = "draws.json"  # beside the records: how each family was drawn
_MEASURED = re.compile(r"\d[\d.]*|'\w+'(?=\s)")  # numbers and answers in a reason, which differ from draw to draw
_WORDED_DRAWS = 128  # questions by which the share of an answer is known
_NO_QUESTION = "?"  # stands for the ill-posed question until the scenario has its place


@dataclass
class Tally:
    """The numbers of a family's draws. file: digest of its file, empty in old notes."""

    seed: int
    wanted: int
    draws: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    file: str = ""
    look: list[str] = field(default_factory=list)
    difficulty: Difficulty = DEFAULT_DIFFICULTY


def load_tallies(released: Path) -> dict[str, Tally]:
    """Return each family's tally of draws, from `draws.json` beside the records."""
    path = released / DRAWS
    if not path.is_file():
        return {}
    notes = json.loads(path.read_text(encoding="utf-8"))
    return {
        name: Tally(
            **note | {"rejected": Counter(note["rejected"]), "difficulty": Difficulty(**note.get("difficulty", {}))}
        )
        for name, note in notes.items()
    }


def require_difficulty(names: Iterable[str], difficulty: Difficulty) -> None:
    """Raise TrapsError naming families that cannot be drawn with the settings."""
    unsupported = {name: unsupported_settings(get_family(name), difficulty) for name in names}
    unsupported = {name: settings for name, settings in unsupported.items() if settings}
    if unsupported:
        advice = "; ".join(f"{name}: no --{', no --'.join(settings)}" for name, settings in sorted(unsupported.items()))
        supporting = [name for name in family_names() if not unsupported_settings(get_family(name), difficulty)]
        raise TrapsError(
            f"some families cannot be drawn like this ({advice}): name others with --families: {', '.join(supporting)}"
        )


def answer_quota(count: int, n_labels: float) -> int:
    """Return the maximum count of one answer among `count` scenarios of a family.

    Under ten: once more than the even split, rounded up. Else 60 % of two answers, 1.5 times the fair share of more.
    """
    if count < 10:
        return math.ceil(count / n_labels) + 1
    return math.floor(count * (0.6 if n_labels == 2 else 1.5 / n_labels))


def ill_posed_quota(taxonomy: str, count: int) -> int:
    """Return the maximum count of an ill-posed text: 1, or 5 % (chaotic)."""
    return 1 if taxonomy == "occlusion" else max(1, count // 20)


@dataclass(frozen=True)
class Draw:
    """One numbered draw of a family. closed: answers that have their quota, which are not resolved."""

    family: str
    seed: int
    number: int
    closed: frozenset[str]
    look: tuple[str, ...] = ()
    difficulty: Difficulty = DEFAULT_DIFFICULTY


def sample_family(
    name: str,
    count: int,
    seed: int,
    released: Path,
    *,
    look: Collection[str] = (),
    difficulty: Difficulty = DEFAULT_DIFFICULTY,
    workers: int | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> Tally:
    """Draw until `released` holds `count` scenarios of a family.

    The same seed gives the same ones on a machine type. A stopped call goes on at the same seed and count, and fills
    the places of records that `tools.redraw.take_out` took out; anything else of the family is replaced, as are records
    of another version of its file.

    look: parts of the look (`look.PARTS`) that vary besides those that always do in the family. difficulty: of every
    scene. report: gets a line for each record and for the first rejection of each kind. Raises TrapsError for a family
    that is unfit or cannot be drawn with the difficulty and, with the tally of rejections, when 40 draws a scenario are
    not enough.
    """
    family, records = fit_to_sample(name), Records(released, name)
    require_difficulty([name], difficulty)
    tally, file, parts = load_tallies(released).get(name), family_digest(name), sorted({*family.looks, *look})
    if tally is not None and (tally.seed, tally.wanted) == (seed, count) and tally.file not in ("", file):
        report(f"{name}: its file was changed since its scenarios were drawn; all are drawn again")
        tally = None
    drawn_as = (seed, count, parts, difficulty)
    if tally is None or (tally.seed, tally.wanted, tally.look, tally.difficulty) != drawn_as:
        tally = Tally(seed, count, file=file, look=parts, difficulty=difficulty)
        records.clear()
    specs = records.read(tally)
    answers = Counter(spec.ground_truth for spec in specs)
    texts = Counter(spec.ill_posed_question for spec in specs)
    hashes = {} if len(specs) == count else {spec.scenario_id: frame_hash(spec, records.qpos(spec)) for spec in specs}
    taken_numbers = {int(spec.scenario_id.rpartition("-")[2]) for spec in specs}
    places = [place for place in range(1, count + 1) if place not in taken_numbers]
    if not places:
        return tally

    def full_answers() -> frozenset[str]:
        return _full_answers(answers, count, family, difficulty.longer)

    def jobs() -> Iterator[Draw]:
        for number in range(tally.draws, MAX_DRAWS * count):
            yield Draw(name, seed, number, full_answers(), tuple(parts), difficulty)

    reported_kinds: set[str] = set()  # kinds of rejections that the report has
    # A draw takes seconds, and those that were begun are waited for: no more than could all be wanted.
    results = run_in_order(try_draw, jobs(), workers, ahead=len(places))
    try:
        for draw, result in results:
            tally.draws += 1
            if isinstance(result, Resolved) and result.spec.ground_truth in full_answers():
                result = f"answer {result.spec.ground_truth!r} has its quota"
            picture_hash = frame_hash(result.spec, result.qpos) if isinstance(result, Resolved) else 0
            if isinstance(result, Resolved) and (lookalike := excess_lookalike(hashes, picture_hash, count)):
                result = f"its first frame looks like that of another: {lookalike}"
            if isinstance(result, str):
                tally.rejected[result.split(":")[0]] += 1
                if rejection_kind(result) not in reported_kinds:  # so that a family that never passes says why at once
                    reported_kinds.add(rejection_kind(result))
                    report(f"{name}: draw {draw.number + 1} is rejected: {result}")
                continue
            placed_draw = _with_id(family, result, draw, places.pop(0), texts, count)
            hashes[placed_draw.spec.scenario_id] = picture_hash
            answers[placed_draw.spec.ground_truth] += 1
            texts[placed_draw.spec.ill_posed_question] += 1
            records.append(placed_draw, tally)
            report(f"{placed_draw.spec.scenario_id}: {placed_draw.spec.ground_truth} after {tally.draws} draws")
            if not places:
                records.sort()
                return tally
    finally:
        results.close()  # type: ignore[attr-defined]
    reasons = ", ".join(f"{n} x {reason}" for reason, n in tally.rejected.most_common())
    raise TrapsError(
        f"{name}: {answers.total()} of {count} after {tally.draws} draws; widen the ranges behind what was rejected: "
        f"{reasons}"
    )


def rejection_kind(reason: str) -> str:
    """Return a rejection's reason without numbers or details, so that like ones are counted together."""
    return _MEASURED.sub("", reason.split(":")[0])


class Records:
    """The released files of a family, except its entry in `draws.json`."""

    def __init__(self, released: Path, family: str) -> None:
        self._released, self._family = released, family
        self._lines = released / f"{family}.jsonl"

    def clear(self) -> None:
        """Remove all files of the family."""
        self._lines.unlink(missing_ok=True)
        for trajectory in (self._released / "trajectories").glob(f"{self._family}-*.npz"):
            trajectory.unlink()

    def read(self, tally: Tally) -> list[SceneSpec]:
        """Return the records of the draws counted so far; drop a record written after a crash."""
        if not self._lines.is_file():
            return []
        specs = []
        for line in self._lines.read_text(encoding="utf-8").splitlines():
            try:
                specs.append(SceneSpec.model_validate(json.loads(line)))
            except ValueError:  # a line that a kill tore
                break
        known_specs = [spec for spec in specs if spec.seed < tally.draws]
        write_text(self._lines, "".join(record_line(spec) for spec in known_specs))
        return known_specs

    def qpos(self, spec: SceneSpec) -> np.ndarray:
        """Return the trajectory of a record."""
        return load_trajectory(self._released / "trajectories" / f"{spec.scenario_id}.npz", spec.trajectory_sha256)

    def sort(self) -> None:
        """Sort the records by id: those that fill a place were added last."""
        lines = self._lines.read_text(encoding="utf-8").splitlines()
        lines.sort(key=lambda line: json.loads(line)["scenario_id"])
        write_text(self._lines, "".join(f"{line}\n" for line in lines))

    def append(self, resolved: Resolved, tally: Tally) -> None:
        """Append a scenario and note the number of draws."""
        save_trajectory(self._released / "trajectories", resolved.spec.scenario_id, resolved.worlds)
        with self._lines.open("a", encoding="utf-8") as lines:
            lines.write(record_line(resolved.spec))
        save_tallies(self._released, load_tallies(self._released) | {self._family: tally})


def save_tallies(released: Path, tallies: Mapping[str, Tally]) -> None:
    """Write `draws.json`: how often each family was drawn and why draws were rejected."""
    notes = dict[str, dict[str, Any]]()
    for name, tally in tallies.items():
        notes[name] = {**vars(tally), "rejected": dict(tally.rejected), "difficulty": tally.difficulty.settings()}
        if tally.difficulty == DEFAULT_DIFFICULTY:
            del notes[name]["difficulty"]
    write_text(released / DRAWS, json.dumps(notes, indent=1, sort_keys=True) + "\n")


def record_line(spec: SceneSpec) -> str:
    """Return a record as a line of its file."""
    return json.dumps(spec.model_dump(mode="json"), ensure_ascii=False) + "\n"


def _full_answers(answers: Counter[str], count: int, family: Family, longer: bool = False) -> frozenset[str]:
    choices = _mean_choices(family, longer)
    return frozenset(answer for answer, n in answers.items() if n >= answer_quota(count, choices[answer]))


@cache
def _mean_choices(family: Family, longer: bool = False) -> Mapping[str, float]:
    """Return how many choices each answer competes with, on average over many draws."""
    rng = np.random.default_rng(0)
    choices_by_draw = [family.word(family.draw(rng, longer), rng).labels for _ in range(_WORDED_DRAWS)]
    shares = defaultdict[str, float](float)
    for labels in choices_by_draw:
        for label in labels:
            shares[label] += 1 / len(labels) / len(choices_by_draw)
    n_choices = float(len(choices_by_draw))  # an answer that none of them offers
    return defaultdict(lambda: n_choices, {label: 1 / share for label, share in shares.items()})


def try_draw(draw: Draw) -> Resolved | str:
    """Return the resolved scenario of a draw, or in words why it is rejected."""
    try:
        drawn_scene = scene_of_draw(draw)
        return resolve(
            get_family(draw.family),
            drawn_scene.params,
            drawn_scene.wording,
            _NO_QUESTION,
            scenario_id=f"{draw.family}-0000",
            seed=draw.number,
            physics=drawn_scene.physics,
        )
    except Rejected as rejected:
        return str(rejected)


@dataclass(frozen=True)
class DrawnScene:
    """The scene of a draw before any pixel is examined."""

    params: Any
    wording: Wording
    physics: Physics


def scene_of_draw(draw: Draw) -> DrawnScene:
    """Return the scene that a numbered draw makes.

    Raises Rejected if the quota of its answer is full, or the answer cannot be certified.
    """
    family = get_family(draw.family)
    rng = np.random.default_rng([draw.seed, *draw.family.encode(), draw.number])
    params = family.draw(rng, draw.difficulty.longer)
    wording = family.word(params, rng)
    params = replace(params, look=look_of_draw(draw.seed, draw.family, draw.number, draw.look))
    physics = replace(family.physics, speed=draw.difficulty.speed)
    if draw.difficulty.longer:
        params = replace(params, difficulty=SceneDifficulty(longer=True))
    answer, scene, points = simulated_scene(family, params, physics)
    if answer in draw.closed:
        raise Rejected(f"answer {answer!r} has its quota")
    if draw.difficulty.distractors:
        distractor_rng = np.random.default_rng([draw.seed, *draw.family.encode(), draw.number, *b"distractors"])
        duration_s = physics.duration_s * physics.speed
        distractors = draw_distractors(
            distractor_rng, draw.difficulty.distractors, scene, points, wording, params, duration_s
        )
        params = replace(params, difficulty=SceneDifficulty(distractors, draw.difficulty.longer))
    return DrawnScene(params, wording, physics)


def _with_id(family: Family, resolved: Resolved, draw: Draw, place: int, texts: Counter[str], count: int) -> Resolved:
    """Return the scenario with its id and an ill-posed question within its quota."""
    spec = resolved.spec.model_copy(update={"scenario_id": f"{family.name}-{place:04d}"})
    question = ill_posed_for(spec, draw.seed, texts, count)
    return Resolved(spec.model_copy(update={"ill_posed_question": question}), resolved.qpos, resolved.twin)


def ill_posed_for(spec: SceneSpec, seed: int, texts: Counter[str], count: int) -> str:
    """Return an ill-posed question for a record, drawn by its id.

    seed: its family's. texts: questions of its family's `count` records. Raises ValueError when all are taken.
    """
    family = get_family(spec.family)
    inventory = family.build(family.params_from(spec.params), family.physics).inventory
    quota, place = ill_posed_quota(spec.taxonomy, count), int(spec.scenario_id.rpartition("-")[2])
    rng = np.random.default_rng([seed, *spec.family.encode(), spec.seed, place])
    return draw_ill_posed(spec.taxonomy, inventory, rng, lambda text: texts[text] < quota)


def simulated_answer(family: Family, params: Any) -> str:
    """Return the answer that a draw's control shows."""
    return simulated_scene(family, params, family.physics)[0]


def simulated_scene(family: Family, params: Any, physics: Physics) -> tuple[str, Scene, np.ndarray]:
    """Return the answer, the scene and the points to frame of a draw's simulated control.

    It takes a second, so it comes before the certificates. The points, (N, 3), surround everything that is shown or
    covered. Raises Rejected if the outcome is undecided or settles too late.
    """
    model, scene = compile_scene(family, params, physics)
    qpos = simulated(model, scene, physics)
    outcome = settled_outcome(family, replay(model, qpos, physics), params)
    settled_at = settles_share(outcome.commit_frame, len(qpos))
    if settled_at > LATEST_SHARE:  # where it settles too early the clip will end earlier
        raise Rejected(str(out_of_pace(settled_at)))
    cover_corners = () if scene.cover is None else (scene.cover.corners(),)
    return outcome.answer, scene, np.concatenate([shown_points(model, scene, qpos), *cover_corners])
