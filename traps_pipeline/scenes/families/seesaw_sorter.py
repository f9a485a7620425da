"""A ball runs down a tilted board of pegs towards a seesaw above two coloured bins; the question is where it ends up.

The ball is thrown up the bare head of the board, curves back and meets the pegs after about a second. Where it strikes
the seesaw, this tips and sheds it into the red bin on the left or the blue one on the right; a ball that misses them
lies in a grey tray at the side. Control: the whole run. Void: the clip ends before that. Each peg magnifies a
difference in the ball's path about tenfold, so that what no pixel shows at the cut decides the place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from traps_pipeline.scenes.kit import Inventory, Motion, Physics, Scene, View, add_box, listed, rgba, uniform
from traps_pipeline.scenes.parts.board import WALL_M, Board, looking_on, peg_rows, place
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.outcome import Reading
from traps_pipeline.scenes.parts.questions import Filled, Question, choice_of, either
from traps_pipeline.scenes.parts.stage import Surface
from traps_pipeline.scenes.parts.vary import Drawn, between, chance, drawn_by, one_of
from traps_pipeline.scenes.vision import Blob, blobs, colour_mask, largest

SILL_M = 0.03  # below the bins
BIN_M = 0.17  # length of the walls between the bins
BARE_M = 0.02  # strip below their upper end without the bin's colour: what lies in a bin lies well inside
BEAM_M = 0.010  # half the thickness of the seesaw
SLICK = Surface(2e-4, sliding=0.5, spinning=3e-4)  # little resistance to turning, as a ball on the seesaw does
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
CHOICES = {"left": "in the left bin (red)", "right": "in the right bin (blue)", "elsewhere": "somewhere else"}
ROWS = peg_rows(4, 6)


def _tilt(rng: np.random.Generator, so_far: Drawn) -> float:
    """Before it, the side from which the ball crosses the middle: start and push follow from that."""
    so_far["side"] = int(rng.choice([-1, 1]))
    return uniform(rng, 24, 31)


def _beam_colour(rng: np.random.Generator, so_far: Drawn) -> str:
    """One that stands out against the board and the ball."""
    ball, beams = so_far["ball_colour"], BEAMS[so_far["board_colour"]]
    return str(rng.choice([beam for beam in beams if (ball, beam) not in CLASHES]))


@dataclass(frozen=True)
class Params:
    """Lengths are measured on the board; sideways ones from its middle."""

    rows: int = ROWS()
    peg_gap_m: float = ROWS()  # from peg to peg in a row
    row_shifts_m: tuple[float, ...] = ROWS()  # sideways shift of every row, lowest first
    board_colour: str = one_of(*BALLS)
    tilt_deg: float = drawn_by(_tilt)  # of the board against the floor
    ball_colour: str = drawn_by(lambda rng, so_far: str(rng.choice(BALLS[so_far["board_colour"]])))
    bin_m: float = between(0.29, 0.33)  # width of a coloured bin, from the middle outwards
    width_m: float = between(1.15, 1.30)  # inside of the board
    beam_m: float = drawn_by(  # half the length of the seesaw
        lambda rng, so_far: round(so_far["bin_m"] - uniform(rng, 0.10, 0.12), 4)
    )
    swing_deg: float = between(14, 20)  # how far it tips
    row_gap_m: float = between(0.092, 0.100)  # from row to row, down the board
    square_pegs: bool = chance(0.35)
    peg_radius_m: float = between(0.012, 0.016)
    ball_radius_m: float = between(0.0345, 0.037)
    start_m: float = drawn_by(lambda rng, so_far: so_far["side"] * uniform(rng, 0.05, 0.40))
    push_m_s: float = drawn_by(lambda rng, so_far: -so_far["side"] * uniform(rng, 0.05, 0.45))  # sideways speed
    rise_m: float = between(0.26, 0.36)  # how far up the board the throw carries
    beam_colour: str = drawn_by(_beam_colour)
    azimuth_deg: float = between(86, 94)
    elevation_deg: float = looking_on(-6, 6)

    @property
    def rim_m(self) -> float:
        """Where the bins open, measured up the board."""
        return SILL_M + BIN_M

    @property
    def pivot_m(self) -> float:
        """Where the seesaw turns, measured up the board: its lower end just clears the bins."""
        return self.rim_m + self.beam_m * math.sin(math.radians(self.swing_deg)) + 0.025


def build(p: Params, physics: Physics) -> Scene:
    """Plate, frame, bins and trays with walls between them, seesaw, pegs, ball."""
    board = Board(
        physics,
        tilt_deg=p.tilt_deg,
        width_m=p.width_m,
        ball_radius_m=p.ball_radius_m,
        light=(0.45, 0.45, 0.44),
        bounce=(-20000.0, -8.0),
    )
    lowest = p.pivot_m + 0.075 + 2.4 * p.ball_radius_m
    *rows, start = [lowest + row * p.row_gap_m for row in range(p.rows + 1)]
    top, side, trim = start + p.rise_m + 2.5 * p.ball_radius_m, board.side, TRIM[p.board_colour]
    SLICK.on(board.block("plate", (-board.outer, board.outer), (SILL_M, top), (-0.02, 0), p.board_colour))
    board.frame(SILL_M, top, trim)
    edges = pairwise((-side, -p.bin_m, 0.0, p.bin_m, side))
    for i, (across, colour) in enumerate(zip(edges, ("grey", "red", "blue", "grey"), strict=True)):
        board.block(f"paint_{i}", across, (SILL_M, p.rim_m - BARE_M), (0, 0.001), colour, solid=False)
    for i, (x, high) in enumerate(((-p.bin_m, p.rim_m), (0.0, p.pivot_m - 0.035), (p.bin_m, p.rim_m))):
        board.divider(i, x, (SILL_M, high), WALL_M / 2, trim)
    _add_seesaw(board, p)
    board.pegs(rows, p.row_shifts_m, p.peg_gap_m, p.peg_radius_m, trim, square=p.square_pegs)
    ball = board.ball("ball", (p.start_m, start), p.ball_colour)
    ball.contype = ball.conaffinity = 3  # the seesaw's 2 as well as the board's 1
    colours = sorted({"red", "blue", "grey", p.ball_colour, p.board_colour, p.beam_colour, trim})
    return Scene(
        spec=board.spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        stage=board.ends(top),
        velocity={"ball": board.throw(p.push_m_s, p.rise_m)},
        inventory=Inventory(tuple(colours), ("ball", "board", "peg", "seesaw", "bin", "tray", "wall")),
    )


def _add_seesaw(board: Board, p: Params) -> None:
    """A beam on a pivot in its middle that touches nothing but the ball; a weak spring levels it."""
    import mujoco

    half_deep = board.deep / 2
    body = board.body.add_body(name="seesaw", pos=[0, p.pivot_m, half_deep])
    joint = body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
    joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_TRUE, [-p.swing_deg, p.swing_deg]
    joint.damping, joint.stiffness = [0.006, 0, 0], [0.03, 0, 0]
    half = (p.beam_m, BEAM_M, half_deep - 0.004)
    SLICK.on(add_box(body, "seesaw", (0, 0, 0), half, p.beam_colour, density=300.0, contype=2, conaffinity=2))
    pivot = body.add_geom(name="pivot", type=mujoco.mjtGeom.mjGEOM_CYLINDER, rgba=rgba(p.beam_colour))
    pivot.size, pivot.pos, pivot.contype, pivot.conaffinity = [0.018, half_deep, 0], [0, -BEAM_M, 0], 2, 2


def outcome(motion: Motion, p: Params) -> Reading:
    """The bin that the ball's centre is in, or elsewhere for a tray at the side; None above the bins. The margin is how
    far that centre ends from where another place begins: a wall or the bins' rim."""
    across, up = place(motion, "ball", p.tilt_deg)
    names = np.where(np.abs(across) > p.bin_m, "elsewhere", np.where(across < 0, "left", "right"))
    labels = [str(name) if u < p.rim_m - BARE_M else None for name, u in zip(names, up, strict=True)]
    off = abs(float(across[-1]))  # from the middle wall, which only a ball in a bin could have missed
    return Reading(labels, min(abs(off - p.bin_m), off if off < p.bin_m else math.inf, p.rim_m - float(up[-1])))


