"""A ball rolls along a track with a line across it; the question is whether it passes the line.

Control: the whole track is in view. Void: the panel stands before all but its first part.
Hidden element: a patch of the track before the line, rough enough to stop the ball, or as smooth as the track.
A ball that passes the line stays at the felt before the end wall.
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
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
TRACK_M = 0.04  # height of the track
WALL_M = 0.014
LINE_M = 0.035  # width of a painted line
STILL_M = 0.003  # a ball that moves less than this any more is at rest
NAMED_COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. Lengths run along the track from its beginning."""

    direction: int
    rough: bool  # the hidden element
    radius_m: float
    speed_m_s: float
    run_m: float  # track before the panel
    lead_m: float  # track behind the panel before the patch
    patch_m: float
    stop_share: float  # where on a rough patch the ball stops
    line_at_m: float  # from the patch to the middle of the line
    felt_m: float  # from the line to the end wall
    half_width_m: float
    ball_colour: str
    start_colour: str  # of the line outside the panel
    line_colour: str
    track_colour: str
    wall_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def patch_span(self) -> Span:
        """Where the patch is."""
        return (self.run_m + self.lead_m, self.run_m + self.lead_m + self.patch_m)

    @property
    def line_m(self) -> float:
        """Where the middle of the line is."""
        return self.patch_span[1] + self.line_at_m


