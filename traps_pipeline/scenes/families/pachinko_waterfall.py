"""Three balls run off sloping shelves and stream down a tilted board of pegs; how many end up in the named zone?

The balls start one behind the other, so that the first meets the pegs after about a second and the others follow.
Control: the whole run, until all three lie in the coloured zones at the bottom. Void: the clip ends before that. Each
peg magnifies a difference in a ball's path about tenfold, so that what no pixel shows at the cut decides the count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
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
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
LIFT_M = 0.12  # height of the board's lower edge above the floor
SILL_M = 0.03  # below the zones
ZONE_M = 0.19  # length of the walls between the zones
BARE_M = 0.025  # strip below their upper end that has not the zone's colour: what lies in a zone lies well inside
WALL_M = 0.008  # half the thickness of walls and shelves
GLASS_GAP_M = 0.006  # play of the balls under the glass that keeps them on the board
BOUNCE = (-20000.0, -6.0)  # direct stiffness and damping of the pegs: lively balls
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


@dataclass(frozen=True)
class Params:
    """Per zone, left to right: width, colour. Per ball: colour, side it comes from (-1: left), way on the shelf."""

    zone_widths_m: tuple[float, ...]
    zone_colours: tuple[str, ...]
    asked: int  # the zone asked for
    rows: int
    row_gap_m: float  # from row to row, down the board
    peg_gap_m: float  # from peg to peg in a row
    row_shifts_m: tuple[float, ...]  # sideways shift of every row, lowest first
    square_pegs: bool
    peg_radius_m: float
    tilt_deg: float  # of the board against the floor
    ball_radius_m: float
    ball_colours: tuple[str, ...]
    sides: tuple[int, ...]
    ways_m: tuple[float, ...]  # to the end of the shelf
    slope_deg: float  # of the shelves
    board_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def width_m(self) -> float:
        """Inside of the board."""
        return sum(self.zone_widths_m)

    @property
    def edges_m(self) -> tuple[float, ...]:
        """Where the zones begin and end, from the middle of the board, left to right."""
        return tuple(float(x) for x in np.cumsum([-self.width_m / 2, *self.zone_widths_m]))

    @property
    def rim_m(self) -> float:
        """Where the zones open, measured up the board."""
        return SILL_M + ZONE_M

    @property
    def lip_m(self) -> float:
        """Where the shelves end, measured up the board."""
        return self.rim_m + (self.rows + 0.6) * self.row_gap_m

    @property
    def height_m(self) -> float:
        """Length of the board, up its slope."""
        rise = max(self.shelf_m(s) for s in set(self.sides)) * math.sin(math.radians(self.slope_deg))
        return self.lip_m + rise + 3 * self.ball_radius_m

    def shelf_m(self, side: int) -> float:
        """Length of the shelf at a side."""
        return max(w for w, s in zip(self.ways_m, self.sides, strict=True) if s == side) + 1.4 * self.ball_radius_m


def draw(rng: np.random.Generator) -> Params:
    """Two or three zones that meet below where the balls fall; three balls from one side, or one from the other."""
    rows, peg_gap = int(rng.integers(5, 8)), uniform(rng, 0.126, 0.140)
    skew = uniform(rng, -0.15, 0.15) if rng.random() < 0.5 else 0.0
    shifts = tuple(round(peg_gap * (i % 2 / 2 + i * skew + float(rng.normal(0, 0.04))), 4) for i in range(rows))
    board = str(rng.choice(list(BALL_COLOURS)))
    side = int(rng.choice([-1, 1]))
    sides = (side,) * BALLS if rng.random() < 0.5 else (side, -side, side)
    ways, gap = {-1: uniform(rng, 0.21, 0.28), 1: uniform(rng, 0.21, 0.28)}, uniform(rng, 0.120, 0.150)
    tilt = uniform(rng, 31, 39)
    zones, width = int(rng.integers(2, 4)), uniform(rng, 1.10, 1.25)
    fall = side * (width / 2 - 0.52) if len(set(sides)) == 1 else 0.0  # about where the balls fall
    edge = fall + float(rng.choice([-1, 1]) * rng.uniform(0.04, 0.17))
    edges = sorted([edge, edge - math.copysign(rng.uniform(0.22, 0.32), edge)]) if zones == 3 else [edge]
    return Params(
        zone_widths_m=tuple(round(float(w), 4) for w in np.diff([-width / 2, *edges, width / 2])),
        zone_colours=distinct_colours(rng, zones, ZONE_COLOURS),
        asked=int(rng.integers(zones)),
        rows=rows,
        row_gap_m=uniform(rng, 0.092, 0.100),
        peg_gap_m=peg_gap,
        row_shifts_m=shifts,
        square_pegs=bool(rng.random() < 0.35),
        peg_radius_m=uniform(rng, 0.012, 0.016),
        tilt_deg=tilt,
        ball_radius_m=uniform(rng, 0.0355, 0.038),
        ball_colours=distinct_colours(rng, BALLS, BALL_COLOURS[board]),
        sides=sides,
        ways_m=tuple(round(ways[s] + gap * sides[:i].count(s), 4) for i, s in enumerate(sides)),
        slope_deg=uniform(rng, 10, 14),
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
    light.diffuse = [0.33, 0.33, 0.32]  # head-on, the usual key light would bleach the colours
    spec.visual.headlight.ambient = [0.5, 0.5, 0.5]  # inner faces of the frame shall not look black
    board = spec.worldbody.add_body(name="board", pos=[0, 0, LIFT_M], quat=_turned(math.radians(p.tilt_deg), 1))
    outer = _add_case(board, p)
    _add_zones(board, p)
    _add_pegs(board, p)
    for side in sorted(set(p.sides)):
        _add_shelf(board, p, side)
    for i, colour in enumerate(p.ball_colours):
        x, height = _start(p, i)
        centre = up * height + normal * p.ball_radius_m + np.array([x, 0, LIFT_M])
        ball = add_ball(spec, f"ball_{i}", centre.tolist(), p.ball_radius_m, colour)
        ball.friction = list(FRICTION)
    ends = [(-outer, *(up * s)[1:]) for s in (0.0, p.height_m + 2 * WALL_M)]
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=tuple(f"ball_{i}" for i in range(BALLS)),
        stage=tuple(Box((-outer, y, z + LIFT_M), (outer, y, z + LIFT_M)) for _, y, z in ends),
        inventory=_inventory(p),
    )


def _slope(p: Params) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors up the board and out of it."""
    tilt = math.radians(p.tilt_deg)
    return np.array([0, math.cos(tilt), math.sin(tilt)]), np.array([0, -math.sin(tilt), math.cos(tilt)])


