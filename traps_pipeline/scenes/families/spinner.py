"""A ball strikes the pointer of a spinner: in which sector does it stop?

Control: spinner and ball are in view from above. Void: the occluder stands before the whole spinner; only the ball's
run-up is seen.
Hidden element: the peg that stops the pointer, which may stand in any of the sectors.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from traps_pipeline.scenes.parts.course import Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD, offered
from traps_pipeline.scenes.parts.questions import colour_from, comes_from, which_colour
from traps_pipeline.scenes.parts.readings import Reading, lasting_from
from traps_pipeline.scenes.parts.vary import between, drawn_by, facing, hidden_index, one_of, shuffled
from traps_pipeline.scenes.parts.vision import Blob, blobs, colour_mask, is_at_rest
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene, add_box, distinct_colours

SECTORS = ("red", "green", "blue", "yellow", "cyan", "purple")
BALLS = ("red", "green", "blue", "orange", "purple", "cyan")
COLOURS = ("red", "green", "purple", "orange", "cyan")  # what a question after the ball's colour may offer
POINTER_COLOUR = "black"
TABLE_M = 0.03  # thickness of the table
FIRST_DEG, LAST_DEG = 48.0, 312.0  # where the sectors begin and end, from the near side onwards
LANE = 0.76  # distance of the ball's path from the hub, in disc radii
POINTER = 0.80  # length of the pointer, likewise
PEG_AT_M, PEG_M, POINTER_HALF_M = 0.085, 0.008, 0.012
RIM_M = 0.015
PLAIN_COLOURS = shuffled("wood", "grey", "white")


@dataclass(frozen=True)
class Params:
    """Parameters; direction +1 is right; sectors are in the order the pointer passes."""

    direction: int = one_of(-1, 1)
    sectors: tuple[str, ...] = drawn_by(lambda rng, so_far: distinct_colours(rng, int(rng.integers(3, 5)), SECTORS))
    table_colour: str = PLAIN_COLOURS()
    rim_colour: str = PLAIN_COLOURS()
    stop_sector: int = hidden_index("sectors")  # where the peg stands
    stop_at: float = between(0.40, 0.58)  # place of the stopped pointer within its sector: 0.5 is the middle
    disc_m: float = between(0.30, 0.34)
    radius_m: float = between(0.042, 0.050)
    speed_m_s: float = between(0.95, 1.2)
    run_m: float = between(0.74, 0.84)  # visible lane before the occluder
    ball_colour: str = drawn_by(  # that no sector has
        lambda rng, so_far: str(rng.choice([colour for colour in BALLS if colour not in so_far["sectors"]]))
    )
    azimuth_deg: float = facing(-12, 18)
    elevation_deg: float = between(-48, -38)

    @property
    def sector_deg(self) -> float:
        """Angle of a sector."""
        return (LAST_DEG - FIRST_DEG) / len(self.sectors)


def build(p: Params, physics: Physics) -> Scene:
    """Build spinner, pointer, peg and ball; the hub is at the origin."""
    course = Course(physics, p.direction)
    r, lane, half_width = p.radius_m, -LANE * p.disc_m, p.disc_m + 0.025
    start, end, rim = -half_width - p.run_m, half_width + 0.12, (0, TABLE_M + 0.035)
    depth_span, outer, floor = (-half_width, half_width), (-half_width - RIM_M, half_width + RIM_M), (0, TABLE_M)

    gripping = Surface(1e-4)
    course.block("lane", (start - 0.07, -half_width), (lane - 1.5 * r, lane + 1.5 * r), floor, p.table_colour, gripping)
    course.block("table", depth_span, depth_span, floor, p.table_colour, gripping)
    course.block("tray", (half_width, end), depth_span, floor, p.table_colour, Surface(4e-3))
    course.sides("rim", (-half_width, end), half_width, RIM_M, rim, p.rim_colour)
    course.block("rim_end", (end, end + RIM_M), outer, (0, TABLE_M + 0.06), p.rim_colour)
    for i, colour in enumerate(p.sectors):  # thin, and nothing touches them
        angles = np.linspace(FIRST_DEG + i * p.sector_deg, FIRST_DEG + (i + 1) * p.sector_deg, 13)
        corners = [_place(0.03, angles[0]), _place(0.03, angles[-1]), *(_place(p.disc_m, a) for a in angles)]
        heights = (TABLE_M - 0.008, TABLE_M + 0.002)
        course.hull(f"sector_{i}", [(x, y, z) for z in heights for x, y in corners], colour)
    _add_pointer(course, p)
    # The peg stands just past the angle at which it is to stop the pointer.
    stop_angle = np.degrees(np.arcsin((PEG_M + POINTER_HALF_M) / PEG_AT_M))
    along, across = _place(PEG_AT_M, FIRST_DEG + (p.stop_sector + p.stop_at) * p.sector_deg + stop_angle)
    peg = course.post("peg", (along, across, TABLE_M + 0.03), PEG_M, 0.03, "white")
    peg.solref, peg.priority = [0.02, 4], 1  # overdamped: the pointer does not bounce back
    at = (start, lane, TABLE_M + r)
    course.ball("ball", at, r, p.ball_colour, speed=p.speed_m_s, rolling=1e-4, sliding=0.1, density=2500)

    span = (-half_width, end + RIM_M)
    course.mark("pointer", (0.0, 0.0), POINTER_COLOUR)
    for i, colour in enumerate(p.sectors):
        course.mark(f"{colour} sector", _place(p.disc_m, FIRST_DEG + (i + 0.5) * p.sector_deg), colour)
    return course.scene(
        p,
        decisive=["pointer"],
        hidden=["peg"],
        cover=course.box(span, (-half_width - 0.02, half_width + 0.03), (0, 0.10), right=0.03),
        in_view=[course.box(span, outer, (0, 0.09))],
        things=[f"{p.ball_colour} ball", "black pointer", "spinner", *(f"{c} sector" for c in p.sectors)],
        also=["table", "rim", "peg"],
        colours=[*p.sectors, POINTER_COLOUR],
        shown_by={"spinner": ["pointer"]},
    )


def _place(radius: float, angle_deg: float) -> tuple[float, float]:
    """Return (along, across) at an angle from the near side as the pointer turns."""
    a = np.radians(angle_deg)
    return float(radius * np.sin(a)), float(radius * -np.cos(a))


def _add_pointer(course: Course, p: Params) -> None:
    """Add a bar that turns about the hub; it starts at the near side."""
    half_pointer = POINTER * p.disc_m / 2
    body = course.hinge("pointer", (0, 0, TABLE_M + 0.03), axis=(0, 0, p.direction), damping=2e-4)
    joint = body.first_joint()
    joint.frictionloss, joint.armature = 0.003, 0.002
    bar = add_box(body, "pointer", (0, -half_pointer, 0), (POINTER_HALF_M, half_pointer, 0.016), POINTER_COLOUR)
    bar.density, bar.friction = 300, [0.1, 0.005, 0.0001]
    course.post("hub", (0, 0, 0), 0.026, 0.022, POINTER_COLOUR, body=body).density = 300


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the pointer's sector, from when it turns no more."""
    tip = -motion.rot("pointer")[:, :2, 1]
    angles = np.degrees(np.arctan2(p.direction * tip[:, 0], -tip[:, 1])) % 360  # from the near side
    turn_left = np.abs(np.radians(angles - angles[-1] + 180) % (2 * np.pi) - np.pi)
    rest_frame = lasting_from(turn_left <= 0.02)
    angle_in_sector = (angles[-1] - FIRST_DEG) % p.sector_deg
    margin = np.radians(min(angle_in_sector, p.sector_deg - angle_in_sector)) * POINTER * p.disc_m
    index = np.floor((angles - FIRST_DEG) / p.sector_deg).astype(int)
    sectors = [p.sectors[k] if i >= rest_frame and 0 <= k < len(p.sectors) else None for i, k in enumerate(index)]
    return Reading(sectors, float(margin))


