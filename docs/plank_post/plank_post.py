"""A ball rolls along a plank towards a tray; the question is whether it gets there.

Control: plank and tray are in view. Void: the occluder stands before all but the beginning of the plank.
Hidden element: a post that stands in the ball's way, or behind the plank.
"""

from __future__ import annotations

from dataclasses import dataclass

from traps_pipeline.scenes.parts.course import SOFT, Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import rests_over
from traps_pipeline.scenes.parts.questions import colour_of, comes_from, yes_no
from traps_pipeline.scenes.parts.readings import Reading, clear_m, still_from, yes_while
from traps_pipeline.scenes.parts.vary import apart, between, facing, hidden, one_of, shuffled
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene

PLANK_M = 0.04  # height of the plank's upper face
WALL_M = 0.012  # thickness of rails and of the tray's walls
POST_M = 0.012  # radius of the post
STILL_M = 0.01  # a ball that moves less than this any more is as good as at rest
PLAY_COLOURS, PLAIN_COLOURS = (
    apart("red", "green", "blue", "yellow", "cyan", "purple"),
    shuffled("wood", "grey", "white"),
)


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. Lengths run along the plank, from its beginning."""

    direction: int = one_of(-1, 1)
    ball_colour: str = PLAY_COLOURS()
    tray_colour: str = PLAY_COLOURS()
    plank_colour: str = PLAIN_COLOURS()
    rail_colour: str = PLAIN_COLOURS()
    post_in_way: bool = hidden(False, True)
    radius_m: float = between(0.045, 0.055)
    speed_m_s: float = between(0.55, 0.75)
    seen_m: float = between(0.55, 0.65)  # plank before the occluder
    before_m: float = between(0.25, 0.35)  # from the occluder to the post
    after_m: float = between(0.15, 0.25)  # from the post to the tray
    tray_m: float = between(0.20, 0.26)
    azimuth_deg: float = facing(-15, 18)
    elevation_deg: float = between(-36, -24)

    @property
    def plank_m(self) -> float:
        """Where the plank ends and the tray begins."""
        return self.seen_m + self.before_m + self.after_m


def build(p: Params, physics: Physics) -> Scene:
    """Plank between rails, tray at its end, post, ball."""
    course = Course(physics, p.direction)
    r, side, end, high = p.radius_m, 1.5 * p.radius_m, p.plank_m + p.tray_m, PLANK_M + 2 * p.radius_m
    outer = (-side - WALL_M, side + WALL_M)

    course.block("plank", (0, p.plank_m), (-side, side), (0, PLANK_M), p.plank_colour, Surface(5e-4))
    course.sides("rail", (0, p.plank_m), side, WALL_M, (0, PLANK_M + 0.3 * r), p.rail_colour)
    walls, floor = PLANK_M + 0.3 * r, Surface(4e-3, solref=SOFT)
    tray = ((p.plank_m, end), outer, (0, 0.012))
    course.tray("tray", *tray, p.tray_colour, wall=WALL_M, far=high, back=walls, front=walls, floor=floor)
    post_at = (p.seen_m + p.before_m, 0 if p.post_in_way else outer[1] + 2 * POST_M, high / 2)
    post = course.post("post", post_at, POST_M, high / 2, "black")
    post.priority = 1  # its contact counts, which is without rebound
    course.ball("ball", (1.5 * r, 0, PLANK_M + r), r, p.ball_colour, speed=p.speed_m_s)
    course.mark("tray", "tray_floor")
    return course.scene(
        p,
        decisive=["ball"],
        hidden=["post"],
        cover=course.cover((p.seen_m, end + WALL_M), (outer[0], outer[1] + 3 * POST_M), high),
        in_view=[course.box((0, end + WALL_M), outer, (0, high))],
        things=[f"{p.ball_colour} ball", f"{p.tray_colour} tray", "plank"],
        also=["rail", "post"],
        colours=["black"],
    )


def outcome(motion: Motion, p: Params) -> Reading:
    """'yes' while the ball's middle is over the tray; 'no' while it is not, from when it is as good as at rest. The
    margin is how far it ends past the plank by its middle, or before its end by its front."""
    past = p.direction * motion.pos("ball")[:, 0] - p.plank_m
    return Reading(yes_while(past > 0, still_from(past, within_m=STILL_M)), clear_m(past, p.radius_m))


FAMILY = scene_family(
    "plank_post",
    category="ramps_rolling",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {ball} ball roll along the plank into the {tray} tray, yes or no?",
        "Is the {ball} ball in the {tray} tray at the end of the plank when it has come to rest: yes or no?",
        yes=["yes it does", "it rolls into the tray", "it lies in the tray"],
        no=["no it does not", "it does not reach the tray", "it stops before the tray"],
    ),
    asides=[
        colour_of("ball", "What colour is the ball on the plank: {choices}?", ("ball", "tray", "plank", "rail")),
        comes_from("From which side does the ball roll in, left or right?"),
    ],
    observe=rests_over("ball", "tray"),
    min_margin_m=0.03,
)
