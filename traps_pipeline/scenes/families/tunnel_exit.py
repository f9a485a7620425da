"""A ball rolls down a covered ramp into a forked tunnel; the question is by which exit it comes out.

Control: both exits and the tray at each of them are in view. Void: the panel stands before the fork and the trays; the
ramp is seen above it.
Hidden element: the deflector in the fork, which is turned to lead the ball to the left or to the right.
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
from traps_pipeline.scenes.vision import Blob, at_rest, blobs, colour_mask, largest
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
FLOOR_M = 0.05
TRAY_M = 0.02  # lower than the tunnel, so that no ball rolls back into it
WALL_M = 0.012
BALL_COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """The ball rolls towards the camera. turn: +1 if the deflector leads it to the right (the hidden element)."""

    turn: int
    turn_deg: float  # angle between the deflector and the ball's way
    radius_m: float
    half_width_m: float  # of the fork
    depth_m: float  # of the fork, from its front to the mouth at its back
    slope_deg: float
    covered_m: float  # covered part of the ramp
    open_m: float  # open part of the ramp, above it
    start_m: float  # where the ball starts, from the upper end of the ramp
    tray_m: float
    ball_colour: str
    tunnel_colour: str
    left_colour: str
    right_colour: str
    ramp_colour: str
    azimuth_deg: float
    elevation_deg: float


def draw(rng: np.random.Generator) -> Params:
    """Which way the deflector is turned is independent of all that can be seen."""
    ball, tunnel = distinct_colours(rng, 2, BALL_COLOURS)
    left, right, ramp = (str(c) for c in rng.permutation(["wood", "grey", "white", "black"])[:3])
    return Params(
        turn=int(rng.choice([-1, 1])),
        turn_deg=uniform(rng, 40, 50),
        radius_m=uniform(rng, 0.046, 0.054),
        half_width_m=uniform(rng, 0.20, 0.25),
        depth_m=uniform(rng, 0.26, 0.30),
        slope_deg=uniform(rng, 12, 16),
        covered_m=uniform(rng, 0.30, 0.42),
        open_m=uniform(rng, 0.42, 0.54),
        start_m=uniform(rng, 0.06, 0.11),
        tray_m=uniform(rng, 0.20, 0.26),
        ball_colour=ball,
        tunnel_colour=tunnel,
        left_colour=left,
        right_colour=right,
        ramp_colour=ramp,
        azimuth_deg=90 + uniform(rng, -16, 16),
        elevation_deg=uniform(rng, -36, -28),
    )


def build(p: Params, physics: Physics) -> Scene:
    """The fork stands in the middle, its front at y = 0; the ramp leads down to it from the back."""
    spec = new_spec(physics)
    r, w, depth = p.radius_m, p.half_width_m, p.depth_m
    roof, bore, end = FLOOR_M + 2.8 * r, 1.3 * r, p.half_width_m + p.tray_m

    def block(name: str, x: Span, y: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        half = ((x[1] - x[0]) / 2, (y[1] - y[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, (sum(x) / 2, sum(y) / 2, sum(z) / 2), half, colour)

    block("fork_floor", (-w, w), (0, depth), (0, FLOOR_M), p.tunnel_colour)
    block("fork_roof", (-w, w), (-WALL_M, depth + WALL_M), (roof, roof + WALL_M), p.tunnel_colour)
    front = block("fork_front", (-w, w), (-WALL_M, 0), (0, roof), p.tunnel_colour)
    _slippery(front)
    for name, side in (("left", -1), ("right", 1)):
        x = sorted((side * bore, side * w))
        block(f"fork_back_{name}", (x[0], x[1]), (depth, depth + WALL_M), (0, roof), p.tunnel_colour)
        colour = p.left_colour if side < 0 else p.right_colour
        x = sorted((side * w, side * end))
        tray = block(f"tray_{name}", (x[0], x[1]), (-WALL_M, depth), (0, TRAY_M), colour)
        tray.friction, tray.condim, tray.priority = [0.8, 0.005, 0.004], 6, 1
        edge = sorted((side * end, side * (end + WALL_M)))
        block(f"tray_end_{name}", (edge[0], edge[1]), (-WALL_M, depth), (0, TRAY_M + 1.2 * r), colour)
        block(f"tray_front_{name}", (x[0], x[1]), (-2 * WALL_M, -WALL_M), (0, TRAY_M + 0.5 * r), colour)
        block(f"tray_back_{name}", (x[0], x[1]), (depth, depth + WALL_M), (0, TRAY_M + 1.2 * r), colour)
    yaw = p.turn * float(np.radians(p.turn_deg)) + np.pi / 2
    deflector = block("deflector", (-2.3 * r, 2.3 * r), (-0.006, 0.006), (FLOOR_M, roof - 0.004), "black")
    deflector.pos = [0, 0.45 * depth, (FLOOR_M + roof) / 2]
    deflector.quat = [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))]
    _slippery(deflector)
    start = _add_ramp(spec, p, bore)
    ball = add_ball(spec, "ball", start, r, p.ball_colour)
    ball.friction = [0.8, 0.005, 1e-4]

    high = roof + WALL_M
    low, back = -2 * WALL_M - 0.01, depth + 2 * WALL_M
    cover = Box((-end - WALL_M - 0.01, low, 0), (end + WALL_M + 0.35 * 0.15, back, high))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        hidden=("deflector",),
        cover=cover,
        stage=(cover, Box((-bore - WALL_M, depth, 0), (bore + WALL_M, start[1] + p.start_m, start[2] + r))),
        inventory=Inventory(
            (p.ball_colour, p.tunnel_colour, p.left_colour, p.right_colour, p.ramp_colour),
            ("ball", "tunnel", "ramp", "tray", "exit"),
            (f"{p.ball_colour} ball", f"{p.tunnel_colour} tunnel", "ramp", "upper end of the ramp"),
        ),
    )


def _slippery(geom: mujoco.MjsGeom) -> None:
    """A ball slides along it and keeps its speed."""
    geom.friction, geom.condim, geom.priority = [0.03, 0.001, 0.00001], 6, 1


def _add_ramp(spec: mujoco.MjSpec, p: Params, bore: float) -> tuple[float, float, float]:
    """The ramp with its cover and posts; gives the place where the ball starts on it."""
    slope = float(np.radians(p.slope_deg))
    length, r, y0 = p.covered_m + p.open_m, p.radius_m, p.depth_m

    def tilted(name: str, x: Span, along: Span, z: Span, colour: str) -> None:
        s, h = sum(along) / 2, sum(z) / 2
        centre = (
            sum(x) / 2,
            y0 + s * np.cos(slope) - h * np.sin(slope),
            FLOOR_M + s * np.sin(slope) + h * np.cos(slope),
        )
        half = ((x[1] - x[0]) / 2, (along[1] - along[0]) / 2, (z[1] - z[0]) / 2)
        geom = add_box(spec.worldbody, name, centre, half, colour)
        geom.quat = [float(np.cos(slope / 2)), float(np.sin(slope / 2)), 0.0, 0.0]

    outer, top = bore + WALL_M, 2.7 * r
    tilted("ramp", (-outer, outer), (0.0, length), (-0.02, 0.0), p.ramp_colour)
    tilted("stem_roof", (-outer, outer), (0.0, p.covered_m), (top, top + WALL_M), p.tunnel_colour)
    for side in (-1, 1):
        x = sorted((side * bore, side * outer))
        tilted(f"stem_{side}", (x[0], x[1]), (0.0, p.covered_m), (0.0, top), p.tunnel_colour)
        tilted(f"rail_{side}", (x[0], x[1]), (p.covered_m, length), (0.0, 0.4 * r), p.ramp_colour)
    at = length - 0.05
    post_top = FLOOR_M + at * np.sin(slope) - 0.03
    y = y0 + at * np.cos(slope)
    add_box(spec.worldbody, "ramp_post", (0, y, post_top / 2), (outer, 0.02, post_top / 2), p.ramp_colour)
    s = length - p.start_m
    return (
        0.0,
        float(y0 + s * np.cos(slope) - r * np.sin(slope)),
        float(FLOOR_M + s * np.sin(slope) + r * np.cos(slope)),
    )


def _beside(motion: Motion, p: Params) -> np.ndarray:
    """How far the near side of the ball is outside the fork (m), negative inside, shape (F,)."""
    return np.abs(motion.pos("ball")[:, 0]) - p.radius_m - p.half_width_m


def readings(motion: Motion, p: Params) -> list[str | None]:
    """The side on which the ball is wholly out of the tunnel."""
    side = np.where(motion.pos("ball")[:, 0] > 0, "right", "left")
    return [str(name) if out > 0 else None for name, out in zip(side, _beside(motion, p), strict=True)]


def margin(motion: Motion, p: Params) -> float:
    """How far outside the fork the ball ends (m)."""
    return float(_beside(motion, p)[-1])


def twins(p: Params) -> list[Params]:
    """The same tunnel with the deflector turned the other way."""
    return [replace(p, turn=-p.turn)]


QUESTIONS = (
    "By which exit does the {ball} ball leave the {tunnel} tunnel, left or right?",
    "On which side does the {ball} ball come out of the forked {tunnel} tunnel: left or right?",
    "Does the {ball} ball come out of the left or the right exit of the {tunnel} tunnel?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Ball and tunnel are named by their colours, which nothing else has."""
    forms = ("{} exit", "the {} exit", "on the {}", "{} side", "to the {}")
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(ball=p.ball_colour, tunnel=p.tunnel_colour),
        labels=("left", "right"),
        aliases={form.format(side): side for side in ("left", "right") for form in forms},
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    named, thing = (
        (p.ball_colour, "ball that rolls down the ramp")
        if rng.integers(2)
        else (p.tunnel_colour, "tunnel that the ball rolls into")
    )
    others = [c for c in BALL_COLOURS if c not in (p.ball_colour, p.tunnel_colour)]
    choices = tuple(str(c) for c in rng.permutation([named, *rng.permutation(others)[:2]]))
    return AnswerableQuestion(f"What colour is the {thing}: {listed(choices)}?", choices, named)


def observe(frames: np.ndarray, question: str) -> str | None:
    """The side of the tunnel on which the ball lies at the end."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = [_ball(frame, values["ball"]) for frame in frames[-3:]]
    tunnel, ball = largest(frames[-1], values["tunnel"], 200), path[-1]
    if ball is None or tunnel is None or not at_rest(path, tolerance_px=4):
        return None
    middle = tunnel.box[0] + tunnel.box[2] / 2
    if abs(ball.x - middle) < tunnel.box[2] / 3:
        return None
    return "left" if ball.x < middle else "right"


def _ball(frame: np.ndarray, colour: str) -> Blob | None:
    """The region of the ball's colour that is no larger than a ball."""
    found = blobs(colour_mask(frame, colour), 60)
    return next((blob for blob in found if max(blob.box[2:]) < 80), None)


FAMILY = Family(
    name="tunnel_exit",
    taxonomy="occlusion",
    category="hidden",
    sub_scenario="tunnel_exit",
    answer_type="direction",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    observe=observe,
    min_margin_m=0.02,
    twins=twins,
)