def _turned(angle: float, axis: int) -> list[float]:
    """Quaternion of a turn (rad) about the x axis (1), y axis (2) or z axis (3)."""
    return [math.cos(angle / 2), *(math.sin(angle / 2) * (i == axis) for i in (1, 2, 3))]


def _deep(p: Params) -> float:
    """How far the glass is from the board (m)."""
    return 2 * p.ball_radius_m + GLASS_GAP_M


def _block(board: mujoco.MjsBody, name: str, x: Span, up: Span, z: Span, colour: str) -> mujoco.MjsGeom:
    """A box of the board by its extent across, up and out of the board."""
    spans = (x, up, z)
    centre, half = [sum(s) / 2 for s in spans], [(s[1] - s[0]) / 2 for s in spans]
    return add_box(board, name, centre, half, colour, friction=list(FRICTION))


def _add_case(board: mujoco.MjsBody, p: Params) -> float:
    """Plate, frame and glass. Returns half the board's outer width (m)."""
    side, top, deep, trim = p.width_m / 2, p.height_m, _deep(p), TRIM[p.board_colour]
    outer = side + 2 * WALL_M
    _block(board, "plate", (-outer, outer), (0, top), (-0.02, 0), p.board_colour)
    _block(board, "head", (-outer, outer), (top, top + 2 * WALL_M), (0, deep), trim)
    _block(board, "left", (-outer, -side), (0, top), (0, deep), trim)
    _block(board, "right", (side, outer), (0, top), (0, deep), trim)
    glass = _block(board, "glass", (-outer, outer), (0, top), (deep, deep + 0.02), "white")
    glass.rgba, glass.friction, glass.priority = [1, 1, 1, 0], [0, 0, 0], 1  # never drawn
    return outer


