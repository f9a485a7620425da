"""A ball runs down a board of pegs to a seesaw above two bins: where does it end?

The ball is thrown up the bare head of the board, curves back over the seesaw and meets the pegs after a second. A
funnel below them leads it onto the seesaw, which tips under it and sheds it into the red bin on the left or the blue
one on the right; a ball that flies past them lies in a grey tray at the side. Control: the whole run. Void: the clip
ends before that. Each peg magnifies a difference in the ball's path about tenfold, so that what no pixel shows at the
cut decides the place. Boards, what stands beside them and the floor differ, so that no two scenes look alike.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from traps_pipeline.scenes.parts.board import WALL_M, Board, camera_elevation, peg_rows, place, turn_quaternion
from traps_pipeline.scenes.parts.course import Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD, extrapolate
from traps_pipeline.scenes.parts.questions import Filled, Question, choice_of, either
from traps_pipeline.scenes.parts.readings import Reading, turns_deg
from traps_pipeline.scenes.parts.vary import Drawn, between, chance, drawn_by, one_of, several_between, shuffled
from traps_pipeline.scenes.parts.vision import Blob, blobs, colour_mask, largest
from traps_pipeline.scenes.physics.kit import (
    Box,
    Inventory,
    Motion,
    Physics,
    Scene,
    View,
    add_box,
    list_choices,
    rgba,
    uniform,
)

SILL_M = 0.03  # below the bins
BIN_M = 0.15  # length of the walls between the bins
BARE_M = 0.02  # strip below their upper end without the bin's colour: what lies in a bin lies well inside
BEAM_M = 0.010  # half the thickness of the seesaw
TIP_M = 0.16  # the lower ends of the funnel over the pivot: a ball passes between them and the seesaw, however it tips
FUNNEL_IN_M = 0.085  # so far they reach in over the bins
STEEP = 1.3  # slope of the funnel
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
ROWS = peg_rows(5, 6)
CRATES = ("grey", "wood", "white", "black")


def _tilt(rng: np.random.Generator, so_far: Drawn) -> float:
    """Draw the tilt, and before it the side on which the ball begins."""
    so_far["side"] = int(rng.choice([-1, 1]))
    return uniform(rng, 31, 35)


def _beam_colour(rng: np.random.Generator, so_far: Drawn) -> str:
    """Draw a colour that stands out against the board and the ball."""
    ball, beams = so_far["ball_colour"], BEAMS[so_far["board_colour"]]
    return str(rng.choice([beam for beam in beams if (ball, beam) not in CLASHES]))


def _start(rng: np.random.Generator, so_far: Drawn) -> float:
    """Draw the start, well inside the frame on the side drawn before."""
    return so_far["side"] * uniform(rng, 0.05, 0.35)


def _push(rng: np.random.Generator, so_far: Drawn) -> float:
    """Draw a push that has the ball over the seesaw after about a second."""
    return round((so_far["trays_m"][0] - so_far["trays_m"][1]) / 2 + uniform(rng, -0.12, 0.12) - so_far["start_m"], 4)


def _rise(rng: np.random.Generator, so_far: Drawn) -> float:
    """Draw a rise that has the ball back at its start after a second, before any peg."""
    slowing = 5 / 7 * 9.81 * math.sin(math.radians(so_far["tilt_deg"]))
    return round(slowing * uniform(rng, 1.0, 1.05) ** 2 / 8, 4)


def _bands(rng: np.random.Generator, so_far: Drawn) -> tuple[float, ...]:
    """Draw two bands, or none."""
    so_far["half_m"] = so_far["bin_m"] + sum(so_far["trays_m"]) / 2
    if so_far["bands"] == "none":
        return ()
    low, high = (-so_far["half_m"], so_far["half_m"]) if so_far["bands"] == "along" else (0.35, 1.5)
    first, second = uniform(rng, low, (low + high) / 2 - 0.1), uniform(rng, (low + high) / 2, high - 0.1)
    return tuple(round(at + width, 3) for at in (first, second) for width in (0, uniform(rng, 0.1, (high - low) / 3)))


def _crates(rng: np.random.Generator, so_far: Drawn) -> tuple[tuple[float, ...], ...]:
    """Draw boxes beside the board: how far across and away, half width and height."""
    crates: list[tuple[float, ...]] = []
    for side in (-1, 1):
        if rng.random() < 0.6:
            half_width, height = uniform(rng, 0.06, 0.16), uniform(rng, 0.05, 0.25)
            distance = uniform(rng, 0.0, 1.0)
            across = side * (so_far["half_m"] + 0.06 + half_width + uniform(rng, 0.0, 0.15))
            crates.append((round(across, 4), distance, half_width, height))
    so_far["crates"] = len(crates)
    return tuple(crates)


@dataclass(frozen=True)
class Params:
    """Parameters; lengths on the board; bins and seesaw are measured from the pivot."""

    rows: int = ROWS()
    peg_gap_m: float = ROWS()  # from peg to peg in a row
    row_shifts_m: tuple[float, ...] = ROWS()  # sideways shift of every row, lowest first
    board_colour: str = one_of(*BALLS)
    tilt_deg: float = drawn_by(_tilt)  # of the board against the floor
    ball_colour: str = drawn_by(lambda rng, so_far: str(rng.choice(BALLS[so_far["board_colour"]])))
    bin_m: float = between(0.36, 0.42)  # width of a coloured bin, from the middle outwards
    trays_m: tuple[float, ...] = several_between(2, 0.09, 0.21)  # width of the trays to the left and to the right
    beam_m: float = drawn_by(  # half the length of the seesaw
        lambda rng, so_far: round(so_far["bin_m"] - uniform(rng, 0.115, 0.145), 4)
    )
    swing_deg: float = between(14, 20)  # how far it tips
    drop_m: float = between(0.015, 0.05)  # from its lower end to the bins: the further, the more balls fly past them
    row_gap_m: float = between(0.092, 0.100)  # from row to row, down the board
    square_pegs: bool = chance(0.35)
    peg_radius_m: float = between(0.011, 0.014)
    ball_radius_m: float = between(0.0355, 0.0375)
    start_m: float = drawn_by(_start)
    push_m_s: float = drawn_by(_push)  # sideways speed
    rise_m: float = drawn_by(_rise)  # how far up the board the throw carries
    beam_colour: str = drawn_by(_beam_colour)
    bands: str = one_of("none", "along", "across")  # in another shade, painted on the board
    bands_m: tuple[float, ...] = drawn_by(_bands)  # from where to where, in turn, from the left or from the sill
    crates_m: tuple[tuple[float, ...], ...] = drawn_by(_crates)
    crate_colours: tuple[str, ...] = shuffled(*CRATES)("crates")
    beside_m: float = between(-0.45, 0.45)  # so much more of the floor is in view to the right, or to the left
    azimuth_deg: float = between(82, 98)
    elevation_deg: float = camera_elevation(-10, 6)

    @property
    def width_m(self) -> float:
        """Inner width of the board."""
        return 2 * self.bin_m + sum(self.trays_m)

    @property
    def middle_m(self) -> float:
        """Position of the pivot across the board."""
        return (self.trays_m[0] - self.trays_m[1]) / 2

    @property
    def rim_m(self) -> float:
        """Height of the bins' openings, measured up the board."""
        return SILL_M + BIN_M

    @property
    def pivot_m(self) -> float:
        """Height of the seesaw's pivot, measured up the board."""
        return self.rim_m + self.beam_m * math.sin(math.radians(self.swing_deg)) + self.drop_m


