"""A ball rolls into a forked tunnel: by which exit does it come out?

Control: both exits and the tray at each of them are in view. Void: the occluder stands before the fork and the trays;
the ramp is seen above it.
Hidden element: the deflector in the fork, which is turned to lead the ball to the left or to the right.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from traps_pipeline.scenes.parts.course import SHADOW_RIGHT, Course, Span, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD, end_of, small_blob
from traps_pipeline.scenes.parts.questions import colour_from, left_or_right
from traps_pipeline.scenes.parts.ramp import Ramp
from traps_pipeline.scenes.parts.readings import Reading, side_while
from traps_pipeline.scenes.parts.vary import apart, between, hidden, in_front, shuffled
from traps_pipeline.scenes.parts.vision import largest
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene

FLOOR_M = 0.05
TRAY_M = 0.02  # lower than the tunnel, so that no ball rolls back into it
WALL_M = 0.012
SLIPPERY = Surface(1e-5, sliding=0.03, spinning=0.001)  # a ball slides along it and keeps its speed
FELT = Surface(0.004)
COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")
PARTS = ("ball", "tunnel")
PLAY_COLOURS, PLAIN_COLOURS = apart(*COLOURS), shuffled("wood", "grey", "white", "black")


@dataclass(frozen=True)
class Params:
    """Parameters; the ball rolls to the camera; turn +1 deflects it to the right."""

    ball_colour: str = PLAY_COLOURS()
    tunnel_colour: str = PLAY_COLOURS()
    left_colour: str = PLAIN_COLOURS()
    right_colour: str = PLAIN_COLOURS()
    ramp_colour: str = PLAIN_COLOURS()
    turn: int = hidden(-1, 1)
    turn_deg: float = between(40, 50)  # angle between the deflector and the ball's way
    radius_m: float = between(0.046, 0.054)
    half_width_m: float = between(0.20, 0.25)  # of the fork
    depth_m: float = between(0.26, 0.30)  # of the fork, from its front to the mouth at its back
    slope_deg: float = between(12, 16)
    covered_m: float = between(0.30, 0.42)  # covered part of the ramp
    open_m: float = between(0.42, 0.54)  # open part of the ramp, above it
    start_m: float = between(0.06, 0.11)  # where the ball starts, from the upper end of the ramp
    tray_m: float = between(0.20, 0.26)
    azimuth_deg: float = in_front(-16, 16)
    elevation_deg: float = between(-36, -28)


def build(p: Params, physics: Physics) -> Scene:
    """Build the fork, its front at the origin, and the ramp down to it from the back."""
    course = Course(physics)
    r, half_width, depth = p.radius_m, p.half_width_m, p.depth_m
    roof, bore, end = FLOOR_M + 2.8 * r, 1.3 * r, p.half_width_m + p.tray_m
    fork, front_span, back_span = (-half_width, half_width), (-WALL_M, 0), (depth, depth + WALL_M)

    course.block("fork_floor", fork, (0, depth), (0, FLOOR_M), p.tunnel_colour)
    course.block("fork_roof", fork, (-WALL_M, depth + WALL_M), (roof, roof + WALL_M), p.tunnel_colour)
    course.block("fork_front", fork, front_span, (0, roof), p.tunnel_colour, SLIPPERY)
    for name, outer_wall, colour in (("left", -1, p.left_colour), ("right", 1, p.right_colour)):
        way_out, tray, high = course.towards(outer_wall), (half_width, end), (0, TRAY_M + 1.2 * r)
        way_out.block(f"fork_back_{name}", (bore, half_width), back_span, (0, roof), p.tunnel_colour)
        way_out.block(f"tray_{name}", tray, (-WALL_M, depth), (0, TRAY_M), colour, FELT)
        way_out.block(f"tray_end_{name}", (end, end + WALL_M), (-WALL_M, depth), high, colour)
        way_out.block(f"tray_front_{name}", tray, (-2 * WALL_M, -WALL_M), (0, TRAY_M + 0.5 * r), colour)
        way_out.block(f"tray_back_{name}", tray, back_span, high, colour)
    half_size = (2.3 * r, 0.006, (roof - 0.004 - FLOOR_M) / 2)
    deflector = SLIPPERY.on(course.slab("deflector", (0, 0.45 * depth, (FLOOR_M + roof) / 2), half_size, "black"))
    yaw = p.turn * float(np.radians(p.turn_deg)) + np.pi / 2
    deflector.quat = [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))]
    ramp = Ramp(p.slope_deg, FLOOR_M, foot_m=depth, towards_camera=True)
    _add_ramp(course, p, ramp, bore)
    start = ramp.at(p.covered_m + p.open_m - p.start_m, r)
    course.ball("ball", start, r, p.ball_colour, rolling=1e-4)

    outer_wall, across = end + WALL_M, (-2 * WALL_M - 0.01, depth + 2 * WALL_M)
    cover = course.box((-outer_wall - 0.01, outer_wall), across, (0, roof + WALL_M), right=SHADOW_RIGHT * 0.15)
    for name, outer_wall, colour in (("left", -1, p.left_colour), ("right", 1, p.right_colour)):
        course.mark(f"{name} exit", (outer_wall * half_width, depth), colour)
    return course.scene(
        p,
        decisive=["ball"],
        hidden=["deflector"],
        cover=cover,
        in_view=[cover, course.box((-bore - WALL_M, bore + WALL_M), (depth, start[1] + p.start_m), (0, start[2] + r))],
        things=[f"{p.ball_colour} ball", f"{p.tunnel_colour} tunnel", "ramp", "upper end of the ramp"],
        also=["tray", "exit"],
        shown_by={"tunnel": ["stem"]},
    )


def _add_ramp(course: Course, p: Params, ramp: Ramp, bore: float) -> None:
    """Add the ramp, its cover below and rails above, and a post under its upper end."""
    length, outer, top = p.covered_m + p.open_m, bore + WALL_M, 2.7 * p.radius_m

    def board(name: str, across: Span, up: Span, over: Span, colour: str, side: int = 1) -> None:
        half_up, half_across, half_over = ((span[1] - span[0]) / 2 for span in (up, across, over))
        ramp.board(
            course,
            name,
            sum(up) / 2,
            sum(over) / 2,
            (half_up, half_across, half_over),
            colour,
            aside=side * sum(across) / 2,
        )

    board("ramp", (-outer, outer), (0, length), (-0.02, 0), p.ramp_colour)
    board("stem_roof", (-outer, outer), (0, p.covered_m), (top, top + WALL_M), p.tunnel_colour)
    for side in (-1, 1):
        board(f"stem_{side}", (bore, outer), (0, p.covered_m), (0, top), p.tunnel_colour, side)
        board(f"rail_{side}", (bore, outer), (p.covered_m, length), (0, 0.4 * p.radius_m), p.ramp_colour, side)
    _, y, z = ramp.at(length - 0.05)
    course.slab("ramp_post", (0, y, (z - 0.03) / 2), (outer, 0.02, (z - 0.03) / 2), p.ramp_colour)


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the side on which the ball is wholly out of the tunnel."""
    across = motion.pos("ball")[:, 0]
    outside_m = np.abs(across) - p.radius_m - p.half_width_m
    return Reading(side_while(outside_m > 0, across, over="right", under="left"), float(outside_m[-1]))


