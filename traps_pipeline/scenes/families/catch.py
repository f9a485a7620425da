"""A ball is thrown in a high arc: does it land in the basket?

Control: the walled pen that it comes down in is in view, and the basket in it. Void: the occluder stands before the
pen. Hidden element: the basket, which stands where the ball comes down or a step before or beyond. The throw is the
same either way, and the walls of the pen keep the ball behind the occluder.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.parts.course import SHADOW_BACK, SHADOW_RIGHT, SOFT, Course, Span, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import end_of, round_blob
from traps_pipeline.scenes.parts.questions import colour_of, comes_from, yes_no
from traps_pipeline.scenes.parts.readings import Reading, side_while
from traps_pipeline.scenes.parts.vary import Drawn, apart, between, drawn_by, facing, hidden, one_of
from traps_pipeline.scenes.parts.vision import blobs, colour_mask
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene, uniform

GRAVITY = 9.81
FLOOR_M = 0.02  # thickness of the pen's floor and of the basket's
WALL_M = 0.012
DEPTH_M = 0.17  # half of the pen's depth
PLAY_COLOURS = apart("red", "green", "blue", "yellow", "orange", "cyan", "purple")
PARTS = ("ball", "pedestal", "basket")


def _basket_half(rng: np.random.Generator, so_far: Drawn) -> float:
    """Return the ball's diameter and a little more; `step_m` needs it unrounded."""
    so_far["half"] = uniform(rng, 2.0, 2.2) * so_far["radius_m"]
    return round(so_far["half"], 4)


def _step(rng: np.random.Generator, so_far: Drawn) -> float:
    """Draw a sideways step, so long that the ball misses the basket."""
    side = int(rng.choice([-1, 1]))
    return round(side * (so_far["half"] + so_far["radius_m"] + uniform(rng, 0.07, 0.10)), 4)


@dataclass(frozen=True)
class Params:
    """Parameters; lengths run from the pedestal's middle; direction +1 is right."""

    direction: int = one_of(-1, 1)
    radius_m: float = between(0.068, 0.080)
    basket_half_m: float = drawn_by(_basket_half)
    ball_colour: str = PLAY_COLOURS()
    basket_colour: str = PLAY_COLOURS()
    pedestal_colour: str = PLAY_COLOURS()
    pedestal_m: float = between(0.28, 0.42)  # height of the pedestal that the ball starts from
    speed_along_m_s: float = between(1.20, 1.40)
    speed_up_m_s: float = between(3.3, 3.8)
    rim_m: float = between(0.15, 0.18)  # height of the basket's sides
    step_m: float = drawn_by(_step)  # from where the ball comes down to the basket's other place, signed
    in_place: bool = hidden(False, True)  # whether the basket stands where the ball comes down
    pen_colour: str = one_of("grey", "black")
    azimuth_deg: float = facing(-14, 20)
    elevation_deg: float = between(-36, -24)

    @property
    def landing_m(self) -> float:
        """Position of the ball when it falls to the height of the basket's sides."""
        fall_m = self.pedestal_m + 0.01 - self.rim_m
        up = self.speed_up_m_s
        return self.speed_along_m_s * (up + (up * up + 2 * GRAVITY * fall_m) ** 0.5) / GRAVITY

    @property
    def basket_m(self) -> float:
        """Position of the basket's middle."""
        return self.landing_m + 0.02 + (0.0 if self.in_place else self.step_m)

    @property
    def pen_m(self) -> Span:
        """Ends of the pen, which holds both places of the basket and a ball beside it."""
        offset_m = self.basket_half_m + 0.03
        room = 2.9 * self.radius_m
        low = self.landing_m + min(0.0, self.step_m) - (offset_m if self.step_m < 0 else max(room, offset_m))
        high = self.landing_m + max(0.0, self.step_m) + (offset_m if self.step_m > 0 else max(room, offset_m)) + 0.04
        return low, high


