"""Two balls roll down ramps side by side, towards the camera; the question is which one is first in the tray.

Control: tracks and tray are in view. Void: the panel stands before them, only the upper parts of the ramps are in view.
Hidden element: one of the tracks crosses a rough board that slows its ball to a creep. The starting
places, of which one is higher than the other, say nothing about which track it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from traps_pipeline.scenes.kit import (
    AnswerableQuestion,
    Box,
    Family,
    Inventory,
    Physics,
    Scene,
    View,
    Wording,
    add_ball,
    add_box,
    distinct_colours,
    listed,
    new_spec,
    uniform,
)
from traps_pipeline.scenes.vision import Blob, at_rest, blobs, colour_mask
from traps_pipeline.scenes.wording import asked, choices_in

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
BOARD_M = 0.016  # thickness of a ramp
WALL_M = 0.012
ROUGH_M = 0.16  # length of the rough board
ARRIVING = 0.86  # share of its energy that a ball still has after the foot of the ramp, as measured
MIN_LEAD_S = 0.35  # a closer finish could fall between two sampled frames
NAMED_COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """Pairs are for the left and the right track. Lengths in y run from the front edge of the tray to the back."""

    colours: tuple[str, str]
    rough_track: int  # 0 left, 1 right: the hidden element
    starts_m: tuple[float, float]  # from the foot of the ramp up to where each ball starts, along the ramp
    slope_deg: float
    ramp_m: float
    creep_m_s: float  # speed at which the ball should leave the rough board
    radius_m: float
    apart_m: float  # between the middles of the tracks
    track_m: float  # height of the tracks
    tray_m: float
    after_m: float  # track between the rough board and the tray
    lead_m: float  # track between the ramp and the rough board
    track_colours: tuple[str, str]
    tray_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def rough_span(self) -> Span:
        """Where the rough board is, in y."""
        return (self.tray_m + self.after_m, self.tray_m + self.after_m + ROUGH_M)

    @property
    def foot_m(self) -> float:
        """Where the ramps end, in y."""
        return self.rough_span[1] + self.lead_m


def draw(rng: np.random.Generator) -> Params:
    """The rough track and the starting places are drawn apart."""
    left, right = distinct_colours(rng, 2, NAMED_COLOURS)
    tray, first, second = (str(c) for c in rng.permutation(["wood", "grey", "black"]))
    ramp, lower = uniform(rng, 0.60, 0.70), uniform(rng, 0.08, 0.13)
    starts = [ramp - 0.07, ramp - 0.07 - lower]
    if rng.integers(2):
        starts.reverse()
    radius = uniform(rng, 0.050, 0.060)
    return Params(
        colours=(left, right),
        rough_track=int(rng.integers(2)),
        starts_m=(round(starts[0], 4), round(starts[1], 4)),
        slope_deg=uniform(rng, 12.5, 15.5),
        ramp_m=ramp,
        creep_m_s=uniform(rng, 0.16, 0.22),
        radius_m=radius,
        apart_m=uniform(rng, 0.26, 0.40),
        track_m=uniform(rng, 0.05, 0.08),
        tray_m=uniform(rng, 0.17, 0.22),
        after_m=uniform(rng, 0.15, 0.19),
        lead_m=uniform(rng, 0.075, 0.11),
        track_colours=(first, first if rng.integers(2) else second),
        tray_colour=tray,
        azimuth_deg=90 + uniform(rng, -16, 16),
        elevation_deg=uniform(rng, -42, -33),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Two tracks that run to the front, each behind a ramp of its own, and one tray before both."""
    spec = new_spec(physics)
    r, side = p.radius_m, 1.5 * p.radius_m

    def block(name: str, x: Span, y: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (sum(x) / 2, sum(y) / 2, sum(z) / 2)
        half = ((x[1] - x[0]) / 2, (y[1] - y[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    rough, slab = p.rough_span, (0.0, p.track_m)
    for i, x in enumerate(_tracks_x(p)):
        across, colour = (x - side, x + side), p.track_colours[i]
        block(f"track_out_{i}", across, (p.tray_m, rough[0]), slab, colour)
        is_rough = i == p.rough_track
        mat = block(f"board_{i}", across, rough, slab, _mat_colour(p) if is_rough else colour)
        mat.friction = [4.0, 0.005, _roughness(p, i, physics) if is_rough else 2e-5]
        block(f"track_in_{i}", across, (rough[1], p.foot_m + 0.01), slab, colour)
        for k in (-1, 1):
            edge = x + k * side
            block(f"rail_{i}_{k}", (edge - 0.004, edge + 0.004), (p.tray_m, p.foot_m), (0, p.track_m + 0.01), colour)
        _add_ramp(spec, p, i, side)
    half = p.apart_m / 2 + side + 0.02
    floor = block("tray_floor", (-half, half), (0, p.tray_m), (0, WALL_M), p.tray_colour)
    floor.friction = [0.8, 0.005, 0.006]
    block("tray_front", (-half - WALL_M, half + WALL_M), (-WALL_M, 0), (0, 1.1 * r), p.tray_colour)
    for k in (-1, 1):
        x = sorted((k * half, k * (half + WALL_M)))
        block(f"tray_side_{k}", (x[0], x[1]), (0, p.tray_m), (0, p.track_m + 0.01), p.tray_colour)
    block("divider", (-0.006, 0.006), (0, p.tray_m), (0, 0.9 * r), p.tray_colour)

    hidden_y = rough[1] + 1.8 * r + 0.03  # the ball that feels the rough board is behind the panel with its shadow
    high = p.track_m + 2 * r + 0.015
    rise = float(p.ramp_m * np.sin(_slope(p)))
    back = p.foot_m + float(p.ramp_m * np.cos(_slope(p)))
    low_x, high_x = -half - WALL_M, half + WALL_M
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball_0", "ball_1"),
        hidden=("board_0", "board_1"),
        cover=Box((low_x, -WALL_M - 0.01, 0.0), (high_x + 0.02, hidden_y, high)),
        stage=(
            Box((low_x, -WALL_M, 0.0), (high_x, p.foot_m, high)),
            Box((low_x, back, 0), (high_x, back, p.track_m + rise)),
        ),
        inventory=Inventory(
            (*p.colours, *p.track_colours, p.tray_colour),
            ("ball", "ramp", "track", "tray", "foot"),
            (*(f"{c} ball" for c in p.colours), "left ramp", "right ramp", "tray"),
        ),
    )


def _slope(p: Params) -> float:
    return float(np.radians(p.slope_deg))


def _tracks_x(p: Params) -> tuple[float, float]:
    return (-p.apart_m / 2, p.apart_m / 2)


def _mat_colour(p: Params) -> str:
    return next(c for c in ("black", "wood", "grey") if c not in p.track_colours)


def _add_ramp(spec: mujoco.MjSpec, p: Params, i: int, side: float) -> None:
    """The ramp of a track with its support, and the ball at rest on it."""
    slope, x = _slope(p), _tracks_x(p)[i]
    sin, cos = float(np.sin(slope)), float(np.cos(slope))
    tilt = [float(np.cos(slope / 2)), float(np.sin(slope / 2)), 0.0, 0.0]  # about x: the back end is up

    def on_ramp(up: float, above: float) -> tuple[float, float, float]:
        """The point `up` along the ramp from its foot and `above` over its surface."""
        return (x, p.foot_m + up * cos - above * sin, p.track_m + up * sin + above * cos)

    half = (side, p.ramp_m / 2, BOARD_M / 2)
    add_box(spec.worldbody, f"ramp_{i}", on_ramp(p.ramp_m / 2, -BOARD_M / 2), half, p.track_colours[i], quat=tilt)
    for k in (-1, 1):
        middle = on_ramp(p.ramp_m / 2, 0)
        half = (0.005, p.ramp_m / 2, 0.4 * p.radius_m)
        add_box(
            spec.worldbody,
            f"ramp_rail_{i}_{k}",
            (x + k * side, *middle[1:]),
            half,
            p.track_colours[i],
            quat=tilt,
        )
    _, y, z = on_ramp(p.ramp_m - 0.05, -BOARD_M)
    add_box(spec.worldbody, f"support_{i}", (x, y, z / 2), (0.8 * side, 0.02, z / 2), p.track_colours[i])
    ball = add_ball(spec, f"ball_{i}", on_ramp(p.starts_m[i], p.radius_m), p.radius_m, p.colours[i])
    ball.friction = [0.8, 0.005, 2e-5]


def _roughness(p: Params, track: int, physics: Physics) -> float:
    """Rolling friction (m) that brings this track's ball down to `creep_m_s`: a solid ball slows at 5 g mu / 7 r.

    Before, it has kept its spin and the part of its velocity along the track at the foot of the ramp.
    """
    slope = _slope(p)
    down = 10 / 7 * physics.gravity_m_s2 * (p.starts_m[track] - p.radius_m * np.tan(slope / 2)) * np.sin(slope)
    entering = ARRIVING * down * (5 / 7 * np.cos(slope) + 2 / 7) ** 2
    return float(7 / 5 * p.radius_m * (entering - p.creep_m_s**2) / (2 * ROUGH_M * physics.gravity_m_s2))


def _ahead_m(motion: Motion, p: Params) -> np.ndarray:
    """How far the middle of each ball is past the edge of the tray (m), shape (F, 2)."""
    return p.tray_m - np.stack([motion.pos(f"ball_{i}")[:, 1] for i in range(2)], axis=1)


def readings(motion: Motion, p: Params) -> list[str | None]:
    """The colour that came into the tray first, from when its ball is in it. A close finish, or a ball that stays
    on its track, has no reading at all."""
    inside = _ahead_m(motion, p) > 0
    arrivals = motion.times[inside.argmax(axis=0)]
    if not inside[-1].all() or abs(arrivals[0] - arrivals[1]) < MIN_LEAD_S:
        return [None] * len(inside)
    winner = p.colours[int(arrivals.argmin())]
    return [winner if t >= arrivals.min() else None for t in motion.times]


def margin(motion: Motion, p: Params) -> float:
    """How far the other ball still is from the tray when the first one is in it (m)."""
    ahead = _ahead_m(motion, p)
    return float(-ahead[int((ahead > 0).any(axis=1).argmax())].min())


def twins(p: Params) -> list[Params]:
    """The same race with the rough board on the other track."""
    return [replace(p, rough_track=1 - p.rough_track)]


QUESTIONS = (
    "Which ball is first in the tray at the foot of the ramps, {choices}?",
    "What colour is the ball that gets into the tray first: {choices}?",
    "Two balls roll down the ramps: which one drops into the tray before the other, {choices}?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The choices are the two colours, in random order."""
    choices = tuple(str(c) for c in rng.permutation(p.colours))
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(choices=listed(choices)),
        labels=choices,
        aliases={form.format(c): c for c in choices for form in ("{} ball", "the {} ball", "{} one", "{} is first")},
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    choices = tuple(str(c) for c in rng.permutation(p.colours))
    if rng.integers(2):
        question = f"Which ball starts higher up on its ramp, {listed(choices)}?"
        return AnswerableQuestion(question, choices, p.colours[int(np.argmax(p.starts_m))])
    side = int(rng.integers(2))
    question = f"Which ball rolls down the {('left', 'right')[side]} ramp, {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.colours[side])


def observe(frames: np.ndarray, question: str) -> str | None:
    """Which ball is first near the place where it rests in the end: the same part of the tray for both."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    choices = choices_in(values["choices"])
    paths = [[_ball(frame, colour) for frame in frames] for colour in choices]
    ends = [path[-1] for path in paths]
    if len(choices) != 2 or any(end is None for end in ends) or not all(at_rest(path) for path in paths):
        return None
    rates = [_progress(path) for path in paths]
    near_end = [int(np.argmax(rate > 0.9 * rate.max())) for rate in rates]
    return None if near_end[0] == near_end[1] else choices[int(np.argmin(near_end))]


def _progress(path: list[Blob | None]) -> np.ndarray:
    """How far a ball is from where it was seen first, frame by frame."""
    first = next(ball for ball in path if ball is not None)
    return np.array([0.0 if ball is None else np.hypot(ball.x - first.x, ball.y - first.y) for ball in path])


def _ball(frame: np.ndarray, colour: str) -> Blob | None:
    """The largest region of a colour that may be a ball: compact, and small beside the frame."""
    for blob in blobs(colour_mask(frame, colour), 60):
        if blob.area < 4000 and 0.4 < blob.box[2] / blob.box[3] < 2.5 and blob.fill > 0.5:
            return blob
    return None


FAMILY = Family(
    name="ramp_race",
    taxonomy="occlusion",
    category="ramps_rolling",
    sub_scenario="ramp_race",
    answer_type="colour",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    observe=observe,
    min_margin_m=0.03,
    twins=twins,
)
