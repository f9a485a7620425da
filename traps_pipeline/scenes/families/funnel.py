"""A ball rolls off a shelf into a funnel: does it come through into the cup below?

Control: funnel and cup are in view. Void: the occluder stands before them, the shelf beside it stays in view.
Hidden element: the two boards of the funnel, which leave a throat that is wider or narrower than the ball. The ball
rolls in the same either way, and in either case it stays behind the occluder.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import cos, radians, sin

import numpy as np

from traps_pipeline.scenes.parts.course import SOFT, Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import round_blob
from traps_pipeline.scenes.parts.questions import colour_of, comes_from, yes_no
from traps_pipeline.scenes.parts.readings import Reading
from traps_pipeline.scenes.parts.vary import Drawn, apart, between, facing, one_of, shuffled, together
from traps_pipeline.scenes.parts.vision import is_at_rest, largest
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene, uniform

FLOOR_M = 0.02  # thickness of the cup's floor
WALL_M = 0.014
DEPTH_M = 0.12  # half of the funnel's and the cup's depth
PLAY_COLOURS = apart("red", "green", "blue", "yellow", "orange", "cyan", "purple")
PLAIN_COLOURS = shuffled("grey", "black", "white")
PARTS = ("ball", "shelf", "cup")


def _throats(rng: np.random.Generator, so_far: Drawn) -> list[float]:
    """Draw a throat wider than the ball and one narrower, in random order."""
    throats = [uniform(rng, 1.3, 1.5), uniform(rng, 0.55, 0.75)]
    return throats if rng.integers(2) == 0 else throats[::-1]


THROATS = together(_throats)


@dataclass(frozen=True)
class Params:
    """Parameters; the funnel is in the middle; direction +1 is right."""

    direction: int = one_of(-1, 1)
    ball_colour: str = PLAY_COLOURS()
    cup_colour: str = PLAY_COLOURS()
    shelf_colour: str = PLAY_COLOURS()
    board_colour: str = PLAIN_COLOURS()
    back_colour: str = PLAIN_COLOURS()
    half_throat: float = THROATS()  # in ball radii: the hidden element
    other_half_throat: float = THROATS()  # what the twin has
    radius_m: float = between(0.058, 0.068)
    speed_m_s: float = between(0.50, 0.62)
    run_m: float = between(0.28, 0.38)  # how far the ball rolls on the shelf
    rise_m: float = between(0.24, 0.30)  # of the shelf over the funnel's upper edge
    throat_at_m: float = between(0.28, 0.33)  # height of the funnel's lower edges
    board_m: float = between(0.32, 0.38)  # length of the funnel's boards
    slope_deg: float = between(44, 54)
    cup_half_m: float = between(0.19, 0.22)
    cup_m: float = between(0.12, 0.15)  # height of the cup's sides
    azimuth_deg: float = facing(-8, 20)
    elevation_deg: float = between(-32, -22)


def twins(p: Params) -> list[Params]:
    """Return another world behind the same void: the funnel has the other throat."""
    return [replace(p, half_throat=p.other_half_throat, other_half_throat=p.half_throat)]


def build(p: Params, physics: Physics) -> Scene:
    """Build shelf on two legs, cup, and funnel before a back wall."""
    course = Course(physics, p.direction, Surface(0.003, sliding=0.5, solref=SOFT))
    r, half_cup, slope, depth_span = p.radius_m, p.cup_half_m, radians(p.slope_deg), (-DEPTH_M, DEPTH_M)
    mouth = p.throat_at_m + p.board_m * sin(slope)  # height of the funnel's upper edges
    narrow_throat, wide_throat = sorted((p.half_throat, p.other_half_throat))
    rim = wide_throat * r + p.board_m * cos(slope)  # half of the funnel's greatest width, whatever its throat
    edge = -(
        rim - (wide_throat - narrow_throat) * r - 0.02
    )  # the shelf ends over the funnel's board, however narrow the throat
    start, top, shelf_underside = edge - p.run_m, mouth + p.rise_m, mouth + p.rise_m - 0.03

    course.block(
        "shelf", (start - r, edge), (-0.08, 0.08), (shelf_underside, top), p.shelf_colour, Surface(2e-5, solref=SOFT)
    )
    for name, y in (("front", -0.07), ("back", 0.07)):
        course.block(
            f"leg_{name}", (start - r, start - r + 0.03), (y - 0.015, y + 0.015), (0, shelf_underside), p.shelf_colour
        )
    course.ball("ball", (start, 0, top + r), r, p.ball_colour, speed=p.speed_m_s)
    course.tray(
        "cup",
        (-half_cup, half_cup),
        depth_span,
        (0, FLOOR_M),
        p.cup_colour,
        wall=WALL_M,
        near=p.cup_m,
        far=p.cup_m,
        back=p.cup_m,
        front=FLOOR_M + 0.4 * r,
    )
    wall_inside, wall_at = rim + 0.03, rim + 0.03 + 0.12  # shadows fall to the right: the wall is there to catch them
    wall = (-wall_inside, wall_at) if p.direction > 0 else (-wall_at, wall_inside)
    course.block("back", wall, (DEPTH_M, DEPTH_M + WALL_M), (0, mouth), p.back_colour)
    for name, sign in (("near", -1), ("far", 1)):
        # The faces of the boards, not their middles, meet the throat's width.
        board_offset = p.half_throat * r + p.board_m / 2 * cos(slope) + 0.008 * sin(slope)
        middle = (sign * board_offset, 0, p.throat_at_m + p.board_m / 2 * sin(slope) - 0.008 * cos(slope))
        size = (p.board_m / 2, DEPTH_M - 0.005, 0.008)
        board = course.slab(f"board_{name}", middle, size, p.board_colour, falls_rad=-sign * slope)
        Surface(0.002, sliding=0.4, solref=SOFT).on(board)
    course.mark("cup", "cup_floor")
    course.mark("funnel", (0.6 * rim, DEPTH_M), p.board_colour)
    return course.scene(
        p,
        decisive=["ball"],
        hidden=["board_near", "board_far"],
        cover=course.box(wall, (-DEPTH_M, DEPTH_M + 0.08), (0, mouth + 0.03), right=0.05),
        in_view=[
            course.box(wall, (-DEPTH_M, DEPTH_M + WALL_M), (0, mouth)),
            course.box((start - r, edge), (-0.085, 0.085), (0, top)),
        ],
        things=[f"{p.ball_colour} ball", f"{p.cup_colour} cup", f"{p.shelf_colour} shelf", "funnel"],
        also=["board", "wall"],
    )


def outcome(motion: Motion, p: Params) -> Reading:
    """Read 'yes' while the ball is below the throat, 'no' while it is stuck above."""
    ball = motion.pos("ball")
    height = ball[:, 2] - p.throat_at_m
    is_through = (height < -p.radius_m) & (np.abs(ball[:, 0]) < p.cup_half_m)
    end = float(height[-1])
    margin = -p.radius_m - end if end < 0 else (1 - p.half_throat) * p.radius_m
    if is_through[-1]:
        return Reading(["yes" if is_past else None for is_past in is_through], margin)
    is_at_rest = np.linalg.norm(ball - ball[-1], axis=1) < 0.5 * p.radius_m
    is_stuck = 0 < end < 2 * p.radius_m
    return Reading(["no" if is_stuck and is_still else None for is_still in is_at_rest], margin)


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return whether the resting ball is below the upper edge of the cup."""
    path = [round_blob(frame, slots["ball"], fill=0.92, longer=2.5) for frame in frames[-3:]]
    ball, cup = path[-1], largest(frames[-1], slots["cup"], 150)
    if ball is None or not is_at_rest(path) or cup is None:
        return None
    return "yes" if ball.y > cup.box[1] else "no"


FAMILY = scene_family(
    "funnel",
    category="other",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {ball} ball come through the funnel into the {cup} cup, yes or no?",
        "Is the {ball} ball in the {cup} cup below the funnel in the end: yes or no?",
        "Does the {ball} ball fit through the funnel and drop into the {cup} cup, yes or no?",
        yes=["yes it does", "it comes through", "it drops into the cup", "in the cup"],
        no=["no it does not", "it gets stuck", "it gets stuck in the funnel", "it stays in the funnel"],
    ),
    asides=[
        comes_from("On which side of the picture is the shelf that the ball rolls along, left or right?"),
        colour_of("ball", "What colour is the rolling ball: {choices}?", PARTS),
        colour_of("shelf", "What colour is the shelf on legs: {choices}?", PARTS),
    ],
    observe=observe,
    min_margin_m=0.01,
    twins=twins,
)
