"""A ball runs down a tilted board of pegs towards a seesaw above two coloured bins; the question is where it ends up.

The ball is thrown up the bare head of the board, curves back and meets the pegs after about a second. The seesaw tips
under it and sheds it into the red bin on the left or the blue one on the right; a ball that misses them lies in a grey
tray at the side. Control: the whole run. Void: the clip ends before that. Each peg magnifies a difference in the
ball's path about tenfold, so that what no pixel shows at the cut decides the place.
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
    listed,
    new_spec,
    rgba,
    uniform,
)
from traps_pipeline.scenes.vision import Blob, blobs, colour_mask, largest
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
LIFT_M = 0.12  # height of the board's lower edge above the floor
SILL_M = 0.03  # below the bins
BIN_M = 0.17  # length of the walls between the bins
BARE_M = 0.02  # strip below their upper end without the bin's colour: what lies in a bin lies well inside
WALL_M = 0.008  # half the thickness of the walls
BEAM_M = 0.010  # half the thickness of the seesaw
GLASS_GAP_M = 0.006  # play of the ball under the glass that keeps it on the board
BOUNCE = (-20000.0, -8.0)  # direct stiffness and damping of the pegs: a lively ball
SLICK = (0.5, 0.0003, 0.0002)  # little resistance to turning on the spot, as a ball that rolls on the seesaw does
# Boards, and the balls and seesaws that stand out against them. Red, blue and grey belong to the bins and trays.
BALLS = {
    "wood": ("white", "black", "green"),
    "white": ("black", "green", "purple"),
    "green": ("white", "black", "yellow"),
    "purple": ("white", "black", "yellow"),
    "black": ("white", "yellow", "green"),
}
BEAMS = {
    "wood": ("purple", "cyan"),
    "white": ("orange", "cyan"),
    "green": ("orange", "purple"),
    "purple": ("orange", "cyan"),
    "black": ("orange", "cyan", "purple"),
}
CLASHES = {("yellow", "orange"), ("green", "cyan"), ("purple", "purple")}  # ball and seesaw
TRIM = {"wood": "grey", "white": "wood", "green": "wood", "purple": "grey", "black": "grey"}  # frame, walls and pegs
LABELS = ("left", "right", "elsewhere")


@dataclass(frozen=True)
class Params:
    """Lengths are measured on the board; sideways ones from its middle."""

    width_m: float  # inside of the board
    bin_m: float  # width of a coloured bin, from the middle outwards
    beam_m: float  # half the length of the seesaw
    swing_deg: float  # how far it tips
    rows: int
    row_gap_m: float  # from row to row, down the board
    peg_gap_m: float  # from peg to peg in a row
    row_shifts_m: tuple[float, ...]  # sideways shift of every row, lowest first
    square_pegs: bool
    peg_radius_m: float
    tilt_deg: float  # of the board against the floor
    ball_radius_m: float
    ball_colour: str
    start_m: float
    push_m_s: float  # sideways speed
    rise_m: float  # how far up the board the throw carries
    board_colour: str
    beam_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def rim_m(self) -> float:
        """Where the bins open, measured up the board."""
        return SILL_M + BIN_M

    @property
    def pivot_m(self) -> float:
        """Where the seesaw turns, measured up the board: its lower end just clears the bins."""
        return self.rim_m + self.beam_m * math.sin(math.radians(self.swing_deg)) + 0.025

    @property
    def pegs_m(self) -> float:
        """Where the lowest row of pegs is, measured up the board."""
        return self.pivot_m + 0.075 + 2.4 * self.ball_radius_m

    @property
    def launch_m(self) -> float:
        """Where the ball starts, above the top row of pegs, measured up the board."""
        return self.pegs_m + self.rows * self.row_gap_m

    @property
    def height_m(self) -> float:
        """Length of the board, up its slope."""
        return self.launch_m + self.rise_m + 2.5 * self.ball_radius_m


def draw(rng: np.random.Generator) -> Params:
    """Staggered or skewed rows of round or square pegs; the throw crosses the middle from either side."""
    rows, peg_gap = int(rng.integers(4, 7)), uniform(rng, 0.126, 0.140)
    skew = uniform(rng, -0.15, 0.15) if rng.random() < 0.5 else 0.0
    shifts = tuple(round(peg_gap * (i % 2 / 2 + i * skew + float(rng.normal(0, 0.04))), 4) for i in range(rows))
    board, side, tilt = str(rng.choice(list(BALLS))), int(rng.choice([-1, 1])), uniform(rng, 24, 31)
    ball = str(rng.choice(BALLS[board]))
    bin_width = uniform(rng, 0.29, 0.33)
    return Params(
        width_m=uniform(rng, 1.15, 1.30),
        bin_m=bin_width,
        beam_m=round(bin_width - uniform(rng, 0.10, 0.12), 4),
        swing_deg=uniform(rng, 14, 20),
        rows=rows,
        row_gap_m=uniform(rng, 0.092, 0.100),
        peg_gap_m=peg_gap,
        row_shifts_m=shifts,
        square_pegs=bool(rng.random() < 0.35),
        peg_radius_m=uniform(rng, 0.012, 0.016),
        tilt_deg=tilt,
        ball_radius_m=uniform(rng, 0.0345, 0.037),
        ball_colour=ball,
        start_m=round(side * uniform(rng, 0.05, 0.40), 4),
        push_m_s=round(-side * uniform(rng, 0.05, 0.45), 4),
        rise_m=uniform(rng, 0.26, 0.36),
        board_colour=board,
        beam_colour=str(rng.choice([c for c in BEAMS[board] if (ball, c) not in CLASHES])),
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
    deep, side, top, frame = 2 * p.ball_radius_m + GLASS_GAP_M, p.width_m / 2, p.height_m, TRIM[p.board_colour]
    outer = side + 2 * WALL_M

    def block(name: str, x: Span, up: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        centre = [sum(x) / 2, sum(up) / 2, sum(z) / 2]
        return add_box(board, name, centre, [(x[1] - x[0]) / 2, (up[1] - up[0]) / 2, (z[1] - z[0]) / 2], colour)

    plate = block("plate", (-outer, outer), (SILL_M, top), (-0.02, 0), p.board_colour)
    plate.friction, plate.condim, plate.priority = list(SLICK), 6, 1
    block("sill", (-outer, outer), (SILL_M - 2 * WALL_M, SILL_M), (0, deep), frame)
    block("head", (-outer, outer), (top, top + 2 * WALL_M), (0, deep), frame)
    block("left", (-outer, -side), (SILL_M, top), (0, deep), frame)
    block("right", (side, outer), (SILL_M, top), (0, deep), frame)
    glass = block("glass", (-outer, outer), (SILL_M, top), (deep, deep + 0.02), "white")
    glass.rgba, glass.friction, glass.priority = [1, 1, 1, 0], [0, 0, 0], 1  # never drawn
    edges = (-side, -p.bin_m, 0.0, p.bin_m, side)
    for i, (low, high, colour) in enumerate(zip(edges, edges[1:], ("grey", "red", "blue", "grey"), strict=False)):
        paint = block(f"paint_{i}", (low, high), (SILL_M, p.rim_m - BARE_M), (0, 0.001), colour)
        paint.contype = paint.conaffinity = 0
    for i, (x, high) in enumerate(((-p.bin_m, p.rim_m), (0.0, p.pivot_m - 0.035), (p.bin_m, p.rim_m))):
        block(f"wall_{i}", (x - WALL_M / 2, x + WALL_M / 2), (SILL_M, high), (0, deep), frame)
        _add_post(board, p, f"tip_{i}", (x, high), WALL_M / 2, square=True)  # a flat end could hold a ball
    _add_seesaw(board, p, deep)
    for row, shift in enumerate(p.row_shifts_m):
        for x in _row(p, shift):
            name = f"peg_{row}_{round((x - shift) / p.peg_gap_m) + 20}"
            _add_post(board, p, name, (x, p.pegs_m + row * p.row_gap_m), p.peg_radius_m, square=p.square_pegs)
    centre = up * p.launch_m + normal * p.ball_radius_m + np.array([p.start_m, 0, LIFT_M])
    ball = add_ball(spec, "ball", centre.tolist(), p.ball_radius_m, p.ball_colour)
    ball.friction = [0.5, 0.005, 0.0002]
    ball.contype = ball.conaffinity = 3
    ends = [(-outer, *(up * s)[1:]) for s in (0.0, top + 2 * WALL_M)]
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        stage=tuple(Box((-outer, y, z + LIFT_M), (outer, y, z + LIFT_M)) for _, y, z in ends),
        velocity={"ball": _throw(p, physics)},
        inventory=_inventory(p),
    )


def _slope(p: Params) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors up the board and out of it."""
    tilt = math.radians(p.tilt_deg)
    return np.array([0, math.cos(tilt), math.sin(tilt)]), np.array([0, -math.sin(tilt), math.cos(tilt)])


