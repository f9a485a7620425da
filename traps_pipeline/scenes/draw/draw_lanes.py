"""Draw scenarios of two events: two draws of a family that differ only in shape, place and outcome."""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_text
from traps_pipeline.base.workers import run_in_order
from traps_pipeline.protocol.datasets import EXTENSION_CATEGORIES
from traps_pipeline.protocol.two_events import LANES
from traps_pipeline.scenes.certification.certify_lanes import certify_lanes, pixels_of
from traps_pipeline.scenes.draw.resolve import json_values
from traps_pipeline.scenes.family_registry import families, get_family
from traps_pipeline.scenes.parts.difficulty import DEFAULT_DIFFICULTY, Difficulty, SceneDifficulty, draw_distractors
from traps_pipeline.scenes.parts.look import Look, draw_look
from traps_pipeline.scenes.physics.kit import COLOURS, LOOK_ALIKE, Family, Physics, Wording, params_to_dict, uniform
from traps_pipeline.scenes.worlds.lane_event import LaneEvent
from traps_pipeline.scenes.worlds.lane_layout import Lane, fit_lanes
from traps_pipeline.scenes.worlds.lane_records import LaneRecord, LaneTwin, TwoEventsSpec
from traps_pipeline.scenes.worlds.lanes import TwoLanes
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.scenes.worlds.spec import physics_record, save_trajectory, trajectory_digest
from traps_pipeline.scenes.worlds.timetable import MOVES_FRAMES, WINDOW_S, Timetable

STRIPS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")
LOOKS = ("pale-floor", "light")  # parts of the look that vary
SETTLES_S = (0.5, 3.6)  # when the worlds of a lane settle
ELEVATION_DEG = (-40.0, -22.0)  # of the camera: a bench below the scene needs it to look down
SIZES = (0.6, 1.6)  # of doubles
ALIKE = (0.8, 1.25)  # the same, as a share of the size at which they have as many pixels as the things
BOARDS = (1.0, 1.2)  # widths of boards, as a share of the least
SETS_OUT_S = (0.0, 2.5)
STANDS_FRAMES = (5, 18)  # how long a board stands that comes and goes, at a time
TURNS = 8  # scenarios of a family in which both answers have their turns
TIMETABLES = 400  # draws of a timetable before a scenario is given up
EVENTS, TRIES = 30, 60  # draws of a lane's event before a scenario is given up; of scenarios
LEFT_OUT: Mapping[str, str] = dict.fromkeys(
    ("hidden_race", "ramp_race"), "it asks which came first, which no settled outcome shows"
)


def lane_families() -> list[str]:
    """Return the names of the families that have scenarios of two events."""
    occlusion = [family for family in families() if family.taxonomy == "occlusion"]
    return [
        family.name
        for family in occlusion
        if family.category not in EXTENSION_CATEGORIES and family.name not in LEFT_OUT
    ]


@dataclass(frozen=True)
class DrawnLanes:
    """A record of two events, and the trajectories by name: of its world, and of those where one lane differs."""

    spec: TwoEventsSpec
    worlds: Mapping[str, np.ndarray]


def draw_two_events(
    family_name: str, number: int, seed: int, difficulty: Difficulty = DEFAULT_DIFFICULTY
) -> Iterator[DrawnLanes | Rejected]:
    """Yield why draws are rejected, and at last the scenario, if there is one."""
    for attempt in range(TRIES):
        rng = np.random.default_rng([seed, *family_name.encode(), number, attempt])
        try:
            yield _scenario(get_family(family_name), number, rng, seed, difficulty)
        except Rejected as failure:
            yield failure
        else:
            return


