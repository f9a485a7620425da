"""A ball rolls down a ramp on to a road that leads under a footbridge; does it come out at the other end?

Control: the road under the bridge and beyond is in view. Void: the panel stands before the far half of the bridge and
the road beyond.
Hidden element: a kerb under the bridge, which lies across the road or along its far edge.
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
    from collections.abc import Callable

    import mujoco

    from traps_pipeline.scenes.simulate import Motion

    Block = Callable[[str, tuple[float, float], tuple[float, float], tuple[float, float], str], mujoco.MjsGeom]

Span = tuple[float, float]
ROAD_M = 0.02
SLAB_M = 0.03
RAILING_M = 0.05
BALL_COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. Lengths run along the road, from the bridge's near edge."""

    direction: int
    blocked: bool  # whether the kerb lies across the road (the hidden element)
    radius_m: float
    slope_deg: float
    ramp_m: float  # length of the ramp along the ground
    flat_m: float  # road from the ramp to the bridge
    bridge_m: float  # width of the bridge, along the road
    span_m: float  # length of the bridge, across the road
    height_m: float  # of the bridge's lower side
    mouth_m: float  # part of the bridge that is seen beside the panel
    beyond_m: float  # road past the bridge
    hump_m: float  # how much higher its middle is
    planks: int
    ball_colour: str
    bridge_colour: str
    road_colour: str
    ramp_colour: str
    kerb_colour: str
    azimuth_deg: float
    elevation_deg: float


def draw(rng: np.random.Generator) -> Params:
    """Half of the roads are blocked; nothing that can be seen tells."""
    ball, bridge = distinct_colours(rng, 2, BALL_COLOURS)
    road, ramp, kerb = (str(c) for c in rng.permutation(["wood", "grey", "white", "black"])[:3])
    direction = int(rng.choice([-1, 1]))
    return Params(
        direction=direction,
        blocked=bool(rng.integers(2)),
        radius_m=uniform(rng, 0.048, 0.056),
        slope_deg=uniform(rng, 10, 15),
        ramp_m=uniform(rng, 0.34, 0.42),
        flat_m=uniform(rng, 0.10, 0.16),
        bridge_m=uniform(rng, 0.40, 0.46),
        span_m=uniform(rng, 0.42, 0.50),
        height_m=uniform(rng, 0.22, 0.25),
        mouth_m=uniform(rng, 0.05, 0.08),
        beyond_m=uniform(rng, 0.30, 0.38),
        hump_m=uniform(rng, 0.06, 0.09),
        planks=int(rng.choice([7, 9])),
        ball_colour=ball,
        bridge_colour=bridge,
        road_colour=road,
        ramp_colour=ramp,
        kerb_colour=kerb,
        azimuth_deg=90 - direction * uniform(rng, -16, 10),
        elevation_deg=uniform(rng, -24, -18),
    )


