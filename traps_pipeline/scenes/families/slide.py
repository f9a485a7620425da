"""A block slides down an incline and across a deck: does it slide off the end?

Control: deck and tray are in view. Void: the occluder stands before them, the incline is in view.
Hidden element: a rough board in the deck, which stands out of it and stops the block, or is sunk into it. A block that
leaves the deck falls into the tray behind it.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from traps_pipeline.scenes.parts.course import SHADOW_RIGHT, Course, Span
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD, compact_blob, rests_over
from traps_pipeline.scenes.parts.questions import colour_from, comes_from, material_of, yes_no
from traps_pipeline.scenes.parts.ramp import Ramp
from traps_pipeline.scenes.parts.readings import Reading, still_from, yes_while
from traps_pipeline.scenes.parts.vary import Drawn, apart, between, drawn_by, facing, hidden, one_of
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene, uniform

INCLINE_M = 0.02  # thickness of the incline
OVERLAP_M = 0.05  # the incline ends inside the deck, so that no edge catches the block
WALL_M = 0.012
TILT_RAD = 0.015  # of the rough board: its near edge is below the deck in either position
SUNK_M = 0.012
STILL_M = 0.003  # a block that moves less than this any more is at rest
COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")
PLAY_COLOURS = apart(*COLOURS)


def _incline_colour(rng: np.random.Generator, so_far: Drawn) -> str:
    """Draw any colour but that of the deck."""
    return str(rng.choice([c for c in ("wood", "grey", "black") if c != so_far["deck_colour"]]))


@dataclass(frozen=True)
class Params:
    """Parameters; lengths run from the incline's foot; direction +1 is right."""

    direction: int = one_of(-1, 1)
    block_colour: str = PLAY_COLOURS()
    tray_colour: str = PLAY_COLOURS()
    deck_colour: str = one_of("wood", "grey")
    incline_colour: str = drawn_by(_incline_colour)
    block_half_m: tuple[float, float, float] = drawn_by(  # along, across, up
        lambda rng, so_far: (uniform(rng, 0.048, 0.060), uniform(rng, 0.045, 0.055), uniform(rng, 0.026, 0.034))
    )
    rough: bool = hidden(False, True)  # whether the board stands out of the deck
    slope_deg: float = between(12, 14.5)
    incline_m: float = between(0.82, 0.90)  # length of the incline's surface
    start_m: float = between(0.08, 0.14)  # from the incline's top to the middle of the block
    deck_friction: float = between(0.03, 0.06)
    rough_friction: float = between(0.75, 0.95)
    deck_m: float = between(0.12, 0.16)  # height of the deck
    mouth_m: float = between(0.03, 0.08)  # deck that is seen before the occluder
    lead_m: float = drawn_by(  # deck behind the occluder before the board
        lambda rng, so_far: 2 * so_far["block_half_m"][0] + uniform(rng, 0.05, 0.09)
    )
    board_m: float = between(0.24, 0.30)
    after_m: float = between(0.10, 0.15)  # deck behind the board
    tray_m: float = between(0.28, 0.34)
    azimuth_deg: float = facing(-18, 10)
    elevation_deg: float = between(-36, -25)

    @property
    def board_span(self) -> Span:
        """Start and end of the rough board."""
        return (self.mouth_m + self.lead_m, self.mouth_m + self.lead_m + self.board_m)

    @property
    def deck_end_m(self) -> float:
        """Position of the deck's end."""
        return self.board_span[1] + self.after_m


