"""A ball rolls off a shelf into a funnel; the question is whether it comes through into the cup below.

Control: funnel and cup are in view. Void: the panel stands before them, the shelf beside it stays in view.
Hidden element: the two boards of the funnel, which leave a throat that is wider or narrower than the ball. The ball
rolls in the same either way, and in either case it stays behind the panel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, radians, sin
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
FLOOR_M = 0.02  # thickness of the cup's floor
WALL_M = 0.014
DEPTH_M = 0.12  # half of the funnel's and the cup's depth
SHELF_M = 0.03  # thickness of the shelf
COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. The funnel is in the middle."""

    direction: int
    radius_m: float
    speed_m_s: float
    run_m: float  # how far the ball rolls on the shelf
    rise_m: float  # of the shelf over the funnel's upper edge
    throat_at_m: float  # height of the funnel's lower edges
    board_m: float  # length of the funnel's boards
    slope_deg: float
    half_throat: float  # in ball radii: the hidden element
    other_half_throat: float  # what the twin has
    cup_half_m: float
    cup_m: float  # height of the cup's sides
    ball_colour: str
    cup_colour: str
    shelf_colour: str
    board_colour: str
    back_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def mouth_m(self) -> float:
        """Height of the funnel's upper edges."""
        return self.throat_at_m + self.board_m * sin(radians(self.slope_deg))

    @property
    def rim_half_m(self) -> float:
        """Half of the funnel's greatest width, whatever its throat."""
        wide = max(self.half_throat, self.other_half_throat) * self.radius_m
        return wide + self.board_m * cos(radians(self.slope_deg))

    @property
    def edge_m(self) -> float:
        """Where the shelf ends, before the middle: over the funnel's board, however narrow the throat."""
        wider = max(self.half_throat, self.other_half_throat) - min(self.half_throat, self.other_half_throat)
        return self.rim_half_m - wider * self.radius_m - 0.02


