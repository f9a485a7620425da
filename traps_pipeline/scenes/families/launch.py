"""A ball runs down a slide and up a kicker that throws it into the air; the question is whether it clears a barrier.

Control: slide, kicker, barrier and the tray behind it are in view. Void: the panel stands before all but the upper
slide.
Hidden element: the barrier, which is low (the ball flies over it) or tall (the ball strikes it and drops into the pit
between kicker and barrier). The slide says nothing about it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
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
Point = tuple[float, float]  # along, up (m)
FLOOR_M = 0.02
DEAD = [-4000.0, -160.0]  # contact without rebound: pit, tray and barrier
BARRIER_HALF_M = 0.014
COLOURS = ("red", "green", "blue", "yellow", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 runs to the right. Lengths along the way are measured from the end of the ledge."""

    direction: int
    tall: bool  # the hidden element
    radius_m: float
    ledge_m: float
    speed_m_s: float  # on the ledge
    slide_deg: float
    slide_m: float  # horizontal length of the straight slide
    kicker_deg: float
    barrier_at_m: float  # from the kicker's lip
    low_barrier_m: float
    tall_barrier_m: float
    tray_m: float
    ball_colour: str
    barrier_colour: str
    slide_colour: str
    kicker_colour: str
    board_colour: str
    tray_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def barrier_m(self) -> float:
        """Height of the barrier that stands there."""
        return self.tall_barrier_m if self.tall else self.low_barrier_m


def draw(rng: np.random.Generator) -> Params:
    """Half of the barriers are tall, whatever else is drawn."""
    direction = int(rng.choice([-1, 1]))
    ball, barrier, kicker = distinct_colours(rng, 3, COLOURS)
    slide, board = rng.permutation(["wood", "grey"])
    return Params(
        direction=direction,
        tall=bool(rng.integers(2)),
        radius_m=uniform(rng, 0.045, 0.053),
        ledge_m=uniform(rng, 0.26, 0.34),
        speed_m_s=uniform(rng, 0.35, 0.50),
        slide_deg=uniform(rng, 27, 33),
        slide_m=uniform(rng, 0.46, 0.54),
        kicker_deg=uniform(rng, 37, 43),
        barrier_at_m=uniform(rng, 0.17, 0.21),
        low_barrier_m=uniform(rng, 0.07, 0.10),
        tall_barrier_m=uniform(rng, 0.30, 0.36),
        tray_m=uniform(rng, 0.40, 0.48),
        ball_colour=ball,
        barrier_colour=barrier,
        slide_colour=str(slide),
        kicker_colour=kicker,
        board_colour=str(board),
        tray_colour=str(rng.choice(["black", "white"])),
        azimuth_deg=90 - direction * uniform(rng, -14, 18),
        elevation_deg=uniform(rng, -32, -20),
    )


def _slide(p: Params) -> list[Point]:
    """The way from the ledge to the lip: a straight slide, then a curve of short flat pieces up to the kicker."""
    bends = np.linspace(-p.slide_deg, p.kicker_deg, 10)[1:]
    steps = [(0.035 * np.cos(np.radians(b)), 0.035 * np.sin(np.radians(b))) for b in bends]
    fall = p.slide_m * np.tan(np.radians(p.slide_deg))
    points = np.cumsum([(0.0, 0.0), (p.slide_m, -fall), *steps], axis=0)
    points[:, 1] += FLOOR_M + 0.015 - points[:, 1].min()
    return [(float(u), float(z)) for u, z in points]


def build(p: Params, physics: Physics) -> Scene:
    """Ledge, slide, kicker, pit, barrier and tray before a board that catches the shadows; `direction` mirrors it."""
    spec = new_spec(physics)
    r, side, rim = p.radius_m, 1.6 * p.radius_m, 0.012
    way = _slide(p)
    (_, top), (lip, lip_z) = way[0], way[-1]
    barrier, end = lip + p.barrier_at_m, lip + p.barrier_at_m + p.tray_m

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    block("ledge", (-p.ledge_m, 0), (-side, side), (0, top), p.slide_colour)
    for i, (a, b) in enumerate(pairwise(way)):
        _plank(spec, p, f"slide_{i}", a, b, side)
    block("kicker", (lip - 0.05, lip), (-side, side), (0, lip_z - 0.05), p.kicker_colour)
    faces = (barrier - BARRIER_HALF_M, barrier + BARRIER_HALF_M)
    pit = block("pit", (lip, faces[0]), (-side, side), (0, FLOOR_M), p.tray_colour)
    wall = block("barrier", faces, (-side, side), (0, p.barrier_m), p.barrier_colour)
    tray = block("tray", (faces[1], end), (-side, side), (0, FLOOR_M), p.tray_colour)
    stop = block("end", (end, end + 0.02), (-side - rim, side), (0, 0.20), p.slide_colour)
    for geom in (pit, wall, tray, stop):
        geom.priority, geom.condim, geom.friction, geom.solref = 1, 6, [0.8, 0.005, 3e-3], DEAD
    block("front_rail", (lip, end), (-side - rim, -side), (0, FLOOR_M + 0.3 * r), p.slide_colour)
    high = p.tall_barrier_m + 0.03
    cut = 0.55 * p.slide_m
    block("board", (cut, end + 0.02), (side, side + 0.015), (0, high), p.board_colour)
    ball = add_ball(spec, "ball", (p.direction * (-p.ledge_m + 1.2 * r), 0, top + r), r, p.ball_colour)
    ball.friction = [0.8, 0.005, 2e-5]

    ends = sorted((p.direction * cut, p.direction * (end + 0.02)))
    back = sorted((-p.direction * p.ledge_m, p.direction * end))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        hidden=("barrier",),
        cover=Box((ends[0], -side - rim, 0.0), (ends[1] + 0.02, side + 0.03, high + 0.03)),
        stage=(Box((back[0], -side, 0.0), (back[1], side, high)),),
        velocity={"ball": _rolling(p)},
        inventory=Inventory(
            (p.ball_colour, p.barrier_colour, p.slide_colour, p.kicker_colour, p.board_colour, p.tray_colour),
            ("ball", "barrier", "slide", "kicker", "ramp", "tray", "board"),
            (f"{p.ball_colour} ball", f"{p.barrier_colour} barrier", "slide", "tray", f"{p.kicker_colour} kicker"),
        ),
    )


