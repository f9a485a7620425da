"""A ball rolls down a ramp towards the camera and onto a table; the question is into which bin it is deflected.

Control: the table and the bins at its sides are in view. Void: the panel stands before them, the ramp is in view.
Hidden element: the deflector on the table, a board that is turned to the left or to the right.
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
from traps_pipeline.scenes.vision import Blob, at_rest, blobs, colour_mask, largest
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
BOARD_M = 0.016  # thickness of the ramp
WALL_M = 0.012
BALL_COLOURS = ("green", "yellow", "orange", "cyan", "purple")  # the bins are red and blue


@dataclass(frozen=True)
class Params:
    """Lengths in y run from the front edge of the table to the back, in x from its middle to the right."""

    deflects: str  # 'left' or 'right': the hidden element
    angle_deg: float  # between the deflector and the ball's way
    deflector_m: float  # half its length
    radius_m: float
    ramp_x_m: float
    slope_deg: float
    ramp_m: float  # length of the ramp's surface
    start_m: float  # from the ramp's top to where the ball starts
    table_m: float  # height of the table
    half_width_m: float  # of the table
    depth_m: float  # of the table
    bin_m: float  # width of a bin
    ball_colour: str
    ramp_colour: str
    table_colour: str
    deflector_colour: str
    azimuth_deg: float
    elevation_deg: float


def draw(rng: np.random.Generator) -> Params:
    """Half of the deflectors are turned to the left; nothing that can be seen tells."""
    ramp, table, deflector = (str(c) for c in rng.permutation(["wood", "grey", "black"]))
    return Params(
        deflects=str(rng.choice(["left", "right"])),
        angle_deg=uniform(rng, 40, 50),
        deflector_m=uniform(rng, 0.13, 0.15),
        radius_m=uniform(rng, 0.047, 0.056),
        ramp_x_m=uniform(rng, -0.06, 0.06),
        slope_deg=uniform(rng, 16, 22),
        ramp_m=uniform(rng, 0.52, 0.62),
        start_m=uniform(rng, 0.06, 0.13),
        table_m=uniform(rng, 0.09, 0.12),
        half_width_m=uniform(rng, 0.26, 0.32),
        depth_m=uniform(rng, 0.35, 0.40),
        bin_m=uniform(rng, 0.18, 0.22),
        ball_colour=str(rng.choice(BALL_COLOURS)),
        ramp_colour=ramp,
        table_colour=table,
        deflector_colour=deflector,
        azimuth_deg=90 + uniform(rng, -20, 20),
        elevation_deg=uniform(rng, -40, -30),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Table with a front and a back wall, deflector, a bin at either side, ramp behind."""
    spec = new_spec(physics)
    r, top, wide = p.radius_m, p.table_m, p.half_width_m

    def block(name: str, x: Span, y: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (sum(x) / 2, sum(y) / 2, sum(z) / 2)
        half = ((x[1] - x[0]) / 2, (y[1] - y[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    rim = top + 1.1 * r
    block("table", (-wide, wide), (0, p.depth_m), (0, top), p.table_colour)
    block("wall_front", (-wide, wide), (-WALL_M, 0), (0, rim), p.table_colour)
    side = 1.5 * r
    for name, x in (("left", (-wide, p.ramp_x_m - side)), ("right", (p.ramp_x_m + side, wide))):
        block(f"wall_{name}", x, (p.depth_m, p.depth_m + WALL_M), (0, rim), p.table_colour)
    turn = np.radians(90 + p.angle_deg if p.deflects == "left" else 90 - p.angle_deg) / 2
    centre = (p.ramp_x_m, p.deflector_m * float(np.cos(np.radians(p.angle_deg))) + 0.02, top + 0.9 * r)
    deflector = add_box(spec.worldbody, "deflector", centre, (p.deflector_m, 0.008, 0.9 * r), p.deflector_colour)
    deflector.quat = [float(np.cos(turn)), 0.0, 0.0, float(np.sin(turn))]
    for geom in spec.worldbody.geoms:
        if geom.name in ("deflector", "wall_front"):
            geom.friction, geom.priority, geom.condim = [0.02, 0.001, 0.0001], 1, 3
    for name, sign, colour in (("left", -1, "red"), ("right", 1, "blue")):
        _add_bin(spec, p, name, sign, colour)
    _add_ramp(spec, p, side)

    high = top + 2 * r + 0.01
    rise = float(p.ramp_m * np.sin(_slope(p)))
    back = p.depth_m + float(p.ramp_m * np.cos(_slope(p)))
    out = wide + p.bin_m + WALL_M
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        hidden=("deflector",),
        cover=Box((-out, -WALL_M - 0.01, 0.0), (out + 0.02, p.depth_m, high)),
        stage=(
            Box((-out, -WALL_M, 0.0), (out, p.depth_m, high)),
            Box((p.ramp_x_m - side, back, 0.0), (p.ramp_x_m + side, back, top + rise)),
        ),
        inventory=Inventory(
            (p.ball_colour, p.ramp_colour, p.table_colour, p.deflector_colour, "red", "blue"),
            ("ball", "ramp", "table", "bin", "board", "wall"),
            (f"{p.ball_colour} ball", "red bin", "blue bin", "ramp", "table"),
        ),
    )


def _slope(p: Params) -> float:
    return float(np.radians(p.slope_deg))


def _add_bin(spec: mujoco.MjSpec, p: Params, name: str, sign: int, colour: str) -> None:
    """An open box beside the table (sign -1: on the left), lower than it."""
    near, far = p.half_width_m, p.half_width_m + p.bin_m
    middle, half = sign * (near + far) / 2, p.bin_m / 2
    depth = p.depth_m / 2
    floor = add_box(spec.worldbody, f"bin_{name}", (middle, depth, 0.006), (half, depth, 0.006), colour)
    floor.friction = [0.8, 0.005, 0.006]
    for end, y, high in (("front", -WALL_M / 2, 0.04), ("back", p.depth_m + WALL_M / 2, p.table_m)):
        add_box(spec.worldbody, f"bin_{name}_{end}", (middle, y, high / 2), (half, WALL_M / 2, high / 2), colour)
    high = p.table_m + p.radius_m
    half = (WALL_M / 2, depth + WALL_M, high / 2)
    add_box(spec.worldbody, f"bin_{name}_end", (sign * (far + WALL_M / 2), depth, high / 2), half, colour)


def _add_ramp(spec: mujoco.MjSpec, p: Params, side: float) -> None:
    """The ramp with its rails and support, and the ball (body `ball`) at rest on it."""
    slope = _slope(p)
    sin, cos = float(np.sin(slope)), float(np.cos(slope))
    tilt = [float(np.cos(slope / 2)), float(np.sin(slope / 2)), 0.0, 0.0]  # about x: the back end is up

    def on_ramp(up: float, above: float) -> tuple[float, float, float]:
        """The point `up` along the ramp from its foot and `above` over its surface."""
        return (p.ramp_x_m, p.depth_m + up * cos - above * sin, p.table_m + up * sin + above * cos)

    half = (side, p.ramp_m / 2, BOARD_M / 2)
    add_box(spec.worldbody, "ramp", on_ramp(p.ramp_m / 2, -BOARD_M / 2), half, p.ramp_colour, quat=tilt)
    _, y, z = on_ramp(p.ramp_m / 2, 0)
    for name, x in (("left", p.ramp_x_m - side), ("right", p.ramp_x_m + side)):
        half = (0.005, p.ramp_m / 2, 0.4 * p.radius_m)
        add_box(spec.worldbody, f"rail_{name}", (x, y, z), half, p.ramp_colour, quat=tilt)
    x, y, z = on_ramp(p.ramp_m - 0.05, -BOARD_M)
    add_box(spec.worldbody, "support", (x, y, z / 2), (0.8 * side, 0.02, z / 2), p.ramp_colour)
    ball = add_ball(spec, "ball", on_ramp(p.ramp_m - p.start_m, p.radius_m), p.radius_m, p.ball_colour)
    ball.friction = [0.8, 0.005, 2e-5]


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'left' or 'right' from when the ball is past that end of the table."""
    along = motion.pos("ball")[:, 0]
    return [("left" if x < 0 else "right") if abs(x) > p.half_width_m else None for x in along]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the middle of the ball ends past the table's end."""
    return float(abs(motion.pos("ball")[-1, 0])) - p.half_width_m


def twins(p: Params) -> list[Params]:
    """The same table with the deflector mirrored."""
    return [replace(p, deflects="right" if p.deflects == "left" else "left")]


QUESTIONS = (
    "Which bin does the {ball} ball end up in, the left one or the right one?",
    "Is the {ball} ball deflected into the bin on the left or on the right?",
    "In which bin does the {ball} ball land as seen from the camera, left or right?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The ball is named by its colour, which nothing else has."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(ball=p.ball_colour),
        labels=("left", "right"),
        aliases={
            "left bin": "left",
            "the left one": "left",
            "red bin": "left",
            "on the left": "left",
            "right bin": "right",
            "the right one": "right",
            "blue bin": "right",
            "on the right": "right",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    if rng.integers(2):
        others = [c for c in BALL_COLOURS if c != p.ball_colour]
        choices = tuple(str(c) for c in rng.permutation([p.ball_colour, *rng.permutation(others)[:2]]))
        return AnswerableQuestion(f"What colour is the ball on the ramp: {listed(choices)}?", choices, p.ball_colour)
    names = {"wood": "brown", "grey": "grey", "black": "black"}
    choices = tuple(str(c) for c in rng.permutation(list(names.values())))
    question = f"What colour is the ramp that the ball rolls down: {listed(choices)}?"
    return AnswerableQuestion(question, choices, names[p.ramp_colour])


def observe(frames: np.ndarray, question: str) -> str | None:
    """Which bin the resting ball is nearer to; the red one is on the left, the blue one on the right."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = [_ball(frame, values["ball"]) for frame in frames]
    red, blue, ball = largest(frames[-1], "red", 100), largest(frames[-1], "blue", 100), path[-1]
    if red is None or blue is None or ball is None or not at_rest(path):
        return None
    return "left" if abs(ball.x - red.x) < abs(ball.x - blue.x) else "right"


def _ball(frame: np.ndarray, colour: str) -> Blob | None:
    """The largest region of a colour that may be a ball: compact, and small beside the frame."""
    for blob in blobs(colour_mask(frame, colour), 60):
        if blob.area < 4000 and 0.4 < blob.box[2] / blob.box[3] < 2.5 and blob.fill > 0.5:
            return blob
    return None


FAMILY = Family(
    name="ramp_deflect",
    taxonomy="occlusion",
    category="ramps_rolling",
    sub_scenario="deflect",
    answer_type="direction",
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