def build(p: Params, physics: Physics) -> Scene:
    """Build plate, frame, bins and trays with walls between them, seesaw, pegs, ball."""
    board = Board(
        physics,
        tilt_deg=p.tilt_deg,
        width_m=p.width_m,
        ball_radius_m=p.ball_radius_m,
        light=(0.45, 0.45, 0.44),
        bounce=(-20000.0, -8.0),
    )
    lowest = p.pivot_m + TIP_M + 0.03
    *rows, start = [lowest + row * p.row_gap_m for row in range(p.rows + 1)]
    top, side, trim = start + p.rise_m + 2.5 * p.ball_radius_m, board.side, TRIM[p.board_colour]
    SLICK.on(board.block("plate", (-board.outer, board.outer), (SILL_M, top), (-0.02, 0), p.board_colour))
    board.frame(SILL_M, top, trim)
    _paint_bands(board, p, top)
    left, middle, right = p.middle_m - p.bin_m, p.middle_m, p.middle_m + p.bin_m
    edges = pairwise((-side, left, middle, right, side))
    for i, (across, colour) in enumerate(zip(edges, ("grey", "red", "blue", "grey"), strict=True)):
        board.block(f"paint_{i}", across, (SILL_M, p.rim_m - BARE_M), (0, 0.001), colour, solid=False)
    for i, (x, high) in enumerate(((left, p.rim_m), (middle, p.pivot_m - 0.035), (right, p.rim_m))):
        board.divider(i, x, (SILL_M, high), WALL_M / 2, trim)
    _add_seesaw(board, p)
    funnel_end = _add_funnel(board, p, trim)
    board.pegs(rows, p.row_shifts_m, p.peg_gap_m, p.peg_radius_m, trim, square=p.square_pegs, where=funnel_end)
    ball = board.ball("ball", (p.start_m, start), p.ball_colour)
    ball.contype = ball.conaffinity = 3  # the seesaw's 2 as well as the board's 1
    _stand_crates(board, p)
    colours = sorted({"red", "blue", "grey", p.ball_colour, p.board_colour, p.beam_colour, trim, *p.crate_colours})
    nouns = ["ball", "board", "peg", "seesaw", "bin", "tray", "wall"]
    outer_x, (sill, head) = p.beside_m + math.copysign(board.outer, p.beside_m), board.ends(top)
    beside_box = Box((outer_x, sill.low[1], sill.low[2]), (outer_x, sill.low[1], sill.low[2]))
    return Scene(
        spec=board.spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        framed=(sill, head, beside_box),
        rest=board.region((SILL_M, p.rim_m), board.deep),
        velocity={"ball": board.throw(p.push_m_s, p.rise_m)},
        inventory=Inventory(tuple(colours), (*nouns, *(["box", "crate"] if p.crates_m else []))),
    )