def _add_zones(board: mujoco.MjsBody, p: Params) -> None:
    """Every zone has its floor and, drawn only, its ground in its colour; walls stand between zones."""
    deep = _deep(p)
    for i, (span, colour) in enumerate(zip(pairwise(p.edges_m), p.zone_colours, strict=True)):
        _block(board, f"sill_{i}", span, (0, SILL_M), (0, deep), colour)
        ground = _block(board, f"zone_{i}", span, (SILL_M, p.rim_m - BARE_M), (0, 0.001), colour)
        ground.contype = ground.conaffinity = 0
    for i, x in enumerate(p.edges_m[1:-1]):
        trim = TRIM[p.board_colour]
        _block(board, f"wall_{i}", (x - WALL_M, x + WALL_M), (SILL_M, p.rim_m), (0, deep), trim)
        _add_post(board, f"tip_{i}", (x, p.rim_m), WALL_M, deep, trim, square=True)  # a flat end could hold a ball


def _add_pegs(board: mujoco.MjsBody, p: Params) -> None:
    """Rows of pegs from wall to wall, without those that leave a ball just enough room to jam at a side wall."""
    reach = p.width_m / 2 - p.peg_radius_m
    for row, shift in enumerate(p.row_shifts_m):
        for k in range(-20, 21):
            x = shift + k * p.peg_gap_m
            room = reach - abs(x)
            if room < 0 or 0.4 * p.ball_radius_m < room < 2.3 * p.ball_radius_m:
                continue
            centre, colour = (x, p.rim_m + (row + 0.9) * p.row_gap_m), TRIM[p.board_colour]
            _add_post(board, f"peg_{row}_{k + 20}", centre, p.peg_radius_m, _deep(p), colour, square=p.square_pegs)


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
        post.quat = _turned(math.pi / 4, 3)


def _lip(p: Params, side: int) -> tuple[float, float]:
    """Where the upper face of a shelf ends: across and up the board (m)."""
    return side * (p.width_m / 2 - p.shelf_m(side) * math.cos(math.radians(p.slope_deg))), p.lip_m


def _add_shelf(board: mujoco.MjsBody, p: Params, side: int) -> None:
    """A shelf from a side wall down towards the middle, as thick as a wall."""
    slope, half = math.radians(p.slope_deg), p.shelf_m(side) / 2
    x, height = _lip(p, side)
    centre = (
        x + side * (half * math.cos(slope) + WALL_M * math.sin(slope)),
        height + half * math.sin(slope) - WALL_M * math.cos(slope),
        _deep(p) / 2,
    )
    shelf = add_box(board, f"shelf_{side}", centre, (half, WALL_M, _deep(p) / 2), TRIM[p.board_colour])
    shelf.friction = list(FRICTION)
    shelf.quat = _turned(side * slope, 3)


def _start(p: Params, ball: int) -> tuple[float, float]:
    """Where a ball's centre starts: across and up the board (m). It rests against its shelf."""
    side, way, slope = p.sides[ball], p.ways_m[ball], math.radians(p.slope_deg)
    x, height = _lip(p, side)
    across = way * math.cos(slope) - p.ball_radius_m * math.sin(slope)
    return x + side * across, height + way * math.sin(slope) + p.ball_radius_m * math.cos(slope)


def _places(motion: Motion, p: Params) -> tuple[np.ndarray, np.ndarray]:
    """Places of the balls across the board, from its middle, and up the board (m), each (F, balls)."""
    position = np.stack([motion.pos(f"ball_{i}") for i in range(BALLS)], axis=1) - np.array([0, 0, LIFT_M])
    return position[..., 0], position @ _slope(p)[0]


def readings(motion: Motion, p: Params) -> list[str | None]:
    """How many balls' centres are in the asked zone, while all are in some zone; None before."""
    across, up = _places(motion, p)
    low, high = p.edges_m[p.asked : p.asked + 2]
    inside, down = (across > low) & (across < high), up < p.rim_m
    return [str(i.sum()) if d.all() else None for i, d in zip(inside, down, strict=True)]


