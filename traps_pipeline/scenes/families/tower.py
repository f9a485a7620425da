"""A ball rolls along a ledge towards a tower of blocks; the question is whether its top block is knocked down.

Control: ledge, tower and tray are in view. Void: the panel stands before all of them but the ball's run-up.
Hidden element: a stop that stands in the ball's way or beside it, or a strip of the ledge that is rough or smooth:
the ball strikes the tower near its top, or never reaches it.
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
from traps_pipeline.scenes.vision import at_rest, colour_mask, largest, track
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")
STRIP_M = 0.16  # length of the strip that is rough or smooth
FELT = 2e-3  # rolling friction (m) behind the panel: no ball comes back from there
HALF_DEPTH_M = 0.11
STILL_M = 0.003


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. The top block has a colour of its own; the others take turns."""

    direction: int
    kind: str  # of the hidden element: 'stop' or 'strip'
    barred: bool  # whether it keeps the ball from the tower: the hidden element
    blocks: int
    block_height_m: float
    block_width_m: float
    top_colour: str
    block_colours: tuple[str, ...]
    ball_colour: str
    radius_m: float
    strike: float  # height at which the ball strikes, in blocks
    speed_m_s: float
    run_m: float  # visible ledge before the panel
    tray_m: float
    ledge_colour: str
    tray_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def ledge_m(self) -> float:
        """Height of the ledge that the ball rolls on."""
        return self.strike * self.block_height_m - self.radius_m

    @property
    def tower_m(self) -> float:
        """Height of the tower."""
        return self.blocks * self.block_height_m


def draw(rng: np.random.Generator) -> Params:
    """Half of the towers are out of the ball's reach; nothing that can be seen tells."""
    direction = int(rng.choice([-1, 1]))
    blocks = int(rng.integers(3, 5))
    top, ball, *others = distinct_colours(rng, 4, COLOURS)
    ledge, tray = rng.permutation(["wood", "grey", "white"])[:2]
    return Params(
        direction=direction,
        kind=str(rng.choice(["stop", "strip"])),
        barred=bool(rng.integers(2)),
        blocks=blocks,
        block_height_m=uniform(rng, 0.088, 0.102) * (1.0 if blocks == 3 else 0.8),
        block_width_m=uniform(rng, 0.075, 0.09),
        top_colour=top,
        block_colours=tuple(others),
        ball_colour=ball,
        radius_m=uniform(rng, 0.046, 0.054),
        strike=blocks - uniform(rng, 0.45, 0.60),
        speed_m_s=uniform(rng, 0.85, 1.05),
        run_m=uniform(rng, 0.36, 0.46),
        tray_m=uniform(rng, 0.32, 0.38),
        ledge_colour=str(ledge),
        tray_colour=str(tray),
        azimuth_deg=90 - direction * uniform(rng, -14, 20),
        elevation_deg=uniform(rng, -32, -21),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Lengths run along the ball's path from the middle of the tower, mirrored by `direction`."""
    spec = new_spec(physics)
    r, ledge, half_w = p.radius_m, p.ledge_m, p.block_width_m / 2
    ledge_end = -half_w - 0.02
    strip = (ledge_end - 2 * r - 0.03 - STRIP_M, ledge_end - 2 * r - 0.03)
    screened = strip[0] - 2 * r - 0.05
    start = screened - p.run_m + r
    end = half_w + p.tray_m
    depth = HALF_DEPTH_M

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    strip_rolls = 0.03 if p.barred and p.kind == "strip" else FELT
    strip_colour = "black" if p.kind == "strip" else p.ledge_colour
    for name, along, rolling, colour in (
        ("ledge_in", (start - 0.06, screened + 2 * r), 1e-4, p.ledge_colour),
        ("felt", (screened + 2 * r, strip[0]), FELT, p.ledge_colour),
        ("strip", strip, strip_rolls, strip_colour),
        ("ledge_out", (strip[1], ledge_end), FELT, p.ledge_colour),
    ):
        deck = block(name, along, (-depth, depth), (0, ledge), colour)
        deck.friction, deck.condim, deck.priority = [0.8, 0.005, rolling], 6, 1
    if p.kind == "stop":
        y = 0.0 if p.barred else depth - 0.018
        block("stop", (strip[1] - 0.05, strip[1]), (y - 0.018, y + 0.018), (ledge, ledge + 1.6 * r), "black")
    block("wall_back", (half_w + 0.02, end), (0.15, 0.165), (0, 0.10), p.tray_colour)
    block("wall_front", (half_w + 0.02, end), (-0.165, -0.15), (0, 0.03), p.tray_colour)
    block("wall_end", (end, end + 0.015), (-0.165, 0.165), (0, 0.16), p.tray_colour)
    for i in range(p.blocks):
        colour = p.top_colour if i == p.blocks - 1 else p.block_colours[i % len(p.block_colours)]
        _add_block(spec, p, i, colour)
    ball = add_ball(spec, "ball", (p.direction * start, 0, ledge + r), r, p.ball_colour, density=2500)
    ball.friction = [0.3, 0.005, 1e-4]

    top = p.tower_m + 0.02
    ends = sorted((p.direction * screened, p.direction * (end + 0.02)))
    shadow = 0.35 * p.tower_m
    right = max(ends[1], shadow + half_w) + (0.07 if p.direction > 0 else 0.0)
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=(_name(p.blocks - 1),),
        hidden=(p.kind,),
        cover=Box((ends[0], -0.17, 0.0), (right, half_w + 0.55 * p.tower_m, top)),
        stage=(Box((ends[0], -0.165, 0.0), (ends[1], 0.165, p.tower_m)),),
        velocity={"ball": (p.direction * p.speed_m_s, 0, 0, 0, p.direction * p.speed_m_s / r, 0)},
        inventory=Inventory(
            (p.top_colour, *p.block_colours, p.ball_colour, p.ledge_colour, p.tray_colour, "black"),
            ("ball", "block", "tower", "ledge", "tray", "wall", "top"),
            (f"{p.ball_colour} ball", f"{p.top_colour} block", f"{p.block_colours[0]} block", "ledge", "tower"),
        ),
    )


