"""Two balls collide on a deck and end on one half: which came from that half?

Control: the whole deck is in view. Void: the occluder stands before it; both balls are seen to roll in behind it.
Hidden element: a rough board on one half of the deck. The ball that crosses it arrives slowly and is knocked back. The
ramps end in steps, so that neither ball comes back out; their small head starts are only a lure.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from traps_pipeline.scenes.parts.course import Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD, colours_of_balls, end_of
from traps_pipeline.scenes.parts.questions import which_colour
from traps_pipeline.scenes.parts.readings import Reading, label_from, still_from, undecided
from traps_pipeline.scenes.parts.vary import apart, between, hidden, in_front, several_between, shuffled
from traps_pipeline.scenes.parts.vision import is_occluder, largest, track
from traps_pipeline.scenes.physics.kit import AnswerableQuestion, Motion, Physics, Scene, Vec3, list_choices

DECK_M = 0.035
STEP_M = 0.018  # the ramps end this high over the deck
WALL_M = 0.012
LINE_M = 0.010  # half the width of the centre line
BOARD_M = 0.10
STILL_M = 0.003  # a ball that moves less than this any more is at rest
FELT = Surface(8e-4, priority=2)
LIVELY = Surface(2e-5, sliding=0.05, solref=(-20000.0, -60.0))  # of the balls
SIDES = ("left", "right")
BALL_COLOURS = "red", "green", "blue", "yellow", "cyan", "purple"
PLAY_COLOURS, PLAIN_COLOURS = apart(*BALL_COLOURS), shuffled("grey", "white")


@dataclass(frozen=True)
class Params:
    """Parameters; pairs are left and right, lengths run outwards from the centre line."""

    colours: tuple[str, str] = PLAY_COLOURS(2)
    deck_colour: str = PLAIN_COLOURS()
    ramp_colour: str = PLAIN_COLOURS()
    starts_m: tuple[float, float] = several_between(2, 0.05, 0.10)  # from the upper end of the ramp
    rough_side: int = hidden(-1, 1)  # -1 left, +1 right
    slowed: float = between(0.40, 0.48)  # share of its speed that a ball keeps on the rough board
    radius_m: float = between(0.050, 0.058)
    half_deck_m: float = between(0.46, 0.52)
    ramp_m: float = between(0.64, 0.70)
    slope_deg: float = between(5.4, 6.6)
    azimuth_deg: float = in_front(-18, 18)
    elevation_deg: float = between(-38, -24)


def build(p: Params, physics: Physics) -> Scene:
    """Build two ramps, steps, and a deck whose two boards differ only in friction."""
    course = Course(physics)
    r, half_deck, half_width, high = p.radius_m, p.half_deck_m, 1.7 * p.radius_m, DECK_M + 2 * p.radius_m
    depth_span, deck_span, board_at = (-half_width, half_width), (0, DECK_M), half_deck - 0.10
    for i, name in enumerate(SIDES):
        outward_course = course.towards((-1, 1)[i])
        board = Surface(_roughness(p), priority=2) if outward_course.direction == p.rough_side else FELT
        outward_course.block(f"deck_{name}", (LINE_M, board_at - BOARD_M), depth_span, deck_span, p.deck_colour, FELT)
        outward_course.block(f"board_{name}", (board_at - BOARD_M, board_at), depth_span, deck_span, "wood", board)
        outward_course.block(f"entry_{name}", (board_at, half_deck), depth_span, deck_span, p.deck_colour, FELT)
        _add_ramp(outward_course, p, name, half_width)
        at = _ramp_point(p, p.ramp_m - p.starts_m[i], r)
        LIVELY.on(outward_course.ball(f"ball_{name}", at, r, p.colours[i]))
    course.block("line", (-LINE_M, LINE_M), depth_span, deck_span, "black", FELT)
    course.sides("rim", (-half_deck, half_deck), half_width, WALL_M, (0, DECK_M + 0.2 * r), p.ramp_colour)

    across = (-half_width - WALL_M - 0.02, half_width + WALL_M + 0.5 * high)
    course.mark("line", "line")
    return course.scene(
        p,
        decisive=[f"ball_{name}" for name in SIDES],
        hidden=[f"board_{name}" for name in SIDES],
        cover=course.box((-half_deck + 0.01, half_deck - 0.01), across, (0, high)),
        in_view=[course.box((-half_deck - p.ramp_m, half_deck + p.ramp_m), depth_span, (0, high))],
        things=[*(f"{colour} ball" for colour in p.colours), *(f"{name} ramp" for name in SIDES)],
        also=["deck", "line", "board", "side"],
        colours=[*p.colours, "wood", "black"],
        shown_by={"side": ["line"], "deck": ["line"]},
    )


def _roughness(p: Params) -> float:
    """Return rolling friction (m) that leaves a ball its share of its speed. A solid ball slows at 5 g mu / 7 r."""
    drop = (p.ramp_m - sum(p.starts_m) / 2) * np.tan(np.radians(p.slope_deg)) * 10 / 7
    return float(7 / 5 * p.radius_m * drop * (1 - p.slowed**2) / (2 * BOARD_M))


def _ramp_point(p: Params, along: float, over: float = 0.0) -> Vec3:
    """Return the place at a distance from a ramp's foot and from its surface."""
    slope = np.radians(p.slope_deg)
    high = DECK_M + STEP_M + along * np.tan(slope)
    return float(p.half_deck_m + along - over * np.sin(slope)), 0.0, float(high + over * np.cos(slope))


