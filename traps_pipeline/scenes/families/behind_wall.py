"""A ball rolls along a lane behind a wall with two windows; the question is whether it comes out at the other end.

Control: the windows and the tray at the end are in view, so that a ball which stays behind the wall is seen in the
second window. Void: the panel stands before the wall and the tray.
Hidden element: a block, which lies across the lane below the second window or beside the lane.
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
DECK_M = 0.04
TRAY_M = 0.02  # lower than the lane, so that no ball rolls back behind the wall
WALL_M = 0.03
SILL_M = 0.045
BALL_COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")
WALL_COLOURS = (*BALL_COLOURS, "black")


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. Lengths run along the lane, from where the wall begins."""

    direction: int
    blocked: bool  # whether the block lies across the lane (the hidden element)
    speed_m_s: float
    radius_m: float
    run_m: float  # open lane before the wall
    wall_m: float
    height_m: float
    windows_m: tuple[float, ...]  # middle of each window
    window_m: float  # width of a window
    mouth_m: float  # part of the wall that is seen beside the panel
    tray_m: float
    merlons: int
    ball_colour: str
    wall_colour: str
    lane_colour: str
    tray_colour: str
    block_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def face_m(self) -> float:
        """Distance of the wall's hidden face from the middle of the lane."""
        return 1.35 * self.radius_m


def draw(rng: np.random.Generator) -> Params:
    """Half of the lanes are blocked; nothing that can be seen tells."""
    direction = int(rng.choice([-1, 1]))
    while True:
        ball, wall = distinct_colours(rng, 2, WALL_COLOURS)
        if ball in BALL_COLOURS:
            break
    plain = [c for c in ("wood", "grey", "white", "black") if c != wall]
    lane, tray, block = (str(c) for c in rng.permutation(plain)[:3])
    wall_m = uniform(rng, 0.82, 0.92)
    return Params(
        direction=direction,
        blocked=bool(rng.integers(2)),
        speed_m_s=uniform(rng, 0.62, 0.78),
        radius_m=uniform(rng, 0.050, 0.058),
        run_m=uniform(rng, 0.30, 0.38),
        wall_m=wall_m,
        height_m=uniform(rng, 0.28, 0.33),
        windows_m=(round(0.30 * wall_m, 4), round(wall_m * uniform(rng, 0.70, 0.76), 4)),
        window_m=uniform(rng, 0.19, 0.22),
        mouth_m=uniform(rng, 0.08, 0.11),
        tray_m=uniform(rng, 0.26, 0.32),
        merlons=int(rng.integers(4, 7)),
        ball_colour=ball,
        wall_colour=wall,
        lane_colour=lane,
        tray_colour=tray,
        block_colour=block,
        azimuth_deg=90 + uniform(rng, -15, 15),
        elevation_deg=uniform(rng, -27, -20),
    )


def build(p: Params, physics: Physics) -> Scene:
    """A lane, a wall with windows and merlons before it, a tray at its end."""
    spec = new_spec(physics)
    r, d = p.radius_m, p.direction
    far, front = p.wall_m + p.tray_m, -p.face_m - WALL_M
    rail = 0.012

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (d * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    side = (-1.25 * r, 1.25 * r)
    bed = (p.windows_m[1] - 2.5 * r, p.windows_m[1] + 1.5 * r)  # rough: a ball that bounces off the block stays there
    for name, along in (("lane_in", (-p.run_m, bed[0])), ("lane_bed", bed), ("lane_out", (bed[1], p.wall_m))):
        floor = block(name, along, side, (0, DECK_M), p.lane_colour)
        rolling = 0.003 if name == "lane_bed" else 1e-4
        floor.friction, floor.condim, floor.priority = [0.8, 0.005, rolling], 6, 1
    tray = block("tray", (p.wall_m, far), side, (0, TRAY_M), p.tray_colour)
    tray.friction, tray.condim, tray.priority = [0.8, 0.005, 0.004], 6, 1
    rim = TRAY_M + 0.6 * r
    block("tray_front", (p.wall_m, far), (side[0] - rail, side[0]), (0, rim), p.tray_colour)
    block("tray_back", (p.wall_m, far), (side[1], side[1] + rail), (0, rim), p.tray_colour)
    block("tray_end", (far, far + rail), (side[0] - rail, side[1] + rail), (0, TRAY_M + 1.5 * r), p.tray_colour)
    _add_wall(block, p)
    stop = p.windows_m[1] + 1.1 * r  # where the block's face is: the ball rests in the window
    across = (-0.8 * r, 0.8 * r) if p.blocked else (1.5 * r, 3.1 * r)
    z = (DECK_M, DECK_M + 1.2 * r) if p.blocked else (0.0, 1.2 * r)
    block("block", (stop, stop + 0.03), across, z, p.block_colour)
    ball = add_ball(spec, "ball", (-d * (p.run_m - 1.3 * r), 0, DECK_M + r), r, p.ball_colour)
    ball.friction = [0.8, 0.005, 1e-4]

    high = DECK_M + 2.2 * r
    ends = sorted((d * p.mouth_m, d * (far + rail)))
    cover = Box(
        (ends[0] - 0.01, front - 0.01, 0),
        (ends[1] + (0.35 * high if d > 0 else 0.01), 3.1 * r + 0.55 * high, high),
    )
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        hidden=("block",),
        cover=cover,
        stage=(
            Box((min(-d * p.run_m, d * far), front, 0), (max(-d * p.run_m, d * far), 3.1 * r, high)),
            Box((min(0, d * p.wall_m), front, 0), (max(0, d * p.wall_m), 0, p.height_m + 0.05)),
        ),
        velocity={"ball": (d * p.speed_m_s, 0.0, 0.0, 0.0, d * p.speed_m_s / r, 0.0)},
        inventory=Inventory(
            (p.ball_colour, p.wall_colour, p.lane_colour, p.tray_colour, p.block_colour),
            ("ball", "wall", "window", "lane", "tray", "block"),
            (f"{p.ball_colour} ball", f"{p.wall_colour} wall", "lane", f"top of the {p.wall_colour} wall"),
        ),
    )


