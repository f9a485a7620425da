"""Two balls roll down ramps side by side: which one is first in the tray?

Control: tracks and tray are in view. Void: the occluder stands before them, only the upper parts of the ramps are in
view. Hidden element: one of the tracks crosses a rough board that slows its ball to a creep. The starting
places, of which one is higher than the other, say nothing about which track it is.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.parts.course import Course, brake
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import colours_of_balls, compact_blob
from traps_pipeline.scenes.parts.questions import which_colour
from traps_pipeline.scenes.parts.ramp import Ramp
from traps_pipeline.scenes.parts.readings import Reading, first_past
from traps_pipeline.scenes.parts.vary import Drawn, apart, between, drawn_by, hidden, in_front
from traps_pipeline.scenes.parts.vision import Blob, is_at_rest
from traps_pipeline.scenes.physics.kit import AnswerableQuestion, Motion, Physics, Scene, list_choices, uniform

BOARD_M = 0.016  # thickness of a ramp
WALL_M = 0.012
ROUGH_M = 0.16  # length of the rough board
ARRIVING = 0.86  # share of its energy that a ball still has after the foot of the ramp, as measured
MIN_LEAD_S = 0.35  # a closer finish could fall between two sampled frames
BALLS = ("ball_0", "ball_1")
FRAMES_AHEAD = 2.0  # frames until the first ball is in the tray
BALL_COLOURS = "red", "green", "blue", "yellow", "orange", "cyan", "purple"
PLAY_COLOURS = apart(*BALL_COLOURS)


def _tray_colour(rng: np.random.Generator, so_far: Drawn) -> str:
    """Draw the tray's colour, and the two colours that the tracks may have."""
    tray, so_far["first"], so_far["second"] = (str(c) for c in rng.permutation(["wood", "grey", "black"]))
    return tray


def _track_colours(rng: np.random.Generator, so_far: Drawn) -> tuple[str, str]:
    """Draw the tracks' colours: the same for both, or one each."""
    return so_far["first"], so_far["first" if rng.integers(2) else "second"]


def _starts(rng: np.random.Generator, so_far: Drawn) -> tuple[float, float]:
    """Draw the starts: one near the top of its ramp, one lower, either on the left."""
    top, lower = so_far["ramp_m"] - 0.07, uniform(rng, 0.08, 0.13)
    high, low = round(top, 4), round(top - lower, 4)
    return (low, high) if rng.integers(2) else (high, low)


@dataclass(frozen=True)
class Params:
    """Parameters; pairs are left and right track; y runs back from the tray's front."""

    colours: tuple[str, str] = PLAY_COLOURS(2)
    tray_colour: str = drawn_by(_tray_colour)
    ramp_m: float = between(0.60, 0.70)
    starts_m: tuple[float, float] = drawn_by(_starts)  # from the foot of the ramp up along it to where each ball starts
    radius_m: float = between(0.050, 0.060)
    rough_track: int = hidden(0, 1)  # 0 left, 1 right
    slope_deg: float = between(12.5, 15.5)
    creep_m_s: float = between(0.16, 0.22)  # speed at which the ball should leave the rough board
    apart_m: float = between(0.26, 0.40)  # between the middles of the tracks
    track_m: float = between(0.05, 0.08)  # height of the tracks
    tray_m: float = between(0.17, 0.22)
    after_m: float = between(0.15, 0.19)  # track between the rough board and the tray
    lead_m: float = between(0.075, 0.11)  # track between the ramp and the rough board
    track_colours: tuple[str, str] = drawn_by(_track_colours)
    azimuth_deg: float = in_front(-16, 16)
    elevation_deg: float = between(-42, -33)


def build(p: Params, physics: Physics) -> Scene:
    """Build two tracks towards the front, a ramp behind each, and one tray."""
    course = Course(physics)
    r, half_track, track = p.radius_m, 1.5 * p.radius_m, (0, p.track_m)
    rough_span = (p.tray_m + p.after_m, p.tray_m + p.after_m + ROUGH_M)
    foot = rough_span[1] + p.lead_m
    mat_colour = next(c for c in ("black", "wood", "grey") if c not in p.track_colours)
    half_up, tracks = p.ramp_m / 2, (-p.apart_m / 2, p.apart_m / 2)
    ramps = [Ramp(p.slope_deg, p.track_m, foot, towards_camera=True, middle_m=x) for x in tracks]
    for i, (x, ramp) in enumerate(zip(tracks, ramps, strict=True)):
        across, colour = (x - half_track, x + half_track), p.track_colours[i]
        course.block(f"track_out_{i}", across, (p.tray_m, rough_span[0]), track, colour)
        mat, rolling_friction = (mat_colour, _roughness(p, i, physics)) if i == p.rough_track else (colour, 2e-5)
        course.block(f"board_{i}", across, rough_span, track, mat).friction = [4.0, 0.005, rolling_friction]
        course.block(f"track_in_{i}", across, (rough_span[1], foot + 0.01), track, colour)
        for k in (-1, 1):
            rail = (x + k * half_track - 0.004, x + k * half_track + 0.004)
            course.block(f"rail_{i}_{k}", rail, (p.tray_m, foot), (0, p.track_m + 0.01), colour)
        ramp.board(course, f"ramp_{i}", half_up, -BOARD_M / 2, (half_up, half_track, BOARD_M / 2), colour)
        for k in (-1, 1):
            ramp.board(
                course, f"ramp_rail_{i}_{k}", half_up, 0, (half_up, 0.005, 0.4 * r), colour, aside=k * half_track
            )
        ramp.support(course, f"support_{i}", p.ramp_m - 0.05, BOARD_M, 0.8 * half_track, colour)
        course.ball(BALLS[i], ramp.at(p.starts_m[i], r), r, p.colours[i])

    half_width = p.apart_m / 2 + half_track + 0.02
    outer, tray_depth, rim = (-half_width - WALL_M, half_width + WALL_M), (0, p.tray_m), (0, p.track_m + 0.01)
    course.block("tray_floor", (-half_width, half_width), tray_depth, (0, WALL_M), p.tray_colour).friction = [
        0.8,
        0.005,
        0.006,
    ]
    course.block("tray_front", outer, (-WALL_M, 0), (0, 1.1 * r), p.tray_colour)
    course.block("tray_side_-1", (outer[0], -half_width), tray_depth, rim, p.tray_colour)
    course.block("tray_side_1", (half_width, outer[1]), tray_depth, rim, p.tray_colour)
    course.block("divider", (-0.006, 0.006), tray_depth, (0, 0.9 * r), p.tray_colour)

    hidden_y = (
        rough_span[1] + 1.8 * r + 0.03
    )  # the ball that feels the rough board is behind the occluder with its shadow
    high = p.track_m + 2 * r + 0.015
    _, back, top = ramps[0].at(p.ramp_m)
    flag_x = half_width if p.azimuth_deg < 94 else -half_width  # where no ball rolls behind the flag
    course.mark("tray", (flag_x, p.tray_m), p.tray_colour)
    return course.scene(
        p,
        decisive=BALLS,
        hidden=["board_0", "board_1"],
        cover=course.box(outer, (-WALL_M - 0.01, hidden_y), (0, high), right=0.02),
        in_view=[course.box(outer, (-WALL_M, foot), (0, high)), course.box(outer, (back, back), (0, top))],
        things=[*(f"{colour} ball" for colour in p.colours), "left ramp", "right ramp", "tray"],
        also=["track", "foot"],
        shown_by={"foot": ["tray"]},
        colours=[*p.colours, *p.track_colours],
    )


