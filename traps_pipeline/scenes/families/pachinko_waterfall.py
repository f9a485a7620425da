"""Three balls stream down a board of pegs: how many end up in the named zone?

The balls start one behind the other, so that the first meets the pegs after about a second and the others follow.
Control: the whole run, until all three lie in the coloured zones at the bottom. Void: the clip ends before that. Each
peg magnifies a difference in a ball's path about tenfold, so that what no pixel shows at the cut decides the count.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from traps_pipeline.scenes.parts.board import (
    WALL_M,
    Board,
    camera_elevation,
    peg_rows,
    place,
    round_ball,
    turn_quaternion,
)
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.questions import NUMBERS, Filled, Question, choice_of, either
from traps_pipeline.scenes.parts.readings import Reading
from traps_pipeline.scenes.parts.vary import Drawn, between, chance, drawn_by, one_of, together
from traps_pipeline.scenes.parts.vision import Blob, colour_mask
from traps_pipeline.scenes.physics.kit import (
    Inventory,
    Motion,
    Physics,
    Scene,
    View,
    add_box,
    distinct_colours,
    list_choices,
    uniform,
)

SILL_M = 0.03  # below the zones
ZONE_M = 0.19  # length of the walls between the zones
BARE_M = 0.025  # strip below their upper end that has not the zone's colour: what lies in a zone lies well inside
FRICTION = (0.5, 0.0003, 0.0002)  # little resistance to turning on the spot, as a ball in the corner of a shelf does
BALLS = 3
# Boards and the balls that stand out against them; the zones' colours; frame, shelves and pegs of a board. No ball has
# a colour that a zone, a frame or a peg has.
BALL_COLOURS = {
    "wood": ("white", "black", "yellow", "cyan"),
    "grey": ("black", "yellow", "cyan"),
    "white": ("black", "yellow", "cyan"),
    "black": ("white", "yellow", "cyan"),
}
ZONE_COLOURS = ("red", "green", "blue", "purple")
TRIM = {"wood": "grey", "grey": "wood", "white": "wood", "black": "grey"}
LABELS = ("0", "1", "2", "3")


def _sides(rng: np.random.Generator, so_far: Drawn) -> tuple[int, ...]:
    """Draw the balls' sides, all or all but one the same, and their ways on the shelf."""
    side = int(rng.choice([-1, 1]))
    sides = (side,) * BALLS if rng.random() < 0.5 else (side, -side, side)
    ways, gap = {-1: uniform(rng, 0.21, 0.28), 1: uniform(rng, 0.21, 0.28)}, uniform(rng, 0.120, 0.150)
    so_far["ways"] = tuple(round(ways[s] + gap * sides[:i].count(s), 4) for i, s in enumerate(sides))
    return sides


def _zones(rng: np.random.Generator, so_far: Drawn) -> tuple[Any, ...]:
    """Draw widths and colours of two or three zones, and the one that is asked for."""
    zones, width = int(rng.integers(2, 4)), uniform(rng, 1.10, 1.25)
    sides = so_far["sides"]
    fall_at = sides[0] * (width / 2 - 0.52) if len(set(sides)) == 1 else 0.0  # about where the balls fall
    edge = fall_at + float(rng.choice([-1, 1]) * rng.uniform(0.04, 0.17))
    edges = sorted([edge, edge - math.copysign(rng.uniform(0.22, 0.32), edge)]) if zones == 3 else [edge]
    widths = tuple(round(float(w), 4) for w in np.diff([-width / 2, *edges, width / 2]))
    return widths, distinct_colours(rng, zones, ZONE_COLOURS), int(rng.integers(zones))


def _ball_colours(rng: np.random.Generator, so_far: Drawn) -> tuple[str, ...]:
    return distinct_colours(rng, BALLS, BALL_COLOURS[so_far["board_colour"]])


ROWS, ZONES = peg_rows(5, 7), together(_zones)


