"""A ball is thrown in a high arc; the question is whether it lands in the basket.

Control: the walled pen that it comes down in is in view, and the basket in it. Void: the panel stands before the pen.
Hidden element: the basket, which stands where the ball comes down or a step before or beyond. The throw is the same
either way, and the walls of the pen keep the ball behind the panel.
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
GRAVITY = 9.81
FLOOR_M = 0.02  # thickness of the pen's floor and of the basket's
WALL_M = 0.012
DEPTH_M = 0.17  # half of the pen's depth
COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 throws to the right. Places are along the throw, from the pedestal's middle."""

    direction: int
    radius_m: float
    pedestal_m: float  # height of the pedestal that the ball starts from
    speed_along_m_s: float
    speed_up_m_s: float
    basket_half_m: float
    rim_m: float  # height of the basket's sides
    step_m: float  # from the place where the ball comes down to the basket's other place, signed
    in_place: bool  # whether the basket stands where the ball comes down: the hidden element
    ball_colour: str
    basket_colour: str
    pedestal_colour: str
    pen_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def landing_m(self) -> float:
        """Where the ball is when it is as high as the basket's sides."""
        fall = self.pedestal_m + 0.01 - self.rim_m
        up = self.speed_up_m_s
        return self.speed_along_m_s * (up + (up * up + 2 * GRAVITY * fall) ** 0.5) / GRAVITY

    @property
    def basket_m(self) -> float:
        """Where the middle of the basket is."""
        return self.landing_m + 0.02 + (0.0 if self.in_place else self.step_m)

    @property
    def pen_m(self) -> Span:
        """Where the pen begins and ends: it has room for both places of the basket and for a ball beside it."""
        aside = self.basket_half_m + 0.03
        room = 2.9 * self.radius_m
        low = self.landing_m + min(0.0, self.step_m) - (aside if self.step_m < 0 else max(room, aside))
        high = self.landing_m + max(0.0, self.step_m) + (aside if self.step_m > 0 else max(room, aside)) + 0.04
        return low, high


