"""A ball rolls off a table and drops; the question is whether it bounces over a wall.

Control: the pad under the table's edge, the wall and the tray behind it are in view. Void: the panel stands before
all of that.
Hidden element: the pad that the ball lands on, which is lively (the ball leaps over the wall) or dead (it stays before
the wall). The pads look the same, and nothing that the ball does before it lands tells them apart.
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
from traps_pipeline.scenes.vision import at_rest, largest, track
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
FLOOR_M = 0.03  # top of the pad and of the tray
WALL_HALF_M = 0.014
LIVELY = 0.85  # share of its speed that a ball keeps on the lively pad
STILL_M = 0.01
COLOURS = ("red", "green", "blue", "yellow", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. Lengths along the way are measured from the table's edge."""

    direction: int
    lively: bool  # the hidden element
    radius_m: float
    speed_m_s: float
    table_m: float
    drop_m: float  # height of the table's top over the pad
    wall_m: float  # height of the wall over the pad
    tray_m: float
    ball_colour: str
    wall_colour: str
    pad_colour: str
    table_colour: str
    board_colour: str
    tray_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def fall_s(self) -> float:
        """Time that the ball falls from the table to the pad."""
        return float(np.sqrt(2 * self.drop_m / 9.81))

    @property
    def wall_at_m(self) -> float:
        """Where the wall stands: below the highest point of the bounce."""
        return (1 + LIVELY) * self.speed_m_s * self.fall_s + 0.3 * self.radius_m

    @property
    def end_m(self) -> float:
        """Inner face of the tray's end."""
        return self.wall_at_m + self.tray_m


def draw(rng: np.random.Generator) -> Params:
    """Half of the pads are lively, whatever else is drawn."""
    direction = int(rng.choice([-1, 1]))
    ball, wall, pad = distinct_colours(rng, 3, COLOURS)
    board, table = rng.permutation(["wood", "grey"])
    return Params(
        direction=direction,
        lively=bool(rng.integers(2)),
        radius_m=uniform(rng, 0.045, 0.055),
        speed_m_s=uniform(rng, 0.50, 0.66),
        table_m=uniform(rng, 0.50, 0.62),
        drop_m=uniform(rng, 0.44, 0.54),
        wall_m=uniform(rng, 0.13, 0.19),
        tray_m=uniform(rng, 0.40, 0.50),
        ball_colour=ball,
        wall_colour=wall,
        pad_colour=pad,
        table_colour=str(table),
        board_colour=str(board),
        tray_colour=str(rng.choice(["black", "white"])),
        azimuth_deg=90 - direction * uniform(rng, -14, 20),
        elevation_deg=uniform(rng, -32, -20),
    )


def build(p: Params, physics: Physics) -> Scene:
    """A table, then pad, wall and tray before a board that catches the shadows; `direction` mirrors all of it."""
    spec = new_spec(physics)
    r, side, rim = p.radius_m, 1.7 * p.radius_m, 0.012
    top = FLOOR_M + p.drop_m

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    block("table", (-p.table_m, 0), (-side, side), (0, top), p.table_colour)
    for i, y in enumerate((-side, side - rim)):
        block(f"table_rail_{i}", (-p.table_m, 0), (y, y + rim), (top, top + 0.3 * r), p.board_colour)
    pad = block("pad", (0, p.wall_at_m - WALL_HALF_M), (-side, side), (0, FLOOR_M), p.pad_colour)
    pad.priority, pad.condim, pad.friction = 2, 6, [0.8, 0.005, 1e-3]
    pad.solref = [-50000.0, -22.0] if p.lively else [-4000.0, -160.0]
    wall = (p.wall_at_m - WALL_HALF_M, p.wall_at_m + WALL_HALF_M)
    block("wall", wall, (-side, side), (0, FLOOR_M + p.wall_m), p.wall_colour)
    tray = block("tray", (wall[1], p.end_m), (-side, side), (0, FLOOR_M), p.tray_colour)
    tray.priority, tray.condim, tray.friction, tray.solref = 1, 6, [0.8, 0.005, 2e-3], [-4000.0, -160.0]
    block("front_rail", (0, p.end_m), (-side - rim, -side), (0, FLOOR_M + 0.3 * r), p.table_colour)
    block("end", (p.end_m, p.end_m + 0.02), (-side - rim, side), (0, FLOOR_M + p.wall_m), p.table_colour)
    block("board", (0, p.end_m + 0.02), (side, side + 0.015), (0, top), p.board_colour)
    ball = add_ball(spec, "ball", (p.direction * (-p.table_m + 1.3 * r), 0, top + r), r, p.ball_colour)
    ball.friction = [0.8, 0.005, 2e-5]

    ends = sorted((p.direction * 0.03, p.direction * (p.end_m + 0.02)))  # a ball just hidden has left the table
    cover = Box((ends[0], -side - rim, 0.0), (ends[1] + 0.02, side + 0.03, top + 0.02))
    back = sorted((-p.direction * p.table_m, p.direction * p.end_m))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        hidden=("pad",),
        cover=cover,
        stage=(Box((back[0], -side, 0.0), (back[1], side, top)),),
        velocity={"ball": _rolling(p)},
        inventory=Inventory(
            (p.ball_colour, p.wall_colour, p.pad_colour, p.table_colour, p.board_colour, p.tray_colour),
            ("ball", "wall", "table", "pad", "tray", "board"),
            (f"{p.ball_colour} ball", f"{p.wall_colour} wall", "table", "tray", f"{p.pad_colour} pad"),
        ),
    )