@dataclass(frozen=True)
class Params:
    """Parameters; a zone has width and colour, a ball colour, side (-1: left), way."""

    rows: int = ROWS()
    peg_gap_m: float = ROWS()  # from peg to peg in a row
    row_shifts_m: tuple[float, ...] = ROWS()  # sideways shift of every row, lowest first
    board_colour: str = one_of(*BALL_COLOURS)
    sides: tuple[int, ...] = drawn_by(_sides)
    ways_m: tuple[float, ...] = drawn_by(lambda rng, so_far: so_far["ways"])  # to the end of the shelf
    tilt_deg: float = between(31, 39)  # of the board against the floor
    zone_widths_m: tuple[float, ...] = ZONES()
    zone_colours: tuple[str, ...] = ZONES()
    asked: int = ZONES()  # the zone asked for
    row_gap_m: float = between(0.092, 0.100)  # from row to row, down the board
    square_pegs: bool = chance(0.35)
    peg_radius_m: float = between(0.012, 0.016)
    ball_radius_m: float = between(0.0355, 0.038)
    ball_colours: tuple[str, ...] = drawn_by(_ball_colours)
    slope_deg: float = between(10, 14)  # of the shelves
    azimuth_deg: float = between(86, 94)
    elevation_deg: float = camera_elevation(-6, 6)

    @property
    def width_m(self) -> float:
        """Inner width of the board."""
        return sum(self.zone_widths_m)

    @property
    def edges_m(self) -> tuple[float, ...]:
        """Edges of the zones, left to right, from the middle of the board."""
        return tuple(float(x) for x in np.cumsum([-self.width_m / 2, *self.zone_widths_m]))

    @property
    def rim_m(self) -> float:
        """Height of the zones' openings, measured up the board."""
        return SILL_M + ZONE_M

    @property
    def lip_m(self) -> float:
        """Height of the shelves' ends, measured up the board."""
        return self.rim_m + (self.rows + 0.6) * self.row_gap_m

    @property
    def slope_rad(self) -> float:
        """Angle of the shelves."""
        return math.radians(self.slope_deg)

    @property
    def height_m(self) -> float:
        """Length of the board, up its slope."""
        rise = max(self.shelf_m(s) for s in set(self.sides)) * math.sin(self.slope_rad)
        return self.lip_m + rise + 3 * self.ball_radius_m

    def shelf_m(self, side: int) -> float:
        """Return the length of the shelf at a side."""
        return max(w for w, s in zip(self.ways_m, self.sides, strict=True) if s == side) + 1.4 * self.ball_radius_m

    def lip_x_m(self, side: int) -> float:
        """Return the position across the board at which a shelf's upper face ends."""
        return side * (self.width_m / 2 - self.shelf_m(side) * math.cos(self.slope_rad))


def build(p: Params, physics: Physics) -> Scene:
    """Build plate, frame, zones with walls between them, pegs, shelves and balls."""
    board = Board(
        physics,
        tilt_deg=p.tilt_deg,
        width_m=p.width_m,
        ball_radius_m=p.ball_radius_m,
        light=(0.33, 0.33, 0.32),
        bounce=(-20000.0, -6.0),
        friction=FRICTION,
    )
    board.spec.visual.headlight.ambient = [0.5, 0.5, 0.5]  # inner faces of the frame shall not look black
    trim, top = TRIM[p.board_colour], p.height_m
    board.block("plate", (-board.outer, board.outer), (0, top), (-0.02, 0), p.board_colour)
    board.frame(0, top, trim, sill=False)
    for i, (span, colour) in enumerate(zip(pairwise(p.edges_m), p.zone_colours, strict=True)):
        board.block(f"sill_{i}", span, (0, SILL_M), (0, board.deep), colour)
        board.block(f"zone_{i}", span, (SILL_M, p.rim_m - BARE_M), (0, 0.001), colour, solid=False)
    for i, x in enumerate(p.edges_m[1:-1]):
        board.divider(i, x, (SILL_M, p.rim_m), WALL_M, trim)
    heights = [p.rim_m + (row + 0.9) * p.row_gap_m for row in range(p.rows)]
    board.pegs(heights, p.row_shifts_m, p.peg_gap_m, p.peg_radius_m, trim, square=p.square_pegs)
    for side in sorted(set(p.sides)):
        _add_shelf(board, p, side)
    for i, colour in enumerate(p.ball_colours):
        board.ball(f"ball_{i}", _start(p, i), colour, friction=FRICTION)
    colours = sorted({*p.ball_colours, *p.zone_colours, p.board_colour, trim})
    return Scene(
        spec=board.spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=tuple(f"ball_{i}" for i in range(BALLS)),
        framed=board.ends(top),
        rest=board.region((0, p.rim_m), board.deep),
        inventory=Inventory(tuple(colours), ("ball", "board", "peg", "zone", "shelf", "wall")),
    )


def _add_shelf(board: Board, p: Params, side: int) -> None:
    """Add a shelf from a side wall down towards the middle, as thick as a wall."""
    slope, half_length = p.slope_rad, p.shelf_m(side) / 2
    centre = (
        p.lip_x_m(side) + side * (half_length * math.cos(slope) + WALL_M * math.sin(slope)),
        p.lip_m + half_length * math.sin(slope) - WALL_M * math.cos(slope),
        board.deep / 2,
    )
    shelf = add_box(board.body, f"shelf_{side}", centre, (half_length, WALL_M, board.deep / 2), TRIM[p.board_colour])
    shelf.friction, shelf.quat = list(FRICTION), turn_quaternion(side * slope, 3)


def _start(p: Params, ball: int) -> tuple[float, float]:
    """Return a ball's place across and up the board (m), at rest against its shelf."""
    side, way, slope = p.sides[ball], p.ways_m[ball], p.slope_rad
    across = way * math.cos(slope) - p.ball_radius_m * math.sin(slope)
    return p.lip_x_m(side) + side * across, p.lip_m + way * math.sin(slope) + p.ball_radius_m * math.cos(slope)


