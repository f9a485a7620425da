"""A ball rolls towards a gate that hangs from a lever; the question is whether it gets past.

Control: lever, gate and the lane beyond are in view. Void: the panel stands before them.
Hidden element: the counterweight on the lever, which sits far out (the lever holds the gate up) or close to the pivot
(the gate hangs down and the lever's stop locks it). The ball drops down a step behind the panel: it cannot come back.
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
from traps_pipeline.scenes.vision import at_rest, largest, track
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
FLOOR_M = 0.03  # the lane behind the panel
STEP_M = 0.02  # the visible lane lies higher by this
STEP_AT_M = 0.07
GAP_M = 0.012  # under the shut gate
GATE_HALF_M = 0.013
COLOURS = ("red", "green", "blue", "yellow", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. Lengths along the lane are measured from the edge of the panel."""

    direction: int
    held_open: bool  # the hidden element: the counterweight sits far out
    radius_m: float
    speed_m_s: float
    run_m: float  # visible lane
    gate_at_m: float
    arm_m: float  # from the gate to the pivot, and from there to the other end of the lever
    drop_m: float  # length of the gate below the lever
    swing_deg: float  # by which the open lever is tilted
    counterweight_half_m: float
    tail_m: float  # lane beyond the lever
    ball_colour: str
    gate_colour: str
    lever_colour: str
    counterweight_colour: str
    lane_colour: str
    board_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def pivot_m(self) -> tuple[float, float]:
        """Where the pivot is: along, up."""
        return self.gate_at_m + self.arm_m, FLOOR_M + GAP_M + self.drop_m

    @property
    def end_m(self) -> float:
        """Inner face of the lane's end."""
        return self.gate_at_m + 2 * self.arm_m + self.tail_m


def draw(rng: np.random.Generator) -> Params:
    """Half of the gates are open, whatever else is drawn."""
    direction = int(rng.choice([-1, 1]))
    ball, gate, counterweight = distinct_colours(rng, 3, COLOURS)
    lane, board = rng.permutation(["wood", "grey"])
    return Params(
        direction=direction,
        held_open=bool(rng.integers(2)),
        radius_m=uniform(rng, 0.043, 0.050),
        speed_m_s=uniform(rng, 0.55, 0.72),
        run_m=uniform(rng, 0.50, 0.62),
        gate_at_m=uniform(rng, 0.30, 0.36),
        arm_m=uniform(rng, 0.24, 0.28),
        drop_m=uniform(rng, 0.22, 0.25),
        swing_deg=uniform(rng, 23, 26),
        counterweight_half_m=uniform(rng, 0.034, 0.040),
        tail_m=uniform(rng, 0.08, 0.14),
        ball_colour=ball,
        gate_colour=gate,
        lever_colour=str(rng.choice(["black", "white"])),
        counterweight_colour=counterweight,
        lane_colour=str(lane),
        board_colour=str(board),
        azimuth_deg=90 - direction * uniform(rng, -14, 18),
        elevation_deg=uniform(rng, -32, -20),
    )


def build(p: Params, physics: Physics) -> Scene:
    """A lane with a step before a board that carries the lever and catches the shadows; `direction` mirrors it."""
    spec = new_spec(physics)
    r, side, rim = p.radius_m, 1.7 * p.radius_m, 0.012
    pivot, pivot_z = p.pivot_m
    high = pivot_z + p.arm_m * float(np.sin(np.radians(p.swing_deg))) + 0.06

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    top = FLOOR_M + STEP_M
    block("lane_in", (-p.run_m, STEP_AT_M), (-side, side), (0, top), p.lane_colour)
    lane = block("lane", (STEP_AT_M, p.end_m), (-side, side), (0, FLOOR_M), p.lane_colour)
    lane.priority, lane.condim, lane.friction = 1, 6, [0.8, 0.005, 1e-3]  # felt: the ball comes to rest on it
    block("front_in", (-p.run_m, STEP_AT_M), (-side - rim, -side), (0, top + 0.3 * r), p.board_colour)
    block("back_in", (-p.run_m, 0), (side, side + rim), (0, top + 0.3 * r), p.board_colour)
    block("front", (STEP_AT_M, p.end_m), (-side - rim, -side), (0, FLOOR_M + 0.3 * r), p.board_colour)
    block("end", (p.end_m, p.end_m + 0.02), (-side - rim, side), (0, FLOOR_M + 1.6 * r), p.board_colour)
    block("board", (0, p.end_m + 0.02), (side, side + 0.015), (0, high), p.board_colour)
    axle = block("axle", (pivot - 0.012, pivot + 0.012), (-0.03, side), (pivot_z - 0.012, pivot_z + 0.012), "grey")
    axle.contype = axle.conaffinity = 0
    _add_lever(spec, p, side)
    ball = add_ball(spec, "ball", (p.direction * (-p.run_m + 1.2 * r), 0, top + r), r, p.ball_colour)
    ball.friction = [0.8, 0.005, 2e-5]

    ends = sorted((0.0, p.direction * (p.end_m + 0.02)))
    back = sorted((-p.direction * p.run_m, p.direction * p.end_m))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        hidden=("counterweight", "beam", "gate"),
        cover=Box((ends[0], -side - rim, 0.0), (ends[1] + 0.02, side + 0.03, high + 0.02)),
        stage=(Box((back[0], -side, 0.0), (back[1], side, high)),),
        velocity={"ball": _rolling(p)},
        inventory=Inventory(
            (p.ball_colour, p.gate_colour, p.lever_colour, p.counterweight_colour, p.lane_colour, p.board_colour),
            ("ball", "gate", "lever", "counterweight", "lane", "board"),
            (f"{p.ball_colour} ball", f"{p.gate_colour} gate", f"{p.lever_colour} lever", "counterweight"),
        ),
    )