def _scenario(family: Family, number: int, rng: np.random.Generator, seed: int, difficulty: Difficulty) -> DrawnLanes:
    (world, *twins), wording = draw_worlds(family, number, rng, seed, difficulty)
    if difficulty.window_s < WINDOW_S:  # the same scene, so that levels may be compared
        window_rng = np.random.default_rng([seed, *family.name.encode(), number, *b"window"])
        settled = [max(each.outcome(k).commit_frame for each in (world, twin)) for k, twin in enumerate(twins)]
        how = world.physics, difficulty.window_s, window_rng
        lanes = [narrowed(lane, at, *how) for lane, at in zip(world.lanes, settled, strict=True)]
        world, *twins = (replace(each, lanes=lanes) for each in (world, *twins))
    evidence = certify_lanes(world, twins)
    records = [
        LaneRecord(
            params=json_values(params_to_dict(world.events[k].params)),
            lane=lane,
            layout=world.layouts[k],
            ground_truth=world.outcome(k).answer,
            twin=LaneTwin(
                params=json_values(params_to_dict(twins[k].events[k].params)),
                ground_truth=twins[k].outcome(k).answer,
                trajectory_sha256=trajectory_digest(twins[k].qpos),
            ),
        )
        for k, lane in enumerate(world.lanes)
    ]
    spec = TwoEventsSpec(
        scenario_id=_id(family.name, number),
        category=family.category,
        family=family.name,
        seed=seed,
        physics=physics_record(world.physics),
        camera=json_values(asdict(world.camera)),
        look=json_values(asdict(world.look)),
        lanes=(records[0], records[1]),
        question=wording.question,
        labels=list(wording.labels),
        aliases=dict(wording.aliases),
        answer_type=family.answer_type,
        trajectory_sha256=trajectory_digest(world.qpos),
        evidence=json_values(evidence),
    )
    return DrawnLanes(spec, {"qpos": world.qpos, "left": twins[0].qpos, "right": twins[1].qpos})


def draw_worlds(
    family: Family,
    number: int,
    rng: np.random.Generator,
    seed: int,
    difficulty: Difficulty = DEFAULT_DIFFICULTY,
    *,
    is_alike: bool = True,
) -> tuple[tuple[TwoLanes, TwoLanes, TwoLanes], Wording]:
    """Return a world of two lanes, those where one lane has its twin, and the words for both. Raises Rejected.

    Nothing is certified. is_alike: doubles have about as many pixels as the things, which are drawn for it.
    """
    first = _event(family, rng, None, difficulty)
    pairs = [first, _event(family, rng, first[0].params, difficulty)][:: 1 if rng.integers(2) else -1]
    wording, look = _wording(pairs, int(rng.integers(2**31))), draw_look(rng, LOOKS)
    for k, pair in enumerate(pairs):  # which of its two worlds a lane shows is no matter of chance
        one, other = (wording.labels.index(event.outcome.answer) for event in pair)
        if (one < other) != is_turn_of_earlier(family.name, number, k, seed):
            pairs[k] = pair[1], pair[0]
    assert look is not None
    if difficulty.distractors:
        pairs = [_with_distractors(pair, wording, difficulty, rng) for pair in pairs]
    above = [bool(number & 1), bool((number + 1 ^ number >> 1) & 1)]  # each arrangement once in four scenarios
    strips = _strips(wording, pairs, rng)
    lanes = [_lane(pair, strip, up, rng) for pair, strip, up in zip(pairs, strips, above, strict=True)]
    sizes = _sizes(_worlds(lanes, pairs, look)) if is_alike else [uniform(rng, *SIZES) for _ in LANES]
    lanes = [replace(lane, size=size * uniform(rng, *ALIKE)) for lane, size in zip(lanes, sizes, strict=True)]
    lanes = [replace(lane, size=round(float(np.clip(lane.size, *SIZES)), 3)) for lane in lanes]
    return _worlds(lanes, pairs, look), wording


Pair = tuple[LaneEvent, LaneEvent]  # a lane's event and its twin
Pairs = Sequence[Pair]


def _worlds(lanes: Sequence[Lane], pairs: Pairs, look: Look) -> tuple[TwoLanes, TwoLanes, TwoLanes]:
    """Return the world, and those with the twin in the left and in the right lane."""
    camera, layouts = fit_lanes(lanes, pairs)
    world = TwoLanes(lanes, [event for event, _ in pairs], camera, layouts, look)
    return world, world.with_event(0, pairs[0][1]), world.with_event(1, pairs[1][1])


def _sizes(worlds: Sequence[TwoLanes]) -> list[float]:
    """Return for each lane the size at which doubles have as many pixels as the things have in the end.

    That is a mean of both worlds, so that it tells nothing of the outcome.
    """
    world, *twins = worlds
    sizes = []
    for k, lane in enumerate(world.lanes):
        settled = max(each.outcome(k).commit_frame for each in (world, twins[k]))
        last = lane.timetable.window(settled, len(world.qpos))[1] - 1
        wanted = [pixels_of(each, "neither", each.decisive(k), [last]).sum() for each in (world, twins[k])]
        shown = pixels_of(world, "both", world.doubles(k), [last]).sum()
        sizes.append(float(np.sqrt(np.mean(wanted) / max(float(shown), 1.0))))
    return sizes


