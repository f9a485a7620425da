"""A ball runs down a tilted board of pegs into numbered buckets; the question is into which.

The ball is thrown up the bare head of the board, curves back and meets the pegs after about a second. Control: the
whole run. Void: the clip ends before the buckets. Each peg magnifies a difference in the ball's path about tenfold, so
that what no pixel shows at the cut decides the bucket.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
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
from traps_pipeline.scenes.vision import Blob, blobs, colour_mask
from traps_pipeline.scenes.wording import asked, choices_in

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
LIFT_M = 0.12  # height of the board's lower edge above the floor
APRON_M = 0.175  # strip below the buckets that carries their numbers
BUCKET_M = 0.16  # length of the walls between the buckets
WALL_M = 0.008  # half the thickness of the walls
GLASS_GAP_M = 0.006  # play of the ball under the glass that keeps it on the board
BOUNCE = (-20000.0, -12.0)  # direct stiffness and damping of the pegs: a lively ball
# Boards, and the balls that stand out against them. No ball has a colour of walls, pegs, apron or digits.
SCHEMES = {
    "wood": ("red", "green", "blue", "purple"),
    "white": ("red", "green", "blue", "purple", "orange"),
    "blue": ("red", "yellow", "orange"),
    "green": ("red", "yellow", "purple"),
    "purple": ("green", "yellow", "cyan"),
    "black": ("red", "yellow", "cyan", "orange"),
}
PEGS = {"wood": "grey", "white": "wood", "blue": "cyan", "green": "wood", "purple": "grey", "black": "grey"}
# Which segments a digit lights: a top, b upper right, c lower right, d bottom, e lower left, f upper left, g middle.
SEGMENTS = {1: "bc", 2: "abged", 3: "abgcd", 4: "fgbc", 5: "afgcd", 6: "afgedc", 7: "abc"}
WORDS = ("one", "two", "three", "four", "five", "six", "seven")
ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh")


@dataclass(frozen=True)
class Params:
    """Per ball: colour, start and push; the first ball is the one asked for, a second one is company."""

    buckets: int
    width_m: float  # inside of the board
    rows: int
    row_gap_m: float  # from row to row, down the board
    peg_gap_m: float  # from peg to peg in a row
    row_shifts_m: tuple[float, ...]  # sideways shift of every row, lowest first
    square_pegs: bool
    peg_radius_m: float
    tilt_deg: float  # of the board against the floor
    ball_radius_m: float
    ball_colours: tuple[str, ...]
    starts_m: tuple[float, ...]  # from the middle of the board, sideways
    pushes_m_s: tuple[float, ...]  # sideways speed
    rises_m: tuple[float, ...]  # how far up the board the throw carries
    board_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def pitch_m(self) -> float:
        """Width of a bucket."""
        return self.width_m / self.buckets

    @property
    def rim_m(self) -> float:
        """Where the buckets open, measured up the board."""
        return APRON_M + BUCKET_M

    @property
    def height_m(self) -> float:
        """Length of the board, up its slope."""
        return self.start_m + max(self.rises_m) + 2.5 * self.ball_radius_m

    @property
    def start_m(self) -> float:
        """Where the balls start, above the top row of pegs, measured up the board."""
        return self.rim_m + (self.rows + 0.9) * self.row_gap_m


def draw(rng: np.random.Generator) -> Params:
    """Staggered or skewed rows of round or square pegs; a second ball in two scenes of five."""
    rows, peg_gap = int(rng.integers(5, 8)), uniform(rng, 0.126, 0.140)
    skew = uniform(rng, -0.15, 0.15) if rng.random() < 0.5 else 0.0
    shifts = tuple(round(peg_gap * (i % 2 / 2 + i * skew + float(rng.normal(0, 0.04))), 4) for i in range(rows))
    board = str(rng.choice(list(SCHEMES)))
    balls = 2 if rng.random() < 0.4 else 1
    sides, tilt = rng.permutation([-1, 1]), uniform(rng, 22, 30)
    return Params(
        buckets=int(rng.integers(5, 8)),
        width_m=uniform(rng, 1.15, 1.40),
        rows=rows,
        row_gap_m=uniform(rng, 0.092, 0.100),
        peg_gap_m=peg_gap,
        row_shifts_m=shifts,
        square_pegs=bool(rng.random() < 0.35),
        peg_radius_m=uniform(rng, 0.012, 0.016),
        tilt_deg=tilt,
        ball_radius_m=uniform(rng, 0.0345, 0.037),
        ball_colours=distinct_colours(rng, balls, SCHEMES[board]),
        starts_m=tuple(round(float(sides[i] * rng.uniform(0.12, 0.40)), 4) for i in range(balls)),
        pushes_m_s=tuple(round(float(-sides[i] * rng.uniform(0.1, 0.6)), 4) for i in range(balls)),
        rises_m=tuple(uniform(rng, 0.26, 0.36) for _ in range(balls)),
        board_colour=board,
        azimuth_deg=uniform(rng, 86, 94),
        elevation_deg=uniform(rng, -6, 6) + tilt - 90,
    )


def build(p: Params, physics: Physics) -> Scene:
    """The board is one static body whose y axis runs up the slope and whose z axis stands on it."""
    spec = new_spec(physics)
    spec.visual.quality.numslices = spec.visual.quality.numstacks = 16  # many pegs: half the drawing time
    up, normal = _slope(p)
    light = spec.light("key")  # almost from the front: long shadows of pegs would clutter the board
    light.dir = (-normal + [0.12, 0, 0]).tolist()
    light.castshadow = False
    light.diffuse = [0.45, 0.45, 0.44]  # head-on, the usual key light would bleach the colours
    half_tilt = math.radians(p.tilt_deg) / 2
    board = spec.worldbody.add_body(
        name="board", pos=[0, 0, LIFT_M], quat=[math.cos(half_tilt), math.sin(half_tilt), 0, 0]
    )
    deep, side, top = 2 * p.ball_radius_m + GLASS_GAP_M, p.width_m / 2, p.height_m

    def block(name: str, x: Span, up: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        centre = [sum(x) / 2, sum(up) / 2, sum(z) / 2]
        return add_box(board, name, centre, [(x[1] - x[0]) / 2, (up[1] - up[0]) / 2, (z[1] - z[0]) / 2], colour)

    outer = side + 2 * WALL_M
    frame = "black" if p.board_colour not in ("black", "purple", "blue") else "white"
    block("plate", (-outer, outer), (APRON_M, top), (-0.02, 0), p.board_colour)
    block("apron", (-outer, outer), (0, APRON_M), (-0.02, 0), "white")
    block("sill", (-outer, outer), (APRON_M - 2 * WALL_M, APRON_M), (0, deep), frame)
    block("head", (-outer, outer), (top, top + 2 * WALL_M), (0, deep), frame)
    block("left", (-outer, -side), (APRON_M, top), (0, deep), frame)
    block("right", (side, outer), (APRON_M, top), (0, deep), frame)
    glass = block("glass", (-outer, outer), (APRON_M, top), (deep, deep + 0.02), "white")
    glass.rgba, glass.friction, glass.priority = [1, 1, 1, 0], [0, 0, 0], 1  # never drawn
    for i in range(1, p.buckets):
        x = -side + i * p.pitch_m
        block(f"wall_{i}", (x - WALL_M / 2, x + WALL_M / 2), (APRON_M, p.rim_m), (0, deep), frame)
        _add_post(board, f"tip_{i}", (x, p.rim_m), WALL_M / 2, deep, frame, square=True)  # a flat end could hold a ball
    for i in range(p.buckets):
        _add_digit(board, i + 1, -side + (i + 0.5) * p.pitch_m)
    _add_pegs(board, p, deep)
    for i, (colour, start) in enumerate(zip(p.ball_colours, p.starts_m, strict=True)):
        centre = up * p.start_m + normal * p.ball_radius_m + np.array([start, 0, LIFT_M])
        ball = add_ball(spec, f"ball_{i}", centre.tolist(), p.ball_radius_m, colour)
        ball.friction = [0.5, 0.005, 0.0002]
    ends = [(-outer, *(up * s)[1:]) for s in (0.0, top + 2 * WALL_M)]
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball_0",),
        stage=tuple(Box((-outer, y, z + LIFT_M), (outer, y, z + LIFT_M)) for _, y, z in ends),
        velocity={f"ball_{i}": _throw(p, i, physics) for i in range(len(p.ball_colours))},
        inventory=_inventory(p),
    )


def _slope(p: Params) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors up the board and out of it."""
    tilt = math.radians(p.tilt_deg)
    return np.array([0, math.cos(tilt), math.sin(tilt)]), np.array([0, -math.sin(tilt), math.cos(tilt)])


