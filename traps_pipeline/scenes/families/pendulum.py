"""A ball strikes the bob of a hanging pendulum; the question is whether the pendulum knocks over a block.

Control: pendulum and block are in view. Void: the panel stands before them and only the ball's run-up is seen.
Hidden element: a peg in the board behind the pendulum. It sticks out just before the rod, and stops the swing before
the bob reaches the block, or farther along, where the rod does not get. The ball stays behind the panel: it drops down
a step there, and a lip stops it once it has struck.
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
    rgba,
    uniform,
)
from traps_pipeline.scenes.vision import largest
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
FLOOR_M = 0.02  # what the block stands on
STEP_M = 0.02  # the visible lane lies higher by this
STEP_AT_M = 0.06
GAP_M = 0.006  # under the hanging bob
PEG_DOWN = 0.62  # height of the peg below the pivot, as a share of the pendulum's length
PEG_RADIUS_M = 0.012
ROD_RADIUS_M = 0.008
COLOURS = ("red", "green", "blue", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. Lengths along the way are measured from the edge of the panel."""

    direction: int
    peg_stops: bool  # the hidden element: the peg sticks out just before the rod
    radius_m: float  # of the ball and of the bob
    speed_m_s: float
    run_m: float  # visible lane
    lane_m: float  # height of the lane behind the panel over the floor
    pivot_at_m: float
    length_m: float
    stop_deg: float  # swing that a stopping peg allows
    free_peg_m: float  # where the peg is otherwise, from the pivot on
    reach_m: float  # how far the bob swings to touch the block
    block_height_m: float
    block_half_m: float
    ball_colour: str
    bob_colour: str
    block_colour: str
    lane_colour: str
    board_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def pivot_z_m(self) -> float:
        """Height of the pivot."""
        return FLOOR_M + self.lane_m + GAP_M + self.radius_m + self.length_m

    @property
    def block_at_m(self) -> float:
        """Centre of the standing block."""
        return self.pivot_at_m + self.radius_m + self.reach_m + self.block_half_m

    @property
    def end_m(self) -> float:
        """Inner face of the floor's end: the fallen block has room before it."""
        return self.block_at_m + self.block_height_m + 0.14


def draw(rng: np.random.Generator) -> Params:
    """Half of the pegs stop the pendulum, whatever else is drawn."""
    direction = int(rng.choice([-1, 1]))
    ball, bob, block = distinct_colours(rng, 3, COLOURS)
    lane, board = rng.permutation(["wood", "grey"])
    return Params(
        direction=direction,
        peg_stops=bool(rng.integers(2)),
        radius_m=uniform(rng, 0.046, 0.054),
        speed_m_s=uniform(rng, 0.75, 0.95),
        run_m=uniform(rng, 0.55, 0.68),
        lane_m=uniform(rng, 0.09, 0.12),
        pivot_at_m=uniform(rng, 0.32, 0.37),
        length_m=uniform(rng, 0.30, 0.36),
        stop_deg=uniform(rng, 3.5, 5.0),
        free_peg_m=uniform(rng, 0.20, 0.25),
        reach_m=uniform(rng, 0.055, 0.065),
        block_height_m=uniform(rng, 0.20, 0.24),
        block_half_m=uniform(rng, 0.016, 0.021),
        ball_colour=ball,
        bob_colour=bob,
        block_colour=block,
        lane_colour=str(lane),
        board_colour=str(board),
        azimuth_deg=90 - direction * uniform(rng, -14, 18),
        elevation_deg=uniform(rng, -32, -20),
    )