def _event(family: Family, rng: np.random.Generator, like: Any, difficulty: Difficulty) -> Pair:
    """Return an event and its twin; like: the other lane's parameters, whose colours and view it takes."""
    assert family.twins is not None, f"{family.name}: an occlusion family needs twins"
    physics = replace(family.physics, speed=difficulty.speed)
    for _ in range(EVENTS):
        params = replace(family.draw(rng, difficulty.longer), azimuth_deg=90.0)
        view = float(np.clip(params.elevation_deg, *ELEVATION_DEG)) if like is None else like.elevation_deg
        params = replace(params, elevation_deg=view)
        if like is not None:
            alike = {m.name: value for m in fields(like) if _is_colour(value := getattr(like, m.name))}
            params = replace(params, **alike)
        if difficulty.longer:
            params = replace(params, difficulty=SceneDifficulty(longer=True))
        event, *twins = (LaneEvent(family, p, physics) for p in (params, *family.twins(params)))
        try:
            others = [twin for twin in twins if _settles(event) and _settles(twin)]
            others = [twin for twin in others if twin.outcome.label != event.outcome.label]
        except Rejected:
            continue
        if others:
            return event, others[int(rng.integers(len(others)))]
    raise Rejected("no draw settles in time, with a twin that ends otherwise")


def _with_distractors(pair: Pair, wording: Wording, difficulty: Difficulty, rng: np.random.Generator) -> Pair:
    """Return an event and its twin with the same distractors."""
    event, points = pair[0], np.concatenate([each.points for each in pair])
    duration_s = event.physics.duration_s * event.physics.speed
    things = draw_distractors(rng, difficulty.distractors, event.scene, points, wording, event.params, duration_s)
    added = SceneDifficulty(things, difficulty.longer)
    one, other = (replace(each, params=replace(each.params, difficulty=added)) for each in pair)
    return one, other


def is_turn_of_earlier(family: str, number: int, lane: int, seed: int) -> bool:
    """Return whether a lane must end in the earlier of its two answers, as half of every eight scenarios do."""
    block, place = divmod(number - 1, TURNS)
    turns = np.random.default_rng([seed, *family.encode(), block, TURNS]).permutation(len(LANES) * TURNS) % 2
    return bool(turns[len(LANES) * place + lane])


def _settles(event: LaneEvent) -> bool:
    early, late = (round(second * event.physics.fps) for second in SETTLES_S)
    return event.outcome.label is not None and early <= event.outcome.commit_frame <= late


def _is_colour(value: Any) -> bool:
    values = value if isinstance(value, tuple) else (value,)
    return bool(values) and all(isinstance(name, str) and name in COLOURS for name in values)


def _wording(pairs: Pairs, seed: int) -> Wording:
    """Return the words that both lanes' scenes have in common."""
    one, *others = (each.family.word(each.params, np.random.default_rng(seed)) for pair in pairs for each in pair)
    if any((one.question, one.labels, one.aliases) != (each.question, each.labels, each.aliases) for each in others):
        raise Rejected("the lanes have no question in common")
    return one


def _strips(wording: Wording, pairs: Pairs, rng: np.random.Generator) -> list[str]:
    """Return two colours of strips that no thing has, or, where there are too few, that the question does not name."""
    named = {name for name in STRIPS if name in wording.question.lower().replace(",", " ").replace("?", " ").split()}
    in_view = {colour for event, _ in pairs for colour in event.scene.inventory.colours}
    for avoided in (in_view | named, named):
        free = [str(name) for name in rng.permutation([name for name in STRIPS if name not in avoided])]
        if two := [[a, b] for a in free for b in free if a != b and {a, b} not in LOOK_ALIKE]:
            return two[0]
    raise Rejected("no two colours are left for the strips")


def _lane(pair: tuple[LaneEvent, LaneEvent], strip: str, bench_above: bool, rng: np.random.Generator) -> Lane:
    physics, settled = pair[0].physics, max(event.outcome.commit_frame for event in pair)
    timetable = draw_timetable(rng, settled, physics.n_frames, physics.fps)
    if timetable is None:
        raise Rejected("no timetable shows the settled outcome")
    at, rests, out, mirrored = uniform(rng, 0, 1), uniform(rng, 0, 1), uniform(rng, *SETS_OUT_S), bool(rng.integers(2))
    boards = uniform(rng, *BOARDS), uniform(rng, *BOARDS)
    return Lane(strip, bench_above, at, mirrored, rests, out, 1.0, boards, timetable)


