"""A ball rolls along a deck with a box at its end: does it reach the box?

Control: the whole deck and the box are in view. Void: the occluder stands before all but the beginning of the deck.
Hidden element: a board that bridges a gap in the deck, or lies on the ground below it, so that the ball falls in.
"""

from dataclasses import dataclass

from traps_pipeline.scenes.parts.course import SHADOW_RIGHT, Course, Span
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD, rests_over
from traps_pipeline.scenes.parts.questions import colour_from, comes_from, material_of, yes_no
from traps_pipeline.scenes.parts.ramp import Ramp
from traps_pipeline.scenes.parts.readings import Reading
from traps_pipeline.scenes.parts.vary import apart, between, drawn_by, facing, hidden, one_of, shuffled
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene, uniform

BOARD_M = 0.016  # thickness of ramp and board
WALL_M = 0.012
COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")
PLAY_COLOURS, PLAIN_COLOURS = apart(*COLOURS), shuffled("wood", "grey", "black")


@dataclass(frozen=True)
class Params:
    """Parameters; lengths run from the ramp's foot; direction +1 is right."""

    direction: int = one_of(-1, 1)
    ball_colour: str = PLAY_COLOURS()
    box_colour: str = PLAY_COLOURS()
    ramp_colour: str = PLAIN_COLOURS()
    deck_colour: str = PLAIN_COLOURS()
    radius_m: float = between(0.045, 0.054)
    gap_open: bool = hidden(False, True)
    slope_deg: float = between(11, 18)
    ramp_m: float = between(0.36, 0.46)  # length of the ramp's surface
    start_m: float = between(0.06, 0.13)  # from the ramp's top to where the ball starts
    deck_m: float = between(0.13, 0.17)  # height of the deck
    mouth_m: float = between(0.04, 0.10)  # deck that is seen before the occluder
    lead_m: float = drawn_by(  # deck behind the occluder before the gap
        lambda rng, so_far: 2 * so_far["radius_m"] + uniform(rng, 0.06, 0.11)
    )
    gap_m: float = drawn_by(lambda rng, so_far: uniform(rng, 3.3, 3.8) * so_far["radius_m"])
    after_m: float = between(0.12, 0.26)  # deck behind the gap
    box_m: float = between(0.19, 0.24)
    azimuth_deg: float = facing(-18, 12)
    elevation_deg: float = between(-36, -25)

    @property
    def gap_span(self) -> Span:
        """Start and end of the gap."""
        return (self.mouth_m + self.lead_m, self.mouth_m + self.lead_m + self.gap_m)

    @property
    def deck_end_m(self) -> float:
        """Position at which the deck ends and the box begins."""
        return self.gap_span[1] + self.after_m


def build(p: Params, physics: Physics) -> Scene:
    """Build ramp with rails and support, deck in two parts with a gap, and box."""
    course = Course(physics, p.direction)
    r, half_width, gap, end = p.radius_m, 1.7 * p.radius_m, p.gap_span, p.deck_end_m + p.box_m
    depth_span, deck, box = (-half_width, half_width), (0, p.deck_m), (p.deck_end_m, end)
    ramp, middle = Ramp(p.slope_deg, p.deck_m), p.ramp_m / 2

    ramp.board(course, "ramp", middle, -BOARD_M / 2, (middle, half_width, BOARD_M / 2), p.ramp_colour)
    for name, y in (("front", -half_width), ("back", half_width)):
        ramp.board(course, f"rail_{name}", middle, 0, (middle, 0.005, 0.4 * r), p.ramp_colour, aside=y)
    ramp.support(course, "support", p.ramp_m - 0.05, BOARD_M, 0.8 * half_width, p.deck_colour)
    course.ball("ball", ramp.at(p.ramp_m - p.start_m, r), r, p.ball_colour)
    course.block("deck_in", (-0.01, gap[0]), depth_span, deck, p.deck_colour)
    course.block("deck_out", (gap[1], p.deck_end_m), depth_span, deck, p.deck_colour)
    top = BOARD_M if p.gap_open else p.deck_m
    course.block("board", gap, depth_span, (top - BOARD_M, top), p.deck_colour).friction = [0.8, 0.005, 0.002]
    for name, y in (("front", -half_width), ("back", half_width)):
        course.block(f"pit_{name}", gap, (y - 0.005, y + 0.005), (0, 0.022), p.deck_colour)
    course.block("box_floor", box, depth_span, (0, WALL_M), p.box_colour).friction = [0.8, 0.005, 0.004]
    course.block("box_front", box, (-half_width - WALL_M, -half_width), (0, 0.035), p.box_colour)
    course.block("box_back", box, (half_width, half_width + WALL_M), (0, 0.09), p.box_colour)
    outer = (-half_width - WALL_M, half_width + WALL_M)
    course.block("box_end", (end, end + WALL_M), outer, (0, p.deck_m + 0.03), p.box_colour)

    high, along = p.deck_m + 2 * r + 0.01, (p.mouth_m, end + WALL_M)
    across = (outer[0] - 0.01, outer[1] + 0.5 * high)
    ramp_top = ramp.at(p.ramp_m)
    course.mark("box", "box_floor")
    return course.scene(
        p,
        decisive=["ball"],
        hidden=["board"],
        cover=course.box(along, across, (0, high), right=course.ahead(SHADOW_RIGHT * high)),
        in_view=[course.box(along, outer, deck), course.box((ramp_top[0], 0), depth_span, (0, ramp_top[2]))],
        things=[f"{p.ball_colour} ball", f"{p.box_colour} box", "ramp", "deck"],
        also=["end"],
        shown_by={"end": ["box"]},
    )


def outcome(motion: Motion, p: Params) -> Reading:
    """Read 'yes' once the ball is past the deck, 'no' once it is down in the gap."""
    ball = motion.pos("ball")
    past_m, depth = p.direction * ball[:, 0] - p.deck_end_m, p.deck_m + p.radius_m - ball[:, 2]
    labels = ["yes" if x > 0 else "no" if z > 0.5 * p.radius_m else None for x, z in zip(past_m, depth, strict=True)]
    return Reading(labels, float(past_m[-1] if past_m[-1] > 0 else depth[-1]))


FAMILY = scene_family(
    "ramp_gap",
    category="ramps_rolling",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {ball} ball reach the {box} box at the end of the deck, yes or no?",
        "Does the {ball} ball that rolls down the ramp get into the {box} box: yes or no?",
        "Is the {ball} ball in the {box} box at the end of the deck in the end, yes or no?",
        yes=["yes it does", "it reaches the box", "it lands in the box"],
        no=["no it does not", "it does not reach the box", "it falls into the gap"],
    ),
    asides=[
        comes_from("At which side is the ramp, left or right?"),
        colour_from("ball", "What colour is the ball: {choices}?", COLOURS, unlike=("ball", "box")),
        material_of("ramp", "What colour is the ramp: {choices}?"),
    ],
    observe=rests_over("ball", "box"),
    foresee=rests_over("ball", "box", ahead=AHEAD),
    min_margin_m=0.03,
)