def _throw(p: Params, physics: Physics) -> tuple[float, ...]:
    """Velocity of a ball that rolls, without slipping, just so far up the slope as `rise_m` says."""
    up, normal = _slope(p)
    slowing = 5 / 7 * physics.gravity_m_s2 * math.sin(math.radians(p.tilt_deg))
    velocity = up * math.sqrt(2 * slowing * p.rise_m) + np.array([p.push_m_s, 0, 0])
    return (*velocity.tolist(), *(np.cross(normal, velocity) / p.ball_radius_m).tolist())


def _row(p: Params, shift: float) -> list[float]:
    """Pegs from wall to wall, without those that leave a ball just enough room to jam at a side wall."""
    reach = p.width_m / 2 - p.peg_radius_m
    places = [shift + k * p.peg_gap_m for k in range(-20, 21)]
    rooms = [reach - abs(x) for x in places]
    jam = (0.4 * p.ball_radius_m, 2.3 * p.ball_radius_m)
    return [x for x, room in zip(places, rooms, strict=True) if room >= 0 and not jam[0] < room < jam[1]]


def _add_post(
    board: mujoco.MjsBody, p: Params, name: str, centre: tuple[float, float], radius: float, *, square: bool
) -> None:
    """A lively post from the board to the glass: round, or square with a corner up so that nothing rests on it."""
    import mujoco

    half = p.ball_radius_m + GLASS_GAP_M / 2
    post = board.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX if square else mujoco.mjtGeom.mjGEOM_CYLINDER,
        pos=[*centre, half],
        size=[radius, radius if square else half, half],
        rgba=rgba(TRIM[p.board_colour]),
    )
    post.solref, post.priority, post.condim, post.friction = list(BOUNCE), 1, 6, [0.3, 0.002, 0.0001]
    if square:
        post.quat = [math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)]


