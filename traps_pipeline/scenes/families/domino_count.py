"""A short row of dominoes is set off by a rolling ball, and kicks a ball into a second row; the question is how many
dominoes of the second row fall.

Control: both rows are in view. Void: the panel stands before the second row.
Hidden element: where the second row has its gap, which the fall does not bridge.
The last visible domino only kicks a ball that is behind the panel from the start and that two posts stop after it has
struck the second row: nothing that the gap changes can push back on what is seen.
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
from traps_pipeline.scenes.vision import Blob, blobs, colour_mask
from traps_pipeline.scenes.wording import asked, choices_in

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

# In domino heights:
PLANK = 0.07  # thickness of the plank that everything stands on
BALL = 0.40  # radius of both balls
BALL_AT = 0.55 + BALL  # centre of the kicked ball, from the front face of the last visible domino
POSTS_AT = 1.75  # near face of the posts, from there as well: the stopped ball is past that domino's reach

STILL_M = 0.002  # a domino that moves less than this any more is at rest
DOMINO_COLOURS = ("red", "green", "blue", "yellow", "cyan", "purple")
RANGES = (((1, 2), (3, 4), (5, 6)), ((1, 2), (3, 5), (6, 7)))
NUMBERS = ("zero", "one", "two", "three", "four", "five", "six", "seven")


@dataclass(frozen=True)
class Params:
    """direction: +1 falls to the right. Lengths without a unit in the name are in domino heights."""

    direction: int
    height_m: float
    width: float
    thickness: float
    spacing: float
    visible: int  # dominoes before the hand-off
    ranges: tuple[tuple[int, int], ...]  # the choices: least and most dominoes of each
    gap_after: int  # dominoes of the second row before its gap: the hidden element
    starter_speed_m_s: float
    first_colour: str
    second_colour: str
    ball_colour: str
    plank_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def hand_off(self) -> float:
        """Distance along the row from the last visible domino to the first concealed one."""
        return POSTS_AT + 0.09 + self.thickness

    @property
    def second(self) -> int:
        """Dominoes in the second row."""
        return self.ranges[-1][1]

    @property
    def labels(self) -> tuple[str, ...]:
        """The choices as they are read out."""
        return tuple(f"{low}-{high}" for low, high in self.ranges)


def draw(rng: np.random.Generator) -> Params:
    """First the choice that shall be right, then where the gap is; nothing that can be seen tells."""
    direction = int(rng.choice([-1, 1]))
    first, second, ball = distinct_colours(rng, 3, DOMINO_COLOURS)
    ranges = RANGES[int(rng.integers(len(RANGES)))]
    low, high = ranges[int(rng.integers(len(ranges)))]
    return Params(
        direction=direction,
        height_m=uniform(rng, 0.17, 0.21),
        width=uniform(rng, 0.54, 0.66),
        thickness=uniform(rng, 0.16, 0.20),
        spacing=uniform(rng, 0.68, 0.74),
        visible=int(rng.integers(2, 4)),
        ranges=ranges,
        gap_after=int(rng.integers(low, high + 1)),
        starter_speed_m_s=uniform(rng, 0.50, 0.70),
        first_colour=first,
        second_colour=second,
        ball_colour=ball,
        plank_colour=str(rng.choice(["wood", "grey", "black"])),
        azimuth_deg=90 - direction * uniform(rng, -14, 14),
        elevation_deg=uniform(rng, -38, -28),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Lengths run along the row, from the first domino on, in domino heights; `direction` mirrors them."""
    spec = new_spec(physics)
    h, half_t = p.height_m, p.thickness / 2
    ball_z = (PLANK + BALL) * h
    last_seen = (p.visible - 1) * p.spacing
    face = last_seen + half_t
    first_concealed = last_seen + p.hand_off
    row_end = first_concealed + p.second * p.spacing

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
        _add_domino(spec, p, f"domino_{i}", i * p.spacing, p.first_colour)
    for i, name in enumerate(_second(p)):
        place = i if i < p.gap_after else i + 1
        _add_domino(spec, p, name, first_concealed + place * p.spacing, p.second_colour)
    for side in (-1, 1):
        x = p.direction * h * (face + POSTS_AT + 0.03)
        y = side * h * (0.8 * BALL + 0.06)  # closer together than the ball is wide: it leans through, and stops
        add_box(spec.worldbody, f"post_{side}", (x, y, 0.5 * h), (0.03 * h, 0.06 * h, 0.5 * h), "grey")

    # Shadows fall to the right and to the back; whatever the gap changes must cast its shadow behind the panel too.
    ends = sorted((p.direction * h * (face + BALL_AT - BALL - 0.03), p.direction * h * (row_end + 1.15)))
    front, back = -h * (p.width / 2 + 0.10), h * (p.width / 2 + 0.65)
    low, high = (ends[0], front, 0.0), (ends[1] + (0.35 * h if p.direction > 0 else 0.0), back, (PLANK + 1.04) * h)
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=_second(p),
        hidden=_second(p),
        cover=Box(low, high),
        stage=(Box((ends[0], front, 0.0), (ends[1], back, (PLANK + 1.0) * h)),),
        velocity={"starter": _rolling(p)},
        inventory=Inventory(
            (p.first_colour, p.second_colour, p.ball_colour, p.plank_colour, "grey"),
            ("domino", "ball", "plank", "post", "row"),
            (f"{p.first_colour} domino", f"{p.second_colour} domino", f"{p.ball_colour} ball", "plank"),
        ),
    )


