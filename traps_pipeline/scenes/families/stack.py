"""A pusher sweeps blocks off a stack: how many stay on the stand?

Control: ball, pusher, stack and tray are in view. Void: the occluder stands before all of them but the ball's run-up.
Hidden element: the height of the stand. The pusher's plate passes just over the ledge that the ball rolls on, so the
blocks that stand higher than the ledge are swept off and those below it stay.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.parts import vary
from traps_pipeline.scenes.parts.course import Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.questions import choice_of, comes_from, how_many, range_of
from traps_pipeline.scenes.parts.readings import Reading, still_from
from traps_pipeline.scenes.parts.vary import between, facing, hidden, one_of, shuffled
from traps_pipeline.scenes.parts.vision import blobs, colour_mask, largest
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene, add_box

RANGES = ((0, 1), (2, 3), (4, 5))  # of standing blocks
COLOURS = ("red", "green", "blue", "yellow", "purple")  # of the blocks
BLOCKS = [f"block_{i}" for i in range(len(COLOURS))]  # from the bottom of the stack upwards
STAND_COLOUR = "black"
RADIUS_M = 0.05
ROD_M = 0.17  # from the plate back to the pad that the ball strikes
STACKED, PLAIN_COLOURS = shuffled(*COLOURS), shuffled("wood", "grey", "white")


@dataclass(frozen=True)
class Params:
    """Parameters; direction +1 is right; block_colours run from the stand upwards."""

    direction: int = one_of(-1, 1)
    ledge_colour: str = PLAIN_COLOURS()
    wall_colour: str = PLAIN_COLOURS()
    pusher_colour: str = PLAIN_COLOURS()
    below: int = hidden(*range(len(COLOURS) + 1))  # blocks below the pusher's plate: sets the height of the stand
    block_colours: tuple[str, ...] = STACKED(len(COLOURS))
    block_height_m: float = between(0.054, 0.062)
    block_width_m: float = between(0.086, 0.104)
    speed_m_s: float = between(0.95, 1.15)
    run_m: float = between(0.72, 0.82)  # visible ledge before the occluder
    tray_m: float = between(0.34, 0.40)
    ball_colour: str = one_of("orange", "cyan")
    azimuth_deg: float = facing(-14, 20)
    elevation_deg: float = between(-31, -21)

    @property
    def stack_m(self) -> float:
        """Height of the stack."""
        return len(COLOURS) * self.block_height_m

    @property
    def ledge_m(self) -> float:
        """Height of the ledge that the ball rolls on."""
        return self.stack_m + 0.03

    @property
    def stand_m(self) -> float:
        """Height of the stand."""
        return self.ledge_m + 0.004 - self.below * self.block_height_m

    @property
    def stand_half_m(self) -> float:
        """Half the width of the stand."""
        return self.block_width_m / 2 + 0.012

    @property
    def travel_m(self) -> float:
        """Distance that the pusher can slide."""
        return self.block_width_m + 0.05


def build(p: Params, physics: Physics) -> Scene:
    """Build ledge, pusher, stand with the stack, and tray."""
    course = Course(physics, p.direction)
    ledge, half_stand, half_w = p.ledge_m, p.stand_half_m, p.block_width_m / 2
    plate, end = -half_w - 0.025, half_stand + p.tray_m
    occluder_at = plate - ROD_M - 2 * RADIUS_M - 0.07
    start = occluder_at - p.run_m + RADIUS_M
    felt_at = plate - ROD_M - 2 * RADIUS_M - 0.02  # where it begins: the ball comes to rest on it, behind the occluder
    deck, high = (ledge - 0.025, ledge), ledge + 0.6 * len(COLOURS) * p.block_height_m

    course.block("ledge", (start - 0.06, felt_at), (-0.075, 0.075), deck, p.ledge_colour, Surface(1e-4))
    course.block("felt", (felt_at, -half_stand - 0.004), (-0.075, 0.075), deck, p.ledge_colour, Surface(4e-3))
    for i, x in enumerate((start - 0.03, occluder_at - 0.03, -half_stand - 0.03)):
        course.block(f"leg_{i}", (x - 0.012, x + 0.012), (-0.06, 0.06), (0, deck[0]), p.ledge_colour)
    course.block("stand", (-half_stand, half_stand), (-half_stand, half_stand), (0, p.stand_m), STAND_COLOUR)
    course.block("wall_back", (occluder_at + 0.01, end), (0.15, 0.165), (0, high), p.wall_colour)
    course.block("wall_front", (half_stand + 0.02, end), (-0.165, -0.15), (0, 0.035), p.wall_colour)
    course.block("wall_end", (end, end + 0.015), (-0.165, 0.165), (0, ledge), p.wall_colour)
    _add_pusher(course, p, plate)
    half_size = (half_w, half_w, p.block_height_m / 2)
    course.tower(BLOCKS, half_size, p.block_colours, density=300, sliding=0.3, solref=(0.006, 1), base=p.stand_m)
    at = (start, 0, ledge + RADIUS_M)
    course.ball("ball", at, RADIUS_M, p.ball_colour, speed=p.speed_m_s, rolling=0.0002, density=7500)

    along, top = (occluder_at, end + 0.02), ledge + p.stack_m + 0.03
    course.mark("block", BLOCKS[-1])
    course.mark("stand", (0.0, 0.15), STAND_COLOUR)
    return course.scene(
        p,
        decisive=BLOCKS,
        hidden=["stand"],
        cover=course.box(along, (-0.17, 0.18), (0, top), right=course.ahead(0.06)),
        in_view=[course.box(along, (-0.165, 0.165), (0, high))],
        things=[f"{p.ball_colour} ball", "black stand", "ledge", *(f"{c} block" for c in p.block_colours)],
        also=["stack", "pusher", "wall"],
        colours=[*p.block_colours, STAND_COLOUR],
        shown_by={"stack": ["block"]},
    )


def _add_pusher(course: Course, p: Params, plate: float) -> None:
    """Add a tall plate on a slide, with a rod back to the pad that the ball strikes."""
    import mujoco

    direction, half_height = p.direction, (p.stack_m + 0.005) / 2
    body = course.spec.worldbody.add_body(name="pusher", pos=[direction * plate, 0, p.ledge_m])
    joint = body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[direction, 0, 0])
    joint.range, joint.limited = [0, p.travel_m], mujoco.mjtLimited.mjLIMITED_TRUE
    joint.damping, joint.frictionloss, joint.solref_limit = [1.0, 0, 0], 0.3, [0.02, 1.5]
    for name, centre, size in (
        ("plate", (0, 0, 0.012 + half_height), (0.008, 0.06, half_height)),
        ("rod", (-direction * ROD_M / 2, 0, RADIUS_M), (ROD_M / 2 - 0.012, 0.008, 0.008)),
        ("pad", (-direction * ROD_M, 0, RADIUS_M), (0.008, 0.05, 0.035)),
    ):
        add_box(body, name, centre, size, p.pusher_colour, density=300, friction=[0.1, 0.005, 0.0001])


def _stands(motion: Motion, p: Params) -> np.ndarray:
    """Return whether each block is over the stand, shape (F, blocks)."""
    at = np.stack([motion.pos(block) for block in BLOCKS], axis=1)
    return (np.abs(at[..., 0]) < p.stand_half_m) & (at[..., 2] > p.stand_m)


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the range of the number of standing blocks, once everything is still."""
    rest_frame = still_from(*(motion.pos(block) for block in BLOCKS), within_m=0.003)
    is_pushed = p.direction * (motion.pos("pusher") - motion.pos("pusher")[0])[:, 0] > 0.95 * p.travel_m
    counts = _stands(motion, p).sum(axis=1)
    labels = [range_of(RANGES, n) if i >= rest_frame and is_pushed[i] else None for i, n in enumerate(counts)]
    return Reading(labels, min(float(abs(abs(motion.pos(block)[-1, 0]) - p.stand_half_m)) for block in BLOCKS))


