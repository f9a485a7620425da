"""A ball rolls down a ramp and strikes a block, which slides on with its momentum; the question is whether the block
reaches the coloured zone at the end of the deck.

Control: deck and zone are in view. Void: the panel stands before them; the ball is seen to roll in behind it.
Hidden element: the board between block and zone, which is slick or rough. The ramp ends in a step, so that nothing
that happens on the deck comes back out.
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
DECK_M = 0.03
STEP_M = 0.022  # the ramp ends this high over the deck
WALL_M = 0.014
STILL_M = 0.002  # a block that moves less than this any more is at rest
COLOURS = ("red", "green", "blue", "yellow", "cyan", "purple")
LIVELY = [-20000.0, -25.0]


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. Lengths run along the track, from the upper end of the ramp."""

    direction: int
    ball_colour: str
    block_colour: str
    zone_colour: str
    deck_colour: str
    ramp_colour: str
    shape: str  # of the block: box or cylinder
    radius_m: float
    start_m: float
    ramp_m: float
    slope_deg: float
    block_m: float  # size of the block
    ahead_m: float  # from the ramp's end to the block
    gap_m: float  # from the block to the zone
    zone_m: float
    rough: bool  # the board between block and zone: the hidden element
    slick_friction: float
    rough_friction: float
    azimuth_deg: float
    elevation_deg: float

    @property
    def block_at_m(self) -> float:
        """Where the middle of the block stands at first."""
        return self.ramp_m + self.ahead_m + self.block_m / 2

    @property
    def zone_at_m(self) -> float:
        """Where the zone begins."""
        return self.block_at_m + self.block_m / 2 + self.gap_m