def build(p: Params, physics: Physics) -> Scene:
    """Build the pedestal, the pen with a high back and a low front, and the basket."""
    course = Course(physics, p.direction, Surface(0.004, solref=SOFT))
    r, rim, depth_span, colour = p.radius_m, p.rim_m, (-DEPTH_M, DEPTH_M), p.pen_colour
    course.block("pedestal", (-0.09, 0.09), (-0.09, 0.09), (0, p.pedestal_m), p.pedestal_colour)
    throw = (p.speed_along_m_s, p.speed_up_m_s)
    course.ball("ball", (0, 0, p.pedestal_m + 0.01 + r), r, p.ball_colour, thrown=throw, rolling=0.0002)

    low, high = p.pen_m
    pen = (low - WALL_M, high + WALL_M)
    course.block("pen_floor", (low, high), depth_span, (0, FLOOR_M), colour)
    course.block("pen_near", (pen[0], low), depth_span, (0, rim), colour)
    course.block("pen_far", (high, pen[1]), depth_span, (0, rim + 0.12), colour)
    course.block("pen_back", pen, (DEPTH_M, DEPTH_M + WALL_M), (0, rim), colour)
    top, middle, inner = FLOOR_M + rim, p.basket_m, DEPTH_M - 0.03
    basket = course.tray(
        "basket",
        (middle - p.basket_half_m, middle + p.basket_half_m),
        (-inner, inner),
        (FLOOR_M, 2 * FLOOR_M),
        p.basket_colour,
        wall=WALL_M,
        near=top,
        far=top,
        back=top,
        front=FLOOR_M + 0.45 * r,
    )
    course.mark("basket", (sum(p.pen_m) / 2, DEPTH_M), p.basket_colour)  # between its two places
    return course.scene(
        p,
        decisive=["ball"],
        hidden=basket,
        cover=course.box(
            pen, (-DEPTH_M, DEPTH_M + SHADOW_BACK * (rim + 0.2)), (0, rim + 0.20), right=SHADOW_RIGHT * (rim + 0.22)
        ),
        in_view=[
            course.box(pen, depth_span, (0, rim + 0.12)),
            course.box((-0.09, 0.09), (-0.09, 0.09), (0, p.pedestal_m)),
        ],
        things=[f"{p.ball_colour} ball", f"{p.basket_colour} basket", f"{p.pedestal_colour} pedestal", "pen"],
        also=["wall"],
    )


def outcome(motion: Motion, p: Params) -> Reading:
    """Read 'yes' while the low ball is between the basket's sides, 'no' beside them."""
    ball = motion.pos("ball")
    along = p.direction * ball[:, 0]
    inside_m = p.basket_half_m - np.abs(along - p.basket_m)
    down = (ball[:, 2] < 2 * FLOOR_M + 1.3 * p.radius_m) & (along > p.pen_m[0])
    return Reading(side_while(down, inside_m), float(abs(inside_m[-1])))


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return whether the resting ball is between the basket's sides in the picture."""
    path = [round_blob(frame, slots["ball"]) for frame in frames[-3:]]
    sides, ball = _sides(frames[-1], slots["basket"]), end_of(path)
    if ball is None or sides is None:
        return None
    return "yes" if _is_between(ball.x, sides) else "no"


def foresee(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Predict whether the ball is in the basket when it has fallen to half its height."""
    path = [round_blob(frame, slots["ball"]) for frame in frames[-3:]]
    sides, flight = _sides(frames[-1], slots["basket"]), [ball for ball in path if ball is not None]
    if sides is None or len(flight) < 3:
        return None
    a, b, c = flight
    fall_px, gain_px = c.y - b.y, c.y - 2 * b.y + a.y  # in a frame, and by how much more in the next
    down = (sides[2] + sides[3]) / 2 - c.y
    speed = fall_px + gain_px / 2
    frames_on = (math.sqrt(max(speed**2 + 2 * gain_px * down, 0.0)) - speed) / gain_px if gain_px > 0 else 0.0
    return "yes" if _is_between(c.x + max(frames_on, 0.0) * (c.x - b.x), sides) else "no"


def _sides(frame: np.ndarray, colour: str) -> tuple[float, float, float, float] | None:
    """Return left, right, top and bottom (px) of all that has the basket's colour."""
    boxes = [part.box for part in blobs(colour_mask(frame, colour), 40)]
    if not boxes:
        return None
    right, bottom = max(x + width for x, _, width, _ in boxes), max(y + height for _, y, _, height in boxes)
    return min(box[0] for box in boxes), right, min(box[1] for box in boxes), bottom


def _is_between(x: float, sides: tuple[float, float, float, float]) -> bool:
    left, right = sides[:2]
    return abs(x - (left + right) / 2) < 0.45 * (right - left)


FAMILY = scene_family(
    "catch",
    category="trajectories_drops",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {ball} ball land in the {basket} basket, yes or no?",
        "Is the thrown {ball} ball caught by the {basket} basket: yes or no?",
        "Does the {ball} ball lie in the {basket} basket in the end, yes or no?",
        yes=["yes it does", "it lands in the basket", "it is caught", "in the basket"],
        no=["no it does not", "it misses the basket", "it lands beside the basket", "it misses"],
    ),
    asides=[
        comes_from("From which side is the ball thrown, left or right?"),
        colour_of("ball", "What colour is the ball that is thrown: {choices}?", PARTS),
        colour_of("pedestal", "What colour is the pedestal that the ball is thrown from: {choices}?", PARTS),
    ],
    observe=observe,
    foresee=foresee,
    min_margin_m=0.03,
)