def _add_ramp(course: Course, p: Params, name: str, side: float) -> None:
    """Add the ramp of one side, and the prop under its upper end."""
    slope, half_thick = float(np.radians(p.slope_deg)), 0.012
    half_size = (p.ramp_m / 2 / float(np.cos(slope)), side, half_thick)
    course.slab(f"ramp_{name}", _ramp_point(p, p.ramp_m / 2, -half_thick), half_size, p.ramp_colour, falls_rad=-slope)
    foot, _, top = _ramp_point(p, p.ramp_m - 0.05)
    middle = top / 2 - 0.012
    course.slab(f"prop_{name}", (foot, 0, middle), (0.012, side, middle), p.ramp_colour)


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the colour of the ball on its own side, once both rest on that side."""
    ends = [motion.pos(f"ball_{name}")[:, 0] for name in SIDES]
    left, right = (float(x[-1]) for x in ends)
    margin = min(abs(left), abs(right))
    if left * right <= 0:
        return Reading(undecided(motion), margin)
    winner = p.colours[0] if left < 0 else p.colours[1]
    return Reading(label_from(still_from(*ends, within_m=STILL_M), winner, motion), margin)


def _ask_aside(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    """Ask for the side or the colour of one ball, which is drawn first."""
    i = int(rng.integers(2))
    if rng.integers(2):
        question = f"On which ramp does the {p.colours[i]} ball start, the left one or the right one?"
        return AnswerableQuestion(question, SIDES, SIDES[i])
    choices = tuple(str(c) for c in rng.permutation(p.colours))
    question = f"Which colour is the ball that starts on the {SIDES[i]} ramp: {list_choices(choices)}?"
    return AnswerableQuestion(question, choices, p.colours[i])


def observe(frames: np.ndarray, slots: Mapping[str, str], ahead: float | None = None) -> str | None:
    """Return the ball that ends on its own side of the black line, if both rest there."""
    line, home_balls = largest(frames[-1], "black"), []
    for colour in colours_of_balls(frames, slots, BALL_COLOURS):
        path = track(frames, colour, 60)
        start, end = path[0], end_of(path, ahead)
        if line is None or start is None or end is None or is_occluder(start) or is_occluder(end):
            return None
        if (start.x - line.x) * (end.x - line.x) > 0:
            home_balls.append(colour)
    return home_balls[0] if len(home_balls) == 1 else None


FAMILY = scene_family(
    "head_on",
    category="collisions",
    params=Params,
    build=build,
    outcome=outcome,
    question=which_colour(
        "The two balls collide and end up on one side of the black line: which one came from that side, {choices}?",
        "Both balls come to rest on one side of the black line: which of them started on that side, {choices}?",
        "What colour is the ball that started on the side of the black line where both balls end up: {choices}?",
        colours=lambda p: p.colours,
        forms=["{} ball", "the {} one", "the {} ball", "the side of the {} ball"],
    ),
    asides=[_ask_aside],
    observe=observe,
    foresee=partial(observe, ahead=AHEAD),
    min_margin_m=0.05,
)
