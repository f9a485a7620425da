"""A ball rolls down a ramp into a row of balls that pass the impact on; the question is whether the last one rolls into
the coloured box.

Control: the whole row and the box are in view. Void: the panel stands before them; the striker rolls in behind it.
Hidden element: a peg that stands between two balls of the row and stops the impact there, or stands beside the row.
The ramp ends in a step, so that nothing that happens in the row comes back out.
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
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
DECK_M = 0.045
STEP_M = 0.020  # the ramp ends this high over the deck
BOX_FLOOR_M = 0.015  # the floor of the box lies this high: lower than the deck, so that the ball stays in it
WALL_M = 0.012
PEG_M = 0.008  # radius of the peg
STILL_M = 0.002  # a ball that moves less than this any more is at rest
COLOURS = ("red", "green", "blue", "yellow", "cyan", "purple")
LIVELY = [-20000.0, -8.0]


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. Lengths run along the track, from the upper end of the ramp."""

    direction: int
    striker_colour: str
    row_colour: str
    last_colour: str
    box_colour: str
    deck_colour: str
    ramp_colour: str
    row: int  # balls in the row, the last one included
    radius_m: float
    gap_m: float  # between two balls of the row
    start_m: float
    ramp_m: float
    slope_deg: float
    ahead_m: float  # from the ramp's end to the first ball
    beyond_m: float  # from the last ball to the box
    box_m: float
    peg_after: int  # the peg belongs behind this ball of the row
    blocked: bool  # whether it stands there, or beside the row: the hidden element
    azimuth_deg: float
    elevation_deg: float

    @property
    def balls_m(self) -> tuple[float, ...]:
        """Where the balls of the row rest at first."""
        first = self.ramp_m + self.ahead_m + self.radius_m
        return tuple(first + i * (2 * self.radius_m + self.gap_m) for i in range(self.row))

    @property
    def box_at_m(self) -> float:
        """Where the box begins."""
        return self.balls_m[-1] + self.radius_m + self.beyond_m


