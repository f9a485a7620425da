"""A ball is thrown into a chute over three trays: in which tray does it land?

Control: chute and trays are in view. Void: the occluder stands before them.
Hidden element: the two parallel boards of the chute, which hang straight down over the middle tray or slant towards the
left or the right one. The throw is the same whichever way they slant, and the trays' walls keep the ball.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np

from traps_pipeline.scenes.parts.course import SOFT, Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import offered, round_blob
from traps_pipeline.scenes.parts.questions import choice_of, comes_from, which_colour
from traps_pipeline.scenes.parts.readings import Reading
from traps_pipeline.scenes.parts.vary import apart, between, facing, hidden, one_of, shuffled
from traps_pipeline.scenes.parts.vision import blobs, colour_mask, is_at_rest, largest
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene

GRAVITY = 9.81
FLOOR_M = 0.02  # thickness of the trays' floors
WALL_M = 0.014
DEPTH_M = 0.14  # half of the trays' depth
DIVIDER_M = 0.10  # height of the walls between the trays
END_M = 0.34  # height of the outer walls
GREYS = ("grey", "black", "white")
SLANTS = 0.4  # columns a row: boards that hang straight down slant less in the picture
TRAY_PX = 40  # a tray is wider in the picture
COLOURS = "red", "green", "blue", "yellow", "orange", "cyan", "purple"
PLAY_COLOURS, PLAIN_COLOURS = apart(*COLOURS), shuffled(*GREYS)


@dataclass(frozen=True)
class Params:
    """Parameters, left to right as the camera sees them; direction +1 is right."""

    direction: int = one_of(-1, 1)
    ball_colour: str = PLAY_COLOURS()
    tray_colours: tuple[str, ...] = PLAY_COLOURS(3)
    pedestal_colour: str = PLAIN_COLOURS()
    back_colour: str = PLAIN_COLOURS()
    radius_m: float = between(0.066, 0.074)
    pedestal_m: float = between(0.50, 0.66)  # height of the pedestal that the ball starts from
    speed_along_m_s: float = between(1.20, 1.38)
    speed_up_m_s: float = between(2.9, 3.3)
    tray_m: float = between(0.29, 0.33)  # width of a tray
    mouth_m: float = between(0.60, 0.64)  # height of the boards' upper edges
    board_m: float = between(0.29, 0.33)  # length of the boards
    gap: float = between(3.9, 4.2)  # between the boards, in ball radii
    slant_deg: float = between(42, 48)  # of the boards from the vertical when they slant
    slant: int = hidden(-1, 0, 1)  # to the left, straight down, to the right
    azimuth_deg: float = facing(-8, 18)
    elevation_deg: float = between(-34, -24)

    @property
    def start_m(self) -> float:
        """Height of the ball's centre in the first frame."""
        return self.pedestal_m + 0.01 + self.radius_m

    @property
    def range_m(self) -> float:
        """Distance from the start to where the ball comes down between the boards."""
        up, drop = self.speed_up_m_s, self.start_m - self.mouth_m
        return self.speed_along_m_s * (up + (up * up + 2 * GRAVITY * drop) ** 0.5) / GRAVITY