def _plank(spec: mujoco.MjSpec, p: Params, name: str, a: Point, b: Point, side: float) -> None:
    """A plank whose upper face runs from one point of the way to the next."""
    (xa, za), (xb, zb) = sorted(((p.direction * u, z) for u, z in (a, b)))
    angle, half_t = -float(np.arctan2(zb - za, xb - xa)), 0.008
    centre = ((xa + xb) / 2 - half_t * np.sin(angle), 0.0, (za + zb) / 2 - half_t * np.cos(angle))
    half = (float(np.hypot(xb - xa, zb - za)) / 2, side, half_t)
    add_box(spec.worldbody, name, centre, half, p.kicker_colour, euler_y=angle)


def _rolling(p: Params) -> tuple[float, ...]:
    """Velocity of a ball that rolls without slipping."""
    speed = p.direction * p.speed_m_s
    return (speed, 0.0, 0.0, 0.0, speed / p.radius_m, 0.0)


def _past_m(motion: Motion, p: Params) -> np.ndarray:
    """How far the ball's centre is past the middle of the barrier (m), shape (F,)."""
    return p.direction * motion.pos("ball")[:, 0] - _slide(p)[-1][0] - p.barrier_at_m


def readings(motion: Motion, p: Params) -> list[str | None]:
    """On which side of the barrier the ball lies, from when it stays low on that side, past the kicker."""
    past = _past_m(motion, p)
    low = motion.pos("ball")[:, 2] < FLOOR_M + p.radius_m + 0.03
    inside = (past > -p.barrier_at_m) & low & (np.sign(past) == np.sign(past[-1]))
    outside = np.flatnonzero(~inside)
    settled = int(outside[-1]) + 1 if outside.size else 0
    answer = "yes" if past[-1] > 0 else "no"
    return [answer if i >= settled else None for i in range(len(past))]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the ball ends from the middle of the barrier."""
    return float(abs(_past_m(motion, p)[-1]))


def twins(p: Params) -> list[Params]:
    """The same run with the other barrier."""
    return [replace(p, tall=not p.tall)]


QUESTIONS = (
    "Does the {ball} ball clear the {barrier} barrier, yes or no?",
    "Launched off the ramp, does the {ball} ball fly over the {barrier} barrier: yes or no?",
    "Does the {ball} ball land beyond the {barrier} barrier, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Ball and barrier are named by their colours."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(ball=p.ball_colour, barrier=p.barrier_colour),
        labels=("yes", "no"),
        aliases={
            "yes it does": "yes",
            "it clears the barrier": "yes",
            "it flies over": "yes",
            "it lands beyond the barrier": "yes",
            "no it does not": "no",
            "it does not clear the barrier": "no",
            "it hits the barrier": "no",
            "it is stopped by the barrier": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    if rng.integers(2):
        question = "Towards which side does the ball run down the slide, left or right?"
        return AnswerableQuestion(question, ("left", "right"), "right" if p.direction > 0 else "left")
    choices = tuple(str(c) for c in rng.permutation([p.ball_colour, p.barrier_colour, p.kicker_colour]))
    question = f"What colour is the ball that runs down the slide: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.ball_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """The ball lies beyond the barrier, seen from where it started, or before it; None while either is not seen."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = track(frames, values["ball"], 60)
    barrier = largest(frames[-1], values["barrier"], 60)
    start, end = next((blob for blob in path if blob), None), path[-1]
    if barrier is None or start is None or end is None or not at_rest(path):
        return None
    return "yes" if (end.x - barrier.x) * (barrier.x - start.x) > 0 else "no"


FAMILY = Family(
    name="launch",
    taxonomy="occlusion",
    category="pendulums_levers",
    sub_scenario="launch",
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
