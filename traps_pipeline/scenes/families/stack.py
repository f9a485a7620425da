"""A rolling ball drives a pusher that sweeps blocks off a stack; the question is how many stay on the stand.

Control: ball, pusher, stack and tray are in view. Void: the panel stands before all of them but the ball's run-up.
Hidden element: the height of the stand. The pusher's plate passes just over the ledge that the ball rolls on, so the
blocks that stand higher than the ledge are swept off and those below it stay.
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
    listed,
    new_spec,
    uniform,
)
from traps_pipeline.scenes.vision import blobs, colour_mask, largest
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    from collections.abc import Sequence

    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
BLOCKS = 5
LABELS = ("0-1", "2-3", "4-5")
BLOCK_COLOURS = ("red", "green", "blue", "yellow", "purple")
STAND_COLOUR = "black"
RADIUS_M = 0.05
ROD_M = 0.17  # from the plate back to the pad that the ball strikes
STILL_M = 0.003


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. block_colours: from the bottom of the stack upwards."""

    direction: int
    below: int  # blocks below the pusher's plate: sets the height of the stand, the hidden element
    block_colours: tuple[str, ...]
    block_height_m: float
    block_width_m: float
    speed_m_s: float
    run_m: float  # visible ledge before the panel
    tray_m: float
    ball_colour: str
    ledge_colour: str
    pusher_colour: str
    wall_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def ledge_m(self) -> float:
        """Height of the ledge that the ball rolls on."""
        return BLOCKS * self.block_height_m + 0.03

    @property
    def stand_m(self) -> float:
        """Height of the stand."""
        return self.ledge_m + 0.004 - self.below * self.block_height_m

    @property
    def stand_half_m(self) -> float:
        """Half the width of the stand."""
        return self.block_width_m / 2 + 0.012

    @property
    def travel_m(self) -> float:
        """How far the pusher can slide."""
        return self.block_width_m + 0.05