def draw(rng: np.random.Generator) -> Params:
    """Half of the throats are too narrow; nothing that can be seen tells."""
    direction = int(rng.choice([-1, 1]))
    ball, cup, shelf = distinct_colours(rng, 3, COLOURS)
    board, back = rng.permutation(["grey", "black", "white"])[:2]
    throats = (uniform(rng, 1.3, 1.5), uniform(rng, 0.55, 0.75))
    first = int(rng.integers(2))
    return Params(
        direction=direction,
        radius_m=uniform(rng, 0.058, 0.068),
        speed_m_s=uniform(rng, 0.50, 0.62),
        run_m=uniform(rng, 0.28, 0.38),
        rise_m=uniform(rng, 0.24, 0.30),
        throat_at_m=uniform(rng, 0.28, 0.33),
        board_m=uniform(rng, 0.32, 0.38),
        slope_deg=uniform(rng, 44, 54),
        half_throat=throats[first],
        other_half_throat=throats[1 - first],
        cup_half_m=uniform(rng, 0.19, 0.22),
        cup_m=uniform(rng, 0.12, 0.15),
        ball_colour=ball,
        cup_colour=cup,
        shelf_colour=shelf,
        board_colour=str(board),
        back_colour=str(back),
        azimuth_deg=90 - direction * uniform(rng, -8, 20),
        elevation_deg=uniform(rng, -32, -22),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Shelf on two legs, funnel before a back wall, cup. Lengths run along the roll, mirrored by `direction`."""
    spec = new_spec(physics)
    r, top = p.radius_m, p.mouth_m + p.rise_m
    start = -p.edge_m - p.run_m

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        geom = add_box(spec.worldbody, name, mid, half, colour)
        geom.solref, geom.friction, geom.condim, geom.priority = [0.01, 1], [0.5, 0.005, 0.003], 6, 1
        return geom

    shelf = block("shelf", (start - r, -p.edge_m), (-0.08, 0.08), (top - SHELF_M, top), p.shelf_colour)
    shelf.friction = [0.8, 0.005, 2e-5]
    for name, y in (("front", -0.07), ("back", 0.07)):
        legs = (start - r, start - r + 0.03)
        block(f"leg_{name}", legs, (y - 0.015, y + 0.015), (0, top - SHELF_M), p.shelf_colour)
    add_ball(spec, "ball", (p.direction * start, 0, top + r), r, p.ball_colour).friction = [0.8, 0.005, 2e-5]

    half, wall = p.cup_half_m, (DEPTH_M - WALL_M, DEPTH_M)
    block("cup_floor", (-half, half), (-DEPTH_M, DEPTH_M), (0, FLOOR_M), p.cup_colour)
    block("cup_near", (-half - WALL_M, -half), (-DEPTH_M, DEPTH_M), (0, p.cup_m), p.cup_colour)
    block("cup_far", (half, half + WALL_M), (-DEPTH_M, DEPTH_M), (0, p.cup_m), p.cup_colour)
    block("cup_back", (-half, half), wall, (0, p.cup_m), p.cup_colour)
    block("cup_front", (-half, half), (-DEPTH_M, WALL_M - DEPTH_M), (0, FLOOR_M + 0.4 * r), p.cup_colour)
    side = p.rim_half_m + 0.03
    beyond = side + 0.12  # shadows fall to the right: the wall is there to catch them
    wall_ends = (-side, beyond) if p.direction > 0 else (-beyond, side)
    block("back", wall_ends, (DEPTH_M, DEPTH_M + WALL_M), (0, p.mouth_m), p.back_colour)
    _add_funnel(spec, p)

    outline = Box((-side, -DEPTH_M, 0.0), (beyond, DEPTH_M + WALL_M, p.mouth_m))
    ends = sorted((p.direction * (start - r), -p.direction * p.edge_m))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        hidden=("board_near", "board_far"),
        cover=Box(outline.low, (beyond + 0.05, DEPTH_M + 0.08, p.mouth_m + 0.03)),
        stage=(outline, Box((ends[0], -0.085, 0.0), (ends[1], 0.085, top))),
        velocity={"ball": _rolling(p)},
        inventory=Inventory(
            (p.ball_colour, p.cup_colour, p.shelf_colour, p.board_colour, p.back_colour),
            ("ball", "funnel", "cup", "shelf", "board", "wall"),
            (f"{p.ball_colour} ball", f"{p.cup_colour} cup", f"{p.shelf_colour} shelf", "funnel"),
        ),
    )


def _add_funnel(spec: mujoco.MjSpec, p: Params) -> None:
    """Two boards that slope down to the throat, their faces (not their middles) meeting the throat's width."""
    slope, half = radians(p.slope_deg), 0.008
    for name, side in (("near", -1), ("far", 1)):
        out = p.half_throat * p.radius_m + p.board_m / 2 * cos(slope) + half * sin(slope)
        centre = (p.direction * side * out, 0.0, p.throat_at_m + p.board_m / 2 * sin(slope) - half * cos(slope))
        size = (p.board_m / 2, DEPTH_M - 0.005, half)
        tilt = -p.direction * side * slope
        board = add_box(spec.worldbody, f"board_{name}", centre, size, p.board_colour, euler_y=tilt)
        board.solref, board.friction, board.condim, board.priority = [0.01, 1], [0.4, 0.005, 0.002], 6, 1


def _rolling(p: Params) -> tuple[float, ...]:
    """Velocity of a ball that rolls without slipping."""
    speed = p.direction * p.speed_m_s
    return (speed, 0.0, 0.0, 0.0, speed / p.radius_m, 0.0)


def _over_throat(motion: Motion, p: Params) -> np.ndarray:
    """Height of the ball's centre over the lower edges of the funnel (m), shape (F,)."""
    return motion.pos("ball")[:, 2] - p.throat_at_m


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'yes' from when the ball is wholly below the throat and over the cup, 'no' while it stays between the boards to
    the end; None before either."""
    height = _over_throat(motion, p)
    through = (height < -p.radius_m) & (np.abs(motion.pos("ball")[:, 0]) < p.cup_half_m)
    if through[-1]:
        return ["yes" if past else None for past in through]
    settled = np.linalg.norm(motion.pos("ball") - motion.pos("ball")[-1], axis=1) < 0.5 * p.radius_m
    caught = 0 < height[-1] < 2 * p.radius_m
    return ["no" if caught and still else None for still in settled]


def margin(motion: Motion, p: Params) -> float:
    """How far the ball ends from being just through the throat, or how much too narrow the throat is for it (m)."""
    height = float(_over_throat(motion, p)[-1])
    return -p.radius_m - height if height < 0 else (1 - p.half_throat) * p.radius_m


def twins(p: Params) -> list[Params]:
    """The same funnel with the other throat."""
    return [replace(p, half_throat=p.other_half_throat, other_half_throat=p.half_throat)]


QUESTIONS = (
    "Does the {ball} ball come through the funnel into the {cup} cup, yes or no?",
    "Is the {ball} ball in the {cup} cup below the funnel in the end: yes or no?",
    "Does the {ball} ball fit through the funnel and drop into the {cup} cup, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Ball and cup are named by colours that nothing else has."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(ball=p.ball_colour, cup=p.cup_colour),
        labels=("yes", "no"),
        aliases={
            "yes it does": "yes",
            "it comes through": "yes",
            "it drops into the cup": "yes",
            "in the cup": "yes",
            "no it does not": "no",
            "it gets stuck": "no",
            "it gets stuck in the funnel": "no",
            "it stays in the funnel": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(3)
    if kind == 0:
        side = "left" if p.direction > 0 else "right"
        question = "On which side of the picture is the shelf that the ball rolls along, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    choices = tuple(str(c) for c in rng.permutation([p.ball_colour, p.shelf_colour, p.cup_colour]))
    if kind == 1:
        return AnswerableQuestion(f"What colour is the rolling ball: {listed(choices)}?", choices, p.ball_colour)
    return AnswerableQuestion(f"What colour is the shelf on legs: {listed(choices)}?", choices, p.shelf_colour)


def _ball_like(blob: Blob) -> bool:
    """Whether a region may be a ball or what two boards leave to see of it: neither as large nor as rectangular as a
    panel."""
    return 60 <= blob.area <= 4000 and blob.fill < 0.92 and max(blob.box[2:]) < 2.5 * min(blob.box[2:])


def observe(frames: np.ndarray, question: str) -> str | None:
    """Whether the resting ball is below the upper edge of the cup in the picture."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = [next(filter(_ball_like, blobs(colour_mask(f, values["ball"]))), None) for f in frames[-3:]]
    cup = next(iter(blobs(colour_mask(frames[-1], values["cup"]), 150)), None)
    ball = path[-1]
    if ball is None or not at_rest(path) or cup is None:
        return None
    return "yes" if ball.y > cup.box[1] else "no"


FAMILY = Family(
    name="funnel",
    taxonomy="occlusion",
    category="other",
    sub_scenario="funnel",
    answer_type="binary",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    observe=observe,
    min_margin_m=0.01,
    twins=twins,
)
