"""A ball rolls behind a wall with two windows: does it come out at the other end?

Control: the windows and the tray at the end are in view, so that a ball which stays behind the wall is seen in the
second window. Void: the occluder stands before the wall and the tray.
Hidden element: a block, which lies across the lane below the second window or beside the lane.
"""

from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.parts.course import Course, Span, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD, past_far_edge
from traps_pipeline.scenes.parts.questions import colour_from, comes_from, yes_no
from traps_pipeline.scenes.parts.readings import Reading, read_passage
from traps_pipeline.scenes.parts.vary import Drawn, apart, between, drawn_by, hidden, in_front, one_of, shuffled
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene, uniform

DECK_M = 0.04
TRAY_M = 0.02  # lower than the lane, so that no ball rolls back behind the wall
WALL_M = 0.03
SILL_M = 0.045
BALL_COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")
PLAY_COLOURS = apart(*BALL_COLOURS, "black", fits=lambda ball, wall: ball != "black")
PLAIN_COLOURS = shuffled("wood", "grey", "white", "black", without="wall_colour")


def _windows(rng: np.random.Generator, so_far: Drawn) -> tuple[float, float]:
    """Draw the windows: the first at a fixed share of the wall, the second anywhere."""
    wall_m = so_far["wall_m"]
    return round(0.30 * wall_m, 4), round(wall_m * uniform(rng, 0.70, 0.76), 4)


@dataclass(frozen=True)
class Params:
    """Parameters; lengths run from the wall's start; direction +1 is right."""

    direction: int = one_of(-1, 1)
    ball_colour: str = PLAY_COLOURS()
    wall_colour: str = PLAY_COLOURS()
    lane_colour: str = PLAIN_COLOURS()
    tray_colour: str = PLAIN_COLOURS()
    block_colour: str = PLAIN_COLOURS()
    wall_m: float = between(0.82, 0.92)
    blocked: bool = hidden(False, True)  # whether the block lies across the lane
    speed_m_s: float = between(0.62, 0.78)
    radius_m: float = between(0.050, 0.058)
    run_m: float = between(0.48, 0.56)  # open lane before the wall
    height_m: float = between(0.28, 0.33)
    windows_m: tuple[float, ...] = drawn_by(_windows)  # middle of each window
    window_m: float = between(0.19, 0.22)  # width of a window
    mouth_m: float = between(0.08, 0.11)  # part of the wall that is seen beside the occluder
    tray_m: float = between(0.26, 0.32)
    merlons: int = one_of(4, 5, 6)
    azimuth_deg: float = in_front(-15, 15)
    elevation_deg: float = between(-27, -20)


def build(p: Params, physics: Physics) -> Scene:
    """Build a lane, a wall with windows and merlons before it, and a tray at its end."""
    course = Course(physics, p.direction)
    r, rail, front = p.radius_m, 0.012, -1.35 * p.radius_m - WALL_M
    half_width, far_end = 1.25 * r, p.wall_m + p.tray_m
    second, depth_span, rim = p.windows_m[1], (-half_width, half_width), TRAY_M + 0.6 * r
    bed = (second - 2.5 * r, second + 1.5 * r)  # rough: a ball that bounces off the block stays there

    course.block("lane_in", (-p.run_m, bed[0]), depth_span, (0, DECK_M), p.lane_colour, Surface(1e-4))
    course.block("lane_bed", bed, depth_span, (0, DECK_M), p.lane_colour, Surface(0.003))
    course.block("lane_out", (bed[1], p.wall_m), depth_span, (0, DECK_M), p.lane_colour, Surface(1e-4))
    course.block("tray", (p.wall_m, far_end), depth_span, (0, TRAY_M), p.tray_colour, Surface(0.004))
    course.sides("tray", (p.wall_m, far_end), half_width, rail, (0, rim), p.tray_colour)
    course.block(
        "tray_end",
        (far_end, far_end + rail),
        (-half_width - rail, half_width + rail),
        (0, TRAY_M + 1.5 * r),
        p.tray_colour,
    )
    _add_wall(course, p, (front, front + WALL_M))
    stop = second + 1.1 * r  # where the block's face is: the ball rests in the window
    across = (-0.8 * r, 0.8 * r) if p.blocked else (1.5 * r, 3.1 * r)
    up = (DECK_M, DECK_M + 1.2 * r) if p.blocked else (0.0, 1.2 * r)
    course.block("block", (stop, stop + 0.03), across, up, p.block_colour)
    course.ball("ball", (1.3 * r - p.run_m, 0, DECK_M + r), r, p.ball_colour, speed=p.speed_m_s, rolling=1e-4)

    high = DECK_M + 2.2 * r
    return course.scene(
        p,
        decisive=["ball"],
        hidden=["block"],
        cover=course.cover((p.mouth_m, far_end + rail), (front - 0.01, 3.1 * r), high),
        in_view=[
            course.box((-p.run_m, far_end), (front, 3.1 * r), (0, high)),
            course.box((0, p.wall_m), (front, 0), (0, p.height_m + 0.05)),
        ],
        things=[f"{p.ball_colour} ball", f"{p.wall_colour} wall", "lane", f"top of the {p.wall_colour} wall"],
        also=["window", "tray", "block"],
    )


def _add_wall(course: Course, p: Params, across: Span) -> None:
    """Add the wall around its two windows, with merlons on top."""
    lintel = SILL_M + 0.62 * (p.height_m - SILL_M)
    edges = [0.0, *(at + s * p.window_m / 2 for at in p.windows_m for s in (-1, 1)), p.wall_m]
    course.block("wall_foot", (0, p.wall_m), across, (0, SILL_M), p.wall_colour)
    course.block("wall_top", (0, p.wall_m), across, (lintel, p.height_m), p.wall_colour)
    for i in range(0, len(edges), 2):
        course.block(f"wall_{i}", (edges[i], edges[i + 1]), across, (SILL_M, lintel), p.wall_colour)
    pitch = p.wall_m / (2 * p.merlons - 1)
    for i in range(p.merlons):
        along = (2 * i * pitch, (2 * i + 1) * pitch)
        course.block(f"merlon_{i}", along, across, (p.height_m, p.height_m + 0.045), p.wall_colour)


def outcome(motion: Motion, p: Params) -> Reading:
    """Read whether the ball is wholly past the wall, or stays where it is behind it."""
    return read_passage(p.direction * motion.pos("ball")[:, 0] - p.radius_m - p.wall_m, p.radius_m)


FAMILY = scene_family(
    "behind_wall",
    category="hidden",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {ball} ball come out from behind the {wall} wall at its other end, yes or no?",
        "After it rolls behind the {wall} wall, does the {ball} ball come out on the other side: yes or no?",
        "Does the {ball} ball roll all the way past the {wall} wall and come out at the far end, yes or no?",
        yes=["it comes out", "yes it comes out", "it comes out at the other end"],
        no=["it does not come out", "no it does not come out", "it stays behind the wall", "it stops behind the wall"],
    ),
    asides=[
        comes_from("From which side does the ball roll towards the wall, left or right?"),
        colour_from("ball", "What colour is the ball: {choices}?", BALL_COLOURS, unlike=("ball", "wall")),
        colour_from("wall", "What colour is the wall: {choices}?", BALL_COLOURS, unlike=("ball", "wall")),
    ],
    observe=past_far_edge("ball", "wall"),
    foresee=past_far_edge("ball", "wall", ahead=AHEAD),
    min_margin_m=0.02,
)