def _add_funnel(board: Board, p: Params, colour: str) -> Callable[[float, float], bool]:
    """Add two slanted bars; return whether a ball passes them by a peg at a place."""
    tip = p.pivot_m + TIP_M
    foot_positions = [p.bin_m - FUNNEL_IN_M + side * p.middle_m for side in (-1, 1)]
    for name, side, foot in zip(("funnel_left", "funnel_right"), (-1, 1), foot_positions, strict=True):
        a, b = np.array([side * foot, tip]), np.array([side * board.side, tip + STEEP * (board.side - foot)])
        middle, along = (a + b) / 2, b - a
        bar = board.block(name, (-1e-3, 1e-3), (-1e-3, 1e-3), (0, board.deep), colour)
        bar.pos = [float(middle[0]), float(middle[1]), board.deep / 2]
        bar.size = [float(np.hypot(*along)) / 2, WALL_M / 2, board.deep / 2]
        bar.quat = turn_quaternion(math.atan2(along[1], along[0]), 3)
        SLICK.on(bar)

    def has_room(across: float, up: float) -> bool:
        foot = foot_positions[0] if across < 0 else foot_positions[1]
        high = tip + STEEP * (board.side - foot) + p.ball_radius_m
        return up > high or foot + (up - tip) / STEEP - abs(across) - p.peg_radius_m > 2.9 * p.ball_radius_m

    return has_room


def _paint_bands(board: Board, p: Params, top: float) -> None:
    """Paint two bands of another shade on the plate."""
    for i, (low, high) in enumerate(zip(p.bands_m[::2], p.bands_m[1::2], strict=True)):
        across, up = (
            ((low, min(high, board.side)), (SILL_M, top))
            if p.bands == "along"
            else ((-board.side, board.side), (low, min(high, top)))
        )
        if up[1] > up[0]:
            band = board.block(f"band_{i}", across, up, (0, 0.0005), p.board_colour, solid=False)
            band.rgba = [*(np.array(band.rgba[:3]) * 0.72 + (0.16 if p.board_colour == "black" else 0)), 1]


def _stand_crates(board: Board, p: Params) -> None:
    """Stand boxes without contact on the floor beside the board."""
    for i, (colour, (across, distance, half_width, height)) in enumerate(zip(p.crate_colours, p.crates_m, strict=True)):
        at = (across, distance, height)
        add_box(
            board.spec.worldbody, f"crate_{i}", at, (half_width, half_width, height), colour, contype=0, conaffinity=0
        )