def outcome(motion: Motion, p: Params) -> Reading:
    """Read how many balls are in the asked zone, while all are in some zone."""
    places = [place(motion, f"ball_{i}", p.tilt_deg) for i in range(BALLS)]
    across, up = (np.stack(values, axis=1) for values in zip(*places, strict=True))
    low, high = p.edges_m[p.asked : p.asked + 2]
    is_inside, down = (across > low) & (across < high), up < p.rim_m
    labels = [str(i.sum()) if d.all() else None for i, d in zip(is_inside, down, strict=True)]
    walls = [x for x in (low, high) if abs(x) < 0.49 * p.width_m]
    return Reading(labels, float(min(p.rim_m - up[-1].max(), *(np.abs(across[-1] - x).min() for x in walls))))


def _counts(p: Params, rng: np.random.Generator) -> Filled:
    """Return the choices: all counts that three balls allow."""
    aliases = {"all three": "3", "all three balls": "3"}
    for label, number in zip(LABELS, NUMBERS, strict=False):
        noun = "ball" if label == "1" else "balls"
        aliases |= dict.fromkeys((number, f"{label} {noun}", f"{number} {noun}"), label)
    return Filled(LABELS, aliases, {"choices": list_choices(LABELS), "zone": p.zone_colours[p.asked]})


LAST_PEGS = 0.45  # of the board's width above the zones: so low a ball has the last rows of pegs before it


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Count the balls in the asked zone, or right above it, if all are that low."""
    if slots["zone"] not in ZONE_COLOURS:
        return None
    grounds = {colour: _ground(frames[-1], colour) for colour in ZONE_COLOURS}
    colours = sorted({colour for pool in BALL_COLOURS.values() for colour in pool})
    balls = [round_ball(frames[-1], colour) for colour in colours]
    zones = [_zone_of(ball, grounds) or _zone_below(ball, grounds) for ball in balls if ball is not None]
    if len(zones) != BALLS or None in zones:
        return None
    return str(zones.count(slots["zone"]))


def _zone_below(ball: Blob, grounds: Mapping[str, np.ndarray | None]) -> str | None:
    """Return the colour of the zone that a ball is above; None if far above."""
    outlines = {colour: ground[:, 0].astype(float) for colour, ground in grounds.items() if ground is not None}
    if len(outlines) < 2:
        return None
    middles = sorted((outline.mean(axis=0) for outline in outlines.values()), key=lambda middle: middle[0])
    along = (middles[-1] - middles[0]) / np.linalg.norm(middles[-1] - middles[0])
    ends = {colour: ((outline @ along).min(), (outline @ along).max()) for colour, outline in outlines.items()}
    width = max(end for _, end in ends.values()) - min(start for start, _ in ends.values())
    offset = np.array([ball.x, ball.y]) - middles[0]
    if not 0 < along[1] * offset[0] - along[0] * offset[1] < LAST_PEGS * width:
        return None
    at = np.array([ball.x, ball.y]) @ along
    return next((colour for colour, (start, end) in ends.items() if start <= at <= end), None)


def _ground(frame: np.ndarray, colour: str) -> np.ndarray | None:
    """Return the convex outline of a zone's colour; None if it is no zone in size."""
    mask = colour_mask(frame, colour).astype(np.uint8)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    regions = [outline for outline in outlines if cv2.contourArea(outline) > 40]
    if sum(cv2.contourArea(region) for region in regions) < 600:
        return None
    return cv2.convexHull(np.concatenate(regions))


def _zone_of(ball: Blob, grounds: Mapping[str, np.ndarray | None]) -> str | None:
    """Return the colour of the zone that a ball's centre lies in."""
    zones_around = (
        c for c, g in grounds.items() if g is not None and cv2.pointPolygonTest(g, (ball.x, ball.y), False) > 0
    )
    return next(zones_around, None)


FAMILY = scene_family(
    "pachinko_waterfall",
    category="pachinko_waterfall",
    sub_scenario="pachinko",
    params=Params,
    build=build,
    outcome=outcome,
    question=Question(
        "numeric",
        (
            "How many of the three balls end up in the {zone} zone: {choices}?",
            "Once all the balls lie at the bottom, how many are in the {zone} zone, {choices}?",
            "What is the number of balls that come to rest in the {zone} zone at the bottom, {choices}?",
        ),
        _counts,
    ),
    asides=[
        either(
            "How many coloured zones are there at the bottom of the board, 2 or 3?",
            ("2", "3"),
            lambda p: str(len(p.zone_colours)),
        ),
        either("From how many sides do the balls roll in, 1 or 2?", ("1", "2"), lambda p: str(len(set(p.sides)))),
        either(
            "Are the pegs on the board round or square?",
            ("round", "square"),
            lambda p: "square" if p.square_pegs else "round",
        ),
        choice_of(
            "Which colour has the zone at the left end of the board: {choices}?",
            choices=lambda p: ZONE_COLOURS,
            answer=lambda p: p.zone_colours[0],
        ),
    ],
    observe=observe,
    min_margin_m=0.01,
    perturbation=1e-5,
    looks=("bystanders", "floor", "light", "material", "panel"),
)