def observe(frames: np.ndarray, slots: Mapping[str, str], ahead: float | None = None) -> str | None:
    """Return the side of the tunnel on which the ball lies at the end."""
    path = [small_blob(frame, slots["ball"]) for frame in frames[-3:]]
    tunnel, ball = largest(frames[-1], slots["tunnel"], 200), end_of(path, ahead, tolerance_px=4)
    if ball is None or tunnel is None:
        return None
    middle = tunnel.box[0] + tunnel.box[2] / 2
    if abs(ball.x - middle) < tunnel.box[2] / 3:
        return None
    return "left" if ball.x < middle else "right"


FAMILY = scene_family(
    "tunnel_exit",
    category="hidden",
    params=Params,
    build=build,
    outcome=outcome,
    question=left_or_right(
        "By which exit does the {ball} ball leave the {tunnel} tunnel, left or right?",
        "By which of its two exits does the {ball} ball leave the forked {tunnel} tunnel: left or right?",
        "Does the {ball} ball come out of the left or the right exit of the {tunnel} tunnel?",
        forms=["{} exit", "the {} exit", "on the {}", "{} side", "to the {}"],
    ),
    asides=[
        colour_from("tunnel", "What colour is the tunnel that the ball rolls into: {choices}?", COLOURS, unlike=PARTS),
        colour_from("ball", "What colour is the ball that rolls down the ramp: {choices}?", COLOURS, unlike=PARTS),
    ],
    observe=observe,
    foresee=partial(observe, ahead=AHEAD),
    min_margin_m=0.02,
)
