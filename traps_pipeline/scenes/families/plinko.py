"""A ball runs down a tilted board of pegs: into which numbered bucket?

The ball is thrown up the bare head of the board, curves back and meets the pegs after about a second. Control: the
whole run. Void: the clip ends before the buckets. Each peg magnifies a difference in the ball's path about tenfold, so
that what no pixel shows at the cut decides the bucket.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from traps_pipeline.scenes.parts.board import WALL_M, Board, camera_elevation, peg_rows, place, round_ball
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.questions import NUMBERS, Filled, Question, colour_from, either
from traps_pipeline.scenes.parts.readings import Reading
from traps_pipeline.scenes.parts.vary import Drawn, between, chance, drawn_by, one_of, together
from traps_pipeline.scenes.parts.wording import choices_in
from traps_pipeline.scenes.physics.kit import (
    Inventory,
    Motion,
    Physics,
    Scene,
    View,
    distinct_colours,
    list_choices,
    uniform,
)

APRON_M = 0.175  # strip below the buckets that carries their numbers
BUCKET_M = 0.16  # length of the walls between the buckets
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
ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh")
ROWS = peg_rows(5, 7)


def _tilt(rng: np.random.Generator, so_far: Drawn) -> float:
    """Draw the tilt, and before it the sides that one or two balls come from."""
    count = 2 if rng.random() < 0.4 else 1
    so_far["sides"] = rng.permutation([-1, 1])[:count]
    return uniform(rng, 22, 30)


def _balls(rng: np.random.Generator, so_far: Drawn) -> tuple[Any, ...]:
    """Draw the balls' colours, starts, pushes towards the other side, and rises."""
    sides = so_far["sides"]
    colours = distinct_colours(rng, len(sides), SCHEMES[so_far["board_colour"]])
    starts = tuple(round(float(side * rng.uniform(0.12, 0.40)), 4) for side in sides)
    pushes = tuple(round(float(-side * rng.uniform(0.1, 0.6)), 4) for side in sides)
    return colours, starts, pushes, tuple(uniform(rng, 0.26, 0.36) for _ in sides)


BALLS = together(_balls)


@dataclass(frozen=True)
class Params:
    """Parameters; a ball has colour, start and push; the question is on the first."""

    rows: int = ROWS()
    peg_gap_m: float = ROWS()  # from peg to peg in a row
    row_shifts_m: tuple[float, ...] = ROWS()  # sideways shift of every row, lowest first
    board_colour: str = one_of(*SCHEMES)
    tilt_deg: float = drawn_by(_tilt)  # of the board against the floor
    buckets: int = one_of(5, 6, 7)
    width_m: float = between(1.15, 1.40)  # inside of the board
    row_gap_m: float = between(0.092, 0.100)  # from row to row, down the board
    square_pegs: bool = chance(0.35)
    peg_radius_m: float = between(0.012, 0.016)
    ball_radius_m: float = between(0.0345, 0.037)
    ball_colours: tuple[str, ...] = BALLS()
    starts_m: tuple[float, ...] = BALLS()  # from the middle of the board, sideways
    pushes_m_s: tuple[float, ...] = BALLS()  # sideways speed
    rises_m: tuple[float, ...] = BALLS()  # how far up the board the throw carries
    azimuth_deg: float = between(86, 94)
    elevation_deg: float = camera_elevation(-6, 6)

    @property
    def pitch_m(self) -> float:
        """Width of a bucket."""
        return self.width_m / self.buckets

    @property
    def rim_m(self) -> float:
        """Height of the buckets' openings, measured up the board."""
        return APRON_M + BUCKET_M

    @property
    def row_heights_m(self) -> list[float]:
        """Heights of the rows of pegs up the board, and of the balls' starts."""
        return [self.rim_m + (row + 0.9) * self.row_gap_m for row in range(self.rows + 1)]