def build(p: Params, physics: Physics) -> Scene:
    """Build pedestal, three trays with a high back, and two boards over them."""
    course = Course(physics, surface=Surface(0.006, sliding=0.5, solref=SOFT))
    r, half_width, start = p.radius_m, 1.5 * p.tray_m, -p.direction * p.range_m
    depth_span, outer, foot = (
        (-DEPTH_M, DEPTH_M),
        (-half_width - WALL_M, half_width + WALL_M),
        (start - 0.08, start + 0.08),
    )
    course.block("pedestal", foot, (-0.08, 0.08), (0, p.pedestal_m), p.pedestal_colour)
    throw = (p.direction * p.speed_along_m_s, p.speed_up_m_s)
    course.ball("ball", (start, 0, p.start_m), r, p.ball_colour, thrown=throw, rolling=0.0002)
    for i, colour in enumerate(p.tray_colours):
        ends = (i * p.tray_m - half_width, (i + 1) * p.tray_m - half_width)
        course.block(f"tray_{i}", ends, depth_span, (0, FLOOR_M), colour)
        course.block(f"front_{i}", ends, (-DEPTH_M - WALL_M, -DEPTH_M), (0, FLOOR_M + 0.3 * r), colour)
        course.block(f"rear_{i}", ends, (DEPTH_M - WALL_M, DEPTH_M), (0, DIVIDER_M), colour)
    for i in (1, 2):
        x = i * p.tray_m - half_width
        course.block(f"divider_{i}", (x - WALL_M / 2, x + WALL_M / 2), depth_span, (0, DIVIDER_M), p.back_colour)
    course.block("end_left", (outer[0], -half_width), depth_span, (0, END_M), p.back_colour)
    course.block("end_right", (half_width, outer[1]), depth_span, (0, END_M), p.back_colour)
    course.block("back", outer, (DEPTH_M, DEPTH_M + WALL_M), (0, p.mouth_m), p.back_colour)
    angle, half_size = p.slant * radians(p.slant_deg), (0.006, DEPTH_M - 0.03, p.board_m / 2)
    for i, hinge in enumerate((-p.gap * r / 2, p.gap * r / 2)):
        centre = (hinge + p.board_m / 2 * sin(angle), 0.0, p.mouth_m - p.board_m / 2 * cos(angle))
        board = course.slab(f"board_{i}", centre, half_size, "wood", falls_rad=-angle)
        Surface(0.001, sliding=0.3, solref=SOFT).on(board)
    for i, colour in enumerate(p.tray_colours):
        course.mark(f"{colour} tray", f"tray_{i}")
    return course.scene(
        p,
        decisive=["ball"],
        hidden=["board_0", "board_1"],
        cover=course.box(outer, (-DEPTH_M - WALL_M, DEPTH_M + 0.10), (0, p.mouth_m + 0.06), right=0.03),
        in_view=[
            course.box(outer, (-DEPTH_M - WALL_M, DEPTH_M + WALL_M), (0, p.mouth_m)),
            course.box(foot, (-0.08, 0.08), (0, p.pedestal_m)),
        ],
        things=[f"{p.ball_colour} ball", *(f"{c} tray" for c in p.tray_colours), "pedestal"],
        also=["chute", "board", "wall"],
        colours=[*p.tray_colours, "wood"],
    )


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the colour of the tray that the ball is over, while it is that low."""
    ball = motion.pos("ball")
    place = ball[:, 0] / p.tray_m + 1.5  # in tray widths from the left end
    tray_index, low = np.clip(np.floor(place), 0, 2).astype(int), ball[:, 2] < DIVIDER_M + 0.02
    margin_m = min(abs(place[-1] - 1), abs(place[-1] - 2)) * p.tray_m
    margin = min(margin_m, DIVIDER_M + p.radius_m - ball[-1, 2])
    return Reading(
        [p.tray_colours[i] if down else None for i, down in zip(tray_index, low, strict=True)], float(margin)
    )


def _colours(slots: Mapping[str, str]) -> Sequence[str]:
    """Return the colours that the question offers, or any a tray beside this ball has."""
    return offered(slots, [colour for colour in COLOURS if colour != slots["ball"]])


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return the tray colour that covers most of the picture around the resting ball."""
    path = [round_blob(frame, slots["ball"]) for frame in frames[-3:]]
    ball = path[-1]
    if ball is None or not is_at_rest(path):
        return None
    reach = 1.1 * max(ball.box[2:])
    rows, columns = np.ogrid[: frames.shape[1], : frames.shape[2]]
    is_near = (columns - ball.x) ** 2 + (rows - ball.y) ** 2 < reach**2
    pixels_of = {c: int((colour_mask(frames[-1], c) & is_near).sum()) for c in _colours(slots)}
    best = max(pixels_of, key=lambda c: pixels_of[c])
    return best if pixels_of[best] >= 60 else None


def foresee(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Predict the tray that the chute's boards lead to; the middle if upright."""
    trays = {colour: largest(frames[-1], colour, 200) for colour in _colours(slots)}
    visible = {colour: blob for colour, blob in trays.items() if blob is not None and blob.box[2] > TRAY_PX}
    tray_colours = sorted(visible, key=lambda colour: visible[colour].x)
    if len(tray_colours) != 3:
        return None
    left, right = visible[tray_colours[0]], visible[tray_colours[2]]
    top = min(blob.y for blob in visible.values())
    slopes = []
    for board in blobs(colour_mask(frames[0], "wood"), 200):
        x, y, width, height = board.box
        if left.box[0] < board.x < right.box[0] + right.box[2] and board.y < top and height > 30:
            rows, columns = np.nonzero(colour_mask(frames[0], "wood")[y : y + height, x : x + width])
            slopes.append(float(np.polyfit(rows, columns, 1)[0]))
    if not slopes:
        return None
    slope = float(np.mean(slopes))  # pixels to the right from row to row
    return tray_colours[0 if slope < -SLANTS else 2 if slope > SLANTS else 1]


FAMILY = scene_family(
    "target_land",
    category="trajectories_drops",
    params=Params,
    build=build,
    outcome=outcome,
    question=which_colour(
        "On which tray does the {ball} ball land, the {choices} one?",
        "What colour is the tray that the {ball} ball ends up in: {choices}?",
        "Which of the three trays catches the {ball} ball: {choices}?",
        colours=lambda p: p.tray_colours,
        forms=["{} tray", "{} one", "in the {} tray", "the {} tray"],
    ),
    asides=[
        comes_from("From which side does the thrown ball come, left or right?"),
        choice_of(
            "What colour is the thrown ball: {choices}?",
            choices=lambda p: [p.ball_colour, *p.tray_colours[:2]],
            answer=lambda p: p.ball_colour,
        ),
        choice_of(
            "What colour is the tall pedestal: {choices}?", choices=lambda p: GREYS, answer=lambda p: p.pedestal_colour
        ),
    ],
    observe=observe,
    foresee=foresee,
    min_margin_m=0.03,
)
