"""A ball rolls off a shelf into a cup on a beam: how does the beam come to rest?

Control: the whole beam is in view. Void: the occluder stands before it, and only the shelf with the ball is seen.
Hidden element: the place of a counterweight on the other arm. Close to the pivot the ball outweighs it, far out it
outweighs the ball, and at one place between the beam hangs level.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from traps_pipeline.scenes.parts.course import DEAD, Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD
from traps_pipeline.scenes.parts.questions import Filled, Question, colour_of, comes_from
from traps_pipeline.scenes.parts.readings import Reading, lasting_from
from traps_pipeline.scenes.parts.vary import apart, between, facing, hidden, one_of, shuffled
from traps_pipeline.scenes.parts.vision import colour_mask, largest
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene, add_box

BEAM_HALF_M = 0.012  # half thickness of the beam
CUP_M = 0.035  # height of the cup's walls
DROP_SLACK_M = 0.006  # between the ball and the edges that it drops past
BALL_DENSITY = 1000.0
STIFFNESS = 1.6  # of the spring that pulls the beam level, in torques of the ball per radian
LEVEL_M = 0.06  # the ends of a balanced beam differ less in height
TIPPED_DEG = 5.0  # in the picture
OVER = 0.75  # of the tilt that it starts with: a beam that turns so far does not come back
PLAY_COLOURS, PLAIN_COLOURS = apart("red", "green", "blue", "cyan", "purple"), shuffled("wood", "grey")


@dataclass(frozen=True)
class Params:
    """Parameters; lengths run from the pivot; at direction +1 the ball drops left."""

    direction: int = one_of(-1, 1)
    ball_colour: str = PLAY_COLOURS()
    beam_colour: str = PLAY_COLOURS()
    counterweight_colour: str = PLAY_COLOURS()
    shelf_colour: str = PLAIN_COLOURS()
    board_colour: str = PLAIN_COLOURS()
    place: str = hidden("near", "even", "far")  # of the counterweight
    even_m: float = between(0.21, 0.24)  # where the counterweight keeps the ball in balance
    near_share: float = between(0.40, 0.50)  # of `even_m`, for the other two places
    far_share: float = between(1.42, 1.52)
    radius_m: float = between(0.045, 0.052)
    speed_m_s: float = between(0.36, 0.48)
    run_m: float = between(0.42, 0.52)
    arm_m: float = between(0.34, 0.38)  # from the pivot to the cup
    pivot_z_m: float = between(0.19, 0.22)
    tilt_deg: float = between(12, 15)  # at which the beam meets its stops
    counterweight_half_m: float = between(0.036, 0.042)
    azimuth_deg: float = facing(-12, 14)
    elevation_deg: float = between(-28, -18)

    @property
    def half_beam_m(self) -> float:
        """Half the length of the beam."""
        return self.arm_m + self.radius_m + 0.03


def build(p: Params, physics: Physics) -> Scene:
    """Build shelf, beam, and the board that carries the beam and catches shadows."""
    course = Course(physics, p.direction)
    r, half_width = p.radius_m, 1.7 * p.radius_m
    sin, cos = np.sin(np.radians(p.tilt_deg)), np.cos(np.radians(p.tilt_deg))
    drop_at = float(p.arm_m * cos - (BEAM_HALF_M + r) * sin)  # before the pivot, over the cup of the raised arm
    z = float(p.pivot_z_m + (p.half_beam_m * sin + (BEAM_HALF_M + CUP_M) * cos) + 0.03)  # the shelf clears that cup
    edge, stop = -drop_at - r - DROP_SLACK_M, -drop_at + r + DROP_SLACK_M
    occluder_at, end, high = -p.half_beam_m - 0.03, p.half_beam_m + 0.03, z + 2 * r + 0.02
    start, depth_span, wall_span = occluder_at - p.run_m, (-half_width, half_width), (z, z + 0.3 * r)

    course.block("table", (start, occluder_at), depth_span, (0, z), p.shelf_colour)
    course.block("shelf", (occluder_at, edge), depth_span, (z - 0.012, z), p.shelf_colour)
    course.block("shelf_front", (start, edge), (-half_width, -half_width + 0.012), wall_span, p.board_colour)
    course.block("shelf_back", (start, edge), (half_width - 0.012, half_width), wall_span, p.board_colour)
    backstop_box = (stop, stop + 0.012), (-0.6 * half_width, half_width), (z - 0.01, z + 1.5 * r)
    backstop = course.block("backstop", *backstop_box, p.shelf_colour)
    backstop.priority, backstop.solref = 1, list(DEAD)
    course.block("board", (occluder_at, end), (half_width, half_width + 0.015), (0, high), p.board_colour)
    course.block("base", (-p.half_beam_m, p.half_beam_m), (-half_width - 0.02, half_width), (0, 0.025), "black")
    axle = (-0.016, 0.016), (-0.05, half_width), (p.pivot_z_m - 0.016, p.pivot_z_m + 0.016)
    course.block("axle", *axle, "white", solid=False)
    _add_beam(course, p)
    at = (start + 1.2 * r, 0, z + r)
    course.ball("ball", at, r, p.ball_colour, speed=p.speed_m_s, density=BALL_DENSITY)
    course.mark("beam", "axle", p.beam_colour)
    return course.scene(
        p,
        decisive=["beam"],
        hidden=["counterweight"],
        cover=course.box((occluder_at, end), (-half_width - 0.02, half_width + 0.03), (0, high + 0.02), right=0.02),
        in_view=[course.box((start, end), depth_span, (0, high))],
        things=[f"{p.ball_colour} ball", f"{p.beam_colour} beam", "shelf", "counterweight", "cup"],
        also=["board", "base"],
        colours=["black", "white"],
    )


def _add_beam(course: Course, p: Params) -> None:
    """Add the hinged beam with cup and counterweight, at the counterweight's stop."""
    d, half_tilt = p.direction, p.direction * float(np.radians(p.tilt_deg)) / 2
    low, high = sorted((-2 * d * p.tilt_deg, 0.0))
    body = course.hinge("beam", (0, 0, p.pivot_z_m), damping=0.5, range_deg=(low, high))
    body.quat = [float(np.cos(half_tilt)), 0.0, float(np.sin(half_tilt)), 0.0]
    joint, ball_kg = body.first_joint(), float(BALL_DENSITY * 4 / 3 * np.pi * p.radius_m**3)
    joint.stiffness, joint.springref = [STIFFNESS * (ball_kg * 9.81 * p.arm_m), 0, 0], -d * p.tilt_deg
    add_box(body, "beam", (0, 0, 0), (p.half_beam_m, 0.03, BEAM_HALF_M), p.beam_colour, density=300)

    inner, thickness, surface = p.radius_m + 0.004, 0.005, Surface(2e-3, spinning=0.01, solref=DEAD)
    for i, (dx, dy) in enumerate(((-1, 0), (1, 0), (0, -1), (0, 1))):
        centre = (-d * p.arm_m + dx * (inner + thickness), dy * (inner + thickness), BEAM_HALF_M + CUP_M / 2)
        size = (thickness if dx else inner + 2 * thickness, thickness if dy else inner + 2 * thickness, CUP_M / 2)
        surface.on(add_box(body, f"cup_{i}", centre, size, "white", density=1))
    size = p.counterweight_half_m
    counterweight_at = p.even_m * {"near": p.near_share, "even": 1.0, "far": p.far_share}[p.place]
    balancing_density = (
        ball_kg * p.arm_m / (p.even_m * 8 * size**3)
    )  # density that keeps the ball in balance at `even_m`
    at = (d * counterweight_at, 0, BEAM_HALF_M + size)
    add_box(body, "counterweight", at, (size, size, size), p.counterweight_colour, density=balancing_density)


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the lower end, or 'balanced', once the ball lies in the cup.

    A ball that misses the cup has no reading. The margin is how far the height difference of the beam's ends is from
    the threshold between tipped and balanced.
    """
    turn = motion.rot("beam")
    ball = np.einsum("fji,fj->fi", turn, motion.pos("ball") - motion.pos("beam"))  # as the beam sees it
    cup = np.array([-p.direction * p.arm_m, 0.0, BEAM_HALF_M + p.radius_m])
    rest_frame = lasting_from(np.linalg.norm(ball - cup, axis=1) <= 0.02)
    rise = 2 * p.half_beam_m * turn[:, 2, 0]  # of the right end over the left one
    sides = ["balanced" if abs(x) < LEVEL_M else "left" if x > 0 else "right" for x in rise]
    return Reading([x if i >= rest_frame else None for i, x in enumerate(sides)], float(abs(abs(rise[-1]) - LEVEL_M)))


def _ends_or_level(p: Params, rng: np.random.Generator) -> Filled:
    """Return the choices: either end, or none."""
    forms = ("the {} end", "{} end", "to the {}", "tipped to the {}", "the {} side", "the {} end is lower")
    aliases = {form.format(side): side for side in ("left", "right") for form in forms}
    aliases |= dict.fromkeys(("level", "it is balanced", "in balance"), "balanced")
    return Filled(("left", "right", "balanced"), aliases, {})


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Compare the last slopes of beam and base; return None if the beam is unseen."""
    slopes = [(_slope_deg(frame, slots["beam"], 200), _slope_deg(frame, "black", 100)) for frame in frames[-3:]]
    tilts = [beam - base for beam, base in slopes if beam is not None and base is not None]
    if len(tilts) < len(slopes) or max(tilts) - min(tilts) > TIPPED_DEG:
        return None
    tilt = float(np.median(tilts))
    return "balanced" if abs(tilt) < TIPPED_DEG else "right" if tilt > 0 else "left"