def build(p: Params, physics: Physics) -> Scene:
    """Build plate, numbered apron, frame, buckets, pegs and balls."""
    board = Board(
        physics,
        tilt_deg=p.tilt_deg,
        width_m=p.width_m,
        ball_radius_m=p.ball_radius_m,
        light=(0.45, 0.45, 0.44),
        bounce=(-20000.0, -12.0),
    )
    *rows, start = p.row_heights_m
    top, full_width = start + max(p.rises_m) + 2.5 * p.ball_radius_m, (-board.outer, board.outer)
    frame = "black" if p.board_colour not in ("black", "purple", "blue") else "white"
    board.block("plate", full_width, (APRON_M, top), (-0.02, 0), p.board_colour)
    board.block("apron", full_width, (0, APRON_M), (-0.02, 0), "white")
    board.frame(APRON_M, top, frame)
    for i in range(1, p.buckets):
        board.divider(i, -board.side + i * p.pitch_m, (APRON_M, p.rim_m), WALL_M / 2, frame)
    for i in range(p.buckets):
        _add_digit(board, i + 1, -board.side + (i + 0.5) * p.pitch_m)
    board.pegs(rows, p.row_shifts_m, p.peg_gap_m, p.peg_radius_m, PEGS[p.board_colour], square=p.square_pegs)
    for i, (colour, across) in enumerate(zip(p.ball_colours, p.starts_m, strict=True)):
        board.ball(f"ball_{i}", (across, start), colour)
    throws = zip(p.pushes_m_s, p.rises_m, strict=True)
    colours = sorted({*p.ball_colours, p.board_colour, PEGS[p.board_colour], "black", "white"})
    return Scene(
        spec=board.spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball_0",),
        framed=board.ends(top),
        rest=board.region((APRON_M, p.rim_m), board.deep),
        velocity={f"ball_{i}": board.throw(push, rise) for i, (push, rise) in enumerate(throws)},
        inventory=Inventory(tuple(colours), ("ball", "board", "peg", "bucket", "number", "wall")),
    )


