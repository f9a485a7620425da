"""How hard two events can be made: how often lanes are read by what they show, and by the settings of a draw.

The *tracker* is told the exact place of everything that moves in each frame that it is shown and no board stands before
the scene, and its colour up to those easily taken for each other, but neither shape nor name. It takes a thing to be
the nearest one of its colour in the picture, from frame to frame, and reads the outcome of what it follows as the
record does. First it follows the released lanes, as they are and with other timetables: the board stands but for a
window of some length, at any time after the outcome settled. `--records` names others, such as those of the hard level;
with `--film` the *observer* reads 25 frames of them by classical vision, too. With `--levels` scenarios are drawn,
certified, filmed and read as `traps benchmark sample --two-events` does with settings, by default of all families that
take twice the speed.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

os.environ.setdefault("MUJOCO_GL", "osmesa")

import mujoco
import numpy as np

from bench.quick import parse
from traps_pipeline.base.paths import TWO_EVENTS_RELEASED
from traps_pipeline.base.workers import run_in_order
from traps_pipeline.benchmark.filmed_lanes import trajectories_of
from traps_pipeline.benchmark.records import two_events_lines
from traps_pipeline.protocol.two_events import CLIPS, LANES
from traps_pipeline.scenes.draw.draw_lanes import DrawnLanes, draw_two_events, lane_families
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.observe import observe
from traps_pipeline.scenes.parts.difficulty import DISTRACTOR, Difficulty, unsupported_settings
from traps_pipeline.scenes.parts.wording import lane_question
from traps_pipeline.scenes.physics.kit import COLOURS, LOOK_ALIKE, Motion
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.lane_records import TwoEventsSpec
from traps_pipeline.scenes.worlds.lanes import TwoLanes
from traps_pipeline.scenes.worlds.outcome import decisive_geoms, read_outcome
from traps_pipeline.scenes.worlds.timetable import Timetable
from traps_pipeline.video.encode import encode

LEVELS: Mapping[str, Difficulty] = {
    "usual": Difficulty(),
    "distractors": Difficulty(distractors=3),
    "speed": Difficulty(speed=2.0),
    "both": Difficulty(distractors=3, speed=2.0),
    "longer": Difficulty(longer=True),
    "all": Difficulty(distractors=3, speed=2.0, longer=True),
    "hard": Difficulty(window_s=0.2),
}
RATES = (10, 5, 2, 1)  # frames a second that the tracker is shown
WINDOWS_S = (1.0, 0.5, 0.3, 0.2)


@dataclass(frozen=True)
class Read:
    """Answers about one lane. tracker: at each of RATES."""

    truth: str | None
    tracker: tuple[str | None, ...]
    observer: str | None = None
    is_filmed: bool = False


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--families", nargs="+", default=fast_families(), help="default: that take twice the speed")
    parser.add_argument("--levels", nargs="*", choices=LEVELS, default=[])
    parser.add_argument("--records", type=Path, default=TWO_EVENTS_RELEASED)
    parser.add_argument("--film", action="store_true", help="let the observer read the records, too")
    parser.add_argument("--count", type=int, default=2, help="scenarios of each family and level")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    arguments = parse(parser, families=["chain"], levels=["usual", "all"], count=1)
    print(f"{'level':12} family              lanes  {' '.join(f'{rate:3d}/s' for rate in RATES)}  observer")
    print_windows([line.spec for line in two_events_lines(arguments.records).values()], arguments)
    for level in arguments.levels:
        of_scene = replace(LEVELS[level], window_s=LEVELS["usual"].window_s)
        admitted = [name for name in arguments.families if not unsupported_settings(get_family(name), of_scene)]
        jobs = [(level, name, number, arguments.seed) for name in admitted for number in range(1, arguments.count + 1)]
        reads = list[Read]()
        for (_, family, *_), lanes in run_in_order(read_lanes, jobs, arguments.workers):
            reads += lanes
            print_row(level, family, lanes)
        print_row(level, "all", reads)


def fast_families() -> list[str]:
    return [name for name in lane_families() if not unsupported_settings(get_family(name), LEVELS["both"])]


def print_row(level: str, family: str, reads: Sequence[Read]) -> None:
    if not reads:
        print(f"{level:12} {family:18} no draw passes", flush=True)
        return
    right = [np.mean([one.tracker[i] == one.truth for one in reads]) for i in range(len(RATES))]
    seen = [one.observer == one.truth for one in reads if one.is_filmed]
    tracker, observer = " ".join(f"{share:5.2f}" for share in right), f"{np.mean(seen):8.2f}" if seen else "       -"
    print(f"{level:12} {family:18} {len(reads):5d}  {tracker}  {observer}", flush=True)


def print_windows(specs: Sequence[TwoEventsSpec], arguments: argparse.Namespace) -> None:
    """Print what the tracker reads of released lanes, as they are and by windows."""
    admitted = [spec for spec in specs if spec.family in arguments.families or not arguments.quick]
    jobs = [(spec, arguments.records, arguments.film) for spec in admitted]
    read = [rows for _, rows in run_in_order(read_windows, jobs, arguments.workers)]
    for k, title in enumerate(("as they are", *(f"{window:g} s" for window in WINDOWS_S))):
        print_row(title, "all", [one for rows in read for one in rows[k]])


def read_windows(job: tuple[TwoEventsSpec, Path, bool]) -> list[list[Read]]:
    """Return what is read of both lanes of a record: with its own timetables, then with each of WINDOWS_S."""
    spec, records, film = job
    world = spec.world(trajectories_of(spec, records / "trajectories" / f"{spec.scenario_id}.npz")["qpos"])
    n_frames, rng = world.physics.n_frames, np.random.default_rng([*spec.scenario_id.encode()])
    reads = []
    for window in (None, *(round(seconds * world.physics.fps) for seconds in WINDOWS_S)):
        lanes = []
        for k, (record, settled) in enumerate(zip(spec.lanes, spec.evidence["settled_frames"], strict=True)):
            timetable = record.lane.timetable
            if window is not None:
                first = int(rng.integers(settled, n_frames - window + 1))
                timetable = Timetable.of_window(first, window, n_frames)
            lanes.append(Read(record.ground_truth, tracked(world, k, timetable)))
        reads.append(lanes)
    seen = observed(spec, world) if film else ()
    filmed = [replace(one, observer=said, is_filmed=True) for one, said in zip(reads[0], seen, strict=False)]
    return [filmed or reads[0], *reads[1:]]


def read_lanes(job: tuple[str, str, int, int]) -> list[Read]:
    """Return what is read of both lanes of a scenario that is drawn; nothing if no draw passes."""
    level, family, number, seed = job
    *_, drawn = draw_two_events(family, number, seed, LEVELS[level])
    if not isinstance(drawn, DrawnLanes):
        return []
    world = drawn.spec.world(drawn.worlds["qpos"])
    return [
        Read(record.ground_truth, tracked(world, k, record.lane.timetable), said, is_filmed=True)
        for k, (record, said) in enumerate(zip(drawn.spec.lanes, observed(drawn.spec, world), strict=True))
    ]


def observed(spec: TwoEventsSpec, world: TwoLanes) -> list[str | None]:
    """Return what the observer reads of both lanes in the clip that hides neither."""
    with TemporaryDirectory() as folder, Renderer(world.model, world.camera) as renderer:
        clip = Path(folder) / "neither.mp4"
        encode([*renderer.frames(world.clip(CLIPS["neither"]))], clip, world.physics.fps)
        return [observe(clip, lane_question(record.lane.strip, spec.question)) for record in spec.lanes]


def tracked(world: TwoLanes, lane: int, timetable: Timetable) -> tuple[str | None, ...]:
    """Return what the tracker reads of a lane at each of RATES."""
    event = world.events[lane]
    return tuple(
        read_outcome(event.family, followed(world, lane, timetable, rate), event.params).label for rate in RATES
    )


def followed(world: TwoLanes, lane: int, timetable: Timetable, rate: int) -> Motion:
    """Return the motion that a tracker takes for that of a lane.

    Each thing is, in each frame it is shown, the nearest one of its colour to where it was in the frame before, and
    stays there until the next one. In the first frame it is told which is which.
    """
    motion, step = world.motion(lane), world.physics.fps // rate
    bodies = [body for body in motion.positions if not body.startswith("double ")]
    is_open = timetable.away(len(motion.times)) == 1
    frames = [0, *(frame for frame in range(step, len(is_open), step) if is_open[frame])]
    shown = np.array(frames)[np.searchsorted(frames, np.arange(len(is_open)), side="right") - 1]
    colour_of = {body: colour(world.model, f"{LANES[lane]} {body}") for body in bodies}
    shift = np.array(world.layouts[lane].shift)
    places = {body: world.camera.project(motion.pos(body) + shift) for body in bodies}
    positions, rotations = dict[str, np.ndarray](), dict[str, np.ndarray]()
    for body in bodies:
        if body.startswith(DISTRACTOR):
            continue
        alike = [other for other in bodies if looks_like(colour_of[body], colour_of[other])]
        tracks, at = np.stack([places[other] for other in alike]), alike.index(body)
        taken = {0: at}
        for before, frame in pairwise(frames):
            at = int(np.linalg.norm(tracks[:, frame] - tracks[at, before], axis=1).argmin())
            taken[frame] = at
        positions[body] = np.stack([motion.positions[alike[taken[frame]]][frame] for frame in shown.tolist()])
        rotations[body] = np.stack([motion.rotations[alike[taken[frame]]][frame] for frame in shown.tolist()])
    return replace(motion, positions=positions, rotations=rotations)


def colour(model: mujoco.MjModel, body: str) -> str | None:
    """Return the name of the colour of a body that moves; None for one that has no colour or does not move."""
    geoms = decisive_geoms(model, [body])
    if model.body_weldid[model.body(body).id] == 0 or not geoms:
        return None
    paint = model.geom(geoms[0]).rgba[:3]
    return min(COLOURS, key=lambda name: float(np.linalg.norm(np.array(COLOURS[name]) - paint)))


def looks_like(one: str | None, other: str | None) -> bool:
    return one == other or any({one, other} == pair for pair in LOOK_ALIKE)


if __name__ == "__main__":
    main()