def margin(motion: Motion, p: Params) -> float:
    """How far the nearest ball's centre is at the end from the walls of the asked zone or from the zones' rim (m)."""
    across, up = (values[-1] for values in _places(motion, p))
    walls = [x for x in p.edges_m[p.asked : p.asked + 2] if abs(x) < 0.49 * p.width_m]
    return float(min(p.rim_m - up.max(), *(np.abs(across - x).min() for x in walls)))


QUESTIONS = (
    "How many of the three balls end up in the {zone} zone: {choices}?",
    "Once all the balls lie at the bottom, how many are in the {zone} zone, {choices}?",
    "What is the number of balls that come to rest in the {zone} zone at the bottom, {choices}?",
)


def _inventory(p: Params) -> Inventory:
    colours = sorted({*p.ball_colours, *p.zone_colours, p.board_colour, TRIM[p.board_colour]})
    return Inventory(tuple(colours), ("ball", "board", "peg", "zone", "shelf", "wall"))


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The choices are all counts that three balls allow."""
    aliases = {}
    for label, number in zip(LABELS, ("zero", "one", "two", "three"), strict=True):
        noun = "ball" if label == "1" else "balls"
        aliases |= dict.fromkeys((number, f"{label} {noun}", f"{number} {noun}"), label)
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(choices=listed(LABELS), zone=p.zone_colours[p.asked]),
        labels=LABELS,
        aliases={**aliases, "all three": "3", "all three balls": "3"},
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(4)
    if kind == 0:
        question = "How many coloured zones are there at the bottom of the board, 2 or 3?"
        return AnswerableQuestion(question, ("2", "3"), str(len(p.zone_colours)))
    if kind == 1:
        question = "From how many sides do the balls roll in, 1 or 2?"
        return AnswerableQuestion(question, ("1", "2"), str(len(set(p.sides))))
    if kind == 2:
        question = "Are the pegs on the board round or square?"
        return AnswerableQuestion(question, ("round", "square"), "square" if p.square_pegs else "round")
    choices = tuple(str(c) for c in rng.permutation(ZONE_COLOURS))
    question = f"Which colour has the zone at the left end of the board: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.zone_colours[0])


def observe(frames: np.ndarray, question: str) -> str | None:
    """Count the balls inside the outline of the asked zone's ground, if all three lie inside some zone's."""
    values = asked(QUESTIONS, question)
    if values is None or values["zone"] not in ZONE_COLOURS:
        return None
    last = frames[-1]
    grounds = {colour: _ground(last, colour) for colour in ZONE_COLOURS}
    homes = [_home(ball, grounds) for ball in _balls(last)]
    if len(homes) != BALLS or None in homes:
        return None
    return str(homes.count(values["zone"]))


def _balls(frame: np.ndarray) -> list[Blob]:
    """The round things of a ball's size in the colours that only balls have."""
    colours = sorted({c for pool in BALL_COLOURS.values() for c in pool})
    seen = [next(iter(_round(frame, colour)), None) for colour in colours]
    return [ball for ball in seen if ball is not None]


def _round(frame: np.ndarray, colour: str) -> list[Blob]:
    found = blobs(colour_mask(frame, colour), min_area=90)
    return [b for b in found if b.area < 900 and b.fill > 0.6 and 0.7 < b.box[2] / b.box[3] < 1.4]


def _ground(frame: np.ndarray, colour: str) -> np.ndarray | None:
    """Convex outline of a zone's colour, which balls may part into regions; None if it has not a zone's size."""
    mask = colour_mask(frame, colour).astype(np.uint8)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    regions = [outline for outline in outlines if cv2.contourArea(outline) > 40]
    if sum(cv2.contourArea(region) for region in regions) < 600:
        return None
    return cv2.convexHull(np.concatenate(regions))


def _home(ball: Blob, grounds: dict[str, np.ndarray | None]) -> str | None:
    """Colour of the zone that a ball's centre lies in."""
    inside = (c for c, g in grounds.items() if g is not None and cv2.pointPolygonTest(g, (ball.x, ball.y), False) > 0)
    return next(inside, None)


FAMILY = Family(
    name="pachinko_waterfall",
    taxonomy="chaotic",
    category="pachinko_waterfall",
    sub_scenario="pachinko",
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
    perturbation=1e-5,
)
