"""A ball rolls towards a gate that hangs from a lever: does it get past?

Control: lever, gate and the lane beyond are in view. Void: the occluder stands before them.
Hidden element: the counterweight on the lever, which sits far out (the lever holds the gate up) or close to the pivot
(the gate hangs down and the lever's stop locks it). The ball drops down a step behind the occluder: it cannot come
back.
"""

from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.parts.course import Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD, beyond
from traps_pipeline.scenes.parts.questions import colour_of, comes_from, yes_no
from traps_pipeline.scenes.parts.readings import Reading, still_from, yes_while
from traps_pipeline.scenes.parts.vary import apart, between, facing, hidden, one_of, shuffled
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene, add_box

FLOOR_M = 0.03  # the lane behind the occluder
STEP_M = 0.02  # the visible lane lies higher by this
STEP_AT_M = 0.07
GAP_M = 0.012  # under the shut gate
GATE_HALF_M = 0.013
PLAY_COLOURS, PLAIN_COLOURS = apart("red", "green", "blue", "yellow", "cyan", "purple"), shuffled("wood", "grey")


@dataclass(frozen=True)
class Params:
    """Parameters; lengths run from the occluder's edge; direction +1 is right."""

    direction: int = one_of(-1, 1)
    ball_colour: str = PLAY_COLOURS()
    gate_colour: str = PLAY_COLOURS()
    counterweight_colour: str = PLAY_COLOURS()
    lane_colour: str = PLAIN_COLOURS()
    board_colour: str = PLAIN_COLOURS()
    held_open: bool = hidden(False, True)  # whether the counterweight sits far out
    radius_m: float = between(0.043, 0.050)
    speed_m_s: float = between(0.55, 0.72)
    run_m: float = between(0.92, 1.04)  # visible lane
    gate_at_m: float = between(0.30, 0.36)
    arm_m: float = between(0.24, 0.28)  # from the gate to the pivot, and from there to the other end of the lever
    drop_m: float = between(0.22, 0.25)  # length of the gate below the lever
    swing_deg: float = between(23, 26)  # by which the open lever is tilted
    counterweight_half_m: float = between(0.034, 0.040)
    tail_m: float = between(0.08, 0.14)  # lane beyond the lever
    lever_colour: str = one_of("black", "white")
    azimuth_deg: float = facing(-14, 18)
    elevation_deg: float = between(-32, -20)

    @property
    def pivot_m(self) -> tuple[float, float]:
        """Position of the pivot (along, up)."""
        return self.gate_at_m + self.arm_m, FLOOR_M + GAP_M + self.drop_m


def build(p: Params, physics: Physics) -> Scene:
    """Build a lane with a step before a board that carries the lever."""
    course = Course(physics, p.direction)
    r, half_width, rim, top, (pivot, pivot_z) = p.radius_m, 1.7 * p.radius_m, 0.012, FLOOR_M + STEP_M, p.pivot_m
    end = p.gate_at_m + 2 * p.arm_m + p.tail_m
    high = pivot_z + p.arm_m * float(np.sin(np.radians(p.swing_deg))) + 0.06
    depth_span, front = (-half_width, half_width), (-half_width - rim, -half_width)

    course.block("lane_in", (-p.run_m, STEP_AT_M), depth_span, (0, top), p.lane_colour)
    surface = Surface(1e-3)  # the ball comes to rest on it
    course.block("lane", (STEP_AT_M, end), depth_span, (0, FLOOR_M), p.lane_colour, surface)
    course.block("front_in", (-p.run_m, STEP_AT_M), front, (0, top + 0.3 * r), p.board_colour)
    course.block("back_in", (-p.run_m, 0), (half_width, half_width + rim), (0, top + 0.3 * r), p.board_colour)
    course.block("front", (STEP_AT_M, end), front, (0, FLOOR_M + 0.3 * r), p.board_colour)
    course.block("end", (end, end + 0.02), (-half_width - rim, half_width), (0, FLOOR_M + 1.6 * r), p.board_colour)
    course.block("board", (0, end + 0.02), (half_width, half_width + 0.015), (0, high), p.board_colour)
    axle = (pivot - 0.012, pivot + 0.012), (-0.03, half_width), (pivot_z - 0.012, pivot_z + 0.012)
    course.block("axle", *axle, "grey", solid=False)
    _add_lever(course, p, half_width)
    course.ball("ball", (-p.run_m + 1.2 * r, 0, top + r), r, p.ball_colour, speed=p.speed_m_s)
    course.mark("gate", (p.gate_at_m, half_width), p.gate_colour)  # below its place on the lever, open or shut
    return course.scene(
        p,
        decisive=["ball"],
        hidden=["counterweight", "beam", "gate"],
        cover=course.box((0, end + 0.02), (-half_width - rim, half_width + 0.03), (0, high + 0.02), right=0.02),
        in_view=[course.box((-p.run_m, end), depth_span, (0, high))],
        things=[f"{p.ball_colour} ball", f"{p.gate_colour} gate", f"{p.lever_colour} lever", "counterweight"],
        also=["lane", "board"],
    )


def _add_lever(course: Course, p: Params, side: float) -> None:
    """Add lever, gate and counterweight, at rest where the counterweight holds them."""
    start, d = p.swing_deg if p.held_open else 0.0, p.direction
    low, high = sorted((d * -start, d * (p.swing_deg - start)))
    body = course.hinge("lever", (p.pivot_m[0], 0, p.pivot_m[1]), damping=0.05, range_deg=(low, high))
    half_turn = d * float(np.radians(start)) / 2
    body.quat = [float(np.cos(half_turn)), 0.0, float(np.sin(half_turn)), 0.0]
    add_box(body, "beam", (0, 0, 0), (p.arm_m + 0.015, 0.022, 0.011), p.lever_colour, density=200)
    gate = (-d * p.arm_m, 0, -p.drop_m / 2)
    add_box(body, "gate", gate, (GATE_HALF_M, 0.85 * side, p.drop_m / 2), p.gate_colour, density=700)
    size, distance = p.counterweight_half_m, (0.80 if p.held_open else 0.15) * p.arm_m
    centre = (d * distance, 0, 0.011 + size)
    add_box(body, "counterweight", centre, (size, size, size), p.counterweight_colour, density=4000)


def outcome(motion: Motion, p: Params) -> Reading:
    """Read whether the ball is wholly past the gate; 'no' only once it stays in place."""
    along = motion.pos("ball")[:, 0]
    past_m = p.direction * along - p.gate_at_m - GATE_HALF_M - p.radius_m
    return Reading(yes_while(past_m > 0, still_from(along, within_m=0.01)), float(abs(past_m[-1])))


FAMILY = scene_family(
    "lever_gate",
    category="pendulums_levers",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {ball} ball get past the {gate} gate, yes or no?",
        "Is the way open for the {ball} ball to pass under the {gate} gate: yes or no?",
        "Does the {ball} ball come to rest beyond the {gate} gate, yes or no?",
        yes=["yes it does", "it gets past", "it gets past the gate", "it passes the gate"],
        no=["no it does not", "it does not get past", "it is stopped by the gate", "the gate stops it"],
    ),
    asides=[
        colour_of(
            "ball", "What colour is the ball that rolls along the lane: {choices}?", ("ball", "gate", "counterweight")
        ),
        comes_from("From which side does the ball roll in, left or right?"),
    ],
    observe=beyond("ball", "gate"),
    foresee=beyond("ball", "gate", ahead=AHEAD),
    physics=Physics(timestep_s=0.001),
    min_margin_m=0.03,
)
