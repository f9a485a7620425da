"""A ball drops onto a ridge between two bins; the question is on which side it comes down.

Control: ridge and bins are in view, the left bin red and the right one blue. Void: the panel stands before them.
Hidden element: the ridge, which stands a little to the left or to the right of where the ball comes down. The drop is
the same either way and drifts to either side, whichever the ridge then turns the ball to.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import atan2, hypot
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
GRAVITY = 9.81
FLOOR_M = 0.02  # thickness of the bins' floors
WALL_M = 0.014
DEPTH_M = 0.15  # half of the bins' depth
FREE_COLOURS = ("green", "yellow", "orange", "cyan", "purple")  # the bins are red and blue


@dataclass(frozen=True)
class Params:
    """drift_m_s: how fast the ball moves to the right as it drops. cube_side: +1 stands to the right of the bins."""

    radius_m: float
    release_m: float  # height of the ball's centre in the first frame
    toss_m_s: float  # how fast it still rises then
    drift_m_s: float
    ridge_m: float  # height of the ridge
    foot_m: float  # half of the ridge's width at its foot
    bin_m: float  # where the bins end, from the middle
    offset_m: float  # from where the ball meets the ridge's height to the ridge, signed: the hidden element
    ball_colour: str
    cube_colour: str
    cube_side: int
    cube_m: float
    wedge_colour: str
    back_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def fall_s(self) -> float:
        """How long the ball takes to the ridge."""
        drop = self.release_m - self.radius_m - self.ridge_m
        return (self.toss_m_s + (self.toss_m_s**2 + 2 * GRAVITY * drop) ** 0.5) / GRAVITY


def draw(rng: np.random.Generator) -> Params:
    """The ridge stands to either side, independently of all that can be seen."""
    radius = uniform(rng, 0.068, 0.080)
    ball, cube = distinct_colours(rng, 2, FREE_COLOURS)
    wedge, back = rng.permutation(["grey", "black", "white"])[:2]
    return Params(
        radius_m=radius,
        release_m=uniform(rng, 1.15, 1.35),
        toss_m_s=uniform(rng, 1.2, 2.0),
        drift_m_s=uniform(rng, -0.22, 0.22),
        ridge_m=uniform(rng, 0.34, 0.42),
        foot_m=uniform(rng, 0.20, 0.26),
        bin_m=uniform(rng, 0.56, 0.66),
        offset_m=round(int(rng.choice([-1, 1])) * uniform(rng, 0.45, 0.75) * radius, 4),
        ball_colour=ball,
        cube_colour=cube,
        cube_side=int(rng.choice([-1, 1])),
        cube_m=uniform(rng, 0.12, 0.18),
        wedge_colour=str(wedge),
        back_colour=str(back),
        azimuth_deg=90 + uniform(rng, -18, 18),
        elevation_deg=uniform(rng, -34, -22),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Bins with a high back and a low front, the ridge of two boards that lean together, a cube to one side."""
    spec = new_spec(physics)
    r, end, high = p.radius_m, p.bin_m, p.ridge_m + 0.10

    def block(name: str, across: Span, deep: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        spans = (across, deep, z)
        mid, half = [sum(s) / 2 for s in spans], [(s[1] - s[0]) / 2 for s in spans]
        geom = add_box(spec.worldbody, name, mid, half, colour)
        geom.solref, geom.friction, geom.condim, geom.priority = [0.01, 1], [0.6, 0.005, 0.004], 6, 1
        return geom

    for name, side, colour in (("left", -1, "red"), ("right", 1, "blue")):
        floor = (-end, 0.0) if side < 0 else (0.0, end)
        wall = (-end - WALL_M, -end) if side < 0 else (end, end + WALL_M)
        block(f"{name}_floor", floor, (-DEPTH_M, DEPTH_M), (0, FLOOR_M), colour)
        block(f"{name}_end", wall, (-DEPTH_M, DEPTH_M), (0, 0.24), colour)
        block(f"{name}_front", floor, (-DEPTH_M - WALL_M, -DEPTH_M), (0, FLOOR_M + 0.4 * r), colour)
    block("back", (-end - WALL_M, end + WALL_M), (DEPTH_M, DEPTH_M + WALL_M), (0, high), p.back_colour)
    for name, side in (("left", -1), ("right", 1)):
        board = block(f"ridge_{name}", (0, hypot(p.foot_m, p.ridge_m)), (-DEPTH_M, DEPTH_M), (0, 0.02), p.wedge_colour)
        slope = atan2(p.ridge_m, p.foot_m)
        board.pos = [p.offset_m + side * p.foot_m / 2, 0, FLOOR_M + p.ridge_m / 2 - 0.02]
        board.quat = [float(np.cos(slope / 2)), 0.0, side * float(np.sin(slope / 2)), 0.0]

    beside = p.cube_side * (end + 0.20 + p.cube_m / 2 + (0.15 if p.cube_side > 0 else 0.0))
    half = p.cube_m / 2
    block("cube", (beside - half, beside + half), (-half, half), (0, p.cube_m), p.cube_colour)
    ball = add_ball(spec, "ball", (-p.drift_m_s * p.fall_s, 0, p.release_m), r, p.ball_colour)
    ball.solref = [0.01, 1]

    bins = Box((-end - WALL_M, -DEPTH_M - WALL_M, 0.0), (end + WALL_M, DEPTH_M + WALL_M, high))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        hidden=("ridge_left", "ridge_right"),
        cover=Box(bins.low, (end + WALL_M + 0.04, DEPTH_M + 0.10, high + 0.02)),
        stage=(bins, Box((beside - half, -half, 0.0), (beside + half, half, p.cube_m))),
        velocity={"ball": (p.drift_m_s, 0.0, p.toss_m_s, 0.0, 0.0, 0.0)},
        inventory=Inventory(
            ("red", "blue", p.ball_colour, p.cube_colour, p.wedge_colour, p.back_colour),
            ("ball", "bin", "ridge", "cube", "wall", "side"),
            (f"{p.ball_colour} ball", f"{p.cube_colour} cube", "red bin", "blue bin", "ridge between the bins"),
        ),
    )


