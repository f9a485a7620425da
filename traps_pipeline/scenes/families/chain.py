"""A ball strikes a row of balls: does the last one roll into the coloured box?

Control: the whole row and the box are in view. Void: the occluder stands before them; the striker rolls in behind it.
Hidden element: a peg that stands between two balls of the row and stops the impact there, or stands beside the row.
The ramp ends in a step, so that nothing that happens in the row comes back out.
"""

from dataclasses import dataclass

from traps_pipeline.scenes.parts.course import SHADOW_BACK, Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import has_begun, lies_on, reaches
from traps_pipeline.scenes.parts.questions import colour_of, comes_from, yes_no
from traps_pipeline.scenes.parts.ramp import SteppedRamp
from traps_pipeline.scenes.parts.readings import Reading, clear_m, still_from, yes_while
from traps_pipeline.scenes.parts.vary import apart, between, drawn_by, facing, hidden, one_of, shuffled
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene

DECK_M = 0.045
STEP_M = 0.020  # the ramp ends this high over the deck
BOX_FLOOR_M = 0.015  # the floor of the box lies this high: lower than the deck, so that the ball stays in it
WALL_M = 0.012
PEG_M = 0.008  # radius of the peg
STILL_M = 0.01  # a ball that moves less than this any more is as good as at rest
LIVELY = Surface(2e-5, sliding=0.02, solref=(-20000.0, -8.0))  # a ball that hands nearly all of its speed on
PLAY_COLOURS, PLAIN_COLOURS = (
    apart("red", "green", "blue", "yellow", "cyan", "purple"),
    shuffled("wood", "grey", "white"),
)


@dataclass(frozen=True)
class Params:
    """Parameters; lengths run from the ramp's upper end; direction +1 is right."""

    direction: int = one_of(-1, 1)
    striker_colour: str = PLAY_COLOURS()
    row_colour: str = PLAY_COLOURS()
    last_colour: str = PLAY_COLOURS()
    box_colour: str = PLAY_COLOURS()
    deck_colour: str = PLAIN_COLOURS()
    ramp_colour: str = PLAIN_COLOURS()
    row: int = one_of(3, 4, longer=(5, 6))  # balls in the row, the last one included
    radius_m: float = between(0.046, 0.054)
    gap_m: float = between(0.030, 0.038)  # between two balls of the row
    start_m: float = between(0.06, 0.12)
    ramp_m: float = between(0.56, 0.64)
    slope_deg: float = between(9.0, 11.0)
    ahead_m: float = between(0.18, 0.22)  # from the ramp's end to the first ball
    beyond_m: float = between(0.10, 0.14)  # from the last ball to the box
    box_m: float = between(0.17, 0.21)
    peg_after: int = drawn_by(lambda rng, so_far: int(rng.integers(so_far["row"] - 1)))  # ball before the peg's place
    blocked: bool = hidden(False, True)  # whether the peg stands there, or beside the row
    azimuth_deg: float = facing(-18, 20)
    elevation_deg: float = between(-38, -24)

    @property
    def balls_m(self) -> tuple[float, ...]:
        """Initial positions of the row's balls."""
        first = self.ramp_m + self.ahead_m + self.radius_m
        return tuple(first + i * (2 * self.radius_m + self.gap_m) for i in range(self.row))

    @property
    def balls(self) -> list[str]:
        """Bodies of the row, from the ramp on."""
        return [*(f"ball_{i}" for i in range(self.row - 1)), "last"]

    @property
    def box_at_m(self) -> float:
        """Position at which the box begins."""
        return self.balls_m[-1] + self.radius_m + self.beyond_m