def draw(rng: np.random.Generator) -> Params:
    """Half of the baskets stand in place; nothing that can be seen tells."""
    direction = int(rng.choice([-1, 1]))
    radius = uniform(rng, 0.068, 0.080)
    half = uniform(rng, 2.0, 2.2) * radius
    ball, basket, pedestal = distinct_colours(rng, 3, COLOURS)
    return Params(
        direction=direction,
        radius_m=radius,
        pedestal_m=uniform(rng, 0.28, 0.42),
        speed_along_m_s=uniform(rng, 1.20, 1.40),
        speed_up_m_s=uniform(rng, 3.3, 3.8),
        basket_half_m=round(half, 4),
        rim_m=uniform(rng, 0.15, 0.18),
        step_m=round(int(rng.choice([-1, 1])) * (half + radius + uniform(rng, 0.07, 0.10)), 4),
        in_place=bool(rng.integers(2)),
        ball_colour=ball,
        basket_colour=basket,
        pedestal_colour=pedestal,
        pen_colour=str(rng.choice(["grey", "black"])),
        azimuth_deg=90 - direction * uniform(rng, -14, 20),
        elevation_deg=uniform(rng, -36, -24),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Pedestal, pen with a back wall and a low front, basket. Lengths run along the throw, mirrored by `direction`."""
    spec = new_spec(physics)
    r, rim = p.radius_m, p.rim_m

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        geom = add_box(spec.worldbody, name, mid, half, colour)
        geom.solref, geom.friction, geom.condim, geom.priority = [0.01, 1], [0.8, 0.005, 0.004], 6, 1
        return geom

    block("pedestal", (-0.09, 0.09), (-0.09, 0.09), (0, p.pedestal_m), p.pedestal_colour)
    add_ball(spec, "ball", (0, 0, p.pedestal_m + 0.01 + r), r, p.ball_colour)

    low, high = p.pen_m
    block("pen_floor", (low, high), (-DEPTH_M, DEPTH_M), (0, FLOOR_M), p.pen_colour)
    block("pen_near", (low - WALL_M, low), (-DEPTH_M, DEPTH_M), (0, rim), p.pen_colour)
    block("pen_far", (high, high + WALL_M), (-DEPTH_M, DEPTH_M), (0, rim + 0.12), p.pen_colour)
    block("pen_back", (low - WALL_M, high + WALL_M), (DEPTH_M, DEPTH_M + WALL_M), (0, rim), p.pen_colour)

    middle, half, deep = p.basket_m, p.basket_half_m, DEPTH_M - 0.03
    near, far, top = middle - half, middle + half, FLOOR_M + rim
    block("basket_floor", (near, far), (-deep, deep), (FLOOR_M, 2 * FLOOR_M), p.basket_colour)
    block("basket_near", (near - WALL_M, near), (-deep, deep), (FLOOR_M, top), p.basket_colour)
    block("basket_far", (far, far + WALL_M), (-deep, deep), (FLOOR_M, top), p.basket_colour)
    block("basket_back", (near, far), (deep - WALL_M, deep), (FLOOR_M, top), p.basket_colour)
    block("basket_front", (near, far), (-deep, WALL_M - deep), (FLOOR_M, FLOOR_M + 0.45 * r), p.basket_colour)

    ends = sorted((p.direction * (low - WALL_M), p.direction * (high + WALL_M)))
    shadow = 0.35 * (rim + 0.22)  # shadows fall to the right and to the back
    cover = Box((ends[0], -DEPTH_M, 0.0), (ends[1] + shadow, DEPTH_M + 0.55 * (rim + 0.2), rim + 0.20))
    stage = Box((ends[0], -DEPTH_M, 0.0), (ends[1], DEPTH_M, rim + 0.12))
    pedestal = Box((-0.09, -0.09, 0.0), (0.09, 0.09, p.pedestal_m))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        hidden=tuple(f"basket_{part}" for part in ("floor", "near", "far", "back", "front")),
        cover=cover,
        stage=(stage, pedestal),
        velocity={"ball": (p.direction * p.speed_along_m_s, 0.0, p.speed_up_m_s, 0.0, 0.0, 0.0)},
        inventory=Inventory(
            (p.ball_colour, p.basket_colour, p.pedestal_colour, p.pen_colour),
            ("ball", "basket", "pedestal", "pen", "wall"),
            (f"{p.ball_colour} ball", f"{p.basket_colour} basket", f"{p.pedestal_colour} pedestal", "pen"),
        ),
    )


def _beside(motion: Motion, p: Params) -> np.ndarray:
    """Distance along the throw of the ball's centre from the nearest side of the basket, positive within (m)."""
    return p.basket_half_m - np.abs(p.direction * motion.pos("ball")[:, 0] - p.basket_m)


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'yes' while the ball is all but down on a floor between the basket's sides, 'no' when it is beside the basket;
    None while it is higher."""
    low = motion.pos("ball")[:, 2] < 2 * FLOOR_M + 1.3 * p.radius_m
    inside = _beside(motion, p) > 0
    there = p.direction * motion.pos("ball")[:, 0] > p.pen_m[0]
    return [
        ("yes" if within else "no") if down and arrived else None
        for down, within, arrived in zip(low, inside, there, strict=True)
    ]


def margin(motion: Motion, p: Params) -> float:
    """How far the ball's centre is at the end from the nearest side of the basket (m)."""
    return float(abs(_beside(motion, p)[-1]))


def twins(p: Params) -> list[Params]:
    """The same throw with the basket in its other place."""
    return [replace(p, in_place=not p.in_place)]


QUESTIONS = (
    "Does the {ball} ball land in the {basket} basket, yes or no?",
    "Is the thrown {ball} ball caught by the {basket} basket: yes or no?",
    "Does the {ball} ball lie in the {basket} basket in the end, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Ball and basket are named by colours that nothing else has."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(ball=p.ball_colour, basket=p.basket_colour),
        labels=("yes", "no"),
        aliases={
            "yes it does": "yes",
            "it lands in the basket": "yes",
            "it is caught": "yes",
            "in the basket": "yes",
            "no it does not": "no",
            "it misses the basket": "no",
            "it lands beside the basket": "no",
            "it misses": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(3)
    if kind == 0:
        side = "left" if p.direction > 0 else "right"
        return AnswerableQuestion("From which side is the ball thrown, left or right?", ("left", "right"), side)
    seen = p.ball_colour if kind == 1 else p.pedestal_colour
    choices = tuple(str(c) for c in rng.permutation([p.ball_colour, p.pedestal_colour, p.basket_colour]))
    thing = "ball that is thrown" if kind == 1 else "pedestal that the ball is thrown from"
    return AnswerableQuestion(f"What colour is the {thing}: {listed(choices)}?", choices, seen)


def _ball_like(blob: Blob) -> bool:
    """Whether a region may be a ball: neither as large nor as rectangular as a panel."""
    return 60 <= blob.area <= 4000 and blob.fill < 0.9 and max(blob.box[2:]) < 1.9 * min(blob.box[2:])


def observe(frames: np.ndarray, question: str) -> str | None:
    """Whether the resting ball is between the sides of the basket in the picture."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = [next(filter(_ball_like, blobs(colour_mask(f, values["ball"]))), None) for f in frames[-3:]]
    parts = blobs(colour_mask(frames[-1], values["basket"]), 40)
    ball = path[-1]
    if ball is None or not at_rest(path) or not parts:
        return None
    left = min(part.box[0] for part in parts)
    right = max(part.box[0] + part.box[2] for part in parts)
    return "yes" if abs(ball.x - (left + right) / 2) < 0.45 * (right - left) else "no"


FAMILY = Family(
    name="catch",
    taxonomy="occlusion",
    category="trajectories_drops",
    sub_scenario="catch",
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
