"""A ball drops through a chute on a plate: to which side does it drop off?

Control: the plate below the chute and the two bins are in view. Void: the occluder stands before them.
Hidden element: the plate is tilted to the left or to the right. The ball drops straight on its middle, whatever the
track and the chute look like; a board behind the bins catches the shadows.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import radians

import numpy as np

from traps_pipeline.scenes.parts.course import SHADOW_RIGHT, Course, Span, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import nearer_side
from traps_pipeline.scenes.parts.questions import colour_from, comes_from, left_or_right
from traps_pipeline.scenes.parts.readings import Reading, side_while
from traps_pipeline.scenes.parts.vary import apart, between, hidden, in_front, one_of, shuffled
from traps_pipeline.scenes.parts.vision import largest, slanting_edges
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene

WALL_M = 0.012
COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")
EDGE_PX = 60  # least length of the plate's edges
SLANTS = 0.36, 1.2  # rows a column, of the plate's edges in the picture
PLAY_COLOURS, PLAIN_COLOURS = apart(*COLOURS), shuffled("wood", "grey", "white")


@dataclass(frozen=True)
class Params:
    """Parameters; direction +1 is right; at tilt +1 the plate sheds to the right."""

    left_colour: str = PLAY_COLOURS()
    right_colour: str = PLAY_COLOURS()
    ball_colour: str = PLAY_COLOURS()
    chute_colour: str = PLAIN_COLOURS()
    board_colour: str = PLAIN_COLOURS()
    plate_colour: str = PLAIN_COLOURS()
    direction: int = one_of(-1, 1)
    tilt: int = hidden(-1, 1)
    tilt_deg: float = between(30, 40)
    radius_m: float = between(0.042, 0.050)
    speed_m_s: float = between(0.30, 0.42)
    start_m: float = between(0.42, 0.54)  # where the ball starts on the track, from the middle of the chute
    chute_m: float = between(0.36, 0.42)  # height of the chute's lower end
    chute_height_m: float = between(0.34, 0.42)
    bin_m: float = between(0.30, 0.38)  # width of each bin
    rim_m: float = between(0.10, 0.14)  # height of the bins' outer walls
    azimuth_deg: float = in_front(-15, 15)
    elevation_deg: float = between(-26, -20)


def build(p: Params, physics: Physics) -> Scene:
    """Build track, chute, tilting plate on a partition, two bins, and back board.

    `direction` mirrors only track, post, chute and ball; bins and board stay as in the picture.
    """
    course = Course(physics)
    r, d, half_y, half_x = p.radius_m, p.direction, 1.5 * p.radius_m, p.bin_m + WALL_M
    bore, top = 1.2 * r, p.chute_m + p.chute_height_m  # half the chute's inner width; its upper end
    track = top - 2.4 * r  # two ball diameters below that
    track_underside, across, front = track - 0.02, (-half_y, half_y), (-half_y - WALL_M, -half_y)

    def along(a: float, b: float) -> Span:
        return (a, b) if d > 0 else (-b, -a)

    far_end = -p.start_m - 0.08
    run = along(far_end, -bore)
    course.block("track", run, (-1.1 * r, 1.1 * r), (track_underside, track), p.chute_colour)
    for side in (-1, 1):
        y = side * 1.1 * r
        course.block(f"rail_{side}", run, (y - 0.005, y + 0.005), (track_underside, track + 0.35 * r), p.chute_colour)
    course.block("post", along(far_end + 0.02, far_end + 0.06), (-0.02, 0.02), (0, track_underside), p.chute_colour)
    for name, side, upper_end in (("far", d, top), ("near", -d, track_underside)):
        x = side * (bore + WALL_M / 2)
        course.block(f"chute_{name}", (x - WALL_M / 2, x + WALL_M / 2), across, (p.chute_m, upper_end), p.chute_colour)
    for name, y in (("front", -half_y - WALL_M), ("back", half_y)):
        width = (-bore - WALL_M, bore + WALL_M)
        course.block(f"chute_{name}", width, (y, y + WALL_M), (p.chute_m, top), p.chute_colour)

    plate = (0, 0, p.chute_m - 3.6 * r)
    tilt = p.tilt * radians(p.tilt_deg)
    Surface(sliding=0.5).on(course.slab("plate", plate, (2 * r, half_y, 0.008), p.plate_colour, falls_rad=tilt))
    course.block("partition", (-WALL_M / 2, WALL_M / 2), across, (0, plate[2] - 0.02), p.chute_colour)
    bins = (
        ("left", p.left_colour, (-p.bin_m, 0), (-half_x, -p.bin_m), (-half_x, 0)),
        ("right", p.right_colour, (0, p.bin_m), (p.bin_m, half_x), (0, half_x)),
    )
    for name, colour, floor, end, span in bins:
        course.block(f"bin_{name}", floor, across, (0, 0.015), colour, Surface(0.004))
        course.block(f"end_{name}", end, across, (0, p.rim_m), colour)
        course.block(f"front_{name}", span, front, (0, 0.5 * r), colour)
    back, board = half_y + 2 * WALL_M, (-half_x - 0.02, half_x + SHADOW_RIGHT * p.chute_m)
    course.block("board", board, (half_y + WALL_M, back), (0, p.chute_m + 0.12), p.board_colour)
    course.ball("ball", (-d * p.start_m, 0, track + r), r, p.ball_colour, speed=d * p.speed_m_s)

    cover = course.box(board, (front[0], back), (0, p.chute_m + 0.02))
    for side in ("left", "right"):
        course.mark(f"{side} bin", f"bin_{side}")
    return course.scene(
        p,
        decisive=["ball"],
        hidden=["plate"],
        cover=cover,
        in_view=[cover, course.box((-bore, bore), across, (p.chute_m, top))],
        things=[f"{p.ball_colour} ball", "high track", "chute", "post"],
        also=["bin", "board", "plate"],
    )


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the bin that the ball is in, while it is below the outer walls."""
    ball = motion.pos("ball")
    x = ball[:, 0]
    return Reading(side_while(ball[:, 2] < p.rim_m + p.radius_m, x, "right", "left"), float(abs(x[-1]) - p.radius_m))