def _second(p: Params) -> tuple[str, ...]:
    """Bodies of the second row, from the hand-off on."""
    return tuple(f"second_{i}" for i in range(p.second))


def _add_domino(spec: mujoco.MjSpec, p: Params, name: str, along: float, colour: str) -> None:
    """A free domino (body and geom `name`), standing across the row."""
    h = p.height_m
    x = p.direction * along * h
    body = spec.worldbody.add_body(name=name, pos=[x, 0, (PLANK + 0.5) * h])
    body.add_freejoint()
    geom = add_box(body, name, (0, 0, 0), (p.thickness * h / 2, p.width * h / 2, h / 2), colour)  # type: ignore[arg-type]
    geom.density = 500
    geom.friction = [0.2, 0.005, 0.0001]
    geom.solref = [0.006, 1]


def _rolling(p: Params) -> tuple[float, ...]:
    """Velocity of a ball that rolls without slipping."""
    speed = p.direction * p.starter_speed_m_s
    return (speed, 0.0, 0.0, 0.0, speed / (BALL * p.height_m), 0.0)


def _tops_m(motion: Motion, p: Params) -> np.ndarray:
    """Height over the plank of the middle of each top of the second row (m), shape (F, dominoes)."""
    tops = [motion.pos(b)[:, 2] + motion.rot(b)[:, 2, 2] * p.height_m / 2 for b in _second(p)]
    return np.stack(tops, axis=1) - PLANK * p.height_m


def readings(motion: Motion, p: Params) -> list[str | None]:
    """The choice for how many tops are below 0.6 of a domino's height, from when none of the second row moves."""
    fallen = (_tops_m(motion, p) < 0.6 * p.height_m).sum(axis=1)
    moves = [np.linalg.norm(motion.pos(b) - motion.pos(b)[-1], axis=1) > STILL_M for b in _second(p)]
    restless = np.flatnonzero(np.any(moves, axis=0))
    still_from = int(restless[-1]) + 1 if restless.size else 0
    return [_choice(p, int(n)) if i >= still_from else None for i, n in enumerate(fallen)]


def _choice(p: Params, count: int) -> str | None:
    fits = (label for label, (low, high) in zip(p.labels, p.ranges, strict=True) if low <= count <= high)
    return next(fits, None)


def margin(motion: Motion, p: Params) -> float:
    """How far (m) any top of the second row ends from 0.6 of a domino's height, at least."""
    return float(np.abs(_tops_m(motion, p)[-1] - 0.6 * p.height_m).min())


def twins(p: Params) -> list[Params]:
    """The same rows with the gap elsewhere, so far that another choice is right."""
    own = _choice(p, p.gap_after)
    return [replace(p, gap_after=n) for n in range(1, p.second + 1) if _choice(p, n) != own]


QUESTIONS = (
    "How many of the {second} dominoes of the second row fall over, {choices}?",
    "How many {second} dominoes are knocked down in the end: {choices}?",
    "Count the {second} dominoes that have fallen at the end: are they {choices}?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The second row is named by its colour, which nothing else has; the choices stay in order."""
    aliases = {f"{low} to {high}": label for label, (low, high) in zip(p.labels, p.ranges, strict=True)}
    aliases |= {f"{low} or {high}": label for label, (low, high) in zip(p.labels, p.ranges, strict=True)}
    for n in range(1, p.second + 1):
        label = _choice(p, n)
        assert label is not None
        aliases |= {str(n): label, NUMBERS[n]: label}
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(second=p.second_colour, choices=listed(p.labels)),
        labels=p.labels,
        aliases=aliases,
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(3)
    if kind == 0:
        return AnswerableQuestion(f"How many {p.first_colour} dominoes are there, 2 or 3?", ("2", "3"), str(p.visible))
    if kind == 1:
        side = "left" if p.direction > 0 else "right"
        question = f"Does the ball start to the left or to the right of the {p.first_colour} dominoes?"
        return AnswerableQuestion(question, ("left", "right"), side)
    choices = tuple(str(c) for c in rng.permutation([p.first_colour, p.second_colour, p.ball_colour]))
    question = f"Which colour are the dominoes that the rolling ball strikes: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.first_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """All dominoes of the second row less those that still stand where they stood at first."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    ranges = [tuple(int(n) for n in choice.split("-")) for choice in choices_in(values["choices"])]
    before, after = colour_mask(frames[0], values["second"]), colour_mask(frames[-1], values["second"])
    standing = blobs(before, min_area=60)
    changed = (after != colour_mask(frames[-3], values["second"])).sum()
    if len(standing) != ranges[-1][1] or after.sum() < 0.3 * before.sum() or changed > 0.1 * after.sum():
        return None
    fallen = sum(not _still_there(blob, before, after) for blob in standing)
    return next((f"{low}-{high}" for low, high in ranges if low <= fallen <= high), None)


def _still_there(blob: Blob, before: np.ndarray, after: np.ndarray) -> bool:
    """Whether the upper half of a domino is where it was."""
    x, y, w, h = blob.box
    part = np.s_[y : y + h // 2, x : x + w]
    return bool((before[part] & after[part]).sum() > 0.7 * before[part].sum())


FAMILY = Family(
    name="domino_count",
    taxonomy="occlusion",
    category="dominoes",
    sub_scenario="domino_count",
    answer_type="count_range",
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
