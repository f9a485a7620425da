"""A ball is thrown into a chute over three coloured trays; the question is in which tray it lands.

Control: chute and trays are in view. Void: the panel stands before them.
Hidden element: the two parallel boards of the chute, which hang straight down over the middle tray or slant towards the
left or the right one. The throw is the same whichever way they slant, and the trays' walls keep the ball.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, sin
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
GRAVITY = 9.81
FLOOR_M = 0.02  # thickness of the trays' floors
WALL_M = 0.014
DEPTH_M = 0.14  # half of the trays' depth
DIVIDER_M = 0.10  # height of the walls between the trays
END_M = 0.34  # height of the outer walls
SLANTS = (-1, 0, 1)
COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 throws to the right. Everything else is laid out as the camera sees it, from left to right."""

    direction: int
    radius_m: float
    pedestal_m: float  # height of the pedestal that the ball starts from
    speed_along_m_s: float
    speed_up_m_s: float
    tray_m: float  # width of a tray
    mouth_m: float  # height of the boards' upper edges
    board_m: float  # length of the boards
    gap: float  # between the boards, in ball radii
    slant_deg: float  # of the boards from the vertical when they slant
    slant: int  # -1 to the left, 0 straight down, +1 to the right: the hidden element
    ball_colour: str
    tray_colours: tuple[str, ...]
    pedestal_colour: str
    back_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def start_m(self) -> float:
        """Height of the ball's centre in the first frame."""
        return self.pedestal_m + 0.01 + self.radius_m

    @property
    def range_m(self) -> float:
        """Distance from the start to where the ball comes down between the boards."""
        up, drop = self.speed_up_m_s, self.start_m - self.mouth_m
        return self.speed_along_m_s * (up + (up * up + 2 * GRAVITY * drop) ** 0.5) / GRAVITY