def foresee(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Predict the side to which the plate falls, by the slopes of its edges."""
    left, right = (largest(frames[0], slots[side], 60) for side in ("left", "right"))
    if left is None or right is None or left.x > right.x:
        return None
    middle, width = (left.box[0] + left.box[2] + right.box[0]) / 2, (left.box[2] + right.box[2]) / 2
    floor = min(left.y, right.y)
    part = np.s_[max(0, int(floor - 0.75 * width)) : int(floor), int(middle - 0.4 * width) : int(middle + 0.4 * width)]
    left_edges, right_edges = (int(edges.sum()) for edges in slanting_edges(frames[0], part, SLANTS))
    if max(right_edges, left_edges) < EDGE_PX:
        return None
    return "right" if right_edges > left_edges else "left"


FAMILY = scene_family(
    "hidden_drop",
    category="hidden",
    params=Params,
    build=build,
    outcome=outcome,
    question=left_or_right(
        "Where does the {ball} ball drop out of the chute: left into the {left} bin or right into the {right} bin?",
        "Does the {ball} ball land in the {left} bin on the left or in the {right} bin on the right?",
        "To which side does the {ball} ball fall from the chute, left ({left} bin) or right ({right} bin)?",
        forms=["to the {0}", "{0} bin", "{0} side", "{1}", "{1} bin", "the {1} bin"],
        colours=lambda p: (p.left_colour, p.right_colour),
    ),
    asides=[
        colour_from(
            "ball", "What colour is the ball on the track: {choices}?", COLOURS, unlike=("ball", "left", "right")
        ),
        comes_from("From which side does the ball roll in, left or right?"),
    ],
    observe=nearer_side("ball", "left", "right", tolerance_px=4),
    foresee=foresee,
    min_margin_m=0.02,
)