def draw(rng: np.random.Generator) -> Params:
    """Half of the boards are rough; nothing that can be seen tells."""
    direction = int(rng.choice([-1, 1]))
    ball, block, zone = distinct_colours(rng, 3, COLOURS)
    deck, ramp = rng.permutation(["wood", "grey", "white"])[:2]
    radius = uniform(rng, 0.046, 0.056)
    return Params(
        direction=direction,
        ball_colour=ball,
        block_colour=block,
        zone_colour=zone,
        deck_colour=str(deck),
        ramp_colour=str(ramp),
        shape=str(rng.choice(["box", "cylinder"])),
        radius_m=radius,
        start_m=uniform(rng, 0.06, 0.14),
        ramp_m=uniform(rng, 0.58, 0.68),
        slope_deg=uniform(rng, 7.0, 9.0),
        block_m=uniform(rng, 0.085, 0.105),
        ahead_m=uniform(rng, 0.18, 0.24),
        gap_m=uniform(rng, 0.20, 0.26),
        zone_m=uniform(rng, 0.20, 0.25),
        rough=bool(rng.integers(2)),
        slick_friction=uniform(rng, 0.018, 0.032),
        rough_friction=uniform(rng, 0.55, 0.75),
        azimuth_deg=90 - direction * uniform(rng, -18, 20),
        elevation_deg=uniform(rng, -38, -24),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Ramp, step, deck with low rims, zone before an end wall. `direction` mirrors all of it."""
    spec = new_spec(physics)
    d, r, size = p.direction, p.radius_m, p.block_m
    half_width, end = 0.085, p.zone_at_m + p.zone_m

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (d * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    _add_ramp(spec, p, half_width)
    side, board_at = (-half_width, half_width), p.block_at_m - size / 2 - 0.03
    block("deck", (p.ramp_m, board_at), side, (0, DECK_M), p.deck_colour)
    board = block("board", (board_at, p.zone_at_m), side, (0, DECK_M), p.deck_colour)
    slide = p.rough_friction if p.rough else p.slick_friction
    board.friction, board.condim, board.priority = [slide, 0.005, 4e-4], 6, 2
    zone = block("zone", (p.zone_at_m, end), side, (0, DECK_M), p.zone_colour)
    zone.friction, zone.condim, zone.priority = [0.25, 0.005, 4e-4], 6, 2
    rim = DECK_M + 0.016
    for name, y in (
        ("rim_front", (-half_width - WALL_M, -half_width)),
        ("rim_back", (half_width, half_width + WALL_M)),
    ):
        block(name, (p.ramp_m, end), y, (0, rim), p.ramp_colour)
    wall = block(
        "end_wall", (end, end + WALL_M), (side[0] - WALL_M, side[1] + WALL_M), (0, DECK_M + 0.05), p.ramp_colour
    )
    wall.priority = 3  # dead: the block stays where it strikes the wall
    _add_target(spec, p)

    height = DECK_M + max(size, 2 * r)
    shadow = 0.45 * height
    ends = sorted((d * (p.ramp_m - 0.04), d * (end + WALL_M)))
    cover = Box((ends[0], side[0] - WALL_M - 0.02, 0.0), (ends[1] + shadow, side[1] + WALL_M + 0.55 * height, height))
    stage = Box((min(0, d * end), side[0] - WALL_M, 0.0), (max(0, d * end), side[1] + WALL_M, height))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("block",),
        hidden=("board",),
        cover=cover,
        stage=(stage,),
        inventory=Inventory(
            (p.ball_colour, p.block_colour, p.zone_colour, p.deck_colour, p.ramp_colour),
            ("ball", "block", "zone", "ramp", "deck", "wall"),
            (f"{p.ball_colour} ball", f"{p.block_colour} block", f"{p.zone_colour} zone", "ramp"),
        ),
    )


def _add_ramp(spec: mujoco.MjSpec, p: Params, half_width: float) -> None:
    """The ramp, and the ball at rest near its upper end."""
    slope, d = np.radians(p.slope_deg), p.direction
    normal = np.array([d * np.sin(slope), 0.0, np.cos(slope)])
    low_z = DECK_M + STEP_M

    def surface(along: float) -> np.ndarray:
        return np.array([d * along, 0.0, low_z + (p.ramp_m - along) * np.tan(slope)])

    thick = 0.012
    add_box(
        spec.worldbody,
        "ramp",
        surface(p.ramp_m / 2) - thick * normal,  # type: ignore[arg-type]
        (p.ramp_m / 2 / float(np.cos(slope)), half_width, thick),
        p.ramp_colour,
        euler_y=d * float(slope),
    )
    top = surface(0.05)[2]
    add_box(spec.worldbody, "prop", (d * 0.05, 0, top / 2 - 0.012), (0.012, half_width, top / 2 - 0.012), p.ramp_colour)
    add_ball(spec, "ball", surface(p.start_m) + p.radius_m * normal, p.radius_m, p.ball_colour, density=800)  # type: ignore[arg-type]


def _add_target(spec: mujoco.MjSpec, p: Params) -> None:
    """The free block, a cube or an upright cylinder."""
    import mujoco

    half = p.block_m / 2
    body = spec.worldbody.add_body(name="block", pos=[p.direction * p.block_at_m, 0, DECK_M + half])
    body.add_freejoint()
    geom = add_box(body, "block", (0, 0, 0), (half, half, half), p.block_colour)
    if p.shape == "cylinder":
        geom.type = mujoco.mjtGeom.mjGEOM_CYLINDER
        geom.size = [half, half, 0]
    geom.density = 700
    geom.friction = [0.1, 0.005, 0.0001]
    geom.solref, geom.priority = LIVELY, 1


def _ahead_m(motion: Motion, p: Params) -> np.ndarray:
    """How far the middle of the block is inside the zone (m), shape (F,)."""
    return p.direction * motion.pos("block")[:, 0] - p.zone_at_m


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'yes' while the middle of the block is in the zone; 'no' while it is not, from when the block moves no more."""
    ahead = _ahead_m(motion, p)
    restless = np.flatnonzero(np.abs(ahead - ahead[-1]) > STILL_M)
    still_from = int(restless[-1]) + 1 if restless.size else 0
    return ["yes" if x > 0 else "no" if i >= still_from else None for i, x in enumerate(ahead)]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the block ends inside the zone, or short of it: by its middle, or by its front."""
    ahead = float(_ahead_m(motion, p)[-1])
    return ahead if ahead > 0 else -ahead - p.block_m / 2


def twins(p: Params) -> list[Params]:
    """The same throw over a slick board instead of a rough one, or the other way round."""
    return [replace(p, rough=not p.rough)]


QUESTIONS = (
    "Does the {block} block that the ball strikes reach the {zone} zone, yes or no?",
    "After the ball has struck it, does the {block} block slide into the {zone} zone: yes or no?",
    "Does the {block} block end up in the {zone} zone, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Block and zone are named by their colours, which nothing else has."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(block=p.block_colour, zone=p.zone_colour),
        labels=("yes", "no"),
        aliases={
            "yes it does": "yes",
            "it reaches the zone": "yes",
            "it slides into the zone": "yes",
            "no it does not": "no",
            "it does not reach the zone": "no",
            "it stops before the zone": "no",
            "it stops short": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    if rng.integers(2):
        side = "left" if p.direction > 0 else "right"
        return AnswerableQuestion("From which side does the ball roll in, left or right?", ("left", "right"), side)
    choices = tuple(str(c) for c in rng.permutation([p.ball_colour, p.block_colour, p.zone_colour]))
    question = f"What colour is the ball that rolls down the ramp: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.ball_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """Whether the block, once at rest, stands nearer to the middle of the zone than to where it stood at first."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = track(frames, values["block"], min_area=60)
    zone = largest(frames[0], values["zone"], min_area=60)
    first, last = path[0], path[-1]
    if first is None or last is None or zone is None or not at_rest(path) or is_panel(last) or is_panel(zone):
        return None
    start, end = (np.array([b.x, b.box[1] + 0.8 * b.box[3]]) for b in (first, last))
    way = np.array([zone.x, zone.y]) - start
    return "yes" if (end - start) @ way / (way @ way) > 0.6 else "no"


FAMILY = Family(
    name="transfer",
    taxonomy="occlusion",
    category="collisions",
    sub_scenario="transfer",
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