def _throw(p: Params, ball: int, physics: Physics) -> tuple[float, ...]:
    """Velocity of a ball that rolls, without slipping, just so far up the slope as its `rises_m` says."""
    up, normal = _slope(p)
    slowing = 5 / 7 * physics.gravity_m_s2 * math.sin(math.radians(p.tilt_deg))
    velocity = up * math.sqrt(2 * slowing * p.rises_m[ball]) + np.array([p.pushes_m_s[ball], 0, 0])
    return (*velocity.tolist(), *(np.cross(normal, velocity) / p.ball_radius_m).tolist())


def _add_pegs(board: mujoco.MjsBody, p: Params, deep: float) -> None:
    """Rows of pegs from wall to wall, without those that leave a ball just enough room to jam at a side wall."""
    reach = p.width_m / 2 - p.peg_radius_m
    for row, shift in enumerate(p.row_shifts_m):
        for k in range(-20, 21):
            x = shift + k * p.peg_gap_m
            room = reach - abs(x)
            if room < 0 or 0.4 * p.ball_radius_m < room < 2.3 * p.ball_radius_m:
                continue
            centre = (x, p.rim_m + (row + 0.9) * p.row_gap_m)
            colour = PEGS[p.board_colour]
            _add_post(board, f"peg_{row}_{k + 20}", centre, p.peg_radius_m, deep, colour, square=p.square_pegs)