def _add_seesaw(board: mujoco.MjsBody, p: Params, deep: float) -> None:
    """A beam on a pivot in its middle that touches nothing but the ball; a weak spring levels it."""
    import mujoco

    body = board.add_body(name="seesaw", pos=[0, p.pivot_m, deep / 2])
    joint = body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
    joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_TRUE, [-p.swing_deg, p.swing_deg]
    joint.damping, joint.stiffness = [0.006, 0, 0], [0.03, 0, 0]
    half = [p.beam_m, BEAM_M, deep / 2 - 0.004]
    beam = add_box(body, "seesaw", [0, 0, 0], half, p.beam_colour, density=300.0, contype=2, conaffinity=2)
    beam.friction, beam.condim, beam.priority = list(SLICK), 6, 1
    pivot = body.add_geom(
        name="pivot", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.018, deep / 2, 0], rgba=rgba(p.beam_colour)
    )
    pivot.pos, pivot.contype, pivot.conaffinity = [0, -BEAM_M, 0], 2, 2


def _place(motion: Motion, p: Params) -> tuple[np.ndarray, np.ndarray]:
    """The ball's place across and up the board (m), each (F,)."""
    position = motion.pos("ball") - np.array([0, 0, LIFT_M])
    return position[:, 0], position @ _slope(p)[0]


def readings(motion: Motion, p: Params) -> list[str | None]:
    """The bin that the ball's centre is in, or elsewhere for a tray at the side; None above the bins."""
    across, up = _place(motion, p)
    names = np.where(np.abs(across) > p.bin_m, "elsewhere", np.where(across < 0, "left", "right"))
    return [str(name) if u < p.rim_m - BARE_M else None for name, u in zip(names, up, strict=True)]