def _places(p: Params, rng: np.random.Generator) -> Filled:
    """The choices are the two bins, in either order, and the rest of the board."""
    order = (*rng.permutation(["left", "right"]), "elsewhere")
    forms = ("{0} bin", "{1}", "{1} bin", "in the {0} bin", "in the {1} bin", "the {0} bin", "{0} bin ({1})")
    aliases = {f.format(*side): side[0] for side in (("left", "red"), ("right", "blue")) for f in forms}
    forms = ("other", "tray", "grey", "grey tray", "side tray", "in a grey tray", "in the grey tray")
    aliases |= dict.fromkeys(forms, "elsewhere") | {text: label for label, text in CHOICES.items()}
    return Filled(tuple(CHOICES), aliases, {"choices": listed([CHOICES[str(label)] for label in order])})


def observe(frames: np.ndarray, named: Mapping[str, str]) -> str | None:
    """In which painted bin or tray the ball lies at the end, by the middle line of the red and the blue one; None
    while it is above that line."""
    red, blue = largest(frames[0], "red", 300), largest(frames[0], "blue", 300)
    if red is None or blue is None or blue.x <= red.x or not any(named["ball"] in pool for pool in BALLS.values()):
        return None
    places = {_lies(_ball(frame, frames[0], named["ball"]), red, blue) for frame in frames[-3:]}
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


FAMILY = scene_family(
    "seesaw_sorter",
    category="seesaw_sorter",
    sub_scenario="seesaw",
    params=Params,
    build=build,
    outcome=outcome,
    question=Question(
        "direction",
        (
            "Where does the {ball} ball end up: {choices}?",
            "At the bottom of the board, where does the {ball} ball come to rest: {choices}?",
            "Which place does the {ball} ball finish in, past the pegs and the seesaw: {choices}?",
        ),
        _places,
    ),
    asides=[
        either("How many rows of pegs are above the seesaw, 4, 5 or 6?", ("4", "5", "6"), lambda p: str(p.rows)),
        either("Are the pegs round or square?", ("round", "square"), lambda p: "square" if p.square_pegs else "round"),
        either(
            "In which half of the board is the ball when the clip begins, left or right?",
            ("left", "right"),
            lambda p: "left" if p.start_m < 0 else "right",
        ),
        choice_of(
            "What colour is the seesaw: {choices}?",
            choices=lambda p: [p.beam_colour, *(c for c in ("orange", "cyan", "purple") if c != p.beam_colour)],
            answer=lambda p: p.beam_colour,
        ),
    ],
    observe=observe,
    min_margin_m=0.01,
)