def _rolling(p: Params) -> tuple[float, ...]:
    """Velocity of a ball that rolls without slipping."""
    speed = p.direction * p.speed_m_s
    return (speed, 0.0, 0.0, 0.0, speed / p.radius_m, 0.0)


def _past_m(motion: Motion, p: Params) -> np.ndarray:
    """How far the ball's centre is past the middle of the wall (m), shape (F,)."""
    return p.direction * motion.pos("ball")[:, 0] - p.wall_at_m


def readings(motion: Motion, p: Params) -> list[str | None]:
    """On which side of the wall the ball is, from when it stays low on that side: it lies in the tray or on the pad."""
    past = _past_m(motion, p)
    low = motion.pos("ball")[:, 2] < FLOOR_M + p.radius_m + 0.4 * p.wall_m
    changed = np.flatnonzero(~low | (np.sign(past) != np.sign(past[-1])))
    settled = int(changed[-1]) + 1 if changed.size else 0
    answer = "yes" if past[-1] > 0 else "no"
    return [answer if i >= settled else None for i in range(len(past))]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the ball ends from the middle of the wall."""
    return float(abs(_past_m(motion, p)[-1]))


def twins(p: Params) -> list[Params]:
    """The same drop onto the other pad."""
    return [replace(p, lively=not p.lively)]


QUESTIONS = (
    "Does the {ball} ball bounce over the {wall} wall, yes or no?",
    "Dropping off the table, does the {ball} ball bounce across the {wall} wall: yes or no?",
    "Does its bounce carry the {ball} ball to the far side of the {wall} wall, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Ball and wall are named by their colours."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(ball=p.ball_colour, wall=p.wall_colour),
        labels=("yes", "no"),
        aliases={
            "yes it does": "yes",
            "it bounces over": "yes",
            "it bounces over the wall": "yes",
            "over the wall": "yes",
            "no it does not": "no",
            "it does not bounce over": "no",
            "it stays before the wall": "no",
            "it does not clear the wall": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    if rng.integers(2):
        question = "Towards which side does the ball roll along the table, left or right?"
        return AnswerableQuestion(question, ("left", "right"), "right" if p.direction > 0 else "left")
    choices = tuple(str(c) for c in rng.permutation([p.ball_colour, p.wall_colour, p.pad_colour]))
    question = f"What colour is the ball that rolls off the table: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.ball_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """The ball lies beyond the wall, seen from where it started, or before it; None while either is not to be seen."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = track(frames, values["ball"], 60)
    wall = largest(frames[-1], values["wall"], 60)
    start, end = next((blob for blob in path if blob), None), path[-1]
    if wall is None or start is None or end is None or not at_rest(path):
        return None
    return "yes" if (end.x - wall.x) * (wall.x - start.x) > 0 else "no"


FAMILY = Family(
    name="bounce",
    taxonomy="occlusion",
    category="trajectories_drops",
    sub_scenario="bounce",
    answer_type="binary",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    observe=observe,
    physics=Physics(timestep_s=0.001),
    min_margin_m=0.03,
    twins=twins,
)