def draw(rng: np.random.Generator) -> Params:
    """Any number of blocks may stand below the plate, from none to all."""
    direction = int(rng.choice([-1, 1]))
    ledge, wall = rng.permutation(["wood", "grey", "white"])[:2]
    return Params(
        direction=direction,
        below=int(rng.integers(BLOCKS + 1)),
        block_colours=tuple(str(c) for c in rng.permutation(list(BLOCK_COLOURS))),
        block_height_m=uniform(rng, 0.054, 0.062),
        block_width_m=uniform(rng, 0.086, 0.104),
        speed_m_s=uniform(rng, 0.95, 1.15),
        run_m=uniform(rng, 0.36, 0.46),
        tray_m=uniform(rng, 0.34, 0.40),
        ball_colour=str(rng.choice(["orange", "cyan"])),
        ledge_colour=str(ledge),
        pusher_colour=str(rng.choice([c for c in ("wood", "grey", "white") if c not in (ledge, wall)])),
        wall_colour=str(wall),
        azimuth_deg=90 - direction * uniform(rng, -14, 20),
        elevation_deg=uniform(rng, -31, -21),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Lengths run along the ball's path from the middle of the stack, mirrored by `direction`."""
    spec = new_spec(physics)
    h, ledge, stand = p.block_height_m, p.ledge_m, p.stand_half_m
    plate = -p.block_width_m / 2 - 0.025
    pad = plate - ROD_M
    screened = pad - 2 * RADIUS_M - 0.07
    start = screened - p.run_m + RADIUS_M
    end = stand + p.tray_m

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    felt_at = pad - 2 * RADIUS_M - 0.02  # the ball stays behind the panel: it comes to rest here
    for name, along, rolling in (("ledge", (start - 0.06, felt_at), 1e-4), ("felt", (felt_at, -stand - 0.004), 4e-3)):
        deck = block(name, along, (-0.075, 0.075), (ledge - 0.025, ledge), p.ledge_colour)
        deck.friction, deck.condim, deck.priority = [0.8, 0.005, rolling], 6, 1
    for i, x in enumerate((start - 0.03, screened - 0.03, -stand - 0.03)):
        block(f"leg_{i}", (x - 0.012, x + 0.012), (-0.06, 0.06), (0, ledge - 0.025), p.ledge_colour)
    block("stand", (-stand, stand), (-stand, stand), (0, p.stand_m), STAND_COLOUR)
    top = ledge + BLOCKS * h + 0.03
    block("wall_back", (screened + 0.01, end), (0.15, 0.165), (0, ledge + 0.6 * BLOCKS * h), p.wall_colour)
    block("wall_front", (stand + 0.02, end), (-0.165, -0.15), (0, 0.035), p.wall_colour)
    block("wall_end", (end, end + 0.015), (-0.165, 0.165), (0, ledge), p.wall_colour)
    _add_pusher(spec, p, plate)
    for i, colour in enumerate(p.block_colours):
        body = spec.worldbody.add_body(name=f"block_{i}", pos=[0, 0, p.stand_m + (i + 0.5) * h])
        body.add_freejoint()
        half_w = p.block_width_m / 2
        geom = add_box(body, f"block_{i}", (0, 0, 0), (half_w, half_w, h / 2), colour)
        geom.density, geom.friction, geom.solref = 300, [0.3, 0.005, 0.0001], [0.006, 1]
    add_ball(spec, "ball", (p.direction * start, 0, ledge + RADIUS_M), RADIUS_M, p.ball_colour, density=7500)

    ends = sorted((p.direction * screened, p.direction * (end + 0.02)))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=tuple(f"block_{i}" for i in range(BLOCKS)),
        hidden=("stand",),
        cover=Box((ends[0], -0.17, 0.0), (ends[1] + (0.06 if p.direction > 0 else 0), 0.18, top)),
        stage=(Box((ends[0], -0.165, 0.0), (ends[1], 0.165, ledge + 0.6 * BLOCKS * h)),),
        velocity={"ball": (p.direction * p.speed_m_s, 0, 0, 0, p.direction * p.speed_m_s / RADIUS_M, 0)},
        inventory=Inventory(
            (*p.block_colours, p.ball_colour, STAND_COLOUR, p.ledge_colour, p.wall_colour, p.pusher_colour),
            ("ball", "block", "stack", "stand", "ledge", "pusher", "wall"),
            (f"{p.ball_colour} ball", "black stand", "ledge", *(f"{c} block" for c in p.block_colours)),
        ),
    )


def _add_pusher(spec: mujoco.MjSpec, p: Params, plate: float) -> None:
    """A tall plate on a slide, with a rod back to the pad that the ball strikes."""
    import mujoco

    tall = BLOCKS * p.block_height_m + 0.005
    body = spec.worldbody.add_body(name="pusher", pos=[p.direction * plate, 0, p.ledge_m])
    joint = body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[p.direction, 0, 0])
    joint.range, joint.limited = [0, p.travel_m], mujoco.mjtLimited.mjLIMITED_TRUE
    joint.damping, joint.frictionloss, joint.solref_limit = [1.0, 0, 0], 0.3, [0.02, 1.5]
    z = RADIUS_M
    parts = (
        ("plate", (0.0, 0.0, 0.012 + tall / 2), (0.008, 0.06, tall / 2)),
        ("rod", (-p.direction * ROD_M / 2, 0.0, z), (ROD_M / 2 - 0.012, 0.008, 0.008)),
        ("pad", (-p.direction * ROD_M, 0.0, z), (0.008, 0.05, 0.035)),
    )
    for name, centre, half in parts:
        geom = add_box(body, name, centre, half, p.pusher_colour)
        geom.density, geom.friction = 300, [0.1, 0.005, 0.0001]