def _name(i: int) -> str:
    return f"block_{i}"


def _add_block(spec: mujoco.MjSpec, p: Params, i: int, colour: str) -> None:
    """A free block, the i-th from the ground."""
    h, half_w = p.block_height_m, p.block_width_m / 2
    body = spec.worldbody.add_body(name=_name(i), pos=[0, 0, (i + 0.5) * h])
    body.add_freejoint()
    geom = add_box(body, _name(i), (0, 0, 0), (half_w, half_w, h / 2), colour)
    geom.density, geom.friction, geom.solref = 300, [0.35, 0.005, 0.0001], [0.006, 1]


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'yes' while the top block is on the ground; 'no' while it is at its height on the tower, from when neither the
    ball nor the block moves any more."""
    top = motion.pos(_name(p.blocks - 1))
    down = top[:, 2] < 1.3 * p.block_height_m
    up = top[:, 2] > p.tower_m - 0.6 * p.block_height_m
    moves = [np.linalg.norm(at - at[-1], axis=1) > STILL_M for at in (top, motion.pos("ball"))]
    restless = np.flatnonzero(np.any(moves, axis=0))
    still_from = int(restless[-1]) + 1 if restless.size else 0
    return [
        "yes" if d else "no" if u and i >= still_from else None for i, (d, u) in enumerate(zip(down, up, strict=True))
    ]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the top block ends above or below the middle of its fall."""
    middle = (p.tower_m - p.block_height_m / 2 + p.block_width_m / 2) / 2
    return float(abs(motion.pos(_name(p.blocks - 1))[-1, 2] - middle))


def twins(p: Params) -> list[Params]:
    """The same tower with the ball's way barred, or free."""
    return [replace(p, barred=not p.barred)]


QUESTIONS = (
    "Is the {top} block at the top of the tower knocked to the ground, yes or no?",
    "Does the {top} block fall off the top of the tower: yes or no?",
    "Does the tower lose its {top} top block in the end, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The top block is named by its colour, which nothing else has."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(top=p.top_colour),
        labels=("yes", "no"),
        aliases={
            "yes it falls": "yes",
            "it falls": "yes",
            "it falls off": "yes",
            "it is knocked off": "yes",
            "no it does not fall": "no",
            "it stays on top": "no",
            "it does not fall": "no",
            "the tower stays standing": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    if rng.integers(2):
        side = "left" if p.direction > 0 else "right"
        question = "From which side does the ball come in on the ledge, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    choices = tuple(str(c) for c in rng.permutation([p.ball_colour, p.top_colour, p.block_colours[0]]))
    question = f"What colour is the ball that comes in on the ledge: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.ball_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """The named block, seen at the start and at the end: has it come down by more than its own size?"""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = track(frames, values["top"], 60)
    first, last = path[0], path[-1]
    if first is None or last is None or not at_rest(path):
        return None
    if first.area > 0.08 * colour_mask(frames[0], values["top"]).size or largest(frames[-1], values["top"], 60) is None:
        return None
    return "yes" if last.y - first.y > 0.7 * first.box[3] else "no"


FAMILY = Family(
    name="tower",
    taxonomy="occlusion",
    category="stacks",
    sub_scenario="tower",
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
