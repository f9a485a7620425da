"""What the settings of `traps benchmark sample --two-events` make harder: how often lanes are read, by level.

Scenarios are drawn and certified as that command does, and the lanes of the clip that hides neither are asked. The
*observer* reads 25 frames by classical vision. The *tracker* is told the exact place of everything that moves in each
frame that it is shown and no board stands before the scene, and its colour up to those easily taken for each other, but
neither shape nor name. It takes a thing to be the nearest one of its colour in the picture, from frame to frame, and
reads the outcome of what it follows as the record does. By default all families are asked that take twice the speed.
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

import numpy as np

from bench.quick import parse
from traps_pipeline.base.workers import run_in_order
from traps_pipeline.protocol.two_events import CLIPS
from traps_pipeline.scenes.draw.draw_lanes import DrawnLanes, draw_two_events, lane_families
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.observe import observe
from traps_pipeline.scenes.parts.difficulty import DISTRACTOR, Difficulty, unsupported_settings
from traps_pipeline.scenes.parts.wording import lane_question
from traps_pipeline.scenes.physics.kit import COLOURS, LOOK_ALIKE, Motion
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.lane_event import LaneEvent
from traps_pipeline.scenes.worlds.lanes import TwoLanes
from traps_pipeline.scenes.worlds.outcome import decisive_geoms, read_outcome
from traps_pipeline.video.encode import encode

LEVELS: Mapping[str, Difficulty] = {
    "usual": Difficulty(),
    "distractors": Difficulty(distractors=3),
    "speed": Difficulty(speed=2.0),
    "both": Difficulty(distractors=3, speed=2.0),
    "longer": Difficulty(longer=True),
    "all": Difficulty(distractors=3, speed=2.0, longer=True),
}
RATES = (5, 2)  # frames a second that the tracker is shown


@dataclass(frozen=True)
class Read:
    """Answers about one lane. tracker: at each of RATES."""

    truth: str | None
    tracker: tuple[str | None, ...]
    observer: str | None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--families", nargs="+", default=fast_families(), help="default: that take twice the speed")
    parser.add_argument("--levels", nargs="+", choices=LEVELS, default=list(LEVELS))
    parser.add_argument("--count", type=int, default=2, help="scenarios of each family and level")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--without-observer", action="store_true", help="film nothing")
    parser.add_argument("--workers", type=int, default=1)
    arguments = parse(parser, families=["chain"], levels=["usual", "all"], count=1)
    print(f"{'level':12} family              lanes  {' '.join(f'tracker {rate}/s' for rate in RATES)}  observer")
    for level in arguments.levels:
        admitted = [name for name in arguments.families if not unsupported_settings(get_family(name), LEVELS[level])]
        jobs = [
            (level, name, number, arguments.seed, not arguments.without_observer)
            for name in admitted
            for number in range(1, arguments.count + 1)
        ]
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
    seen = np.mean([one.observer == one.truth for one in reads])
    tracker = " ".join(f"{share:11.2f}" for share in right)
    print(f"{level:12} {family:18} {len(reads):5d}  {tracker}  {seen:8.2f}", flush=True)


def read_lanes(job: tuple[str, str, int, int, bool]) -> list[Read]:
    """Return what is read of both lanes of a scenario; nothing if no draw passes."""
    level, family, number, seed, is_observed = job
    *_, drawn = draw_two_events(family, number, seed, LEVELS[level])
    if not isinstance(drawn, DrawnLanes):
        return []
    world, reads = drawn.spec.world(drawn.worlds["qpos"]), []
    with TemporaryDirectory() as folder:
        clip = Path(folder) / "neither.mp4"
        if is_observed:
            with Renderer(world.model, world.camera) as renderer:
                encode([*renderer.frames(world.clip(CLIPS["neither"]))], clip, world.physics.fps)
        for k, (record, event) in enumerate(zip(drawn.spec.lanes, world.events, strict=True)):
            question = lane_question(record.lane.strip, drawn.spec.question)
            tracked = [read_outcome(event.family, followed(world, k, rate), event.params).label for rate in RATES]
            seen = observe(clip, question) if is_observed else None
            reads.append(Read(record.ground_truth, tuple(tracked), seen))
    return reads


def followed(world: TwoLanes, lane: int, rate: int) -> Motion:
    """Return the motion that a tracker takes for that of a lane.

    Each thing is, in each frame it is shown, the nearest one of its colour to where it was in the frame before, and
    stays there until the next one.
    """
    event, motion, step = world.events[lane], world.events[lane].motion, world.physics.fps // rate
    is_open = world.lanes[lane].timetable.away(len(motion.times)) == 1
    frames = [0, *(frame for frame in range(step, len(is_open), step) if is_open[frame])]
    shown = np.array(frames)[np.searchsorted(frames, np.arange(len(is_open)), side="right") - 1]
    shift, colour_of = np.array(world.layouts[lane].shift), {body: colour(event, body) for body in motion.positions}
    places = {body: world.camera.project(motion.pos(body) + shift) for body in motion.positions}
    positions, rotations = dict[str, np.ndarray](), dict[str, np.ndarray]()
    for body in motion.positions:
        if body.startswith(DISTRACTOR):
            continue
        alike = [other for other in colour_of if looks_like(colour_of[body], colour_of[other])]
        tracks, at = np.stack([places[other] for other in alike]), alike.index(body)
        taken = {0: at}
        for before, frame in pairwise(frames):
            at = int(np.linalg.norm(tracks[:, frame] - tracks[at, before], axis=1).argmin())
            taken[frame] = at
        positions[body] = np.stack([motion.positions[alike[taken[frame]]][frame] for frame in shown.tolist()])
        rotations[body] = np.stack([motion.rotations[alike[taken[frame]]][frame] for frame in shown.tolist()])
    return replace(motion, positions=positions, rotations=rotations)


def colour(event: LaneEvent, body: str) -> str | None:
    """Return the name of the colour of a body that moves; None for one that has no colour or does not move."""
    model = event.model
    geoms = decisive_geoms(model, [body])
    if model.body_weldid[model.body(body).id] == 0 or not geoms:
        return None
    paint = model.geom(geoms[0]).rgba[:3]
    return min(COLOURS, key=lambda name: float(np.linalg.norm(np.array(COLOURS[name]) - paint)))


def looks_like(one: str | None, other: str | None) -> bool:
    return one == other or any({one, other} == pair for pair in LOOK_ALIKE)


if __name__ == "__main__":
    main()