def foresee(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Predict the end from the swing: still tipped over, or level if it slows."""
    slopes = [(_slope_deg(frame, slots["beam"], 200), _slope_deg(frame, "black", 100)) for frame in frames]
    tilts = [beam - base for beam, base in slopes if beam is not None and base is not None]
    if len(tilts) < 3 or abs(tilts[0]) < TIPPED_DEG:
        return None
    next_tilt = tilts[-1] + AHEAD * (tilts[-1] - tilts[-2])
    if min(abs(next_tilt), abs(tilts[-1])) < OVER * abs(tilts[0]):
        return "balanced"
    return "right" if next_tilt > 0 else "left"


def _slope_deg(frame: np.ndarray, colour: str, min_area: int) -> float | None:
    """Return the slope of a colour's longest strip, positive if it falls to the right."""
    blob = largest(frame, colour, min_area)
    if blob is None or blob.box[2] < 80:
        return None
    x, y, width, height = blob.box
    part = colour_mask(frame, colour)[y : y + height, x : x + width]
    _, labels = cv2.connectedComponents(part.astype(np.uint8), connectivity=8)
    strip = labels == np.bincount(labels[labels > 0]).argmax()
    columns = np.flatnonzero(strip.any(axis=0))
    rows = np.array([np.flatnonzero(strip[:, c]).mean() for c in columns])
    return float(np.degrees(np.arctan(np.polyfit(columns, rows, 1)[0])))


FAMILY = scene_family(
    "balance",
    category="pendulums_levers",
    params=Params,
    build=build,
    outcome=outcome,
    question=Question(
        "direction",
        (
            "Which end of the {beam} beam is lower in the end, left or right, or is the beam balanced?",
            "How does the {beam} beam come to rest: tipped to the left, tipped to the right or balanced?",
            "To which side does the {beam} beam tip for good: left, right, or does it end up balanced?",
        ),
        _ends_or_level,
    ),
    asides=[
        colour_of(
            "ball", "What colour is the ball that rolls along the shelf: {choices}?", ("ball", "beam", "counterweight")
        ),
        comes_from("From which side does the ball roll along the shelf, left or right?"),
    ],
    observe=observe,
    foresee=foresee,
    physics=Physics(timestep_s=0.001),
    min_margin_m=0.02,
)
