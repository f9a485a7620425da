"""A ball strikes a pendulum's bob: does the pendulum knock over a block?

Control: pendulum and block are in view. Void: the occluder stands before them and only the ball's run-up is seen.
Hidden element: a peg in the board behind the pendulum. It sticks out just before the rod, and stops the swing before
the bob reaches the block, or farther along, where the rod does not get. The ball stays behind the occluder: it drops
down a step there, and a lip stops it once it has struck.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.parts.course import Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD, extrapolate
from traps_pipeline.scenes.parts.questions import colour_of, comes_from, yes_no
from traps_pipeline.scenes.parts.readings import Reading, top_m, yes_while
from traps_pipeline.scenes.parts.vary import apart, between, facing, hidden, one_of, shuffled
from traps_pipeline.scenes.parts.vision import largest, track
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene, rgba

FLOOR_M = 0.02  # what the block stands on
STEP_M = 0.02  # the visible lane lies higher by this
STEP_AT_M = 0.06
GAP_M = 0.006  # under the hanging bob
PEG_DOWN = 0.62  # height of the peg below the pivot, as a share of the pendulum's length
PEG_RADIUS_M = 0.012
ROD_RADIUS_M = 0.008
GIVES_PX = 2.0  # of a block that is struck
PLAY_COLOURS, PLAIN_COLOURS = apart("red", "green", "blue", "cyan", "purple"), shuffled("wood", "grey")


@dataclass(frozen=True)
class Params:
    """Parameters; lengths run from the occluder's edge; direction +1 is right."""

    direction: int = one_of(-1, 1)
    ball_colour: str = PLAY_COLOURS()
    bob_colour: str = PLAY_COLOURS()
    block_colour: str = PLAY_COLOURS()
    lane_colour: str = PLAIN_COLOURS()
    board_colour: str = PLAIN_COLOURS()
    peg_stops: bool = hidden(False, True)  # whether the peg sticks out just before the rod
    radius_m: float = between(0.046, 0.054)  # of the ball and of the bob
    speed_m_s: float = between(0.75, 0.95)
    run_m: float = between(0.55, 0.68)  # visible lane
    lane_m: float = between(0.09, 0.12)  # height of the lane behind the occluder over the floor
    pivot_at_m: float = between(0.32, 0.37)
    length_m: float = between(0.30, 0.36)
    stop_deg: float = between(3.5, 5.0)  # swing that a stopping peg allows
    free_peg_m: float = between(0.20, 0.25)  # where the peg is otherwise, from the pivot on
    reach_m: float = between(0.055, 0.065)  # how far the bob swings to touch the block
    block_height_m: float = between(0.20, 0.24)
    block_half_m: float = between(0.016, 0.021)
    azimuth_deg: float = facing(-14, 18)
    elevation_deg: float = between(-32, -20)

    @property
    def pivot_z_m(self) -> float:
        """Height of the pivot."""
        return FLOOR_M + self.lane_m + GAP_M + self.radius_m + self.length_m

    @property
    def block_at_m(self) -> float:
        """Position of the standing block's centre."""
        return self.pivot_at_m + self.radius_m + self.reach_m + self.block_half_m

    @property
    def peg_at_m(self) -> float:
        """Position of the peg in the board."""
        swing = PEG_DOWN * self.length_m * float(np.tan(np.radians(self.stop_deg)))
        return self.pivot_at_m + (swing + ROD_RADIUS_M + PEG_RADIUS_M if self.peg_stops else self.free_peg_m)