def build(p: Params, physics: Physics) -> Scene:
    """A raised lane, then floor and block before a board that carries pendulum and peg; `direction` mirrors it."""
    spec = new_spec(physics)
    r, side, rim = p.radius_m, 1.6 * p.radius_m, 0.012
    top = FLOOR_M + p.lane_m
    high = p.pivot_z_m + 0.05

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    lip = p.pivot_at_m - 2 * r + 0.80 * r  # the ball touches it a little after it has touched the bob
    block("lane_in", (-p.run_m, STEP_AT_M), (-side, side), (0, top + STEP_M), p.lane_colour)
    lane = block("lane", (STEP_AT_M, lip + 0.008), (-side, side), (0, top), p.lane_colour)
    lane.priority, lane.condim, lane.friction = 1, 6, [0.8, 0.005, 3e-4]
    block("lip", (lip, lip + 0.008), (-side, side), (top, top + 0.25 * r), p.board_colour)
    block("front_in", (-p.run_m, STEP_AT_M), (-side - rim, -side), (0, top + STEP_M + 0.3 * r), p.board_colour)
    block("back_in", (-p.run_m, 0), (side, side + rim), (0, top + STEP_M + 0.3 * r), p.board_colour)
    block("front", (STEP_AT_M, lip + 0.008), (-side - rim, -side), (0, top + 0.3 * r), p.board_colour)
    block("floor_board", (lip + 0.008, p.end_m), (-side - rim, side), (0, FLOOR_M), p.lane_colour)
    block("end", (p.end_m, p.end_m + 0.02), (-side - rim, side), (0, FLOOR_M + 0.06), p.board_colour)
    block("board", (0, p.end_m + 0.02), (side, side + 0.015), (0, high), p.board_colour)
    _add_pendulum(spec, p, side)
    _add_peg(spec, p, side)
    body = spec.worldbody.add_body(name="block", pos=[p.direction * p.block_at_m, 0, FLOOR_M + p.block_height_m / 2])
    body.add_freejoint()
    add_box(body, "block", (0, 0, 0), (p.block_half_m, 0.6 * side, p.block_height_m / 2), p.block_colour, density=400)
    ball = add_ball(spec, "ball", (p.direction * (-p.run_m + 1.2 * r), 0, top + STEP_M + r), r, p.ball_colour)
    ball.friction = [0.8, 0.005, 2e-5]

    ends = sorted((0.0, p.direction * (p.end_m + 0.02)))
    back = sorted((-p.direction * p.run_m, p.direction * p.end_m))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("block",),
        hidden=("peg",),
        cover=Box((ends[0], -side - rim, 0.0), (ends[1] + 0.02, side + 0.03, high + 0.02)),
        stage=(Box((back[0], -side, 0.0), (back[1], side, high)),),
        velocity={"ball": _rolling(p)},
        inventory=Inventory(
            (p.ball_colour, p.bob_colour, p.block_colour, p.lane_colour, p.board_colour, "black", "yellow"),
            ("ball", "pendulum", "bob", "block", "lane", "board", "peg", "rod"),
            (f"{p.ball_colour} ball", f"{p.block_colour} block", f"{p.bob_colour} pendulum bob", "pendulum"),
        ),
    )


def _add_pendulum(spec: mujoco.MjSpec, p: Params, side: float) -> None:
    """A bob on a rod that hangs from an axle in the board and swings along the way."""
    import mujoco

    body = spec.worldbody.add_body(name="pendulum", pos=[p.direction * p.pivot_at_m, 0, p.pivot_z_m])
    body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0], damping=[0.02, 0, 0])
    rod = body.add_geom(name="rod", type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, 0, 0, -p.length_m])
    rod.size, rod.rgba, rod.density = [ROD_RADIUS_M, 0, 0], rgba("black"), 300
    bob = body.add_geom(name="bob", type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=[0, 0, -p.length_m])
    bob.size, bob.rgba = [p.radius_m, 0, 0], rgba(p.bob_colour)
    bob.priority, bob.solref, bob.friction = 2, [-60000, -25], [0.1, 0.005, 0.0001]  # takes over the ball's speed
    axle = spec.worldbody.add_geom(name="axle", type=mujoco.mjtGeom.mjGEOM_CAPSULE)
    axle.fromto = [p.direction * p.pivot_at_m, -0.015, p.pivot_z_m, p.direction * p.pivot_at_m, side, p.pivot_z_m]
    axle.size, axle.rgba, axle.contype, axle.conaffinity = [0.014, 0, 0], rgba("black"), 0, 0