def draw(rng: np.random.Generator) -> Params:
    """The boards slant one of three ways, independently of all that can be seen."""
    direction = int(rng.choice([-1, 1]))
    ball, *trays = distinct_colours(rng, 4, COLOURS)
    pedestal, back = rng.permutation(["grey", "black", "white"])[:2]
    return Params(
        direction=direction,
        radius_m=uniform(rng, 0.066, 0.074),
        pedestal_m=uniform(rng, 0.50, 0.66),
        speed_along_m_s=uniform(rng, 1.20, 1.38),
        speed_up_m_s=uniform(rng, 2.9, 3.3),
        tray_m=uniform(rng, 0.29, 0.33),
        mouth_m=uniform(rng, 0.60, 0.64),
        board_m=uniform(rng, 0.29, 0.33),
        gap=uniform(rng, 3.9, 4.2),
        slant_deg=uniform(rng, 42, 48),
        slant=int(rng.choice(SLANTS)),
        ball_colour=ball,
        tray_colours=tuple(trays),
        pedestal_colour=str(pedestal),
        back_colour=str(back),
        azimuth_deg=90 - direction * uniform(rng, -8, 18),
        elevation_deg=uniform(rng, -34, -24),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Pedestal, three trays with a high back and a low front, two slanting boards before the back."""
    spec = new_spec(physics)
    r, side = p.radius_m, 1.5 * p.tray_m

    def block(name: str, across: Span, deep: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        spans = (across, deep, z)
        mid, half = [sum(s) / 2 for s in spans], [(s[1] - s[0]) / 2 for s in spans]
        geom = add_box(spec.worldbody, name, mid, half, colour)
        geom.solref, geom.friction, geom.condim, geom.priority = [0.01, 1], [0.5, 0.005, 0.006], 6, 1
        return geom

    start = -p.direction * p.range_m
    block("pedestal", (start - 0.08, start + 0.08), (-0.08, 0.08), (0, p.pedestal_m), p.pedestal_colour)
    add_ball(spec, "ball", (start, 0, p.start_m), r, p.ball_colour)
    for i, colour in enumerate(p.tray_colours):
        ends = (i * p.tray_m - side, (i + 1) * p.tray_m - side)
        block(f"tray_{i}", ends, (-DEPTH_M, DEPTH_M), (0, FLOOR_M), colour)
        block(f"front_{i}", ends, (-DEPTH_M - WALL_M, -DEPTH_M), (0, FLOOR_M + 0.3 * r), colour)
        block(f"rear_{i}", ends, (DEPTH_M - WALL_M, DEPTH_M), (0, DIVIDER_M), colour)
    for i in (1, 2):
        x = i * p.tray_m - side
        block(f"divider_{i}", (x - WALL_M / 2, x + WALL_M / 2), (-DEPTH_M, DEPTH_M), (0, DIVIDER_M), p.back_colour)
    block("end_left", (-side - WALL_M, -side), (-DEPTH_M, DEPTH_M), (0, END_M), p.back_colour)
    block("end_right", (side, side + WALL_M), (-DEPTH_M, DEPTH_M), (0, END_M), p.back_colour)
    block("back", (-side - WALL_M, side + WALL_M), (DEPTH_M, DEPTH_M + WALL_M), (0, p.mouth_m), p.back_colour)
    _add_chute(spec, p)

    trays = Box((-side - WALL_M, -DEPTH_M - WALL_M, 0.0), (side + WALL_M, DEPTH_M + WALL_M, p.mouth_m))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        hidden=("board_0", "board_1"),
        cover=Box(trays.low, (side + WALL_M + 0.03, DEPTH_M + 0.10, p.mouth_m + 0.06)),
        stage=(trays, Box((start - 0.08, -0.08, 0.0), (start + 0.08, 0.08, p.pedestal_m))),
        velocity={"ball": (p.direction * p.speed_along_m_s, 0.0, p.speed_up_m_s, 0.0, 0.0, 0.0)},
        inventory=Inventory(
            (p.ball_colour, *p.tray_colours, p.pedestal_colour, p.back_colour, "wood"),
            ("ball", "tray", "pedestal", "chute", "board", "wall"),
            (f"{p.ball_colour} ball", *(f"{c} tray" for c in p.tray_colours), "pedestal"),
        ),
    )


def _add_chute(spec: mujoco.MjSpec, p: Params) -> None:
    """Two parallel boards that hang from their upper edges."""
    angle = p.slant * np.radians(p.slant_deg)
    for i, hinge in enumerate((-p.gap * p.radius_m / 2, p.gap * p.radius_m / 2)):
        centre = (hinge + p.board_m / 2 * sin(angle), 0.0, p.mouth_m - p.board_m / 2 * cos(angle))
        half = (0.006, DEPTH_M - 0.03, p.board_m / 2)
        board = add_box(spec.worldbody, f"board_{i}", centre, half, "wood", euler_y=-angle)
        board.solref, board.friction, board.condim, board.priority = [0.01, 1], [0.3, 0.005, 0.001], 6, 1


def _tray(motion: Motion, p: Params) -> np.ndarray:
    """The ball's place across the trays, in tray widths from the left end, shape (F,)."""
    return motion.pos("ball")[:, 0] / p.tray_m + 1.5


def readings(motion: Motion, p: Params) -> list[str | None]:
    """The colour of the tray that the ball is over while its centre is hardly higher than the dividers; None while it
    is higher."""
    tray = np.clip(np.floor(_tray(motion, p)), 0, 2).astype(int)
    low = motion.pos("ball")[:, 2] < DIVIDER_M + 0.02
    return [p.tray_colours[i] if down else None for i, down in zip(tray, low, strict=True)]


def margin(motion: Motion, p: Params) -> float:
    """How far the ball's centre is at the end from the nearest divider, or below its upper edge (m)."""
    offset = float(_tray(motion, p)[-1])
    across = min(abs(offset - 1), abs(offset - 2)) * p.tray_m
    return min(across, DIVIDER_M + p.radius_m - float(motion.pos("ball")[-1, 2]))


def twins(p: Params) -> list[Params]:
    """The same throw with the boards slanting another way."""
    return [replace(p, slant=slant) for slant in SLANTS if slant != p.slant]


QUESTIONS = (
    "On which tray does the {ball} ball land, the {choices} one?",
    "What colour is the tray that the {ball} ball ends up in: {choices}?",
    "Which of the three trays catches the {ball} ball: {choices}?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The choices are the trays' colours, in random order."""
    choices = tuple(str(c) for c in rng.permutation(p.tray_colours))
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(ball=p.ball_colour, choices=listed(choices)),
        labels=choices,
        aliases={form.format(c): c for c in choices for form in ("{} tray", "{} one", "in the {} tray", "the {} tray")},
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(3)
    if kind == 0:
        side = "left" if p.direction > 0 else "right"
        question = "From which side does the thrown ball come, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    if kind == 1:
        choices = tuple(str(c) for c in rng.permutation([p.ball_colour, *p.tray_colours[:2]]))
        return AnswerableQuestion(f"What colour is the thrown ball: {listed(choices)}?", choices, p.ball_colour)
    greys = tuple(str(c) for c in rng.permutation(["grey", "black", "white"]))
    return AnswerableQuestion(f"What colour is the tall pedestal: {listed(greys)}?", greys, p.pedestal_colour)


def _ball_like(blob: Blob) -> bool:
    """Whether a region may be a ball: neither as large nor as rectangular as a panel."""
    return 60 <= blob.area <= 4000 and blob.fill < 0.9 and max(blob.box[2:]) < 1.9 * min(blob.box[2:])


def observe(frames: np.ndarray, question: str) -> str | None:
    """The tray colour that most of the picture around the resting ball has."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = [next(filter(_ball_like, blobs(colour_mask(f, values["ball"]))), None) for f in frames[-3:]]
    ball = path[-1]
    if ball is None or not at_rest(path):
        return None
    reach = 1.1 * max(ball.box[2:])
    rows, columns = np.ogrid[: frames.shape[1], : frames.shape[2]]
    near = (columns - ball.x) ** 2 + (rows - ball.y) ** 2 < reach**2
    around = {c: int((colour_mask(frames[-1], c) & near).sum()) for c in choices_in(values["choices"])}
    best = max(around, key=lambda c: around[c])
    return best if around[best] >= 60 else None


FAMILY = Family(
    name="target_land",
    taxonomy="occlusion",
    category="trajectories_drops",
    sub_scenario="target_land",
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