def _roughness(p: Params, track: int, physics: Physics) -> float:
    """Return rolling friction (m) that brings this track's ball down to `creep_m_s`.

    Before, it has kept its spin and the part of its velocity along the track at the foot of the ramp.
    """
    slope = float(np.radians(p.slope_deg))
    down = 10 / 7 * physics.gravity_m_s2 * (p.starts_m[track] - p.radius_m * np.tan(slope / 2)) * np.sin(slope)
    entry_speed2 = ARRIVING * down * (5 / 7 * np.cos(slope) + 2 / 7) ** 2
    return float(brake(p.radius_m, entry_speed2 - p.creep_m_s**2, ROUGH_M, physics))


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the colour whose ball is the first with its middle past the tray's edge."""
    ahead = p.tray_m - np.stack([motion.pos(ball)[:, 1] for ball in BALLS], axis=1)
    return first_past(motion, ahead, p.colours, MIN_LEAD_S)


def _higher_or_side(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    """Ask which ball starts higher up, or which is on one of the ramps."""
    choices = tuple(str(c) for c in rng.permutation(p.colours))
    if rng.integers(2):
        higher = p.colours[int(np.argmax(p.starts_m))]
        return AnswerableQuestion(f"Which ball starts higher up on its ramp, {list_choices(choices)}?", choices, higher)
    side = int(rng.integers(2))
    question = f"Which ball rolls down the {('left', 'right')[side]} ramp, {list_choices(choices)}?"
    return AnswerableQuestion(question, choices, p.colours[side])


SETTLING_PX = 8.0  # so far a ball may still roll in the tray when an occluder comes


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return which ball is first near its place of rest, the same part of the tray."""
    choices = colours_of_balls(frames, slots, BALL_COLOURS)
    paths = [[compact_blob(frame, colour) for frame in frames] for colour in choices]
    if len(choices) != 2 or not all(is_at_rest(path, tolerance_px=SETTLING_PX) for path in paths):
        return None
    rates = [_progress(path) for path in paths]
    near_end = [int(np.argmax(rate > 0.9 * rate.max())) for rate in rates]
    return None if near_end[0] == near_end[1] else choices[int(np.argmin(near_end))]


def foresee(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Predict which ball will be lower in the picture if both gain speed as they do."""
    lower: dict[str, float] = {}
    for colour in colours_of_balls(frames, slots, BALL_COLOURS):
        path = [compact_blob(frame, colour) for frame in frames[-3:]]
        ys = [ball.y + ball.box[3] / 2 for ball in path if ball is not None]
        if len(ys) == len(path) == 3:
            step, gain = ys[2] - ys[1], ys[2] - 2 * ys[1] + ys[0]
            lower[colour] = ys[2] + FRAMES_AHEAD * step + FRAMES_AHEAD * (FRAMES_AHEAD + 1) / 2 * gain
    return max(lower, key=lambda colour: lower[colour]) if len(lower) == 2 else None


def _progress(path: list[Blob | None]) -> np.ndarray:
    """Return how far a ball is from where it was seen first, frame by frame."""
    first = next(ball for ball in path if ball is not None)
    return np.array([0.0 if ball is None else np.hypot(ball.x - first.x, ball.y - first.y) for ball in path])


FAMILY = scene_family(
    "ramp_race",
    category="ramps_rolling",
    params=Params,
    build=build,
    outcome=outcome,
    question=which_colour(
        "Which ball is first in the tray at the foot of the ramps, {choices}?",
        "What colour is the ball that gets into the tray first: {choices}?",
        "Two balls roll down the ramps: which one drops into the tray before the other, {choices}?",
        colours=lambda p: p.colours,
        forms=["{} ball", "the {} ball", "{} one", "{} is first"],
    ),
    asides=[_higher_or_side],
    observe=observe,
    foresee=foresee,
    min_margin_m=0.03,
)
