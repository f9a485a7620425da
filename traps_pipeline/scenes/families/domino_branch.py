"""A row of dominoes comes towards the camera and splits in two branches; the question is at the end of which branch the
domino falls, the left one or the right one.

Control: both branches are in view. Void: the panel stands before them; the row is seen to fall behind it.
Hidden element: one domino of either branch, of which one stands in its branch and the other lies beside it.
The last visible domino only kicks a ball that rolls behind the panel, drives in between the two branches and is stopped
by a post there: nothing that the gap changes can push back on what is seen.
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
from traps_pipeline.scenes.vision import colour_mask, is_panel, largest
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

# In domino heights:
BOARD = 0.07  # thickness of the board that everything stands on
BALL = 0.40  # radius of both balls
BALL_AT = 0.55 + BALL  # centre of the kicked ball, from the front face of the last visible domino
STOP_AT = 2.9  # where the post stops that centre: behind the panel, out of the domino's reach
PUSH = 0.10  # how far the stopped ball has pushed into either branch

STILL_M = 0.002  # a domino that moves less than this any more is at rest
DOMINO_COLOURS = ("red", "green", "blue", "yellow", "cyan", "purple")
BRANCHES = {"left": -1, "right": 1}


@dataclass(frozen=True)
class Params:
    """Lengths without a unit in the name are in domino heights; angles are between a branch and the row."""

    height_m: float
    width: float
    thickness: float
    spacing: float
    visible: int  # dominoes before the hand-off
    branch: int  # dominoes of either branch, the last one included
    angles_deg: tuple[float, float]  # left and right branch
    gap_index: int  # which domino of a branch the hidden element is
    gap_side: str  # in which branch it lies beside: left or right
    starter_speed_m_s: float
    row_colour: str
    ball_colour: str
    left_colour: str
    right_colour: str
    board_colour: str
    azimuth_deg: float
    elevation_deg: float


def draw(rng: np.random.Generator) -> Params:
    """The gap is on either side as often; nothing that can be seen tells."""
    row, ball, left, right = distinct_colours(rng, 4, DOMINO_COLOURS)
    branch = int(rng.integers(3, 5))
    return Params(
        height_m=uniform(rng, 0.17, 0.21),
        width=uniform(rng, 0.46, 0.52),
        thickness=uniform(rng, 0.16, 0.19),
        spacing=uniform(rng, 0.68, 0.74),
        visible=int(rng.integers(2, 4)),
        branch=branch,
        angles_deg=(uniform(rng, 55, 63), uniform(rng, 55, 63)),
        gap_index=int(rng.integers(1, branch - 1)),
        gap_side=str(rng.choice(list(BRANCHES))),
        starter_speed_m_s=uniform(rng, 0.50, 0.70),
        row_colour=row,
        ball_colour=ball,
        left_colour=left,
        right_colour=right,
        board_colour=str(rng.choice(["wood", "grey", "black"])),
        azimuth_deg=90 + uniform(rng, -9, 9),
        elevation_deg=uniform(rng, -44, -39),
    )


def build(p: Params, physics: Physics) -> Scene:
    """The row runs along -y from the first domino at the origin; the branches start where the kicked ball stops."""
    spec = new_spec(physics)
    h = p.height_m
    face = (p.visible - 1) * p.spacing + p.thickness / 2
    junction = face + STOP_AT
    reach = BALL + p.thickness + (p.branch - 1) * p.spacing + 0.65  # of a branch, when its end domino has fallen
    angles = np.radians(p.angles_deg)
    left, right = (float(reach * np.sin(a) + p.width / 2) for a in angles)
    front = junction + float(reach * np.cos(angles).max()) + p.width / 2
    ball_z = (BOARD + BALL) * h

    centre = (h * (right - left) / 2, -h * (front - 2.4) / 2, BOARD * h / 2)
    add_box(
        spec.worldbody, "board", centre, (h * (right + left) / 2, h * (front + 2.4) / 2, BOARD * h / 2), p.board_colour
    )
    for name, along in (("starter", -1.8), ("kicked", face + BALL_AT)):
        ball = add_ball(spec, name, (0, -along * h, ball_z), BALL * h, p.ball_colour, density=300)
        ball.friction = [0.1, 0.005, 0.0004]  # the board grips it, a domino slides over it and squeezes it out
    for i in range(p.visible):
        _add_domino(spec, p, f"domino_{i}", (0.0, i * p.spacing), 0.0, p.row_colour)
    for side in BRANCHES:
        _add_branch(spec, p, side, junction)
    post = (0, -h * (junction + BALL + 0.03), h * (BOARD + 0.3))
    add_box(spec.worldbody, "post", post, (0.03 * h, 0.03 * h, 0.3 * h), "grey")

    # Shadows fall to the right and to the back.
    low = (-h * left, -h * front, 0.0)
    high = (h * (right + 0.35), -h * (junction - BALL - 0.2), (BOARD + 1.04) * h)
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("end_left", "end_right"),
        hidden=tuple(f"{side}_{p.gap_index}" for side in BRANCHES),
        cover=Box(low, high),
        stage=(Box(low, (h * right, h * 2.3, h)),),
        velocity={"starter": (0, -p.starter_speed_m_s, 0, p.starter_speed_m_s / (BALL * h), 0, 0)},
        inventory=Inventory(
            (p.row_colour, p.ball_colour, p.left_colour, p.right_colour, p.board_colour, "grey"),
            ("domino", "ball", "board", "post", "row", "branch"),
            (f"{p.left_colour} domino", f"{p.right_colour} domino", f"{p.ball_colour} ball", "board"),
        ),
    )


def _branch(p: Params, side: str) -> list[str]:
    """Bodies of a branch, from the junction on."""
    return [f"{side}_{i}" for i in range(p.branch - 1)] + [f"end_{side}"]


def _add_branch(spec: mujoco.MjSpec, p: Params, side: str, junction: float) -> None:
    """The dominoes of a branch, one of which may lie beside it, on the inner side."""
    sign = BRANCHES[side]
    yaw = sign * np.radians(p.angles_deg[list(BRANCHES).index(side)])
    ahead, inwards = np.array([np.sin(yaw), np.cos(yaw)]), sign * np.array([-np.cos(yaw), np.sin(yaw)])
    start = np.array([0.0, junction]) + (BALL - PUSH + p.thickness / 2) * ahead
    end_colour = p.left_colour if side == "left" else p.right_colour
    for i, name in enumerate(_branch(p, side)):
        at, aside = start + i * p.spacing * ahead, i == p.gap_index and side == p.gap_side
        if aside:
            at = at + (p.width + 0.15) * inwards
        colour = end_colour if i == p.branch - 1 else p.row_colour
        _add_domino(spec, p, name, (float(at[0]), float(at[1])), float(yaw), colour, lying=aside)


def _add_domino(
    spec: mujoco.MjSpec,
    p: Params,
    name: str,
    at: tuple[float, float],
    yaw: float,
    colour: str,
    *,
    lying: bool = False,
) -> None:
    """A free domino (body and geom `name`) at (across, along), its thickness along a direction `yaw` from the row."""
    h = p.height_m
    z = BOARD + (p.thickness / 2 if lying else 0.5)
    body = spec.worldbody.add_body(name=name, pos=[at[0] * h, -at[1] * h, z * h])
    body.quat = [float(np.cos(yaw / 2)), 0, 0, float(np.sin(yaw / 2))]
    body.add_freejoint()
    half = [p.width * h / 2, p.thickness * h / 2, h / 2]
    if lying:
        half[1:] = half[:0:-1]
    geom = add_box(body, name, (0, 0, 0), half, colour)
    geom.density = 500
    geom.friction = [0.2, 0.005, 0.0001]
    geom.solref = [0.006, 1]


def _tops_m(motion: Motion, p: Params) -> np.ndarray:
    """Height over the board of the middle of the two end dominoes' tops (m), left one first, shape (F, 2)."""
    tops = [motion.pos(f"end_{s}")[:, 2] + motion.rot(f"end_{s}")[:, 2, 2] * p.height_m / 2 for s in BRANCHES]
    return np.stack(tops, axis=1) - BOARD * p.height_m