def _add_post(
    board: mujoco.MjsBody,
    name: str,
    centre: tuple[float, float],
    radius: float,
    deep: float,
    colour: str,
    *,
    square: bool,
) -> None:
    """A lively post from the board to the glass: round, or square with a corner up so that nothing rests on it."""
    import mujoco

    post = board.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX if square else mujoco.mjtGeom.mjGEOM_CYLINDER,
        pos=[*centre, deep / 2],
        size=[radius, radius if square else deep / 2, deep / 2],
        rgba=rgba(colour),
    )
    post.solref, post.priority, post.condim, post.friction = list(BOUNCE), 1, 6, [0.3, 0.002, 0.0001]
    if square:
        post.quat = [math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)]


def _add_digit(board: mujoco.MjsBody, digit: int, x: float) -> None:
    """A seven-segment digit on the apron, drawn only."""
    half, pen = 0.024, 0.007  # half the digit's width, half a stroke
    low, mid, high = 0.025, 0.07, 0.115
    strokes = {
        "a": (0, high, half + pen, pen),
        "g": (0, mid, half + pen, pen),
        "d": (0, low, half + pen, pen),
        "f": (-half, (mid + high) / 2, pen, (high - mid) / 2),
        "b": (half, (mid + high) / 2, pen, (high - mid) / 2),
        "e": (-half, (low + mid) / 2, pen, (mid - low) / 2),
        "c": (half, (low + mid) / 2, pen, (mid - low) / 2),
    }
    for segment in SEGMENTS[digit]:
        right, up, half_x, half_y = strokes[segment]
        name = f"digit_{digit}_{segment}"
        add_box(board, name, [x + right, up, 0.001], [half_x, half_y, 0.002], "black", contype=0, conaffinity=0)


def _place(motion: Motion, p: Params) -> tuple[np.ndarray, np.ndarray]:
    """The asked ball's distance from the left wall and its place up the board (m), each (F,)."""
    position = motion.pos("ball_0") - np.array([0, 0, LIFT_M])
    return position[:, 0] + p.width_m / 2, position @ _slope(p)[0]


