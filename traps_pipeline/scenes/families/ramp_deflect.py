"""A ball rolls down a ramp onto a table: into which bin is it deflected?

Control: the table and the bins at its sides are in view. Void: the occluder stands before them, the ramp is in view.
Hidden element: the deflector on the table, a board that is turned to the left or to the right.
"""

from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.parts.course import Course
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD, compact_blob, nearer_side
from traps_pipeline.scenes.parts.questions import colour_from, left_or_right, material_of
from traps_pipeline.scenes.parts.ramp import Ramp
from traps_pipeline.scenes.parts.readings import Reading, side_while
from traps_pipeline.scenes.parts.vary import between, hidden, in_front, one_of, shuffled
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene

BOARD_M = 0.016  # thickness of the ramp
WALL_M = 0.012
BALLS = ("green", "yellow", "orange", "cyan", "purple")  # the bins are red and blue
PLAIN_COLOURS = shuffled("wood", "grey", "black")


@dataclass(frozen=True)
class Params:
    """Parameters; y runs back from the table's front edge, x right from its middle."""

    ramp_colour: str = PLAIN_COLOURS()
    table_colour: str = PLAIN_COLOURS()
    deflector_colour: str = PLAIN_COLOURS()
    deflects: str = hidden("left", "right")
    angle_deg: float = between(40, 50)  # between the deflector and the ball's way
    deflector_m: float = between(0.13, 0.15)  # half its length
    radius_m: float = between(0.047, 0.056)
    ramp_x_m: float = between(-0.06, 0.06)
    slope_deg: float = between(16, 22)
    ramp_m: float = between(0.60, 0.68)  # length of the ramp's surface
    start_m: float = between(0.06, 0.09)  # from the ramp's top to where the ball starts
    table_m: float = between(0.09, 0.12)  # height of the table
    half_width_m: float = between(0.26, 0.32)  # of the table
    depth_m: float = between(0.35, 0.40)  # of the table
    bin_m: float = between(0.18, 0.22)  # width of a bin
    ball_colour: str = one_of(*BALLS)
    azimuth_deg: float = in_front(-20, 20)
    elevation_deg: float = between(-40, -30)


def build(p: Params, physics: Physics) -> Scene:
    """Build table with front and back wall, deflector, two bins, and a ramp behind."""
    course = Course(physics)
    r, top, half_width, rim, half_ramp = (
        p.radius_m,
        p.table_m,
        p.half_width_m,
        p.table_m + 1.1 * p.radius_m,
        1.5 * p.radius_m,
    )

    course.block("table", (-half_width, half_width), (0, p.depth_m), (0, top), p.table_colour)
    front = course.block("wall_front", (-half_width, half_width), (-WALL_M, 0), (0, rim), p.table_colour)
    for name, x in (("left", (-half_width, p.ramp_x_m - half_ramp)), ("right", (p.ramp_x_m + half_ramp, half_width))):
        course.block(f"wall_{name}", x, (p.depth_m, p.depth_m + WALL_M), (0, rim), p.table_colour)
    turn = np.radians(90 + p.angle_deg if p.deflects == "left" else 90 - p.angle_deg) / 2
    centre = (p.ramp_x_m, p.deflector_m * float(np.cos(np.radians(p.angle_deg))) + 0.02, top + 0.9 * r)
    deflector = course.slab("deflector", centre, (p.deflector_m, 0.008, 0.9 * r), p.deflector_colour)
    deflector.quat = [float(np.cos(turn)), 0.0, 0.0, float(np.sin(turn))]
    for geom in (deflector, front):
        geom.friction, geom.priority, geom.condim = [0.02, 0.001, 0.0001], 1, 3
    _add_bin(course, p, "left", -1, "red")
    _add_bin(course, p, "right", 1, "blue")

    ramp = Ramp(p.slope_deg, top, p.depth_m, towards_camera=True, middle_m=p.ramp_x_m)
    middle = p.ramp_m / 2
    ramp.board(course, "ramp", middle, -BOARD_M / 2, (middle, half_ramp, BOARD_M / 2), p.ramp_colour)
    for name, x in (("left", -half_ramp), ("right", half_ramp)):
        ramp.board(course, f"rail_{name}", middle, 0, (middle, 0.005, 0.4 * r), p.ramp_colour, aside=x)
    ramp.support(course, "support", p.ramp_m - 0.05, BOARD_M, 0.8 * half_ramp, p.ramp_colour)
    course.ball("ball", ramp.at(p.ramp_m - p.start_m, r), r, p.ball_colour)

    high, outer_x = top + 2 * r + 0.01, half_width + p.bin_m + WALL_M
    _, back, ramp_top = ramp.at(p.ramp_m)
    for name in ("left", "right"):
        course.mark(f"{name} bin", f"bin_{name}")
    return course.scene(
        p,
        decisive=["ball"],
        hidden=["deflector"],
        cover=course.box((-outer_x, outer_x), (-WALL_M - 0.01, p.depth_m), (0, high), right=0.02),
        in_view=[
            course.box((-outer_x, outer_x), (-WALL_M, p.depth_m), (0, high)),
            course.box((p.ramp_x_m - half_ramp, p.ramp_x_m + half_ramp), (back, back), (0, ramp_top)),
        ],
        things=[f"{p.ball_colour} ball", "red bin", "blue bin", "ramp", "table"],
        also=["board", "wall"],
        colours=["red", "blue"],
    )


def _add_bin(course: Course, p: Params, name: str, sign: int, colour: str) -> None:
    """Add an open box beside the table (sign -1: on the left), lower than it."""
    near_x, far_x = p.half_width_m, p.half_width_m + p.bin_m
    middle, half_bin, depth = sign * (near_x + far_x) / 2, p.bin_m / 2, p.depth_m / 2
    course.slab(f"bin_{name}", (middle, depth, 0.006), (half_bin, depth, 0.006), colour).friction = [0.8, 0.005, 0.006]
    for end, y, high in (("front", -WALL_M / 2, 0.04), ("back", p.depth_m + WALL_M / 2, p.table_m)):
        course.slab(f"bin_{name}_{end}", (middle, y, high / 2), (half_bin, WALL_M / 2, high / 2), colour)
    high = p.table_m + p.radius_m
    at = (sign * (far_x + WALL_M / 2), depth, high / 2)
    course.slab(f"bin_{name}_end", at, (WALL_M / 2, depth + WALL_M, high / 2), colour)


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the end of the table that the ball is past, and by how far its middle."""
    x = motion.pos("ball")[:, 0]
    past_m = np.abs(x) - p.half_width_m
    return Reading(side_while(past_m > 0, x, "right", "left"), float(past_m[-1]))


FAMILY = scene_family(
    "ramp_deflect",
    category="ramps_rolling",
    sub_scenario="deflect",
    params=Params,
    build=build,
    outcome=outcome,
    question=left_or_right(
        "Which bin does the {ball} ball end up in, the left one or the right one?",
        "Is the {ball} ball deflected into the bin on the left or on the right?",
        "In which bin does the {ball} ball land as seen from the camera, left or right?",
        forms=["{0} bin", "the {0} one", "{1} bin", "on the {0}"],
        colours=lambda p: ("red", "blue"),
    ),
    asides=[
        material_of("ramp", "What colour is the ramp that the ball rolls down: {choices}?"),
        colour_from("ball", "What colour is the ball on the ramp: {choices}?", BALLS, unlike=("ball",)),
    ],
    observe=nearer_side("ball", "red", "blue", find=compact_blob, least=100),
    foresee=nearer_side("ball", "red", "blue", find=compact_blob, least=100, ahead=AHEAD),
    min_margin_m=0.03,
)