def narrowed(lane: Lane, settled: int, physics: Physics, window_s: float, rng: np.random.Generator) -> Lane:
    """Return a lane whose board is away for a window alone, at any time after the outcome has settled."""
    frames = round(window_s * physics.fps)
    first = int(rng.integers(settled, physics.n_frames - frames + 1))
    return replace(lane, timetable=Timetable.of_window(first, frames, physics.n_frames), window_s=window_s)


def draw_timetable(rng: np.random.Generator, settled: int, n_frames: int, fps: int) -> Timetable | None:
    """Return a random timetable of a board that shows what has settled by a frame; None if none was found.

    In a half of them each the board stands in the first frame, and in the last; and it comes or goes at least once.
    """
    for _ in range(TIMETABLES):
        first, middle, last = (bool(rng.integers(2)) for _ in range(3))
        lengths = [int(rng.integers(STANDS_FRAMES[0], STANDS_FRAMES[1] + 1)) for _ in range(3)]
        spans = [(0, lengths[0])] if first else []
        if middle:
            start = int(rng.integers(MOVES_FRAMES + 1, n_frames - lengths[1] - MOVES_FRAMES))
            spans.append((start, start + lengths[1]))
        spans += [(n_frames - lengths[2], n_frames)] if last else []
        is_apart = all(b[0] - a[1] >= 2 * MOVES_FRAMES for a, b in pairwise(spans))
        timetable = Timetable(tuple(spans))
        if spans and is_apart and timetable.shows(settled, n_frames, fps):
            return timetable
    return None


def sample_two_events(
    names: Iterable[str],
    count: int,
    seed: int,
    released: Path,
    difficulty: Difficulty = DEFAULT_DIFFICULTY,
    *,
    workers: int | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> int:
    """Draw `count` scenarios of each family into `released`; return how many there are.

    Each is written at once, and stays where it was drawn from the same seed and settings: a stopped call goes on.
    report: gets a line for each scenario. Raises TrapsError for a place that no draw fills.
    """
    existing = {name: _drawn_before(released / f"{name}.jsonl", seed, difficulty) for name in names}
    places = [(name, k) for name, lines in existing.items() for k in range(1, count + 1) if _id(name, k) not in lines]
    jobs = [(*place, seed, difficulty) for place in places]
    for (name, number, *_), (drawn, rejected) in run_in_order(_draw, jobs, workers):
        reasons = ", ".join(f"{n} x {reason}" for reason, n in Counter(rejected).most_common())
        if drawn is None:
            raise TrapsError(f"{_id(name, number)}: no draw of {TRIES} makes a scenario ({reasons}); take another seed")
        save_trajectory(released / "trajectories", drawn.spec.scenario_id, drawn.worlds)
        lines = existing[name]
        lines[drawn.spec.scenario_id] = drawn.spec.model_dump_json()
        write_text(released / f"{name}.jsonl", "".join(f"{lines[id_]}\n" for id_ in sorted(lines)))
        report(f"{drawn.spec.scenario_id}: drawn; rejected before: {reasons or 'none'}")
    return sum(map(len, existing.values()))


def _drawn_before(path: Path, seed: int, difficulty: Difficulty) -> dict[str, str]:
    """Return lines of records of a seed and its settings by id; a file of another seed counts as none."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    records = [(line, json.loads(line)) for line in lines]
    drawn_as = (seed, difficulty)
    return {each["scenario_id"]: line for line, each in records if (each["seed"], difficulty_of(each)) == drawn_as}


def difficulty_of(record: Mapping[str, Any]) -> Difficulty:
    """Return the settings with which a record was drawn."""
    drawn = record["lanes"][0]["params"].get("difficulty") or {}
    speed = record["physics"].get("speed", DEFAULT_DIFFICULTY.speed)
    window_s = record["lanes"][0]["lane"].get("window_s", DEFAULT_DIFFICULTY.window_s)
    return Difficulty(len(drawn.get("distractors", ())), speed, drawn.get("longer", False), window_s)


def _id(family: str, number: int) -> str:
    return f"{family}-e{number:03d}"


def _draw(job: tuple[str, int, int, Difficulty]) -> tuple[DrawnLanes | None, list[str]]:
    """Return a scenario, if there is one, and why earlier draws are rejected."""
    *rejected, last = draw_two_events(*job)
    return (last, [*map(str, rejected)]) if isinstance(last, DrawnLanes) else (None, [*map(str, rejected), str(last)])