def build(p: Params, physics: Physics) -> Scene:
    """Build a raised lane, floor and block before a board with pendulum and peg."""
    course = Course(physics, p.direction)
    r, half_width, rim, high = p.radius_m, 1.6 * p.radius_m, 0.012, p.pivot_z_m + 0.05
    depth_span, top = (-half_width, half_width), FLOOR_M + p.lane_m
    end = p.block_at_m + p.block_height_m + 0.14  # the fallen block has room before it
    lip = p.pivot_at_m - 2 * r + 0.80 * r  # the ball touches it a little after it has touched the bob

    course.block("lane_in", (-p.run_m, STEP_AT_M), depth_span, (0, top + STEP_M), p.lane_colour)
    course.block("lane", (STEP_AT_M, lip + 0.008), depth_span, (0, top), p.lane_colour, Surface(3e-4))
    course.block("lip", (lip, lip + 0.008), depth_span, (top, top + 0.25 * r), p.board_colour)
    course.block(
        "front_in", (-p.run_m, STEP_AT_M), (-half_width - rim, -half_width), (0, top + STEP_M + 0.3 * r), p.board_colour
    )
    course.block("back_in", (-p.run_m, 0), (half_width, half_width + rim), (0, top + STEP_M + 0.3 * r), p.board_colour)
    course.block(
        "front", (STEP_AT_M, lip + 0.008), (-half_width - rim, -half_width), (0, top + 0.3 * r), p.board_colour
    )
    course.block("floor_board", (lip + 0.008, end), (-half_width - rim, half_width), (0, FLOOR_M), p.lane_colour)
    course.block("end", (end, end + 0.02), (-half_width - rim, half_width), (0, FLOOR_M + 0.06), p.board_colour)
    course.block("board", (0, end + 0.02), (half_width, half_width + 0.015), (0, high), p.board_colour)
    _add_pendulum(course, p, half_width)
    peg_z = p.pivot_z_m - PEG_DOWN * p.length_m
    course.rod("peg", (p.peg_at_m, -0.04, peg_z), (p.peg_at_m, half_width, peg_z), PEG_RADIUS_M, "yellow")
    half_size = (p.block_half_m, 0.6 * half_width, p.block_height_m / 2)
    course.free_box("block", (p.block_at_m, 0, FLOOR_M + p.block_height_m / 2), half_size, p.block_colour, density=400)
    course.ball("ball", (-p.run_m + 1.2 * r, 0, top + STEP_M + r), r, p.ball_colour, speed=p.speed_m_s)
    course.mark("bob", (p.pivot_at_m, half_width), p.bob_colour)
    course.mark("block", "block")
    return course.scene(
        p,
        decisive=["block"],
        hidden=["peg"],
        cover=course.box((0, end + 0.02), (-half_width - rim, half_width + 0.03), (0, high + 0.02), right=0.02),
        in_view=[course.box((-p.run_m, end), depth_span, (0, high))],
        things=[f"{p.ball_colour} ball", f"{p.block_colour} block", f"{p.bob_colour} pendulum bob", "pendulum"],
        also=["lane", "board", "peg", "rod"],
        colours=["black", "yellow"],
        shown_by={"pendulum": ["bob"]},
    )


def _add_pendulum(course: Course, p: Params, side: float) -> None:
    """Add a bob on a rod that swings along the way from an axle in the board."""
    import mujoco

    body = course.hinge("pendulum", (p.pivot_at_m, 0, p.pivot_z_m), damping=0.02)
    course.rod("rod", (0, 0, 0), (0, 0, -p.length_m), ROD_RADIUS_M, "black", body=body).density = 300
    bob = body.add_geom(name="bob", type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=[0, 0, -p.length_m])
    bob.size, bob.rgba = [p.radius_m, 0, 0], rgba(p.bob_colour)
    bob.priority, bob.solref, bob.friction = 2, [-60000, -25], [0.1, 0.005, 0.0001]  # takes over the ball's speed
    pivot = (p.pivot_at_m, -0.015, p.pivot_z_m)
    course.rod("axle", pivot, (p.pivot_at_m, side, p.pivot_z_m), 0.014, "black", solid=False)


def outcome(motion: Motion, p: Params) -> Reading:
    """Read 'yes' once the block's top is low, 'no' once the pendulum swings back."""
    top = top_m(motion, "block", p.block_height_m, FLOOR_M)
    swing = -p.direction * motion.rot("pendulum")[:, 0, 2]
    has_fallen = top < p.block_height_m / 2
    return Reading(yes_while(has_fallen, int(np.argmax(swing)) + 1), float(abs(top[-1] - p.block_height_m / 2)))


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return whether the block lies flat at the end; None if out of view."""
    blocks = [largest(frame, slots["block"], 80) for frame in frames[-3:]]
    shapes = [blob.box[3] / blob.box[2] for blob in blocks if blob is not None]
    if len(shapes) < 3 or largest(frames[-1], slots["bob"], 80) is None:
        return None
    return "no" if float(np.median(shapes)) > 1.0 else "yes"


def foresee(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Predict a fall: the block gives way, or the bob is about to strike it."""
    first, last = largest(frames[0], slots["block"], 80), largest(frames[-1], slots["block"], 80)
    bob = extrapolate(track(frames, slots["bob"], 80), AHEAD)
    if first is None or last is None or bob is None:
        return None
    gives_way = abs(last.x - first.x) + abs(last.box[2] - first.box[2]) > GIVES_PX
    is_struck = abs(bob.x - first.x) < (bob.box[2] + first.box[2]) / 2
    return "yes" if gives_way or is_struck else "no"


FAMILY = scene_family(
    "pendulum",
    category="pendulums_levers",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {bob} pendulum bob knock over the {block} block, yes or no?",
        "Struck by the ball, does the {bob} pendulum bob topple the {block} block: yes or no?",
        "Does the pendulum with the {bob} bob bring down the {block} block, yes or no?",
        yes=["yes it does", "it knocks it over", "the block falls", "the block falls over"],
        no=["no it does not", "the block does not fall", "the block stays standing", "it does not reach the block"],
    ),
    asides=[
        colour_of(
            "ball", "What colour is the ball that rolls along the raised lane: {choices}?", ("ball", "bob", "block")
        ),
        comes_from("From which side of the picture does the rolling ball set out, left or right?"),
    ],
    observe=observe,
    foresee=foresee,
    physics=Physics(timestep_s=0.001),
    min_margin_m=0.03,
)
