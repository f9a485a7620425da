"""A ball strikes a block, which slides on: does the block reach the zone?

Control: deck and zone are in view. Void: the occluder stands before them; the ball is seen to roll in behind it.
Hidden element: the board between block and zone, which is slick or rough. The ramp ends in a step, so that nothing
that happens on the deck comes back out.
"""

from dataclasses import dataclass

from traps_pipeline.scenes.parts.course import SHADOW_BACK, Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD, lies_on, reaches
from traps_pipeline.scenes.parts.questions import colour_of, comes_from, yes_no
from traps_pipeline.scenes.parts.ramp import SteppedRamp
from traps_pipeline.scenes.parts.readings import Reading, clear_m, still_from, yes_while
from traps_pipeline.scenes.parts.vary import apart, between, facing, hidden, one_of, shuffled
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene

DECK_M = 0.03
STEP_M = 0.022  # the ramp ends this high over the deck
WALL_M = 0.014
SIDE_M = 0.085  # half the deck's width
STILL_M = 0.002  # a block that moves less than this any more is at rest
PLAY_COLOURS = apart("red", "green", "blue", "yellow", "cyan", "purple")
PLAIN_COLOURS = shuffled("wood", "grey", "white")


@dataclass(frozen=True)
class Params:
    """Parameters; lengths run from the ramp's upper end; direction +1 is right."""

    direction: int = one_of(-1, 1)
    ball_colour: str = PLAY_COLOURS()
    block_colour: str = PLAY_COLOURS()
    zone_colour: str = PLAY_COLOURS()
    deck_colour: str = PLAIN_COLOURS()
    ramp_colour: str = PLAIN_COLOURS()
    radius_m: float = between(0.046, 0.056)
    shape: str = one_of("box", "cylinder")  # of the block
    start_m: float = between(0.06, 0.14)
    ramp_m: float = between(0.58, 0.68)
    slope_deg: float = between(7.0, 9.0)
    block_m: float = between(0.085, 0.105)  # size of the block
    ahead_m: float = between(0.18, 0.24)  # from the ramp's end to the block
    gap_m: float = between(0.20, 0.26)  # from the block to the zone
    zone_m: float = between(0.20, 0.25)
    rough: bool = hidden(False, True)  # the board between block and zone
    slick_friction: float = between(0.018, 0.032)
    rough_friction: float = between(0.55, 0.75)
    azimuth_deg: float = facing(-18, 20)
    elevation_deg: float = between(-38, -24)

    @property
    def target(self) -> str:
        """Word for the block by its shape."""
        return "block" if self.shape == "box" else "cylinder"

    @property
    def block_at_m(self) -> float:
        """Initial position of the block's middle."""
        return self.ramp_m + self.ahead_m + self.block_m / 2

    @property
    def zone_at_m(self) -> float:
        """Position at which the zone begins."""
        return self.block_at_m + self.block_m / 2 + self.gap_m


def build(p: Params, physics: Physics) -> Scene:
    """Build ramp, step, deck with low rims, and zone before an end wall."""
    course = Course(physics, p.direction)
    r, end, board_at = p.radius_m, p.zone_at_m + p.zone_m, p.block_at_m - p.block_m / 2 - 0.03
    depth_span, outer, deck = (-SIDE_M, SIDE_M), (-SIDE_M - WALL_M, SIDE_M + WALL_M), (0, DECK_M)
    board = Surface(4e-4, sliding=p.rough_friction if p.rough else p.slick_friction, priority=2)

    ramp = SteppedRamp(p.ramp_m, p.slope_deg, DECK_M + STEP_M)
    ramp.add(course, SIDE_M, p.ramp_colour)
    course.ball("ball", ramp.at(p.start_m, r), r, p.ball_colour, rolling=0.0002, density=800)
    course.block("deck", (p.ramp_m, board_at), depth_span, deck, p.deck_colour)
    course.block("board", (board_at, p.zone_at_m), depth_span, deck, p.deck_colour, board)
    course.block("zone", (p.zone_at_m, end), depth_span, deck, p.zone_colour, Surface(4e-4, sliding=0.25, priority=2))
    course.sides("rim", (p.ramp_m, end), SIDE_M, WALL_M, (0, DECK_M + 0.016), p.ramp_colour)
    wall = course.block("end_wall", (end, end + WALL_M), outer, (0, DECK_M + 0.05), p.ramp_colour)
    wall.priority = 3  # dead: the block stays where it strikes the wall
    _add_target(course, p)

    high = DECK_M + max(p.block_m, 2 * r)
    along, across = (p.ramp_m - 0.04, end + WALL_M), (outer[0] - 0.02, outer[1] + SHADOW_BACK * high)
    course.mark(p.target, "block")
    course.mark("zone", "zone")
    return course.scene(
        p,
        decisive=["block"],
        hidden=["board"],
        cover=course.box(along, across, (0, high), right=0.45 * high),
        in_view=[course.box((0, end), outer, (0, high))],
        things=[f"{p.ball_colour} ball", f"{p.block_colour} {p.target}", f"{p.zone_colour} zone", "ramp"],
        also=["deck", "wall"],
    )


def _add_target(course: Course, p: Params) -> None:
    """Add the free block, a cube or an upright cylinder."""
    import mujoco

    half_block = p.block_m / 2
    at = (p.block_at_m, 0, DECK_M + half_block)
    solref = (-20000.0, -25.0)
    body = course.free_box(
        "block", at, (half_block, half_block, half_block), p.block_colour, density=700, sliding=0.1, solref=solref
    )
    geom = body.first_geom()
    geom.priority = 1
    if p.shape == "cylinder":
        geom.type, geom.size = mujoco.mjtGeom.mjGEOM_CYLINDER, [half_block, half_block, 0]


def outcome(motion: Motion, p: Params) -> Reading:
    """Read whether the block's middle is in the zone; 'no' only once it rests."""
    ahead = p.direction * motion.pos("block")[:, 0] - p.zone_at_m
    return Reading(yes_while(ahead > 0, still_from(ahead, within_m=STILL_M)), clear_m(ahead, p.block_m / 2))


FAMILY = scene_family(
    "transfer",
    category="collisions",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {block} {target} that the ball strikes reach the {zone} zone, yes or no?",
        "After the ball has struck it, does the {block} {target} slide into the {zone} zone: yes or no?",
        "Does the {block} {target} end up in the {zone} zone, yes or no?",
        yes=["yes it does", "it reaches the zone", "it slides into the zone"],
        no=["no it does not", "it does not reach the zone", "it stops before the zone", "it stops short"],
        fills=lambda p, rng: {"target": p.target},
    ),
    asides=[
        colour_of("ball", "What colour is the ball that rolls down the ramp: {choices}?", ("ball", "block", "zone")),
        comes_from("From which side does the ball roll in, left or right?"),
    ],
    observe=reaches("block", "zone", foot=0.8),
    foresee=reaches("block", "zone", foot=0.8, ahead=AHEAD),
    look=lies_on("block", "zone"),
    min_margin_m=0.03,
)
