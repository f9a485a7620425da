"""A ball rolls off a table and drops: does it bounce over a wall?

Control: the pad under the table's edge, the wall and the tray behind it are in view. Void: the occluder stands before
all of that.
Hidden element: the pad that the ball lands on, which is lively (the ball leaps over the wall) or dead (it stays before
the wall). The pads look the same, and nothing that the ball does before it lands tells them apart.
"""

from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.parts.course import DEAD, Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD, beyond
from traps_pipeline.scenes.parts.questions import colour_of, goes_to, yes_no
from traps_pipeline.scenes.parts.readings import Reading, read_crossing
from traps_pipeline.scenes.parts.vary import apart, between, facing, hidden, one_of, shuffled
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene

FLOOR_M = 0.03  # top of the pad and of the tray
WALL_HALF_M = 0.014
LIVELY = 0.85  # share of its speed that a ball keeps on the lively pad
PLAY_COLOURS, PLAIN_COLOURS = apart("red", "green", "blue", "yellow", "cyan", "purple"), shuffled("wood", "grey")


@dataclass(frozen=True)
class Params:
    """Parameters; lengths run from the table's edge; direction +1 is right."""

    direction: int = one_of(-1, 1)
    ball_colour: str = PLAY_COLOURS()
    wall_colour: str = PLAY_COLOURS()
    pad_colour: str = PLAY_COLOURS()
    board_colour: str = PLAIN_COLOURS()
    table_colour: str = PLAIN_COLOURS()
    lively: bool = hidden(False, True)
    radius_m: float = between(0.045, 0.055)
    speed_m_s: float = between(0.50, 0.66)
    table_m: float = between(0.50, 0.62)
    drop_m: float = between(0.44, 0.54)  # height of the table's top over the pad
    wall_m: float = between(0.13, 0.19)  # height of the wall over the pad
    tray_m: float = between(0.40, 0.50)
    tray_colour: str = one_of("black", "white")
    azimuth_deg: float = facing(-14, 20)
    elevation_deg: float = between(-32, -20)

    @property
    def wall_at_m(self) -> float:
        """Position of the wall, below the top of the bounce."""
        fall_s = float(np.sqrt(2 * self.drop_m / 9.81))
        return (1 + LIVELY) * self.speed_m_s * fall_s + 0.3 * self.radius_m


def build(p: Params, physics: Physics) -> Scene:
    """Build a table, then pad, wall and tray before a board that catches the shadows."""
    course = Course(physics, p.direction)
    r, half_width, rim, top = p.radius_m, 1.7 * p.radius_m, 0.012, FLOOR_M + p.drop_m
    near_face, far_face, end = p.wall_at_m - WALL_HALF_M, p.wall_at_m + WALL_HALF_M, p.wall_at_m + p.tray_m
    depth_span, floor, wall_span = (-half_width, half_width), (0, FLOOR_M), (0, FLOOR_M + p.wall_m)
    pad = Surface(1e-3, solref=(-50000.0, -22.0) if p.lively else DEAD, priority=2)

    course.block("table", (-p.table_m, 0), depth_span, (0, top), p.table_colour)
    for i, y in enumerate((-half_width, half_width - rim)):
        course.block(f"table_rail_{i}", (-p.table_m, 0), (y, y + rim), (top, top + 0.3 * r), p.board_colour)
    course.block("pad", (0, near_face), depth_span, floor, p.pad_colour, pad)
    course.block("wall", (near_face, far_face), depth_span, wall_span, p.wall_colour)
    course.block("tray", (far_face, end), depth_span, floor, p.tray_colour, Surface(2e-3, solref=DEAD))
    course.block("front_rail", (0, end), (-half_width - rim, -half_width), (0, FLOOR_M + 0.3 * r), p.table_colour)
    course.block("end", (end, end + 0.02), (-half_width - rim, half_width), wall_span, p.table_colour)
    course.block("board", (0, end + 0.02), (half_width, half_width + 0.015), (0, top), p.board_colour)
    course.ball("ball", (-p.table_m + 1.3 * r, 0, top + r), r, p.ball_colour, speed=p.speed_m_s)
    course.mark("wall", "wall")
    return course.scene(
        p,
        decisive=["ball"],
        hidden=["pad"],
        # The occluder begins a little beyond the edge: a ball just hidden has left the table.
        cover=course.box((0.03, end + 0.02), (-half_width - rim, half_width + 0.03), (0, top + 0.02), right=0.02),
        in_view=[course.box((-p.table_m, end), depth_span, (0, top))],
        things=[f"{p.ball_colour} ball", f"{p.wall_colour} wall", "table", "tray", f"{p.pad_colour} pad"],
        also=["board"],
    )


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the side of the wall on which the ball stays low, on the tray or the pad."""
    ball = motion.pos("ball")
    low = ball[:, 2] < FLOOR_M + p.radius_m + 0.4 * p.wall_m
    return read_crossing(p.direction * ball[:, 0] - p.wall_at_m, valid=low)


FAMILY = scene_family(
    "bounce",
    category="trajectories_drops",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {ball} ball bounce over the {wall} wall, yes or no?",
        "Dropping off the table, does the {ball} ball bounce across the {wall} wall: yes or no?",
        "Does its bounce carry the {ball} ball to the far side of the {wall} wall, yes or no?",
        yes=["yes it does", "it bounces over", "it bounces over the wall", "over the wall"],
        no=["no it does not", "it does not bounce over", "it stays before the wall", "it does not clear the wall"],
    ),
    asides=[
        colour_of("ball", "What colour is the ball that rolls off the table: {choices}?", ("ball", "wall", "pad")),
        goes_to("Towards which side does the ball roll along the table, left or right?"),
    ],
    observe=beyond("ball", "wall"),
    foresee=beyond("ball", "wall", ahead=AHEAD),
    physics=Physics(timestep_s=0.001),
    min_margin_m=0.03,
)