def readings(motion: Motion, p: Params) -> list[str | None]:
    """The side on which alone the end domino's top is below half a domino's height, from when no domino of the
    branches moves any more."""
    fallen = _tops_m(motion, p) < p.height_m / 2
    bodies = [body for side in BRANCHES for body in _branch(p, side)]
    moves = [np.linalg.norm(motion.pos(b) - motion.pos(b)[-1], axis=1) > STILL_M for b in bodies]
    restless = np.flatnonzero(np.any(moves, axis=0))
    still_from = int(restless[-1]) + 1 if restless.size else 0
    sides = [("left" if left else "right") if left != right else None for left, right in fallen]
    return [side if i >= still_from else None for i, side in enumerate(sides)]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) either end domino's top ends above or below half a domino's height, at least."""
    return float(np.abs(_tops_m(motion, p)[-1] - p.height_m / 2).min())


def twins(p: Params) -> list[Params]:
    """The same row with the gap in the other branch."""
    return [replace(p, gap_side="right" if p.gap_side == "left" else "left")]


QUESTIONS = (
    "Which end domino falls over, the {left} one on the left or the {right} one on the right: left or right?",
    "The left branch ends in a {left} domino, the right one in a {right} domino: which of them falls, left or right?",
    "In which branch is the last domino knocked over, left (the {left} one) or right (the {right} one)?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Both end dominoes are named by their colours, which nothing else has."""
    aliases = {}
    for side, colour in (("left", p.left_colour), ("right", p.right_colour)):
        forms = (
            f"the {side} one",
            f"{side} branch",
            f"the {side} branch",
            colour,
            f"{colour} domino",
            f"the {colour} one",
        )
        aliases |= dict.fromkeys(forms, side)
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(left=p.left_colour, right=p.right_colour),
        labels=("left", "right"),
        aliases=aliases,
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    choices = tuple(str(c) for c in rng.permutation([p.row_colour, p.ball_colour, p.left_colour, p.right_colour]))
    if rng.integers(2):
        question = f"What colour is the ball that sets off the row of dominoes: {listed(choices)}?"
        return AnswerableQuestion(question, choices, p.ball_colour)
    question = f"What colour is the domino that falls first: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.row_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """The side whose end domino alone is no longer where it stood at first."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    stands = [_stands(frames, values[side]) for side in BRANCHES]
    if None in stands or stands[0] == stands[1]:
        return None
    return "right" if stands[0] else "left"


def _stands(frames: np.ndarray, colour: str) -> bool | None:
    """Whether the upper half of the thing of that colour is where it was; None if it is not to be seen at the end."""
    first, last = largest(frames[0], colour, min_area=60), largest(frames[-1], colour, min_area=60)
    if first is None or last is None or is_panel(first) or is_panel(last):
        return None
    x, y, w, h = first.box
    part = np.s_[y : y + h // 2, x : x + w]
    before, after = (colour_mask(frame, colour)[part] for frame in (frames[0], frames[-1]))
    return bool((before & after).sum() > 0.7 * before.sum())


FAMILY = Family(
    name="domino_branch",
    taxonomy="occlusion",
    category="dominoes",
    sub_scenario="domino_branch",
    answer_type="direction",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    observe=observe,
    physics=Physics(timestep_s=0.001, tolerance=0.0),
    min_margin_m=0.03,
    twins=twins,
)