def build(p: Params, physics: Physics) -> Scene:
    """Build deck, incline with its support and block, the board in the deck, and tray."""
    course = Course(physics, p.direction)
    half_width, deck_end, end = p.block_half_m[1] + 0.04, p.deck_end_m, p.deck_end_m + p.tray_m
    depth_span, outer, tray = (
        (-half_width, half_width),
        (-half_width - WALL_M, half_width + WALL_M),
        (p.deck_end_m, end),
    )

    deck = course.block("deck", (-OVERLAP_M, deck_end), depth_span, (0, p.deck_m), p.deck_colour)
    ramp = Ramp(p.slope_deg, p.deck_m)
    half_size = ((p.incline_m + OVERLAP_M / 2) / 2, half_width, INCLINE_M / 2)
    middle = (p.incline_m - OVERLAP_M / 2) / 2
    incline = ramp.board(course, "incline", middle, -INCLINE_M / 2, half_size, p.incline_colour)
    for geom in (deck, incline):
        geom.friction, geom.priority = [p.deck_friction, 0.001, 0.0001], 1
    ramp.support(course, "support", p.incline_m - 0.05, INCLINE_M, 0.8 * half_width, p.deck_colour)
    start = ramp.at(p.incline_m - p.start_m, p.block_half_m[2])
    block = course.free_box("block", start, p.block_half_m, p.block_colour, density=600)
    turn = ramp.slope_rad / 2
    block.quat = [float(np.cos(turn)), 0.0, p.direction * float(np.sin(turn)), 0.0]
    _add_board(course, p, half_width)
    course.block("tray_floor", tray, depth_span, (0, WALL_M), p.tray_colour)
    course.block("tray_front", tray, (outer[0], -half_width), (0, 0.03), p.tray_colour)
    course.block("tray_back", tray, (half_width, outer[1]), (0, 0.07), p.tray_colour)
    course.block("tray_end", (end, end + WALL_M), outer, (0, p.deck_m + 0.02), p.tray_colour)

    high, along = p.deck_m + 2 * max(p.block_half_m) + 0.01, (p.mouth_m, end + WALL_M)
    across = (outer[0] - 0.01, outer[1] + 0.5 * high)
    incline_top = ramp.at(p.incline_m)
    course.mark("tray", "tray_floor")
    return course.scene(
        p,
        decisive=["block"],
        hidden=["board"],
        cover=course.box(along, across, (0, high), right=course.ahead(SHADOW_RIGHT * high)),
        in_view=[
            course.box(along, outer, (0, p.deck_m)),
            course.box((incline_top[0], 0), depth_span, (0, incline_top[2])),
        ],
        things=[f"{p.block_colour} block", f"{p.tray_colour} tray", "incline", "deck"],
        also=["end"],
        shown_by={"end": ["deck"]},
    )


def _add_board(course: Course, p: Params, side: float) -> None:
    """Add the rough board, tilted a little; it stands out of the deck or stays below."""
    begin, end = p.board_span
    half_length, thickness = (end - begin) / 2, 0.03
    rise = half_length * TILT_RAD - 0.001  # of its middle over the deck when the near edge is just below the surface
    middle = (begin + half_length, 0, p.deck_m + rise - thickness / 2 - (0.0 if p.rough else SUNK_M))
    board = course.slab("board", middle, (half_length, side - 0.002, thickness / 2), "black", falls_rad=-TILT_RAD)
    board.friction, board.priority = [p.rough_friction, 0.005, 0.0001], 2


def outcome(motion: Motion, p: Params) -> Reading:
    """Read whether the block is off the deck, past its end; 'no' only once it rests."""
    block = motion.pos("block")
    past_m = p.direction * block[:, 0] - p.deck_end_m
    is_off = (past_m > 0) & (block[:, 2] < p.deck_m)
    return Reading(yes_while(is_off, still_from(block, within_m=STILL_M)), float(abs(past_m[-1])))


BLOCK = partial(compact_blob, area=4500, shape=(0.3, 3.5), fill=0.4)
FAMILY = scene_family(
    "slide",
    category="ramps_rolling",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {block} block slide off the end of the deck into the {tray} tray, yes or no?",
        "Does the sliding {block} block end up in the {tray} tray: yes or no?",
        "Does the {block} block keep sliding until it drops into the {tray} tray, yes or no?",
        yes=["yes it does", "it slides off", "it drops into the tray"],
        no=["no it does not", "it stops on the deck", "it stays on the deck"],
    ),
    asides=[
        comes_from("From which side does the block start to slide, left or right?"),
        colour_from("block", "What colour is the sliding block: {choices}?", COLOURS, unlike=("block", "tray")),
        material_of("incline", "What colour is the incline that the block slides down: {choices}?"),
    ],
    observe=rests_over("block", "tray", find=BLOCK),
    foresee=rests_over("block", "tray", find=BLOCK, ahead=AHEAD),
    min_margin_m=0.03,
)
