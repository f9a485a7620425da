"""A row of dominoes is set off by a rolling ball; the question is whether the last one falls.

Control: the whole row is in view. Void: the panel stands before its second part.
Hidden element: one domino of the second part, which stands in the row or lies beside it and leaves a gap.
The last visible domino only kicks a ball that is behind the panel from the start and that two posts stop after it has
struck the second part: nothing that the gap changes can push back on what is seen.
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
from traps_pipeline.scenes.vision import at_rest, colour_mask, is_panel, track
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

# In domino heights:
PLANK = 0.07  # thickness of the plank that everything stands on
BALL = 0.40  # radius of both balls
BALL_AT = 0.55 + BALL  # centre of the kicked ball, from the front face of the last visible domino
POSTS_AT = 1.75  # near face of the posts, from there as well: the stopped ball is past that domino's reach

STILL_M = 0.002  # a domino that moves less than this any more is at rest
DOMINO_COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 falls to the right. Lengths without a unit in the name are in domino heights."""

    direction: int
    height_m: float
    width: float
    thickness: float
    spacing: float
    visible: int  # dominoes before the hand-off
    concealed: int  # dominoes after it, the last one included
    gap_index: int  # which of the concealed ones the hidden element is
    gap_open: bool  # whether it lies beside the row
    starter_speed_m_s: float
    first_colour: str
    row_colour: str
    last_colour: str
    ball_colour: str
    plank_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def hand_off(self) -> float:
        """Distance along the row from the last visible domino to the first concealed one."""
        return POSTS_AT + 0.09 + self.thickness


