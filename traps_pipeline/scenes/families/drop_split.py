"""A ball drops onto a ridge between two bins: on which side does it come down?

Control: ridge and bins are in view, the left bin red and the right one blue. Void: the occluder stands before them.
Hidden element: the ridge, which stands a little to the left or to the right of where the ball comes down. The drop is
the same either way and drifts to either side, whichever the ridge then turns the ball to.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import atan2, hypot

import numpy as np

from traps_pipeline.scenes.parts.course import SOFT, Course, Surface, part_colours
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import extrapolate, round_blob
from traps_pipeline.scenes.parts.questions import Aside, choice_of, either, left_or_right
from traps_pipeline.scenes.parts.readings import Reading, side_while
from traps_pipeline.scenes.parts.vary import Drawn, apart, between, drawn_by, in_front, one_of, shuffled
from traps_pipeline.scenes.parts.vision import colour_mask, is_at_rest, largest, slanting_edges
from traps_pipeline.scenes.physics.kit import AnswerableQuestion, Motion, Physics, Scene, uniform

GRAVITY = 9.81
FLOOR_M = 0.02  # thickness of the bins' floors
WALL_M = 0.014
DEPTH_M = 0.15  # half of the bins' depth
FELT = Surface(0.004, sliding=0.6, solref=SOFT)
FREE_COLOURS = ("green", "yellow", "orange", "cyan", "purple")  # the bins are red and blue
SLANTS = 0.8, 3.0  # rows a column, of the ridge's edges in the picture
EDGE_PX = 60  # least length of the edges of either side
PLAY_COLOURS, PLAIN_COLOURS = apart(*FREE_COLOURS), shuffled("grey", "black", "white")


def _offset(rng: np.random.Generator, so_far: Drawn) -> float:
    """Draw an offset to either side that surely turns the ball that way."""
    return round(int(rng.choice([-1, 1])) * uniform(rng, 0.45, 0.75) * so_far["radius_m"], 4)


@dataclass(frozen=True)
class Params:
    """Parameters; drift is in m/s to the right; cube_side +1 is right of the bins."""

    radius_m: float = between(0.068, 0.080)
    ball_colour: str = PLAY_COLOURS()
    cube_colour: str = PLAY_COLOURS()
    wedge_colour: str = PLAIN_COLOURS()
    back_colour: str = PLAIN_COLOURS()
    release_m: float = between(1.15, 1.35)  # height of the ball's centre in the first frame
    toss_m_s: float = between(2.0, 2.5)  # how fast it still rises then
    drift_m_s: float = between(-0.22, 0.22)
    ridge_m: float = between(0.34, 0.42)  # height of the ridge
    foot_m: float = between(0.20, 0.26)  # half of the ridge's width at its foot
    bin_m: float = between(0.56, 0.66)  # where the bins end, from the middle
    offset_m: float = drawn_by(_offset)  # from where the ball meets the ridge's height to the ridge: the hidden element
    cube_side: int = one_of(-1, 1)
    cube_m: float = between(0.12, 0.18)
    azimuth_deg: float = in_front(-18, 18)
    elevation_deg: float = between(-34, -22)


def twins(p: Params) -> list[Params]:
    """Return another world behind the same void: the ridge stands on the drop's other side."""
    return [replace(p, offset_m=-p.offset_m)]