def _add_lever(spec: mujoco.MjSpec, p: Params, side: float) -> None:
    """The lever with gate and counterweight, hinged about y and at rest where the counterweight holds it."""
    import mujoco

    start = p.swing_deg if p.held_open else 0.0
    pivot, pivot_z = p.pivot_m
    half = p.direction * float(np.radians(start)) / 2
    body = spec.worldbody.add_body(name="lever", pos=[p.direction * pivot, 0, pivot_z])
    body.quat = [float(np.cos(half)), 0.0, float(np.sin(half)), 0.0]
    low, high = sorted((p.direction * -start, p.direction * (p.swing_deg - start)))  # degrees, as MuJoCo compiles them
    body.add_joint(
        type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0], range=[low, high], limited=True, damping=[0.05, 0, 0]
    )
    add_box(body, "beam", (0, 0, 0), (p.arm_m + 0.015, 0.022, 0.011), p.lever_colour, density=200)
    gate = (-p.direction * p.arm_m, 0, -p.drop_m / 2)
    add_box(body, "gate", gate, (GATE_HALF_M, 0.85 * side, p.drop_m / 2), p.gate_colour, density=700)
    size, away = p.counterweight_half_m, (0.80 if p.held_open else 0.15) * p.arm_m
    centre = (p.direction * away, 0, 0.011 + size)
    add_box(body, "counterweight", centre, (size, size, size), p.counterweight_colour, density=4000)


def _rolling(p: Params) -> tuple[float, ...]:
    """Velocity of a ball that rolls without slipping."""
    speed = p.direction * p.speed_m_s
    return (speed, 0.0, 0.0, 0.0, speed / p.radius_m, 0.0)


def _past_m(motion: Motion, p: Params) -> np.ndarray:
    """How far the ball's rear is past the gate (m), negative before it, shape (F,)."""
    return p.direction * motion.pos("ball")[:, 0] - p.gate_at_m - GATE_HALF_M - p.radius_m


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'yes' from when the ball is wholly past the gate; 'no' while it is not, from when it lies within a centimetre of
    its last place."""
    past, along = _past_m(motion, p), motion.pos("ball")[:, 0]
    restless = np.flatnonzero(np.abs(along - along[-1]) > 0.01)
    still_from = int(restless[-1]) + 1 if restless.size else 0
    return ["yes" if gone else "no" if i >= still_from else None for i, gone in enumerate(past > 0)]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the ball ends beyond the gate, or how far it still would have to go."""
    return float(abs(_past_m(motion, p)[-1]))


def twins(p: Params) -> list[Params]:
    """The same run with the counterweight in its other place."""
    return [replace(p, held_open=not p.held_open)]


QUESTIONS = (
    "Does the {ball} ball get past the {gate} gate, yes or no?",
    "Is the way open for the {ball} ball to pass under the {gate} gate: yes or no?",
    "Does the {ball} ball come to rest beyond the {gate} gate, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Ball and gate are named by their colours."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(ball=p.ball_colour, gate=p.gate_colour),
        labels=("yes", "no"),
        aliases={
            "yes it does": "yes",
            "it gets past": "yes",
            "it gets past the gate": "yes",
            "it passes the gate": "yes",
            "no it does not": "no",
            "it does not get past": "no",
            "it is stopped by the gate": "no",
            "the gate stops it": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    if rng.integers(2):
        side = "left" if p.direction > 0 else "right"
        return AnswerableQuestion("From which side does the ball roll in, left or right?", ("left", "right"), side)
    choices = tuple(str(c) for c in rng.permutation([p.ball_colour, p.gate_colour, p.counterweight_colour]))
    question = f"What colour is the ball that rolls along the lane: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.ball_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """The ball lies beyond the gate, seen from where it started, or before it; None while either is not to be seen."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = track(frames, values["ball"], 60)
    gate = largest(frames[-1], values["gate"], 60)
    start, end = next((blob for blob in path if blob), None), path[-1]
    if gate is None or start is None or end is None or not at_rest(path):
        return None
    return "yes" if (end.x - gate.x) * (gate.x - start.x) > 0 else "no"


FAMILY = Family(
    name="lever_gate",
    taxonomy="occlusion",
    category="pendulums_levers",
    sub_scenario="lever_gate",
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