def readings(motion: Motion, p: Params) -> list[str | None]:
    """The number of the bucket that the ball's centre is in; None above the buckets."""
    across, up = _place(motion, p)
    bucket = np.clip(across // p.pitch_m, 0, p.buckets - 1).astype(int) + 1
    return [str(b) if u < p.rim_m else None for b, u in zip(bucket, up, strict=True)]


def margin(motion: Motion, p: Params) -> float:
    """How far the ball's centre is at the end from where another bucket begins: its walls or their rim (m)."""
    across, up = (float(values[-1]) for values in _place(motion, p))
    offset = across % p.pitch_m
    return min(offset, p.pitch_m - offset, p.rim_m - up)


QUESTIONS = (
    "In which numbered bucket, {choices} from left to right, does the {ball} ball come to rest?",
    "Which bucket is the {ball} ball in when it stops: {choices}?",
    "What is the number of the bucket that the {ball} ball ends up in: {choices}?",
)


def _inventory(p: Params) -> Inventory:
    frame = {"black", "white"}  # frame, apron, digits
    colours = sorted({*p.ball_colours, p.board_colour, PEGS[p.board_colour], *frame})
    return Inventory(tuple(colours), ("ball", "board", "peg", "bucket", "number", "wall"))


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The choices are the buckets' numbers."""
    labels = tuple(str(i + 1) for i in range(p.buckets))
    aliases = {}
    for label, number, ordinal in zip(labels, WORDS, ORDINALS, strict=False):
        forms = (
            number,
            f"bucket {label}",
            f"bucket {number}",
            f"number {label}",
            f"{ordinal} bucket",
            f"bucket number {label}",
        )
        aliases |= dict.fromkeys(forms, label)
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(choices=listed(labels), ball=p.ball_colours[0]),
        labels=labels,
        aliases=aliases,
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(4)
    if kind == 0:
        counts = ("5", "6", "7")
        return AnswerableQuestion(f"How many numbered buckets are there, {listed(counts)}?", counts, str(p.buckets))
    if kind == 1:
        return AnswerableQuestion("How many balls are on the board, 1 or 2?", ("1", "2"), str(len(p.ball_colours)))
    if kind == 2:
        return AnswerableQuestion(
            "Are the pegs round or square?", ("round", "square"), "square" if p.square_pegs else "round"
        )
    others = [c for c in SCHEMES if c != p.board_colour]
    choices = tuple(str(c) for c in rng.permutation([p.board_colour, *rng.permutation(others)[:2]]))
    return AnswerableQuestion(f"What colour is the board behind the pegs: {listed(choices)}?", choices, p.board_colour)


# In lengths of the apron's lower edge, which is as long as the board is wide (1.18 to 1.43 m): a ball that lies in a
# bucket is 0.15 to 0.18 above that edge (more if it leans on another), one yet to enter a bucket at least 0.23.
IN_BUCKET = 0.222
FRAME = 0.012  # share of that edge below the frame at either side


def observe(frames: np.ndarray, question: str) -> str | None:
    """The bucket above whose share of the apron's lower edge the ball is, if it is low enough to lie in one."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    choices, last = choices_in(values["choices"]), frames[-1]
    ball, edge = _ball(last, values["ball"]), _lower_edge(last)
    if ball is None or edge is None:
        return None
    left, right = edge
    along, offset = right - left, np.array([ball.x, ball.y]) - left
    share = float(offset @ along / (along @ along) - FRAME) / (1 - 2 * FRAME)
    height = float(along[1] * offset[0] - along[0] * offset[1]) / float(along @ along)
    if not (0 < share < 1 and 0 < height < IN_BUCKET):
        return None
    return choices[int(share * len(choices))]


def _ball(frame: np.ndarray, colour: str) -> Blob | None:
    """The largest round thing of a ball's size; None for a colour that no ball has."""
    if not any(colour in pool for pool in SCHEMES.values()):
        return None
    found = blobs(colour_mask(frame, colour), min_area=90)
    return next((b for b in found if b.area < 900 and b.fill > 0.6 and 0.7 < b.box[2] / b.box[3] < 1.4), None)


def _lower_edge(frame: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """The lower left and right corner of the white apron: no white is lower."""
    outlines, _ = cv2.findContours((frame.min(axis=2) > 225).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    large = [outline[:, 0] for outline in outlines if cv2.contourArea(outline) > 1500]
    if not large:
        return None
    points = np.concatenate(large).astype(float)
    return points[np.argmax(points[:, 1] - points[:, 0])], points[np.argmax(points[:, 1] + points[:, 0])]


FAMILY = Family(
    name="plinko",
    taxonomy="chaotic",
    category="plinko",
    sub_scenario="plinko",
    answer_type="numeric",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    observe=observe,
    min_margin_m=0.01,
    perturbation=1e-6,
)
