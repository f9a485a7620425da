"""A ball runs down a slide and up a kicker: does it fly over a barrier?

Control: slide, kicker, barrier and the tray behind it are in view. Void: the occluder stands before all but the upper
slide.
Hidden element: the barrier, which is low (the ball flies over it) or tall (the ball strikes it and drops into the pit
between kicker and barrier). The slide says nothing about it.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from traps_pipeline.scenes.parts.course import DEAD, Course, Point, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import beyond, will_clear
from traps_pipeline.scenes.parts.questions import colour_of, goes_to, yes_no
from traps_pipeline.scenes.parts.readings import Reading, read_crossing
from traps_pipeline.scenes.parts.vary import apart, between, facing, hidden, one_of, shuffled
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene

FLOOR_M = 0.02
BARRIER_HALF_M = 0.014
CATCH = Surface(3e-3, solref=DEAD)  # of pit, tray and barrier
PLAY_COLOURS, PLAIN_COLOURS = apart("red", "green", "blue", "yellow", "cyan", "purple"), shuffled("wood", "grey")


@dataclass(frozen=True)
class Params:
    """Parameters; lengths run from the ledge's end; direction +1 is right."""

    direction: int = one_of(-1, 1)
    ball_colour: str = PLAY_COLOURS()
    barrier_colour: str = PLAY_COLOURS()
    kicker_colour: str = PLAY_COLOURS()
    slide_colour: str = PLAIN_COLOURS()
    board_colour: str = PLAIN_COLOURS()
    tall: bool = hidden(False, True)
    radius_m: float = between(0.045, 0.053)
    ledge_m: float = between(0.26, 0.34)
    speed_m_s: float = between(0.35, 0.50)  # on the ledge
    slide_deg: float = between(27, 33)
    slide_m: float = between(0.46, 0.54)  # horizontal length of the straight slide
    kicker_deg: float = between(37, 43)
    barrier_at_m: float = between(0.17, 0.21)  # from the kicker's lip
    low_barrier_m: float = between(0.07, 0.10)
    tall_barrier_m: float = between(0.30, 0.36)
    tray_m: float = between(0.40, 0.48)
    tray_colour: str = one_of("black", "white")
    azimuth_deg: float = facing(-14, 18)
    elevation_deg: float = between(-32, -20)

    @property
    def way(self) -> list[Point]:
        """Points of the way: a straight slide, then a curve of flat pieces to the lip."""
        slopes_deg = np.linspace(-self.slide_deg, self.kicker_deg, 10)[1:]
        steps = [(0.035 * np.cos(np.radians(b)), 0.035 * np.sin(np.radians(b))) for b in slopes_deg]
        fall_m = self.slide_m * np.tan(np.radians(self.slide_deg))
        points = np.cumsum([(0.0, 0.0), (self.slide_m, -fall_m), *steps], axis=0)
        points[:, 1] += FLOOR_M + 0.015 - points[:, 1].min()
        return [(float(u), float(z)) for u, z in points]


def build(p: Params, physics: Physics) -> Scene:
    """Build ledge, slide, kicker, pit, barrier and tray before a board for shadows."""
    course = Course(physics, p.direction)
    r, half_width, rim = p.radius_m, 1.6 * p.radius_m, 0.012
    (_, top), (lip, lip_z) = p.way[0], p.way[-1]
    barrier, end = lip + p.barrier_at_m, lip + p.barrier_at_m + p.tray_m
    near_face, far_face = barrier - BARRIER_HALF_M, barrier + BARRIER_HALF_M
    depth_span, high, cut = (-half_width, half_width), p.tall_barrier_m + 0.03, 0.55 * p.slide_m

    course.block("ledge", (-p.ledge_m, 0), depth_span, (0, top), p.slide_colour)
    for i, (a, b) in enumerate(pairwise(p.way)):
        course.plank(f"slide_{i}", a, b, half_width, p.kicker_colour)
    course.block("kicker", (lip - 0.05, lip), depth_span, (0, lip_z - 0.05), p.kicker_colour)
    course.block("pit", (lip, near_face), depth_span, (0, FLOOR_M), p.tray_colour, CATCH)
    height = p.tall_barrier_m if p.tall else p.low_barrier_m
    course.block("barrier", (near_face, far_face), depth_span, (0, height), p.barrier_colour, CATCH)
    course.block("tray", (far_face, end), depth_span, (0, FLOOR_M), p.tray_colour, CATCH)
    course.block("end", (end, end + 0.02), (-half_width - rim, half_width), (0, 0.20), p.slide_colour, CATCH)
    course.block("front_rail", (lip, end), (-half_width - rim, -half_width), (0, FLOOR_M + 0.3 * r), p.slide_colour)
    course.block("board", (cut, end + 0.02), (half_width, half_width + 0.015), (0, high), p.board_colour)
    course.ball("ball", (-p.ledge_m + 1.2 * r, 0, top + r), r, p.ball_colour, speed=p.speed_m_s)
    course.mark("barrier", "barrier")
    return course.scene(
        p,
        decisive=["ball"],
        hidden=["barrier"],
        cover=course.box((cut, end + 0.02), (-half_width - rim, half_width + 0.03), (0, high + 0.03), right=0.02),
        in_view=[course.box((-p.ledge_m, end), depth_span, (0, high))],
        things=[f"{p.ball_colour} ball", f"{p.barrier_colour} barrier", "slide", "tray", f"{p.kicker_colour} kicker"],
        also=["ramp", "board"],
        shown_by={"ramp": ["slide"]},
    )


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the side of the barrier on which the ball stays low, past the kicker."""
    ball = motion.pos("ball")
    past_m = p.direction * ball[:, 0] - p.way[-1][0] - p.barrier_at_m
    return read_crossing(past_m, valid=(past_m > -p.barrier_at_m) & (ball[:, 2] < FLOOR_M + p.radius_m + 0.03))


FAMILY = scene_family(
    "launch",
    category="pendulums_levers",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {ball} ball clear the {barrier} barrier, yes or no?",
        "Launched off the ramp, does the {ball} ball fly over the {barrier} barrier: yes or no?",
        "Does the {ball} ball land beyond the {barrier} barrier, yes or no?",
        yes=["yes it does", "it clears the barrier", "it flies over", "it lands beyond the barrier"],
        no=["no it does not", "it does not clear the barrier", "it hits the barrier", "it is stopped by the barrier"],
    ),
    asides=[
        colour_of(
            "ball", "What colour is the ball that runs down the slide: {choices}?", ("ball", "barrier", "kicker")
        ),
        goes_to("Towards which side does the ball run down the slide, left or right?"),
    ],
    observe=beyond("ball", "barrier"),
    foresee=will_clear("ball", "barrier"),
    physics=Physics(timestep_s=0.001),
    min_margin_m=0.03,
)
