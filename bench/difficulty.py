"""What the settings of `traps benchmark sample` make harder: how often an observer and a tracker answer, by level.

Controls are drawn and simulated as `traps benchmark sample` does, cut to the length of their outcome, and shown to the
end without a closing board; no certificate of pixels is measured, which would take a minute each. The *observer* is the
family's own: classical vision on 25 frames. The *tracker* is told the exact place of everything that moves in each
frame it is shown, and its colour up to those easily taken for each other, but neither shape nor name. It takes a thing
to be the nearest one of its colour in the picture, from frame to frame, and reads the outcome of what it follows as the
record does. By default all families are asked that take twice the speed.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

os.environ.setdefault("MUJOCO_GL", "osmesa")

import numpy as np

from bench.quick import parse
from traps_pipeline.scenes.draw.sample import MAX_DRAWS, Draw, scene_of_draw
from traps_pipeline.scenes.family_registry import family_names, get_family
from traps_pipeline.scenes.parts.difficulty import DISTRACTOR, Difficulty, unsupported_settings
from traps_pipeline.scenes.physics.kit import COLOURS, LOOK_ALIKE, Motion
from traps_pipeline.scenes.picture.camera import fit_shot
from traps_pipeline.scenes.worlds.outcome import Rejected, compile_scene, decisive_geoms, read_outcome, simulated
from traps_pipeline.scenes.worlds.pace import lengths, shortened
from traps_pipeline.scenes.worlds.shot import shown_points
from traps_pipeline.scenes.worlds.world import World

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
    """Answers to one control. tracker: at each of RATES."""

    truth: str | None
    tracker: tuple[str | None, ...]
    observer: str | None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--families", nargs="+", default=fast_families(), help="default: those that take twice the speed"
    )
    parser.add_argument("--levels", nargs="+", choices=LEVELS, default=list(LEVELS))
    parser.add_argument("--count", type=int, default=8, help="scenarios of each family and level")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--without-observer", action="store_true", help="draw no picture")
    arguments = parse(parser, families=["chain"], levels=["usual", "all"], count=1)
    print(f"{'level':12} family               of  draws  {' '.join(f'tracker {rate}/s' for rate in RATES)}  observer")
    for level in arguments.levels:
        reads, draws = list[Read](), 0
        for family in arguments.families:
            if unsupported_settings(get_family(family), LEVELS[level]):
                continue
            own = list(controls(family, LEVELS[level], arguments.seed, arguments.count))
            if not own:
                print(f"{level:12} {family:18} no draw passes", flush=True)
                continue
            here = [read(world, question, not arguments.without_observer) for _, question, world in own]
            print_row(level, family, here, own[-1][0] + 1)
            reads, draws = reads + here, draws + own[-1][0] + 1
        if reads:
            print_row(level, "all", reads, draws)


def fast_families() -> list[str]:
    return [name for name in family_names() if not unsupported_settings(get_family(name), LEVELS["both"])]


def print_row(level: str, family: str, reads: Sequence[Read], draws: int) -> None:
    right = [np.mean([one.tracker[i] == one.truth for one in reads]) for i in range(len(RATES))]
    seen = np.mean([one.observer == one.truth for one in reads])
    tracker = " ".join(f"{share:11.2f}" for share in right)
    print(f"{level:12} {family:18} {len(reads):4d} {draws:6d}  {tracker}  {seen:8.2f}", flush=True)


def controls(name: str, difficulty: Difficulty, seed: int, count: int) -> Iterator[tuple[int, str, World]]:
    """Yield the number, question and world of the first draws of a family that come to an outcome in time."""
    family = get_family(name)
    looks, found = tuple(sorted(family.looks)), 0
    for number in range(MAX_DRAWS * count):
        try:
            drawn = scene_of_draw(Draw(name, seed, number, frozenset(), looks, difficulty))
            model, scene = compile_scene(family, drawn.params, drawn.physics)
            qpos = simulated(model, scene, drawn.physics)
        except Rejected:
            continue
        camera, _ = fit_shot(scene.view, shown_points(model, scene, qpos), scene.cover)
        world = World(family, drawn.params, drawn.physics, qpos, camera, None, simulated=qpos)
        yield number, drawn.wording.question, shortened(world, lengths([world], number)[0])
        found += 1
        if found == count:
            return


def read(world: World, question: str, observed: bool) -> Read:
    seen = None
    if observed and world.family.observe is not None:
        with world.renderer() as renderer:
            frames = np.stack(list(renderer.frames(world.qpos[:: world.physics.fps // 5])))
        seen = world.family.observe(frames, question)
    tracked = tuple(read_outcome(world.family, followed(world, rate), world.params).label for rate in RATES)
    return Read(world.outcome.label, tracked, seen)


def followed(world: World, rate: int) -> Motion:
    """Return the motion that a tracker takes for that of the scene: each thing is, in each frame it is shown, the
    nearest one of its colour to where it was in the frame before, and stays there until the next one."""
    motion, step = world.motion, world.physics.fps // rate
    shown = step * (np.arange(len(motion.times)) // step)
    colour_of = {body: colour(world, body) for body in motion.positions}
    places = {body: world.camera.project(motion.pos(body)) for body in motion.positions}
    positions, rotations = dict[str, np.ndarray](), dict[str, np.ndarray]()
    for body in motion.positions:
        if body.startswith(DISTRACTOR):
            continue
        alike = [other for other in colour_of if looks_like(colour_of[body], colour_of[other])]
        tracks, at = np.stack([places[other] for other in alike]), alike.index(body)
        taken = np.empty(len(shown), int)
        for frame in range(0, len(shown), step):
            before = tracks[at, max(frame - step, 0)]
            at = int(np.linalg.norm(tracks[:, frame] - before, axis=1).argmin()) if frame else at
            taken[frame : frame + step] = at
        positions[body] = np.stack([motion.positions[alike[i]][s] for i, s in zip(taken, shown, strict=True)])
        rotations[body] = np.stack([motion.rotations[alike[i]][s] for i, s in zip(taken, shown, strict=True)])
    return replace(motion, positions=positions, rotations=rotations)


def colour(world: World, body: str) -> str | None:
    """Return the name of the colour of a body that moves; None for one that has no colour or does not move."""
    model = world.model
    geoms = decisive_geoms(model, [body])
    if model.body_weldid[model.body(body).id] == 0 or not geoms:
        return None
    paint = model.geom(geoms[0]).rgba[:3]
    return min(COLOURS, key=lambda name: float(np.linalg.norm(np.array(COLOURS[name]) - paint)))


def looks_like(one: str | None, other: str | None) -> bool:
    return one == other or any({one, other} == pair for pair in LOOK_ALIKE)


if __name__ == "__main__":
    main()