def margin(motion: Motion, p: Params) -> float:
    """How far the ball's centre is at the end from where another place begins: a wall or the bins' rim (m)."""
    across, up = (float(values[-1]) for values in _place(motion, p))
    return min(abs(abs(across) - p.bin_m), abs(across) if abs(across) < p.bin_m else math.inf, p.rim_m - up)


QUESTIONS = (
    "Where does the {ball} ball end up: {choices}?",
    "Once the seesaw has tipped, where does the {ball} ball come to rest: {choices}?",
    "Which place does the {ball} ball finish in after the seesaw: {choices}?",
)
CHOICES = {"left": "in the left bin (red)", "right": "in the right bin (blue)", "elsewhere": "somewhere else"}


def _inventory(p: Params) -> Inventory:
    colours = sorted({"red", "blue", "grey", p.ball_colour, p.board_colour, p.beam_colour, TRIM[p.board_colour]})
    return Inventory(tuple(colours), ("ball", "board", "peg", "seesaw", "bin", "tray", "wall"))


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The choices are the two bins, in either order, and the rest of the board."""
    order = (*rng.permutation(LABELS[:2]), "elsewhere")
    aliases = {}
    for label, colour in (("left", "red"), ("right", "blue")):
        forms = ("{0} bin", "{1}", "{1} bin", "in the {0} bin", "in the {1} bin", "the {0} bin", "{0} bin ({1})")
        aliases |= {form.format(label, colour): label for form in forms} | {CHOICES[label]: label}
    forms = ("somewhere else", "other", "tray", "grey", "grey tray", "side tray", "in a grey tray", "in the grey tray")
    aliases |= dict.fromkeys(forms, "elsewhere")
    choices = listed([CHOICES[str(label)] for label in order])
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(choices=choices, ball=p.ball_colour),
        labels=LABELS,
        aliases=aliases,
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(4)
    if kind == 0:
        counts = ("4", "5", "6")
        return AnswerableQuestion(f"How many rows of pegs are above the seesaw, {listed(counts)}?", counts, str(p.rows))
    if kind == 1:
        return AnswerableQuestion(
            "Are the pegs round or square?", ("round", "square"), "square" if p.square_pegs else "round"
        )
    if kind == 2:
        side = "left" if p.start_m < 0 else "right"
        return AnswerableQuestion(
            "In which half of the board is the ball when the clip begins, left or right?", ("left", "right"), side
        )
    others = [c for c in ("orange", "cyan", "purple") if c != p.beam_colour]
    choices = tuple(str(c) for c in rng.permutation([p.beam_colour, *others]))
    return AnswerableQuestion(f"What colour is the seesaw: {listed(choices)}?", choices, p.beam_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """In which painted bin or tray the ball lies at the end, by the middle line of the red and the blue one; None
    while it is above that line."""
    values = asked(QUESTIONS, question)
    if values is None or values["ball"] not in {ball for balls in BALLS.values() for ball in balls}:
        return None
    red, blue = largest(frames[0], "red", 300), largest(frames[0], "blue", 300)
    if red is None or blue is None or blue.x <= red.x:
        return None
    places = {_lies(_ball(frame, frames[0], values["ball"]), red, blue) for frame in frames[-3:]}
    return places.pop() if len(places) == 1 else None


def _ball(frame: np.ndarray, first: np.ndarray, colour: str) -> Blob | None:
    """The largest region of the ball's colour that was not of that colour in the first frame."""
    before = cv2.dilate(colour_mask(first, colour).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return next(iter(blobs(colour_mask(frame, colour) & ~before, 40)), None)


def _lies(ball: Blob | None, red: Blob, blue: Blob) -> str | None:
    """The place of a ball by its pixels."""
    if ball is None or ball.y < red.y + (ball.x - red.x) * (blue.y - red.y) / (blue.x - red.x):
        return None
    if red.box[0] < ball.x < (red.x + blue.x) / 2:
        return "left"
    return "right" if (red.x + blue.x) / 2 <= ball.x < blue.box[0] + blue.box[2] else "elsewhere"


FAMILY = Family(
    name="seesaw_sorter",
    taxonomy="chaotic",
    category="seesaw_sorter",
    sub_scenario="seesaw",
    answer_type="direction",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    observe=observe,
    min_margin_m=0.01,
    perturbation=1e-4,
)