def legible(motion: Motion, p: Params) -> list[tuple[tuple[str, ...], float]]:
    """Return the blocks to be seen: all standing ones, and enough of the fallen ones."""
    is_standing = _stands(motion, p)[-1]
    groups = [((BLOCKS[i],), 150.0) for i in np.flatnonzero(is_standing)]
    fallen_blocks = tuple(BLOCKS[i] for i in np.flatnonzero(~is_standing))
    return [*groups, (fallen_blocks, 200.0 * len(fallen_blocks))] if fallen_blocks else groups


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Count the block colours that lie above the black stand and within its width."""
    counts = [_count(frame, slots["stand"]) for frame in frames[-3:]]
    if counts[-1] is None or len(set(counts)) > 1:
        return None
    return range_of(RANGES, counts[-1])


def foresee(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Count the blocks that are over the stand in the last frame; the others fall."""
    count = _count(frames[-1], slots["stand"])
    return None if count is None else range_of(RANGES, count)


def _count(frame: np.ndarray, stand_colour: str) -> int | None:
    stand_blob = largest(frame, stand_colour, 450)  # a flag of the stand is smaller
    if stand_blob is None:
        return None
    x, y, width, _ = stand_blob.box
    blobs_by_colour = [blobs(colour_mask(frame, colour), 60) for colour in COLOURS]
    top, foot = y - 3.5 * width, y + 0.4 * width  # a flag is above all blocks
    return sum(any(x - 4 < b.x < x + width + 4 and top < b.y < foot for b in parts) for parts in blobs_by_colour)


FAMILY = scene_family(
    "stack",
    category="stacks",
    params=Params,
    build=build,
    outcome=outcome,
    question=how_many(
        "How many of the five blocks are still stacked on the {stand} stand at the end: {choices}?",
        "The stack has five blocks. How many of them stay on the {stand} stand, {choices}?",
        "When everything has come to rest, how many blocks are left on the {stand} stand: {choices}?",
        ranges=lambda p: RANGES,
        fills=lambda p, rng: {"stand": STAND_COLOUR},
    ),
    asides=[
        choice_of(
            "What colour is the ball that rolls along the ledge: {choices}?",
            choices=lambda p: ["orange", "cyan", "purple"],
            answer=lambda p: p.ball_colour,
        ),
        comes_from("From which side does the ball roll along the ledge, left or right?"),
    ],
    observe=observe,
    foresee=foresee,
    legible=legible,
    physics=Physics(timestep_s=0.001),
    min_margin_m=0.012,
    # The same stack where another answer is right.
    twins=lambda p: [twin for twin in vary.twins(p) if range_of(RANGES, twin.below) != range_of(RANGES, p.below)],
    looks=("bystanders", "camera", "material", "pale-floor", "panel"),
)