def draw(rng: np.random.Generator) -> Params:
    """Half of the rows have a gap; nothing that can be seen tells."""
    direction = int(rng.choice([-1, 1]))
    concealed = int(rng.integers(3, 5))
    first, row, last, ball = colours = distinct_colours(rng, 4, DOMINO_COLOURS)
    return Params(
        direction=direction,
        height_m=uniform(rng, 0.17, 0.21),
        width=uniform(rng, 0.54, 0.66),
        thickness=uniform(rng, 0.16, 0.20),
        spacing=uniform(rng, 0.68, 0.74),
        visible=int(rng.integers(3, 5)),
        concealed=concealed,
        gap_index=int(rng.integers(1, concealed - 1)),
        gap_open=bool(rng.integers(2)),
        starter_speed_m_s=uniform(rng, 0.50, 0.70),
        first_colour=first,
        row_colour=row,
        last_colour=last,
        ball_colour=ball,
        plank_colour=str(rng.choice(["grey", "black"] if "orange" in colours else ["wood", "grey", "black"])),
        azimuth_deg=90 - direction * uniform(rng, -32, 18),
        elevation_deg=uniform(rng, -36, -24),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Lengths run along the row, from the first domino on, in domino heights; `direction` mirrors them."""
    spec = new_spec(physics)
    h, half_t = p.height_m, p.thickness / 2
    ball_z = (PLANK + BALL) * h
    last_seen = (p.visible - 1) * p.spacing
    face = last_seen + half_t
    first_concealed = last_seen + p.hand_off
    row_end = first_concealed + (p.concealed - 1) * p.spacing

    plank = (p.direction * h * (row_end + 1.15 - 2.3) / 2, h * (row_end + 1.15 + 2.3) / 2)
    add_box(
        spec.worldbody,
        "plank",
        (plank[0], 0, PLANK * h / 2),
        (plank[1], (p.width / 2 + 0.06) * h, PLANK * h / 2),
        p.plank_colour,
    )
    starter = add_ball(spec, "starter", (-p.direction * h * 1.8, 0, ball_z), BALL * h, p.ball_colour, density=300)
    kicked = add_ball(
        spec, "kicked", (p.direction * h * (face + BALL_AT), 0, ball_z), BALL * h, p.ball_colour, density=300
    )
    for ball in (starter, kicked):
        ball.friction = [0.1, 0.005, 0.0004]  # the plank grips it, a domino slides over it and squeezes it out
    for i in range(p.visible):
        colour = p.first_colour if i == 0 else p.row_colour
        _add_domino(spec, p, f"domino_{i}", i * p.spacing, colour)
    for i in range(p.concealed):
        colour = p.last_colour if i == p.concealed - 1 else p.row_colour
        aside = p.gap_open and i == p.gap_index
        _add_domino(spec, p, _concealed(p)[i], first_concealed + i * p.spacing, colour, aside=aside)
    for side in (-1, 1):
        x = p.direction * h * (face + POSTS_AT + 0.03)
        y = side * h * (0.8 * BALL + 0.06)  # closer together than the ball is wide: it leans through, and stops
        add_box(spec.worldbody, f"post_{side}", (x, y, 0.5 * h), (0.03 * h, 0.06 * h, 0.5 * h), "grey")

    # Shadows fall to the right and to the back; whatever the gap changes must cast its shadow behind the panel too.
    ends = sorted((p.direction * h * (face + BALL_AT - BALL - 0.03), p.direction * h * (row_end + 1.15)))
    front, back = -h * (p.width / 2 + 0.10), h * (1.5 * p.width + 0.20)
    low, high = (ends[0], front, 0.0), (ends[1] + (0.35 * h if p.direction > 0 else 0.0), back, (PLANK + 1.04) * h)
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("last",),
        hidden=(_concealed(p)[p.gap_index],),
        cover=Box(low, high),
        stage=(Box((ends[0], front, 0.0), (ends[1], back, (PLANK + 1.0) * h)),),
        velocity={"starter": _rolling(p)},
        inventory=Inventory(
            (p.first_colour, p.row_colour, p.last_colour, p.ball_colour, p.plank_colour, "grey"),
            ("domino", "ball", "plank", "post"),
            (f"{p.first_colour} domino", f"{p.last_colour} domino", f"{p.ball_colour} ball", "plank"),
        ),
    )


def _concealed(p: Params) -> list[str]:
    return [f"concealed_{i}" for i in range(p.concealed - 1)] + ["last"]


def _add_domino(spec: mujoco.MjSpec, p: Params, name: str, along: float, colour: str, *, aside: bool = False) -> None:
    """A free domino (body and geom `name`), standing in the row or lying flat behind it."""
    h = p.height_m
    x = p.direction * along * h
    body = spec.worldbody.add_body(name=name, pos=[x, 0, (PLANK + 0.5) * h])
    if aside:
        body.pos = [x, h * (p.width + 0.10), p.thickness * h / 2]
        body.quat = [0.5**0.5, 0, 0.5**0.5, 0]
    body.add_freejoint()
    geom = add_box(body, name, (0, 0, 0), (p.thickness * h / 2, p.width * h / 2, h / 2), colour)  # type: ignore[arg-type]
    geom.density = 500
    geom.friction = [0.2, 0.005, 0.0001]
    geom.solref = [0.006, 1]


def _rolling(p: Params) -> tuple[float, ...]:
    """Velocity of a ball that rolls without slipping."""
    speed = p.direction * p.starter_speed_m_s
    return (speed, 0.0, 0.0, 0.0, speed / (BALL * p.height_m), 0.0)


def _top_m(motion: Motion, p: Params) -> np.ndarray:
    """Height over the plank of the middle of the last domino's top (m) in every frame, shape (F,)."""
    return motion.pos("last")[:, 2] - PLANK * p.height_m + motion.rot("last")[:, 2, 2] * p.height_m / 2


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'yes' from when the top of the last domino is below half a domino's height; 'no' while it is not, from when no
    concealed domino moves any more."""
    fallen = _top_m(motion, p) < p.height_m / 2
    moves = [np.linalg.norm(motion.pos(b) - motion.pos(b)[-1], axis=1) > STILL_M for b in _concealed(p)]
    restless = np.flatnonzero(np.any(moves, axis=0))
    still_from = int(restless[-1]) + 1 if restless.size else 0
    return ["yes" if down else "no" if i >= still_from else None for i, down in enumerate(fallen)]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the top of the last domino ends above or below half a domino's height."""
    return float(abs(_top_m(motion, p)[-1] - p.height_m / 2))


def twins(p: Params) -> list[Params]:
    """The same row with the gap closed, or opened."""
    return [replace(p, gap_open=not p.gap_open)]


QUESTIONS = (
    "Does the {last} domino at the end of the row fall over, yes or no?",
    "Does the last domino, the {last} one, get knocked over: yes or no?",
    "Is the {last} domino at the far end of the row knocked down in the end, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The last domino is named by its colour, which no other domino has."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(last=p.last_colour),
        labels=("yes", "no"),
        aliases={
            "yes it falls": "yes",
            "it falls": "yes",
            "it falls over": "yes",
            "falls": "yes",
            "no it does not fall": "no",
            "it does not fall": "no",
            "it stays standing": "no",
            "stays upright": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(3)
    if kind == 0:
        side = "left" if p.direction > 0 else "right"
        question = "From which side does the ball roll towards the first domino, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    choices = tuple(str(c) for c in rng.permutation([p.first_colour, p.row_colour, p.ball_colour]))
    if kind == 1:
        question = f"What colour is the domino that the ball strikes first: {listed(choices)}?"
        return AnswerableQuestion(question, choices, p.first_colour)
    question = f"What colour is the ball that rolls into the dominoes: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.ball_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """Whether the last domino, once at rest, is no longer where it stood at first."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = track(frames, values["last"], min_area=60)
    if path[0] is None or is_panel(path[0]) or not at_rest(path):
        return None
    x, y, w, h = path[0].box
    part = np.s_[y : y + h // 2, x : x + w]
    before, after = (colour_mask(frame, values["last"])[part] for frame in (frames[0], frames[-1]))
    return "no" if (before & after).sum() > 0.7 * before.sum() else "yes"


FAMILY = Family(
    name="domino_chain",
    taxonomy="occlusion",
    category="dominoes",
    sub_scenario="domino_chain",
    answer_type="binary",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    observe=observe,
    physics=Physics(timestep_s=0.001, tolerance=0.0),  # a solver that stops early makes rounding visible in the twin
    min_margin_m=0.03,
    twins=twins,
)