def build(p: Params, physics: Physics) -> Scene:
    """Build bins with a high back and a low front, a ridge of two boards, and a cube."""
    course = Course(physics, surface=FELT)
    r, end, high = p.radius_m, p.bin_m, p.ridge_m + 0.10
    outer, depth_span = end + WALL_M, (-DEPTH_M, DEPTH_M)
    bins = (("left", "red", (-end, 0), (-outer, -end)), ("right", "blue", (0, end), (end, outer)))
    for name, colour, floor, wall in bins:
        course.block(f"{name}_floor", floor, depth_span, (0, FLOOR_M), colour)
        course.block(f"{name}_end", wall, depth_span, (0, 0.24), colour)
        course.block(f"{name}_front", floor, (-DEPTH_M - WALL_M, -DEPTH_M), (0, FLOOR_M + 0.4 * r), colour)
    course.block("back", (-outer, outer), (DEPTH_M, DEPTH_M + WALL_M), (0, high), p.back_colour)
    half_board = (hypot(p.foot_m, p.ridge_m) / 2, DEPTH_M, 0.01)
    for name, side in (("left", -1), ("right", 1)):
        middle = (p.offset_m + side * p.foot_m / 2, 0, FLOOR_M + p.ridge_m / 2 - 0.02)
        slope = side * atan2(p.ridge_m, p.foot_m)
        FELT.on(course.slab(f"ridge_{name}", middle, half_board, p.wedge_colour, falls_rad=slope))

    cube_at = p.cube_side * (end + 0.20 + p.cube_m / 2 + (0.15 if p.cube_side > 0 else 0.0))
    half_cube = p.cube_m / 2
    course.block(
        "cube", (cube_at - half_cube, cube_at + half_cube), (-half_cube, half_cube), (0, p.cube_m), p.cube_colour
    )
    fall_s = (p.toss_m_s + (p.toss_m_s**2 + 2 * GRAVITY * (p.release_m - r - p.ridge_m)) ** 0.5) / GRAVITY
    start, throw = (-p.drift_m_s * fall_s, 0, p.release_m), (p.drift_m_s, p.toss_m_s)
    course.ball("ball", start, r, p.ball_colour, thrown=throw, rolling=0.0002).solref = list(SOFT)

    front = -DEPTH_M - WALL_M
    things = (f"{p.ball_colour} ball", f"{p.cube_colour} cube", "red bin", "blue bin")
    for side in ("left", "right"):
        course.mark(f"{side} bin", f"{side}_floor")
    course.mark("ridge", (0.0, DEPTH_M), p.wedge_colour)
    scene = course.scene(
        p,
        decisive=["ball"],
        hidden=["ridge_left", "ridge_right"],
        cover=course.box((-outer, outer), (front, DEPTH_M + 0.10), (0, high + 0.02), right=0.04),
        in_view=[
            course.box((-outer, outer), (front, DEPTH_M + WALL_M), (0, high)),
            course.box((cube_at - half_cube, cube_at + half_cube), (-half_cube, half_cube), (0, p.cube_m)),
        ],
        things=things,
        also=["ridge", "wall", "side"],
        colours=["red", "blue"],
        shown_by={"side": ["bin"]},
    )
    phrases = (*things, "ridge between the bins")  # which does not end in its noun
    return replace(scene, inventory=replace(scene.inventory, things=phrases))


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the side of the ridge that the ball is on, while it is below the top."""
    ball = motion.pos("ball")
    past_m = ball[:, 0] - p.offset_m
    return Reading(side_while(ball[:, 2] < p.ridge_m, past_m, "right", "left"), float(abs(past_m[-1])))


def _ask_colour(part: str, question: str) -> Aside:
    """Ask for the colour of ball or cube; the third choice is a colour of neither."""

    def ask(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
        colours = [p.ball_colour, p.cube_colour]
        third_colour = next(str(c) for c in rng.permutation(FREE_COLOURS) if c not in colours)
        return choice_of(question, lambda p: [*colours, third_colour], lambda p: part_colours(p)[part])(p, rng)

    return ask


def _middle_x(frame: np.ndarray, colour: str) -> float | None:
    """Return the middle (px) of all that has a colour; None if there is little of it."""
    columns = np.flatnonzero(colour_mask(frame, colour).sum(axis=0) >= 4)
    return float(columns[0] + columns[-1]) / 2 if len(columns) >= 15 else None


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return whether the resting ball is nearer to the red or the blue bin's middle."""
    path = [round_blob(frame, slots["ball"]) for frame in frames[-3:]]
    ball, red, blue = path[-1], _middle_x(frames[-1], "red"), _middle_x(frames[-1], "blue")
    if ball is None or not is_at_rest(path) or red is None or blue is None:
        return None
    return "left" if abs(ball.x - red) < abs(ball.x - blue) else "right"


def foresee(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Predict the side of the ridge's top, seen by its edges, on which the ball lands."""
    ball = extrapolate([round_blob(frame, slots["ball"]) for frame in frames], 0.5)
    red, blue = (colour_mask(frames[0], colour) for colour in ("red", "blue"))
    bins = [largest(frames[0], colour) for colour in ("red", "blue")]
    if ball is None or bins[0] is None or bins[1] is None:
        return None
    left, right = np.flatnonzero(red.sum(axis=0) >= 4)[0], np.flatnonzero(blue.sum(axis=0) >= 4)[-1]
    floor, width = int(min(bins[0].y, bins[1].y)), int(right - left)
    first = int(left + 0.2 * width)
    part = np.s_[max(0, floor - width // 3) : floor, first : int(right - 0.2 * width)]
    halves = [np.nonzero(edges)[1] for edges in slanting_edges(frames[0], part, SLANTS)]
    if min(len(columns) for columns in halves) < EDGE_PX:
        return None
    top = first + sum(float(columns.mean()) for columns in halves) / 2
    return "right" if ball.x > top else "left"


FAMILY = scene_family(
    "drop_split",
    category="trajectories_drops",
    params=Params,
    build=build,
    outcome=outcome,
    question=left_or_right(
        "Into which bin does the {ball} ball drop off the ridge, the left (red) or the right (blue) one?",
        "On which side of the ridge does the {ball} ball come down, in the left or in the right bin?",
        "Does the ridge send the {ball} ball to the left (red bin) or to the right (blue bin)?",
        forms=["{1}", "{1} bin", "{0} bin", "to the {0}", "the {0} side", "{0} side", "the {1} one"],
        colours=lambda p: ("red", "blue"),
    ),
    asides=[
        either(
            "At which edge of the picture does the {cube} cube stand, left or right?",
            ("left", "right"),
            lambda p: "right" if p.cube_side > 0 else "left",
        ),
        _ask_colour("ball", "What colour is the ball: {choices}?"),
        _ask_colour("cube", "What colour is the cube beside the bins: {choices}?"),
    ],
    observe=observe,
    foresee=foresee,
    min_margin_m=0.08,
    twins=twins,
    looks=("bystanders", "camera", "light", "material", "panel"),
)