def _add_wall(block: Block, p: Params) -> None:
    """The wall around its two windows, with merlons on top."""
    across = (-p.face_m - WALL_M, -p.face_m)
    lintel = SILL_M + 0.62 * (p.height_m - SILL_M)
    half = p.window_m / 2
    edges = [0.0, *(at + s * half for at in p.windows_m for s in (-1, 1)), p.wall_m]
    block("wall_foot", (0, p.wall_m), across, (0, SILL_M), p.wall_colour)
    block("wall_top", (0, p.wall_m), across, (lintel, p.height_m), p.wall_colour)
    for i in range(0, len(edges), 2):
        block(f"wall_{i}", (edges[i], edges[i + 1]), across, (SILL_M, lintel), p.wall_colour)
    pitch = p.wall_m / (2 * p.merlons - 1)
    for i in range(p.merlons):
        along = (2 * i * pitch, (2 * i + 1) * pitch)
        block(f"merlon_{i}", along, across, (p.height_m, p.height_m + 0.045), p.wall_colour)


def _beyond(motion: Motion, p: Params) -> np.ndarray:
    """How far the rear of the ball is past the far end of the wall (m), shape (F,)."""
    return p.direction * motion.pos("ball")[:, 0] - p.radius_m - p.wall_m


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'yes' from when the ball is wholly past the wall; 'no' from when it is where it stays behind the wall."""
    beyond = _beyond(motion, p)
    if beyond[-1] > 0:
        return ["yes" if x > 0 else None for x in beyond]
    last_moving = int(np.flatnonzero(np.abs(beyond - beyond[-1]) > p.radius_m).max(initial=-1))
    return [None if i <= last_moving else "no" for i in range(len(beyond))]


def margin(motion: Motion, p: Params) -> float:
    """How far the ball ends past the end of the wall, or short of it (m)."""
    beyond = _beyond(motion, p)[-1]
    return float(beyond if beyond > 0 else -beyond - 2 * p.radius_m)


def twins(p: Params) -> list[Params]:
    """The same lane with the block put across it, or taken out of the way."""
    return [replace(p, blocked=not p.blocked)]


QUESTIONS = (
    "Does the {ball} ball come out from behind the {wall} wall at its other end, yes or no?",
    "After it rolls behind the {wall} wall, does the {ball} ball come out on the other side: yes or no?",
    "Does the {ball} ball roll all the way past the {wall} wall and come out at the far end, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Ball and wall are named by their colours, which nothing else has."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(ball=p.ball_colour, wall=p.wall_colour),
        labels=("yes", "no"),
        aliases={
            "it comes out": "yes",
            "yes it comes out": "yes",
            "it comes out at the other end": "yes",
            "it does not come out": "no",
            "no it does not come out": "no",
            "it stays behind the wall": "no",
            "it stops behind the wall": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(3)
    if kind == 0:
        side = "left" if p.direction > 0 else "right"
        question = "From which side does the ball roll towards the wall, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    named, thing = (p.ball_colour, "ball") if kind == 1 else (p.wall_colour, "wall")
    others = [c for c in BALL_COLOURS if c not in (p.ball_colour, p.wall_colour)]
    choices = tuple(str(c) for c in rng.permutation([named, *rng.permutation(others)[:2]]))
    return AnswerableQuestion(f"What colour is the {thing}: {listed(choices)}?", choices, named)


def observe(frames: np.ndarray, question: str) -> str | None:
    """'yes' if the ball ends past the edge of the wall that is farther from where it starts."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = [_ball(frame, values["ball"]) for frame in frames]
    start = next((blob.x for blob in path if blob), None)
    wall, end = largest(frames[-1], values["wall"], 200), path[-1]
    if start is None or wall is None or end is None or not at_rest(path, tolerance_px=4):
        return None
    left, width = wall.box[0], wall.box[2]
    return "yes" if (end.x > left + width if start < wall.x else end.x < left) else "no"


def _ball(frame: np.ndarray, colour: str) -> Blob | None:
    """The region of the ball's colour that is no larger than a ball."""
    found = blobs(colour_mask(frame, colour), 60)
    return next((blob for blob in found if max(blob.box[2:]) < 80), None)


FAMILY = Family(
    name="behind_wall",
    taxonomy="occlusion",
    category="hidden",
    sub_scenario="behind_wall",
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