def _add_seesaw(board: Board, p: Params) -> None:
    """Add a beam on a pivot that touches only the ball; a weak spring levels it."""
    import mujoco

    half_deep = board.deep / 2
    body = board.body.add_body(name="seesaw", pos=[p.middle_m, p.pivot_m, half_deep])
    joint = body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
    joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_TRUE, [-p.swing_deg, p.swing_deg]
    joint.damping, joint.stiffness = [0.006, 0, 0], [0.03, 0, 0]
    half_size = (p.beam_m, BEAM_M, half_deep - 0.004)
    SLICK.on(add_box(body, "seesaw", (0, 0, 0), half_size, p.beam_colour, density=300.0, contype=2, conaffinity=2))
    pivot = body.add_geom(name="pivot", type=mujoco.mjtGeom.mjGEOM_CYLINDER, rgba=rgba(p.beam_colour))
    pivot.size, pivot.pos, pivot.contype, pivot.conaffinity = [0.018, half_deep, 0], [0, -BEAM_M, 0], 2, 2


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the bin that the ball is in, or elsewhere for a tray; None above the bins."""
    across, up = place(motion, "ball", p.tilt_deg)
    across = across - p.middle_m
    names = np.where(np.abs(across) > p.bin_m, "elsewhere", np.where(across < 0, "left", "right"))
    labels = [str(name) if u < p.rim_m - BARE_M else None for name, u in zip(names, up, strict=True)]
    offset_m = abs(float(across[-1]))  # from the middle wall, which only a ball in a bin could have missed
    margin = min(abs(offset_m - p.bin_m), offset_m if offset_m < p.bin_m else math.inf, p.rim_m - float(up[-1]))
    return Reading(labels, margin, turns_deg=turns_deg(motion.rot("seesaw")))


def _places(p: Params, rng: np.random.Generator) -> Filled:
    """Return the choices: the two bins, in either order, and the rest of the board."""
    order = (*rng.permutation(["left", "right"]), "elsewhere")
    forms = ("{0} bin", "{1}", "{1} bin", "in the {0} bin", "in the {1} bin", "the {0} bin", "{0} bin ({1})")
    aliases = {f.format(*side): side[0] for side in (("left", "red"), ("right", "blue")) for f in forms}
    forms = ("other", "tray", "grey", "grey tray", "side tray", "in a grey tray", "in the grey tray")
    aliases |= dict.fromkeys(forms, "elsewhere") | {text: label for label, text in CHOICES.items()}
    return Filled(tuple(CHOICES), aliases, {"choices": list_choices([CHOICES[str(label)] for label in order])})


PAST_PEGS = 1.2  # bin widths above the bins: so low a ball has at most one row of pegs before it


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return the bin or tray of the resting ball, or where it falls; None above them."""
    red, blue = largest(frames[0], "red", 300), largest(frames[0], "blue", 300)
    if red is None or blue is None or blue.x <= red.x or not any(slots["ball"] in pool for pool in BALLS.values()):
        return None
    path = [_ball(frame, frames[0], slots["ball"]) for frame in frames[-3:]]
    places = {_bin_of(ball, red, blue) for ball in path}
    place_seen = places.pop() if len(places) == 1 else None
    return _predict_bin(path, red, blue) if place_seen is None else place_seen


def _predict_bin(path: Sequence[Blob | None], red: Blob, blue: Blob) -> str | None:
    """Return where a ball past the pegs goes by the seesaw's side; None before."""
    now, later_blob = extrapolate(path, 0.0), extrapolate(path, AHEAD)
    if now is None or later_blob is None:
        return None
    middle, along = np.array([red.x + blue.x, red.y + blue.y]) / 2, np.array([blue.x - red.x, blue.y - red.y])
    bin_px = float(np.linalg.norm(along))  # from the middle of one bin to that of the other: as wide as each is
    along = along / bin_px
    height_in_bins = (along[1] * (now.x - middle[0]) - along[0] * (now.y - middle[1])) / bin_px
    if not 0 < height_in_bins < PAST_PEGS:
        return None
    offset_in_bins = (np.array([later_blob.x, later_blob.y]) - middle) @ along / bin_px
    return "elsewhere" if abs(offset_in_bins) > 1 else "right" if offset_in_bins > 0 else "left"


def _ball(frame: np.ndarray, first: np.ndarray, colour: str) -> Blob | None:
    """Return the largest region that got the ball's colour since the first frame."""
    mask_before = cv2.dilate(colour_mask(first, colour).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return next(iter(blobs(colour_mask(frame, colour) & ~mask_before, 40)), None)


def _bin_of(ball: Blob | None, red: Blob, blue: Blob) -> str | None:
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
        either("How many rows of pegs are above the seesaw, 5 or 6?", ("5", "6"), lambda p: str(p.rows)),
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
    perturbation=6e-4,
    looks=("bystanders", "floor", "light", "material", "panel"),
)
