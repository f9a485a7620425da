"""Two balls roll down ramps at each other and collide on the deck between them; the question is which one is knocked
back to its own side.

Control: the whole deck is in view. Void: the panel stands before it; both balls are seen to roll in behind it.
Hidden element: a rough board on one half of the deck. The ball that crosses it arrives slowly and is knocked back. The
ramps end in steps, so that neither ball comes back out; their small head starts are only a lure.
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
from traps_pipeline.scenes.vision import at_rest, is_panel, largest, track
from traps_pipeline.scenes.wording import asked, choices_in

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
DECK_M = 0.035
STEP_M = 0.018  # the ramps end this high over the deck
WALL_M = 0.012
LINE_M = 0.010  # half the width of the centre line
BOARD_M = 0.10
STILL_M = 0.003  # a ball that moves less than this any more is at rest
BALL_COLOURS = ("red", "green", "blue", "yellow", "cyan", "purple")
LINE_COLOUR = "black"
SIDES = (-1, 1)


@dataclass(frozen=True)
class Params:
    """Pairs are for the left and the right ball. Lengths run outwards from the centre line."""

    colours: tuple[str, str]
    starts_m: tuple[float, float]  # from the upper end of the ramp
    rough_side: int  # the hidden element: -1 left, +1 right
    slowed: float  # share of its speed that a ball keeps on the rough board
    radius_m: float
    half_deck_m: float
    ramp_m: float
    slope_deg: float
    deck_colour: str
    ramp_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def board_at_m(self) -> float:
        """Where the boards end on the side of the ramps."""
        return self.half_deck_m - 0.10


def draw(rng: np.random.Generator) -> Params:
    """Which side is rough is independent of everything that can be seen."""
    colours = distinct_colours(rng, 2, BALL_COLOURS)
    deck, ramp = rng.permutation(["grey", "white"])
    return Params(
        colours=(colours[0], colours[1]),
        starts_m=(uniform(rng, 0.05, 0.10), uniform(rng, 0.05, 0.10)),
        rough_side=int(rng.choice(SIDES)),
        slowed=uniform(rng, 0.40, 0.48),
        radius_m=uniform(rng, 0.050, 0.058),
        half_deck_m=uniform(rng, 0.46, 0.52),
        ramp_m=uniform(rng, 0.40, 0.46),
        slope_deg=uniform(rng, 8.0, 10.0),
        deck_colour=str(deck),
        ramp_colour=str(ramp),
        azimuth_deg=90 + uniform(rng, -18, 18),
        elevation_deg=uniform(rng, -38, -24),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Two ramps, steps, and a deck with a centre line and low rims. The boards are alike but for their friction."""
    spec = new_spec(physics)
    r, half = p.radius_m, p.half_deck_m
    half_width = 1.7 * r

    def block(name: str, x: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (sum(x) / 2, sum(across) / 2, sum(z) / 2)
        return add_box(
            spec.worldbody, name, mid, ((x[1] - x[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2), colour
        )

    side, inner = (-half_width, half_width), p.board_at_m - BOARD_M
    for s, name in zip(SIDES, ("left", "right"), strict=True):
        for part, near, far, colour in (
            ("deck", LINE_M, inner, p.deck_colour),
            ("board", inner, p.board_at_m, "wood"),
            ("entry", p.board_at_m, half, p.deck_colour),
        ):
            x = (min(s * near, s * far), max(s * near, s * far))
            geom = block(f"{part}_{name}", x, side, (0, DECK_M), colour)
            rolling = _roughness(p, physics) if part == "board" and s == p.rough_side else 8e-4
            geom.friction, geom.condim, geom.priority = [0.8, 0.005, rolling], 6, 2
        _add_ramp(spec, p, s, name, half_width)
    line = block("line", (-LINE_M, LINE_M), side, (0, DECK_M), LINE_COLOUR)
    line.friction, line.condim, line.priority = [0.8, 0.005, 8e-4], 6, 2
    rim = DECK_M + 0.2 * r
    for name, y in (
        ("rim_front", (-half_width - WALL_M, -half_width)),
        ("rim_back", (half_width, half_width + WALL_M)),
    ):
        block(name, (-half, half), y, (0, rim), p.ramp_colour)

    height = DECK_M + 2 * r
    low = (-half + 0.01, -half_width - WALL_M - 0.02, 0.0)
    end = half + p.ramp_m
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball_left", "ball_right"),
        hidden=("board_left", "board_right"),
        cover=Box(low, (half - 0.01, half_width + WALL_M + 0.5 * height, height)),
        stage=(Box((-end, -half_width, 0.0), (end, half_width, height)),),
        inventory=Inventory(
            (*p.colours, "wood", LINE_COLOUR, p.deck_colour, p.ramp_colour),
            ("ball", "ramp", "deck", "line", "board", "side"),
            (*(f"{c} ball" for c in p.colours), "left ramp", "right ramp"),
        ),
    )


def _roughness(p: Params, physics: Physics) -> float:
    """Rolling friction (m) that leaves a ball its share of its speed: a solid ball slows at 5 g mu / 7 r."""
    drop = (p.ramp_m - sum(p.starts_m) / 2) * np.tan(np.radians(p.slope_deg)) * 10 / 7
    return float(7 / 5 * p.radius_m * drop * (1 - p.slowed**2) / (2 * BOARD_M))


def _add_ramp(spec: mujoco.MjSpec, p: Params, s: int, name: str, half_width: float) -> None:
    """The ramp of one side, and its ball at rest near the upper end."""
    slope = np.radians(p.slope_deg)
    normal = np.array([-s * np.sin(slope), 0.0, np.cos(slope)])

    def surface(up: float) -> np.ndarray:
        return np.array([s * (p.half_deck_m + up), 0.0, DECK_M + STEP_M + up * np.tan(slope)])

    thick = 0.012
    add_box(
        spec.worldbody,
        f"ramp_{name}",
        surface(p.ramp_m / 2) - thick * normal,  # type: ignore[arg-type]
        (p.ramp_m / 2 / float(np.cos(slope)), half_width, thick),
        p.ramp_colour,
        euler_y=-s * float(slope),
    )
    foot = surface(p.ramp_m - 0.05)
    add_box(
        spec.worldbody,
        f"prop_{name}",
        (foot[0], 0, foot[2] / 2 - 0.012),
        (0.012, half_width, foot[2] / 2 - 0.012),
        p.ramp_colour,
    )
    which = SIDES.index(s)
    at = surface(p.ramp_m - p.starts_m[which]) + p.radius_m * normal
    ball = add_ball(spec, f"ball_{name}", at, p.radius_m, p.colours[which])  # type: ignore[arg-type]
    ball.solref, ball.friction, ball.priority = [-20000.0, -60.0], [0.05, 0.005, 2e-5], 1


def _ends(motion: Motion) -> np.ndarray:
    """The balls' x (m), shape (F, 2), left ball first."""
    return np.stack([motion.pos("ball_left")[:, 0], motion.pos("ball_right")[:, 0]], axis=1)


def readings(motion: Motion, p: Params) -> list[str | None]:
    """From when both balls are at rest: the colour of the one that is on its own side while the other is there too.
    No reading at all if they do not end on one side."""
    x = _ends(motion)
    if x[-1, 0] * x[-1, 1] <= 0:
        return [None] * len(x)
    back = p.colours[0] if x[-1, 0] < 0 else p.colours[1]
    restless = np.flatnonzero((np.abs(x - x[-1]) > STILL_M).any(axis=1))
    still_from = int(restless[-1]) + 1 if restless.size else 0
    return [back if i >= still_from else None for i in range(len(x))]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) past the centre line the ball is that crossed it."""
    return float(np.abs(_ends(motion)[-1]).min())


def twins(p: Params) -> list[Params]:
    """The same collision with the other half of the deck rough."""
    return [replace(p, rough_side=-p.rough_side)]


QUESTIONS = (
    "The two balls roll at each other: which one is knocked back to the side it came from, {choices}?",
    "Which ball is driven back to its own side when the two collide: {choices}?",
    "What colour is the ball that the other one pushes back to its own half of the deck: {choices}?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The choices are the two colours, in random order."""
    choices = tuple(str(c) for c in rng.permutation(p.colours))
    forms = ("{} ball", "the {} one", "{} is knocked back", "the {} ball is knocked back")
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(choices=listed(choices)),
        labels=choices,
        aliases={form.format(c): c for c in choices for form in forms},
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    side = int(rng.integers(2))
    if rng.integers(2):
        question = f"On which ramp does the {p.colours[side]} ball start, the left one or the right one?"
        return AnswerableQuestion(question, ("left", "right"), ("left", "right")[side])
    choices = tuple(str(c) for c in rng.permutation(p.colours))
    question = f"Which colour is the ball that starts on the {('left', 'right')[side]} ramp: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.colours[side])


def observe(frames: np.ndarray, question: str) -> str | None:
    """The ball that ends on its own side of the black line, if both are at rest on that side."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    choices = choices_in(values["choices"])
    paths = [track(frames, colour, min_area=60) for colour in choices]
    starts, ends = [path[0] for path in paths], [path[-1] for path in paths]
    line = largest(frames[0], LINE_COLOUR)
    if (
        line is None
        or any(b is None or is_panel(b) for b in (*starts, *ends))
        or not all(at_rest(path) for path in paths)
    ):
        return None
    from_line = [[b.x - line.x for b in balls if b is not None] for balls in (starts, ends)]
    kept = [c for c, start, end in zip(choices, *from_line, strict=True) if start * end > 0]
    return kept[0] if len(kept) == 1 else None


FAMILY = Family(
    name="head_on",
    taxonomy="occlusion",
    category="collisions",
    sub_scenario="head_on",
    answer_type="colour",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    observe=observe,
    min_margin_m=0.05,
    twins=twins,
)