def build(p: Params, physics: Physics) -> Scene:
    """A ramp, a road with an end wall, a bridge on four legs across the road."""
    spec = new_spec(physics)
    r, d = p.radius_m, p.direction
    end, half_y = p.bridge_m + p.beyond_m, 1.6 * r

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (d * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    stop = 0.62 * p.bridge_m + r  # where the kerb's face is: the ball rests in the middle of the bridge
    bed = (stop - 3.5 * r, stop)  # rough: a ball that bounces off the kerb stays there
    spans = (("road_in", (-p.flat_m, bed[0]), 1e-4), ("road_bed", bed, 0.003), ("road_out", (bed[1], end), 0.004))
    for name, along, rolling in spans:
        road = block(name, along, (-half_y, half_y), (0, ROAD_M), p.road_colour)
        road.friction, road.condim, road.priority = [0.8, 0.005, rolling], 6, 1
    block("end_wall", (end, end + 0.015), (-half_y, half_y), (0, ROAD_M + 1.4 * r), p.road_colour)
    start = _add_ramp(spec, p, half_y)
    _add_bridge(block, p)
    if p.blocked:
        kerb = block("kerb", (stop, stop + 0.04), (-half_y, half_y), (ROAD_M, ROAD_M + 0.9 * r), p.kerb_colour)
    else:
        at = (stop + 0.02 - half_y, stop + 0.02 + half_y)
        kerb = block("kerb", at, (half_y, half_y + 0.04), (0, 0.9 * r), p.kerb_colour)
    kerb.friction, kerb.condim, kerb.priority = [0.2, 0.005, 0.001], 6, 1
    ball = add_ball(spec, "ball", start, r, p.ball_colour)
    ball.friction = [0.8, 0.005, 1e-4]

    high, front = ROAD_M + 2.1 * r, -p.span_m / 2 - 0.01
    ends = sorted((d * p.mouth_m, d * (end + 0.015)))
    cover = Box(
        (ends[0] - 0.01, front, 0),
        (ends[1] + (0.35 * high if d > 0 else 0.01), half_y + 0.04 + 0.55 * high, high),
    )
    road_ends = sorted((-d * (p.flat_m + p.ramp_m), d * end))
    top = p.height_m + p.hump_m + SLAB_M + RAILING_M + 0.03
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        hidden=("kerb",),
        cover=cover,
        stage=(
            Box((road_ends[0], -half_y, 0), (road_ends[1], half_y, high)),
            Box((min(0, d * p.bridge_m), front, 0), (max(0, d * p.bridge_m), -front, top)),
        ),
        inventory=Inventory(
            (p.ball_colour, p.bridge_colour, p.road_colour, p.ramp_colour, p.kerb_colour),
            ("ball", "bridge", "road", "ramp", "railing", "kerb"),
            (f"{p.ball_colour} ball", f"{p.bridge_colour} bridge", "ramp", "road", "railing of the bridge"),
        ),
    )


def _add_ramp(spec: mujoco.MjSpec, p: Params, half_y: float) -> tuple[float, float, float]:
    """The ramp down to the road; gives the place where the ball starts on it."""
    slope, d = float(np.radians(p.slope_deg)), p.direction
    length, thick = p.ramp_m / np.cos(slope), 0.012
    foot = np.array([-p.flat_m, ROAD_M])
    up, normal = np.array([-np.cos(slope), np.sin(slope)]), np.array([np.sin(slope), np.cos(slope)])
    centre = foot + up * length / 2 - normal * thick
    half = (length / 2, half_y, thick)
    add_box(spec.worldbody, "ramp", (d * centre[0], 0, centre[1]), half, p.ramp_colour, euler_y=d * slope)
    top = foot + up * (length - 0.03) - normal * thick
    add_box(
        spec.worldbody,
        "ramp_post",
        (d * top[0], 0, (top[1] - 0.008) / 2),
        (0.02, half_y * 0.8, (top[1] - 0.008) / 2),
        p.ramp_colour,
    )
    ball = foot + up * (length - 1.2 * p.radius_m) + normal * p.radius_m
    return (d * float(ball[0]), 0.0, float(ball[1]))


def _add_bridge(block: Block, p: Params) -> None:
    """A humped deck of planks on four legs, with a railing on either edge."""
    side, post, pitch = p.span_m / 2, 0.014, p.span_m / p.planks
    edges = ((0, 2 * post), (p.bridge_m - 2 * post, p.bridge_m))
    for k in range(p.planks):
        y = -side + (k + 0.5) * pitch
        z = p.height_m + p.hump_m * (1 - (y / side) ** 2)
        across = (y - 0.47 * pitch, y + 0.47 * pitch)
        block(f"plank_{k}", (0, p.bridge_m), across, (z, z + SLAB_M), p.bridge_colour)
        for i, along in enumerate(edges):
            rail_z = z + SLAB_M + RAILING_M
            block(f"handrail_{i}{k}", along, (y - pitch / 2, y + pitch / 2), (rail_z, rail_z + 0.03), p.bridge_colour)
            if k % 2 == 0:
                block(f"post_{i}{k}", along, (y - post / 2, y + post / 2), (z + SLAB_M, rail_z), p.bridge_colour)
            if k in (0, p.planks - 1):
                block(f"leg_{i}{k}", along, (y - post, y + post), (0, z), p.bridge_colour)