def _standing(motion: Motion, p: Params) -> np.ndarray:
    """Whether each block is over the stand, shape (F, blocks)."""
    at = np.stack([motion.pos(f"block_{i}") for i in range(BLOCKS)], axis=1)
    return (np.abs(at[..., 0]) < p.stand_half_m) & (at[..., 2] > p.stand_m)


def readings(motion: Motion, p: Params) -> list[str | None]:
    """The range of the number of standing blocks, from when the pusher has gone all its way and no block moves."""
    at = np.stack([motion.pos(f"block_{i}") for i in range(BLOCKS)], axis=1)
    restless = np.flatnonzero((np.linalg.norm(at - at[-1], axis=2) > STILL_M).any(axis=1))
    still_from = int(restless[-1]) + 1 if restless.size else 0
    pusher = p.direction * motion.pos("pusher")[:, 0]
    pushed = pusher - pusher[0] > 0.95 * p.travel_m
    counts = _standing(motion, p).sum(axis=1)
    return [LABELS[n // 2] if i >= still_from and pushed[i] else None for i, n in enumerate(counts)]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the block nearest to the edge of the stand is from it."""
    x = np.array([abs(motion.pos(f"block_{i}")[-1, 0]) for i in range(BLOCKS)])
    return float(np.abs(x - p.stand_half_m).min())


def legible(motion: Motion, p: Params) -> list[tuple[tuple[str, ...], float]]:
    """Every standing block; of the fallen ones, which may lie behind each other, enough to be seen there."""
    standing = _standing(motion, p)[-1]
    groups = [((f"block_{i}",), 150.0) for i in np.flatnonzero(standing)]
    fallen = tuple(f"block_{i}" for i in np.flatnonzero(~standing))
    return [*groups, (fallen, 200.0 * len(fallen))] if fallen else groups


def twins(p: Params) -> list[Params]:
    """The same stack on a stand of another height."""
    return [replace(p, below=n) for n in range(BLOCKS + 1) if n // 2 != p.below // 2]


QUESTIONS = (
    "How many of the five blocks are still stacked on the {stand} stand at the end: {choices}?",
    "The stack has five blocks. How many of them stay on the {stand} stand, {choices}?",
    "When everything has come to rest, how many blocks are left on the {stand} stand: {choices}?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The stand is named by its colour, which nothing else has."""
    aliases = {form.format(*label.split("-")): label for label in LABELS for form in ("{} to {}", "{} or {}")}
    numbers = {name: LABELS[i // 2] for i, name in enumerate(("zero", "one", "two", "three", "four", "five"))}
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(stand=STAND_COLOUR, choices=listed(LABELS)),
        labels=LABELS,
        aliases={**aliases, **{str(i): LABELS[i // 2] for i in range(BLOCKS + 1)}, **numbers},
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    if rng.integers(2):
        side = "left" if p.direction > 0 else "right"
        question = "From which side does the ball roll along the ledge, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    choices = tuple(str(c) for c in rng.permutation(["orange", "cyan", "purple"]))
    question = f"What colour is the ball that rolls along the ledge: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.ball_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """Counts the block colours that lie above the black stand and within its width."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    counts = [_count(frame, values["stand"]) for frame in frames[-3:]]
    if None in counts or len(set(counts)) > 1:
        return None
    return LABELS[int(counts[0] or 0) // 2]


def _count(frame: np.ndarray, stand_colour: str) -> int | None:
    stand = largest(frame, stand_colour, 150)
    if stand is None:
        return None
    x, y, width, _ = stand.box
    seen = 0
    for colour in BLOCK_COLOURS:
        found: Sequence = blobs(colour_mask(frame, colour), 60)
        seen += any(x - 4 < b.x < x + width + 4 and b.y < y + 0.4 * width for b in found)
    return seen


FAMILY = Family(
    name="stack",
    taxonomy="occlusion",
    category="stacks",
    sub_scenario="stack",
    answer_type="count_range",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    observe=observe,
    legible=legible,
    physics=Physics(timestep_s=0.001),
    min_margin_m=0.012,
    twins=twins,
)