def observe(frames: np.ndarray, slots: Mapping[str, str], ahead: float | None = None) -> str | None:
    """Return the colour that surrounds the black pointer once it is at rest."""
    pointers = [_pointer(frame) for frame in frames[-3:]]
    if pointers[-1][0] is None or (ahead is None and not is_at_rest([pointer for pointer, _ in pointers])):
        return None
    ring = cv2.dilate(pointers[-1][1], np.ones((15, 15), np.uint8)).astype(bool)
    counts = {c: int((ring & colour_mask(frames[-1], c)).sum()) for c in offered(slots, SECTORS)}
    best = max(counts, key=lambda c: counts[c])
    return best if counts[best] > 0.45 * sum(counts.values()) else None


def _pointer(frame: np.ndarray) -> tuple[Blob | None, np.ndarray]:
    """Return the largest black region and its mask, the peg's gap in it closed."""
    black = colour_mask(frame, POINTER_COLOUR).astype(np.uint8)
    black = cv2.morphologyEx(black, cv2.MORPH_CLOSE, np.ones((11, 11), np.uint8))
    pointer = next(iter(blobs(black, 150)), None)
    mask = np.zeros_like(black)
    if pointer is not None:
        x, y, width, height = pointer.box
        mask[y : y + height, x : x + width] = black[y : y + height, x : x + width]
    return pointer, mask


FAMILY = scene_family(
    "spinner",
    category="other",
    params=Params,
    build=build,
    outcome=outcome,
    question=which_colour(
        "In which sector does the black pointer of the spinner stop, {choices}?",
        "What colour is the sector that the black pointer points to at the end: {choices}?",
        "On which sector does the black pointer come to rest: {choices}?",
        colours=lambda p: p.sectors,
        forms=["{} sector", "the {} sector", "on {}"],
    ),
    asides=[
        colour_from("ball", "What colour is the ball that rolls towards the spinner: {choices}?", COLOURS, ["ball"]),
        comes_from("From which side does the ball roll towards the spinner, left or right?"),
    ],
    observe=observe,
    foresee=partial(observe, ahead=AHEAD),
    physics=Physics(timestep_s=0.001),
    min_margin_m=0.03,
    looks=("bystanders", "camera", "material", "pale-floor", "panel"),
)