def _add_digit(board: Board, digit: int, x: float) -> None:
    """Add a seven-segment digit on the apron, drawn only."""
    half_width, pen = 0.024, 0.007  # half the digit's width, half a stroke
    low, middle, high = 0.025, 0.07, 0.115
    strokes = {
        "a": (0, high, half_width + pen, pen),
        "g": (0, middle, half_width + pen, pen),
        "d": (0, low, half_width + pen, pen),
        "f": (-half_width, (middle + high) / 2, pen, (high - middle) / 2),
        "b": (half_width, (middle + high) / 2, pen, (high - middle) / 2),
        "e": (-half_width, (low + middle) / 2, pen, (middle - low) / 2),
        "c": (half_width, (low + middle) / 2, pen, (middle - low) / 2),
    }
    for segment in SEGMENTS[digit]:
        right, up, half_x, half_y = strokes[segment]
        board.paint(f"digit_{digit}_{segment}", (x + right, up, 0.001), (half_x, half_y, 0.002), "black")


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the number of the bucket that the asked ball's centre is in."""
    middle, up = place(motion, "ball_0", p.tilt_deg)
    across = middle + p.width_m / 2
    bucket = np.clip(across // p.pitch_m, 0, p.buckets - 1).astype(int) + 1
    offset = float(across[-1]) % p.pitch_m
    labels = [str(b) if u < p.rim_m else None for b, u in zip(bucket, up, strict=True)]
    return Reading(labels, min(offset, p.pitch_m - offset, p.rim_m - float(up[-1])))


def _numbers(p: Params, rng: np.random.Generator) -> Filled:
    """Return the choices: the buckets' numbers."""
    labels = tuple(str(i + 1) for i in range(p.buckets))
    aliases: dict[str, str] = {}
    for n, word, ordinal in zip(labels, NUMBERS[1:], ORDINALS, strict=False):
        forms = (word, f"bucket {n}", f"bucket {word}", f"number {n}", f"{ordinal} bucket", f"bucket number {n}")
        aliases |= dict.fromkeys(forms, n)
    return Filled(labels, aliases, {"choices": list_choices(labels), "ball": p.ball_colours[0]})


# In lengths of the apron's lower edge, which is as long as the board is wide (1.18 to 1.43 m): a ball that is so far
# above that edge has two rows of pegs before it at most. One that lies in a bucket is 0.15 to 0.18 above the edge.
LAST_PEGS = 0.44
INK = 0.025, 0.075  # where the middle of the digits is
FRAME = 0.012  # share of that edge below the frame at either side


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return the bucket right below the ball, if only the last two rows are left."""
    last = frames[-1]
    if not any(slots["ball"] in pool for pool in SCHEMES.values()):
        return None
    ball, edge = round_ball(last, slots["ball"]), _lower_edge(last)
    if ball is None or edge is None:
        return None
    left, right = edge
    along, offset = right - left, np.array([ball.x, ball.y]) - left
    share = float(offset @ along / (along @ along) - FRAME) / (1 - 2 * FRAME)
    height = float(along[1] * offset[0] - along[0] * offset[1]) / float(along @ along)
    if not (0 < share < 1 and 0 < height < LAST_PEGS):
        return None
    buckets = len(choices_in(slots["choices"])) if "choices" in slots else _count_digits(last, edge)
    return str(int(share * buckets) + 1) if buckets else None


def _count_digits(frame: np.ndarray, edge: tuple[np.ndarray, np.ndarray]) -> int:
    """Count the digits on the apron, one a bucket, by the gaps between their ink."""
    left, right = edge
    along = right - left
    up = np.array([along[1], -along[0]])
    across, heights = np.linspace(0.02, 0.98, 600), np.linspace(*INK, 24)
    x, y = (left[i] + across * along[i] + heights[:, None] * up[i] for i in (0, 1))
    is_inside = (x >= 0) & (x < frame.shape[1]) & (y >= 0) & (y < frame.shape[0])
    rows, columns = (np.clip(v.round().astype(int), 0, n - 1) for v, n in zip((y, x), frame.shape[:2], strict=True))
    ink = ((frame[rows, columns].max(axis=2) < 110) & is_inside).any(axis=0).astype(np.uint8)
    ink = cv2.morphologyEx(ink[None], cv2.MORPH_CLOSE, np.ones((1, 9), np.uint8))[0]
    return int((np.diff(ink, prepend=0) == 1).sum())


def _lower_edge(frame: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the lower left and right corner of the white apron."""
    outlines, _ = cv2.findContours((frame.min(axis=2) > 225).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    large_outlines = [outline[:, 0] for outline in outlines if cv2.contourArea(outline) > 1500]
    if not large_outlines:
        return None
    points = np.concatenate(large_outlines).astype(float)
    return points[np.argmax(points[:, 1] - points[:, 0])], points[np.argmax(points[:, 1] + points[:, 0])]


FAMILY = scene_family(
    "plinko",
    category="plinko",
    params=Params,
    build=build,
    outcome=outcome,
    question=Question(
        "numeric",
        (
            "In which numbered bucket, {choices} from left to right, does the {ball} ball come to rest?",
            "Which bucket is the {ball} ball in when it stops: {choices}?",
            "What is the number of the bucket that the {ball} ball ends up in: {choices}?",
        ),
        _numbers,
    ),
    asides=[
        either("How many numbered buckets are there, 5, 6 or 7?", ("5", "6", "7"), lambda p: str(p.buckets)),
        either("How many balls are on the board, 1 or 2?", ("1", "2"), lambda p: str(len(p.ball_colours))),
        either("Are the pegs round or square?", ("round", "square"), lambda p: "square" if p.square_pegs else "round"),
        colour_from("board", "What colour is the board behind the pegs: {choices}?", list(SCHEMES), unlike=("board",)),
    ],
    observe=observe,
    min_margin_m=0.01,
    perturbation=1e-6,
    looks=("bystanders", "floor", "light", "material", "panel"),
)