def _add_peg(spec: mujoco.MjSpec, p: Params, side: float) -> None:
    """The peg, which sticks out of the board across the way."""
    import mujoco

    down = PEG_DOWN * p.length_m
    stopping = down * float(np.tan(np.radians(p.stop_deg))) + ROD_RADIUS_M + PEG_RADIUS_M
    x = p.direction * (p.pivot_at_m + (stopping if p.peg_stops else p.free_peg_m))
    peg = spec.worldbody.add_geom(name="peg", type=mujoco.mjtGeom.mjGEOM_CAPSULE)
    peg.fromto = [x, -0.04, p.pivot_z_m - down, x, side, p.pivot_z_m - down]
    peg.size, peg.rgba = [PEG_RADIUS_M, 0, 0], rgba("yellow")


def _rolling(p: Params) -> tuple[float, ...]:
    """Velocity of a ball that rolls without slipping."""
    speed = p.direction * p.speed_m_s
    return (speed, 0.0, 0.0, 0.0, speed / p.radius_m, 0.0)


def _top_m(motion: Motion, p: Params) -> np.ndarray:
    """Height over the floor of the middle of the block's top (m) in every frame, shape (F,)."""
    return motion.pos("block")[:, 2] - FLOOR_M + motion.rot("block")[:, 2, 2] * p.block_height_m / 2


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'yes' from when the block's top is below half the block's height; 'no' while it is not, from when the pendulum
    has swung out farthest and comes back."""
    fallen = _top_m(motion, p) < p.block_height_m / 2
    swing = -p.direction * motion.rot("pendulum")[:, 0, 2]
    back_from = int(np.argmax(swing)) + 1
    return ["yes" if down else "no" if i >= back_from else None for i, down in enumerate(fallen)]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the block's top ends above or below half the block's height."""
    return float(abs(_top_m(motion, p)[-1] - p.block_height_m / 2))


def twins(p: Params) -> list[Params]:
    """The same run with the peg in its other place."""
    return [replace(p, peg_stops=not p.peg_stops)]


QUESTIONS = (
    "Does the {bob} pendulum bob knock over the {block} block, yes or no?",
    "Struck by the ball, does the {bob} pendulum bob topple the {block} block: yes or no?",
    "Does the pendulum with the {bob} bob bring down the {block} block, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Bob and block are named by their colours."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(bob=p.bob_colour, block=p.block_colour),
        labels=("yes", "no"),
        aliases={
            "yes it does": "yes",
            "it knocks it over": "yes",
            "the block falls": "yes",
            "the block falls over": "yes",
            "no it does not": "no",
            "the block does not fall": "no",
            "the block stays standing": "no",
            "it does not reach the block": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    if rng.integers(2):
        side = "left" if p.direction > 0 else "right"
        question = "From which side of the picture does the rolling ball set out, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    choices = tuple(str(c) for c in rng.permutation([p.ball_colour, p.bob_colour, p.block_colour]))
    question = f"What colour is the ball that rolls along the raised lane: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.ball_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """The block is tall and narrow at the end, or it lies flat; None while it is not to be seen."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    seen = [largest(frame, values["block"], 80) for frame in frames[-3:]]
    shapes = [blob.box[3] / blob.box[2] for blob in seen if blob is not None]
    if len(shapes) < 3 or largest(frames[-1], values["bob"], 80) is None:
        return None
    return "no" if float(np.median(shapes)) > 1.0 else "yes"


FAMILY = Family(
    name="pendulum",
    taxonomy="occlusion",
    category="pendulums_levers",
    sub_scenario="pendulum",
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