def _beyond(motion: Motion, p: Params) -> np.ndarray:
    """How far the rear of the ball is past the far edge of the bridge (m), shape (F,)."""
    return p.direction * motion.pos("ball")[:, 0] - p.radius_m - p.bridge_m


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'yes' from when the ball is wholly past the bridge; 'no' from when it is where it stays under it."""
    beyond = _beyond(motion, p)
    if beyond[-1] > 0:
        return ["yes" if x > 0 else None for x in beyond]
    last_moving = int(np.flatnonzero(np.abs(beyond - beyond[-1]) > p.radius_m).max(initial=-1))
    return [None if i <= last_moving else "no" for i in range(len(beyond))]


def margin(motion: Motion, p: Params) -> float:
    """How far the ball ends past the bridge, or short of its far edge (m)."""
    beyond = _beyond(motion, p)[-1]
    return float(beyond if beyond > 0 else -beyond - 2 * p.radius_m)


def twins(p: Params) -> list[Params]:
    """The same road with the kerb put across it, or taken out of the way."""
    return [replace(p, blocked=not p.blocked)]


QUESTIONS = (
    "Does the {ball} ball roll out from under the {bridge} bridge at the other end, yes or no?",
    "Once it is under the {bridge} bridge, does the {ball} ball get through to the far side: yes or no?",
    "Does the {ball} ball make it all the way under the {bridge} bridge and out again, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Ball and bridge are named by their colours, which nothing else has."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(ball=p.ball_colour, bridge=p.bridge_colour),
        labels=("yes", "no"),
        aliases={
            "it rolls out": "yes",
            "it gets through": "yes",
            "yes it gets through": "yes",
            "it comes out at the other end": "yes",
            "it does not get through": "no",
            "no it does not get through": "no",
            "it stays under the bridge": "no",
            "it stops under the bridge": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(3)
    if kind == 0:
        side = "left" if p.direction > 0 else "right"
        question = "On which side of the bridge is the ramp that the ball rolls down, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    named, thing = (p.ball_colour, "ball") if kind == 1 else (p.bridge_colour, "bridge")
    others = [c for c in BALL_COLOURS if c not in (p.ball_colour, p.bridge_colour)]
    choices = tuple(str(c) for c in rng.permutation([named, *rng.permutation(others)[:2]]))
    return AnswerableQuestion(f"What colour is the {thing}: {listed(choices)}?", choices, named)


def observe(frames: np.ndarray, question: str) -> str | None:
    """'yes' if the ball ends past the edge of the bridge that is farther from where it starts."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = [_ball(frame, values["ball"]) for frame in frames]
    start = next((blob.x for blob in path if blob), None)
    bridge, end = largest(frames[-1], values["bridge"], 200), path[-1]
    if start is None or bridge is None or end is None or not at_rest(path, tolerance_px=4):
        return None
    left, width = bridge.box[0], bridge.box[2]
    return "yes" if (end.x > left + width if start < bridge.x else end.x < left) else "no"


def _ball(frame: np.ndarray, colour: str) -> Blob | None:
    """The region of the ball's colour that is no larger than a ball."""
    found = blobs(colour_mask(frame, colour), 60)
    return next((blob for blob in found if max(blob.box[2:]) < 80), None)


FAMILY = Family(
    name="under_bridge",
    taxonomy="occlusion",
    category="hidden",
    sub_scenario="under_bridge",
    answer_type="binary",
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