def draw(rng: np.random.Generator) -> Params:
    """Half of the patches are rough; nothing that can be seen tells."""
    direction = int(rng.choice([-1, 1]))
    ball, start, line = distinct_colours(rng, 3, NAMED_COLOURS)
    track, wall = (str(c) for c in rng.permutation(["wood", "grey", "white"])[:2])
    radius = uniform(rng, 0.048, 0.058)
    return Params(
        direction=direction,
        rough=bool(rng.integers(2)),
        radius_m=radius,
        speed_m_s=uniform(rng, 0.55, 0.90),
        run_m=uniform(rng, 0.34, 0.44),
        lead_m=2 * radius + uniform(rng, 0.04, 0.08),
        patch_m=uniform(rng, 0.22, 0.30),
        stop_share=uniform(rng, 0.45, 0.85),
        line_at_m=uniform(rng, 0.08, 0.14),
        felt_m=uniform(rng, 0.24, 0.32),
        half_width_m=uniform(rng, 0.11, 0.17),
        ball_colour=ball,
        start_colour=start,
        line_colour=line,
        track_colour=track,
        wall_colour=wall,
        azimuth_deg=90 - direction * uniform(rng, -20, 20),
        elevation_deg=uniform(rng, -40, -28),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Track with kerbs, patch, two lines and end wall. Lengths are mirrored by `direction`."""
    spec = new_spec(physics)
    r, side, end = p.radius_m, p.half_width_m, p.line_m + p.felt_m
    patch = p.patch_span

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    def line(name: str, middle: float, colour: str) -> None:
        painted = block(name, (middle - LINE_M / 2, middle + LINE_M / 2), (-side, side), (0, TRACK_M + 0.001), colour)
        painted.contype = painted.conaffinity = 0

    slab = (0.0, TRACK_M)
    block("track_in", (-0.02, patch[0]), (-side, side), slab, p.track_colour)
    mat = block("patch", patch, (-side, side), slab, "black" if p.rough else p.track_colour)
    mat.friction = [4.0, 0.005, _roughness(p, physics) if p.rough else 2e-5]
    block("track_out", (patch[1], p.line_m), (-side, side), slab, p.track_colour)
    felt = block("felt", (p.line_m, end), (-side, side), slab, p.track_colour)
    felt.friction = [0.8, 0.005, 0.006]
    line("start_line", 0.6 * p.run_m, p.start_colour)
    line("line", p.line_m, p.line_colour)
    for name, across in (("front", (-side - WALL_M, -side)), ("back", (side, side + WALL_M))):
        block(f"kerb_{name}", (-0.02, end), across, (0, TRACK_M + 0.012), p.wall_colour)
    block("end_wall", (end, end + WALL_M), (-side - WALL_M, side + WALL_M), (0, TRACK_M + 2 * r), p.wall_colour)
    ball = add_ball(spec, "ball", (p.direction * 0.05, 0, TRACK_M + r), r, p.ball_colour)
    ball.friction = [0.8, 0.005, 2e-5]

    high = TRACK_M + 2 * r + 0.01
    ends = sorted((p.direction * p.run_m, p.direction * (end + WALL_M)))
    shadow = 0.35 * high if p.direction > 0 else 0.0  # shadows fall to the right and to the back
    low_y, high_y = -side - WALL_M, side + WALL_M
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        hidden=("patch",),
        cover=Box((ends[0], low_y - 0.01, 0.0), (ends[1] + shadow, high_y + 0.03, high)),
        stage=(Box((ends[0], low_y, 0.0), (ends[1], high_y, high)), Box((-0.02, low_y, 0), (0.02, high_y, TRACK_M))),
        velocity={"ball": _rolling(p)},
        inventory=Inventory(
            (p.ball_colour, p.start_colour, p.line_colour, p.track_colour, p.wall_colour),
            ("ball", "track", "line", "wall", "kerb", "end"),
            (f"{p.ball_colour} ball", f"{p.line_colour} line", f"{p.start_colour} line", "track"),
        ),
    )


def _rolling(p: Params) -> tuple[float, ...]:
    """Velocity of a ball that rolls without slipping."""
    speed = p.direction * p.speed_m_s
    return (speed, 0.0, 0.0, 0.0, speed / p.radius_m, 0.0)


def _roughness(p: Params, physics: Physics) -> float:
    """Rolling friction (m) that stops the ball `stop_share` along the patch: a solid ball slows at 5 g mu / 7 r."""
    return 7 / 5 * p.radius_m * p.speed_m_s**2 / (2 * p.stop_share * p.patch_m * physics.gravity_m_s2)


def _past_line_m(motion: Motion, p: Params) -> np.ndarray:
    """How far the middle of the ball is past the far edge of the line (m), shape (F,)."""
    return p.direction * motion.pos("ball")[:, 0] - p.line_m - LINE_M / 2


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'yes' from when the ball is past the line; 'no' while it is not, from when it moves no more."""
    past = _past_line_m(motion, p)
    restless = np.flatnonzero(np.abs(past - past[-1]) > STILL_M)
    still_from = int(restless[-1]) + 1 if restless.size else 0
    return ["yes" if x > 0 else "no" if i >= still_from else None for i, x in enumerate(past)]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the middle of the ball ends from the line."""
    past = float(_past_line_m(motion, p)[-1])
    return past if past > 0 else -past - LINE_M


def twins(p: Params) -> list[Params]:
    """The same track with a smooth patch, or a rough one."""
    return [replace(p, rough=not p.rough)]


QUESTIONS = (
    "Does the {ball} ball roll past the {line} line, yes or no?",
    "Does the rolling {ball} ball get across the {line} line before it stops: yes or no?",
    "Is the {ball} ball beyond the {line} line when it comes to a stop, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Ball and line are named by their colours, which nothing else has."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(ball=p.ball_colour, line=p.line_colour),
        labels=("yes", "no"),
        aliases={
            "yes it does": "yes",
            "it passes the line": "yes",
            "it rolls past the line": "yes",
            "no it does not": "no",
            "it stops before the line": "no",
            "it does not pass the line": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(3)
    if kind == 0:
        side = "left" if p.direction > 0 else "right"
        return AnswerableQuestion("From which side does the ball come, left or right?", ("left", "right"), side)
    choices = tuple(str(c) for c in rng.permutation([p.ball_colour, p.start_colour, p.line_colour]))
    if kind == 1:
        return AnswerableQuestion(f"What colour is the rolling ball: {listed(choices)}?", choices, p.ball_colour)
    question = f"What colour is the first line that the ball rolls across: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.start_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """On which side of the line the ball rests; it came from the side where it was seen first."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = [_ball(frame, values["ball"]) for frame in frames]
    first, last = next((ball for ball in path if ball is not None), None), path[-1]
    if first is None or last is None or not at_rest(path):
        return None
    ys, xs = np.nonzero(colour_mask(frames[-1], values["line"]))
    if len(xs) < 60 or np.ptp(ys) < 10:
        return None
    slope, offset = np.polyfit(ys, xs, 1)  # the line in the picture, x as a function of y
    foot = last.y + 0.4 * last.box[3]
    return "yes" if (last.x - slope * foot - offset) * (last.x - first.x) > 0 else "no"


def _ball(frame: np.ndarray, colour: str) -> Blob | None:
    """The largest region of a colour that may be a ball: compact, and small beside the frame."""
    for blob in blobs(colour_mask(frame, colour), 60):
        if blob.area < 4000 and 0.5 < blob.box[2] / blob.box[3] < 2.0 and blob.fill > 0.5:
            return blob
    return None


FAMILY = Family(
    name="roll_stop",
    taxonomy="occlusion",
    category="ramps_rolling",
    sub_scenario="roll_stop",
    answer_type="binary",
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