def _side(motion: Motion, p: Params) -> np.ndarray:
    """How far the ball's centre is to the right of the ridge (m), shape (F,)."""
    return motion.pos("ball")[:, 0] - p.offset_m


def readings(motion: Motion, p: Params) -> list[str | None]:
    """The side of the ridge that the ball is on while its centre is lower than the ridge; None while it is higher."""
    low = motion.pos("ball")[:, 2] < p.ridge_m
    return [("right" if x > 0 else "left") if down else None for x, down in zip(_side(motion, p), low, strict=True)]


def margin(motion: Motion, p: Params) -> float:
    """How far the ball's centre is at the end from the ridge's foot on the other side (m)."""
    return float(abs(_side(motion, p)[-1]))


def twins(p: Params) -> list[Params]:
    """The same drop with the ridge on the other side of it."""
    return [replace(p, offset_m=-p.offset_m)]


QUESTIONS = (
    "Into which bin does the {ball} ball drop, the left (red) or the right (blue) one?",
    "On which side of the ridge does the {ball} ball come down, left or right?",
    "Does the ridge send the {ball} ball to the left (red bin) or to the right (blue bin)?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Left and right as the camera sees them; the bins' colours say the same."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(ball=p.ball_colour),
        labels=("left", "right"),
        aliases={
            form.format(side, colour): side
            for side, colour in (("left", "red"), ("right", "blue"))
            for form in ("{1}", "{1} bin", "{0} bin", "to the {0}", "the {0} side", "{0} side", "the {1} one")
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(3)
    if kind == 0:
        side = "right" if p.cube_side > 0 else "left"
        question = f"At which edge of the picture does the {p.cube_colour} cube stand, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    other = next(c for c in rng.permutation(FREE_COLOURS) if c not in (p.ball_colour, p.cube_colour))
    choices = tuple(str(c) for c in rng.permutation([p.ball_colour, p.cube_colour, other]))
    if kind == 1:
        return AnswerableQuestion(f"What colour is the ball: {listed(choices)}?", choices, p.ball_colour)
    return AnswerableQuestion(f"What colour is the cube beside the bins: {listed(choices)}?", choices, p.cube_colour)


def _ball_like(blob: Blob) -> bool:
    """Whether a region may be a ball: neither as large nor as rectangular as a panel."""
    return 60 <= blob.area <= 4000 and blob.fill < 0.9 and max(blob.box[2:]) < 1.9 * min(blob.box[2:])


def _middle_x(frame: np.ndarray, colour: str) -> float | None:
    """The middle (px) of all that has a colour; None if there is little of it."""
    columns = np.flatnonzero(colour_mask(frame, colour).sum(axis=0) >= 4)
    return float(columns[0] + columns[-1]) / 2 if len(columns) >= 15 else None


def observe(frames: np.ndarray, question: str) -> str | None:
    """Whether the resting ball is nearer to the middle of what is red or of what is blue."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = [next(filter(_ball_like, blobs(colour_mask(f, values["ball"]))), None) for f in frames[-3:]]
    ball, red, blue = path[-1], _middle_x(frames[-1], "red"), _middle_x(frames[-1], "blue")
    if ball is None or not at_rest(path) or red is None or blue is None:
        return None
    return "left" if abs(ball.x - red) < abs(ball.x - blue) else "right"


FAMILY = Family(
    name="drop_split",
    taxonomy="occlusion",
    category="trajectories_drops",
    sub_scenario="drop_split",
    answer_type="direction",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    observe=observe,
    min_margin_m=0.08,
    twins=twins,
)