def build(p: Params, physics: Physics) -> Scene:
    """Build ramp, step, deck with the row between low rims, and sunken box."""
    course = Course(physics, p.direction)
    r, half_width, end = p.radius_m, 1.35 * p.radius_m, p.box_at_m + p.box_m
    depth_span, outer = (-half_width, half_width), (-half_width - WALL_M, half_width + WALL_M)
    deck_span, box_span = (p.ramp_m, p.box_at_m), (p.box_at_m, end)

    ramp = SteppedRamp(p.ramp_m, p.slope_deg, DECK_M + STEP_M)
    Surface(2e-5, priority=2).on(ramp.add(course, half_width, p.ramp_colour))
    LIVELY.on(course.ball("striker", ramp.at(p.start_m, r), r, p.striker_colour))
    course.block("deck", deck_span, depth_span, (0, DECK_M), p.deck_colour, Surface(1.5e-3, sliding=0.4, priority=2))
    course.block(
        "box_floor", box_span, depth_span, (0, BOX_FLOOR_M), p.box_colour, Surface(2e-3, sliding=0.4, priority=2)
    )
    for name, across in (("rim_front", (outer[0], -half_width)), ("rim_back", (half_width, outer[1]))):
        course.block(name, deck_span, across, (0, DECK_M + 0.25 * r), p.ramp_colour)
        course.block(f"box_{name}", box_span, across, (0, DECK_M), p.box_colour)
    wall = course.block("box_end", (end, end + WALL_M), outer, (0, DECK_M + r), p.box_colour)
    wall.priority = 3  # dead: the ball stays in the box
    for name, along in zip(p.balls, p.balls_m, strict=True):
        colour = p.last_colour if name == "last" else p.row_colour
        LIVELY.on(course.ball(name, (along, 0, DECK_M + r), r, colour))
    peg_at = p.balls_m[p.peg_after] + r + p.gap_m / 2
    peg_offset, peg_half_height = 0.0 if p.blocked else half_width + WALL_M + 2 * PEG_M, (DECK_M + 1.9 * r) / 2
    course.post(
        "peg", (peg_at, peg_offset, peg_half_height), PEG_M, peg_half_height, "black"
    ).priority = 3  # dead: the ball stops at it

    high = DECK_M + 2 * r
    across = (outer[0] - 0.02, outer[1] + 4 * PEG_M + SHADOW_BACK * high)
    course.mark("ball", "last")
    course.mark("box", "box_floor")
    return course.scene(
        p,
        decisive=["last"],
        hidden=["peg"],
        cover=course.box((p.ramp_m - 0.04, end + WALL_M), across, (0, high), right=0.45 * high),
        in_view=[course.box((0, end), outer, (0, high))],
        things=[f"{p.striker_colour} ball", f"{p.last_colour} ball", f"{p.box_colour} box", "ramp"],
        also=["row", "deck", "peg"],
        colours=["black"],
        shown_by={"row": ["ball"]},
    )


def outcome(motion: Motion, p: Params) -> Reading:
    """Read whether the last ball's middle is in the box; 'no' only once all rest."""
    along = {ball: p.direction * motion.pos(ball)[:, 0] for ball in ("striker", *p.balls)}
    ahead = along["last"] - p.box_at_m
    rest_frame = still_from(*along.values(), within_m=STILL_M)
    return Reading(yes_while(ahead > 0, rest_frame), clear_m(ahead, p.radius_m))


FAMILY = scene_family(
    "chain",
    category="collisions",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the last ball of the row, the {last} one, roll into the {box} box, yes or no?",
        "Is the impact passed on so that the {last} ball ends in the {box} box: yes or no?",
        "Does the {last} ball at the end of the row get into the {box} box, yes or no?",
        yes=["yes it does", "it rolls into the box", "it ends in the box"],
        no=["no it does not", "it does not roll into the box", "it stays where it is", "it stays in the row"],
    ),
    asides=[
        colour_of(
            "striker",
            "Which colour is the ball that comes down the ramp: {choices}?",
            ("striker", "row", "last", "box"),
        ),
        comes_from("On which side does the ball on the ramp start, left or right?"),
    ],
    observe=reaches("last", "box"),
    foresee=has_begun("last", reach=0.25),
    look=lies_on("last", "box"),
    min_margin_m=0.03,
)