def draw(rng: np.random.Generator) -> Params:
    """Half of the rows are blocked; nothing that can be seen tells."""
    direction = int(rng.choice([-1, 1]))
    striker, row, last, box = distinct_colours(rng, 4, COLOURS)
    deck, ramp = rng.permutation(["wood", "grey", "white"])[:2]
    count = int(rng.integers(3, 5))
    return Params(
        direction=direction,
        striker_colour=striker,
        row_colour=row,
        last_colour=last,
        box_colour=box,
        deck_colour=str(deck),
        ramp_colour=str(ramp),
        row=count,
        radius_m=uniform(rng, 0.046, 0.054),
        gap_m=uniform(rng, 0.030, 0.038),
        start_m=uniform(rng, 0.06, 0.12),
        ramp_m=uniform(rng, 0.56, 0.64),
        slope_deg=uniform(rng, 9.0, 11.0),
        ahead_m=uniform(rng, 0.18, 0.22),
        beyond_m=uniform(rng, 0.10, 0.14),
        box_m=uniform(rng, 0.17, 0.21),
        peg_after=int(rng.integers(0, count - 1)),
        blocked=bool(rng.integers(2)),
        azimuth_deg=90 - direction * uniform(rng, -18, 20),
        elevation_deg=uniform(rng, -38, -24),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Ramp, step, deck with the row between low rims, sunken box. `direction` mirrors all of it."""
    spec = new_spec(physics)
    d, r = p.direction, p.radius_m
    half_width, end = 1.35 * r, p.box_at_m + p.box_m

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (d * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    _add_ramp(spec, p, half_width)
    side = (-half_width, half_width)
    deck = block("deck", (p.ramp_m, p.box_at_m), side, (0, DECK_M), p.deck_colour)
    floor = block("box_floor", (p.box_at_m, end), side, (0, BOX_FLOOR_M), p.box_colour)
    for geom, rolling in ((deck, 1.5e-3), (floor, 2e-3)):
        geom.friction, geom.condim, geom.priority = [0.4, 0.005, rolling], 6, 2
    rim = DECK_M + 0.25 * r
    for name, y in (
        ("rim_front", (-half_width - WALL_M, -half_width)),
        ("rim_back", (half_width, half_width + WALL_M)),
    ):
        block(name, (p.ramp_m, p.box_at_m), y, (0, rim), p.ramp_colour)
        block(f"box_{name}", (p.box_at_m, end), y, (0, DECK_M), p.box_colour)
    wall = block("box_end", (end, end + WALL_M), (side[0] - WALL_M, side[1] + WALL_M), (0, DECK_M + r), p.box_colour)
    wall.priority = 3  # dead: the ball stays in the box
    for i, along in enumerate(p.balls_m):
        name, colour = ("last", p.last_colour) if i == p.row - 1 else (f"ball_{i}", p.row_colour)
        _lively(add_ball(spec, name, (d * along, 0, DECK_M + r), r, colour))
    _add_peg(spec, p, half_width)

    height = DECK_M + 2 * r
    back = half_width + WALL_M + 4 * PEG_M + 0.55 * height
    ends = sorted((d * (p.ramp_m - 0.04), d * (end + WALL_M)))
    cover = Box((ends[0], side[0] - WALL_M - 0.02, 0.0), (ends[1] + 0.45 * height, back, height))
    stage = Box((min(0, d * end), side[0] - WALL_M, 0.0), (max(0, d * end), side[1] + WALL_M, height))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("last",),
        hidden=("peg",),
        cover=cover,
        stage=(stage,),
        inventory=Inventory(
            (p.striker_colour, p.row_colour, p.last_colour, p.box_colour, p.deck_colour, p.ramp_colour, "black"),
            ("ball", "row", "box", "ramp", "deck", "peg"),
            (f"{p.striker_colour} ball", f"{p.last_colour} ball", f"{p.box_colour} box", "ramp"),
        ),
    )


def _add_ramp(spec: mujoco.MjSpec, p: Params, half_width: float) -> None:
    """The ramp, and the striker at rest near its upper end."""
    slope, d = np.radians(p.slope_deg), p.direction
    normal = np.array([d * np.sin(slope), 0.0, np.cos(slope)])

    def surface(along: float) -> np.ndarray:
        return np.array([d * along, 0.0, DECK_M + STEP_M + (p.ramp_m - along) * np.tan(slope)])

    thick = 0.012
    half = (p.ramp_m / 2 / float(np.cos(slope)), half_width, thick)
    ramp = add_box(
        spec.worldbody,
        "ramp",
        surface(p.ramp_m / 2) - thick * normal,  # type: ignore[arg-type]
        half,
        p.ramp_colour,
        euler_y=d * float(slope),
    )
    ramp.friction, ramp.condim, ramp.priority = [0.8, 0.005, 2e-5], 6, 2
    top = surface(0.05)[2] / 2 - 0.012
    add_box(spec.worldbody, "prop", (d * 0.05, 0, top), (0.012, half_width, top), p.ramp_colour)
    at = surface(p.start_m) + p.radius_m * normal
    _lively(add_ball(spec, "striker", at, p.radius_m, p.striker_colour))  # type: ignore[arg-type]


def _lively(ball: mujoco.MjsGeom) -> None:
    """A hard, slippery ball: it hands nearly all of its speed on."""
    ball.solref, ball.priority = LIVELY, 1
    ball.friction = [0.02, 0.005, 2e-5]


def _add_peg(spec: mujoco.MjSpec, p: Params, half_width: float) -> None:
    import mujoco

    along, y = p.balls_m[p.peg_after] + p.radius_m + p.gap_m / 2, 0.0
    if not p.blocked:
        y = half_width + WALL_M + 2 * PEG_M
    height = DECK_M + 1.9 * p.radius_m
    peg = spec.worldbody.add_geom(name="peg", type=mujoco.mjtGeom.mjGEOM_CYLINDER, rgba=[0.08, 0.08, 0.09, 1])
    peg.size, peg.pos = [PEG_M, height / 2, 0], [p.direction * along, y, height / 2]
    peg.priority = 3  # dead: the ball stops at it


def _ahead_m(motion: Motion, p: Params) -> np.ndarray:
    """How far the middle of the last ball is beyond the edge of the box (m), shape (F,)."""
    return p.direction * motion.pos("last")[:, 0] - p.box_at_m


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'yes' while the middle of the last ball is in the box; 'no' while it is not, from when all balls are as good as
    at rest."""
    ahead = _ahead_m(motion, p)
    row = ["striker", "last", *(f"ball_{i}" for i in range(p.row - 1))]
    moves = [np.abs(motion.pos(b)[:, 0] - motion.pos(b)[-1, 0]) > 5 * STILL_M for b in row]
    restless = np.flatnonzero(np.any(moves, axis=0))
    still_from = int(restless[-1]) + 1 if restless.size else 0
    return ["yes" if x > 0 else "no" if i >= still_from else None for i, x in enumerate(ahead)]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the middle of the last ball ends beyond the edge of the box, or its front short of that edge."""
    ahead = float(_ahead_m(motion, p)[-1])
    return ahead if ahead > 0 else -ahead - p.radius_m


def twins(p: Params) -> list[Params]:
    """The same row with the peg put in, or taken out."""
    return [replace(p, blocked=not p.blocked)]


QUESTIONS = (
    "Does the last ball of the row, the {last} one, roll into the {box} box, yes or no?",
    "Is the impact passed on so that the {last} ball ends in the {box} box: yes or no?",
    "Does the {last} ball at the end of the row get into the {box} box, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The last ball and the box are named by their colours, which nothing else has."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(last=p.last_colour, box=p.box_colour),
        labels=("yes", "no"),
        aliases={
            "yes it does": "yes",
            "it rolls into the box": "yes",
            "it ends in the box": "yes",
            "no it does not": "no",
            "it does not roll into the box": "no",
            "it stays where it is": "no",
            "it stays in the row": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    if rng.integers(2):
        side = "left" if p.direction > 0 else "right"
        question = "On which side does the ball on the ramp start, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    choices = tuple(str(c) for c in rng.permutation([p.striker_colour, p.row_colour, p.last_colour, p.box_colour]))
    question = f"Which colour is the ball that comes down the ramp: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.striker_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """Whether the last ball, once at rest, is nearer to the middle of the box than to where it lay at first."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = track(frames, values["last"], min_area=60)
    box = largest(frames[0], values["box"], min_area=60)
    first, last = path[0], path[-1]
    if first is None or last is None or box is None or not at_rest(path) or is_panel(last) or is_panel(box):
        return None
    start, way = np.array([first.x, first.y]), np.array([box.x - first.x, box.y - first.y])
    return "yes" if (np.array([last.x, last.y]) - start) @ way / (way @ way) > 0.6 else "no"


FAMILY = Family(
    name="chain",
    taxonomy="occlusion",
    category="collisions",
    sub_scenario="chain",
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
