"""A ball rolls on to a road under a footbridge: does it come out beyond?

Control: the road under the bridge and beyond is in view. Void: the occluder stands before the far half of the bridge
and the road beyond.
Hidden element: a kerb under the bridge, which lies across the road or along its far edge.
"""

from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.parts.course import Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD, past_far_edge
from traps_pipeline.scenes.parts.questions import colour_from, comes_from, yes_no
from traps_pipeline.scenes.parts.readings import Reading, read_passage
from traps_pipeline.scenes.parts.vary import apart, between, facing, hidden, one_of, shuffled
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene, Vec3

ROAD_M = 0.02
SLAB_M = 0.03
RAILING_M = 0.05
BALL_COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")
PLAY_COLOURS, PLAIN_COLOURS = apart(*BALL_COLOURS), shuffled("wood", "grey", "white", "black")


@dataclass(frozen=True)
class Params:
    """Parameters; lengths run from the bridge's near edge; direction +1 is right."""

    ball_colour: str = PLAY_COLOURS()
    bridge_colour: str = PLAY_COLOURS()
    road_colour: str = PLAIN_COLOURS()
    ramp_colour: str = PLAIN_COLOURS()
    kerb_colour: str = PLAIN_COLOURS()
    direction: int = one_of(-1, 1)
    blocked: bool = hidden(False, True)  # whether the kerb lies across the road
    radius_m: float = between(0.048, 0.056)
    slope_deg: float = between(10, 15)
    ramp_m: float = between(0.34, 0.42)  # length of the ramp along the ground
    flat_m: float = between(0.38, 0.46)  # road from the ramp to the bridge
    bridge_m: float = between(0.40, 0.46)  # width of the bridge, along the road
    span_m: float = between(0.42, 0.50)  # length of the bridge, across the road
    height_m: float = between(0.22, 0.25)  # of the bridge's lower side
    mouth_m: float = between(0.05, 0.08)  # part of the bridge that is seen beside the occluder
    beyond_m: float = between(0.30, 0.38)  # road past the bridge
    hump_m: float = between(0.06, 0.09)  # how much higher its middle is
    planks: int = one_of(7, 9)
    azimuth_deg: float = facing(-16, 10)
    elevation_deg: float = between(-24, -18)


def build(p: Params, physics: Physics) -> Scene:
    """Build a ramp, a road with an end wall, and a bridge on four legs across it."""
    course = Course(physics, p.direction)
    r, end, half_width = p.radius_m, p.bridge_m + p.beyond_m, 1.6 * p.radius_m
    depth_span, road = (-half_width, half_width), (0, ROAD_M)
    stop = 0.62 * p.bridge_m + r  # where the kerb's face is: the ball rests in the middle of the bridge
    bed = (stop - 3.5 * r, stop)  # rough: a ball that bounces off the kerb stays there

    course.block("road_in", (-p.flat_m, bed[0]), depth_span, road, p.road_colour, Surface(1e-4))
    course.block("road_bed", bed, depth_span, road, p.road_colour, Surface(0.003))
    course.block("road_out", (bed[1], end), depth_span, road, p.road_colour, Surface(0.004))
    course.block("end_wall", (end, end + 0.015), depth_span, (0, ROAD_M + 1.4 * r), p.road_colour)
    start = _add_ramp(course, p, half_width)
    _add_bridge(course, p)
    along, across, up = (stop, stop + 0.04), depth_span, (ROAD_M, ROAD_M + 0.9 * r)
    if not p.blocked:
        along, across, up = (
            (stop + 0.02 - half_width, stop + 0.02 + half_width),
            (half_width, half_width + 0.04),
            (0, 0.9 * r),
        )
    course.block("kerb", along, across, up, p.kerb_colour, Surface(0.001, sliding=0.2))
    course.ball("ball", start, r, p.ball_colour, rolling=1e-4)

    high, front = ROAD_M + 2.1 * r, -p.span_m / 2 - 0.01
    top = p.height_m + p.hump_m + SLAB_M + RAILING_M + 0.03
    return course.scene(
        p,
        decisive=["ball"],
        hidden=["kerb"],
        cover=course.cover((p.mouth_m, end + 0.015), (front, half_width + 0.04), high),
        in_view=[
            course.box((-(p.flat_m + p.ramp_m), end), depth_span, (0, high)),
            course.box((0, p.bridge_m), (front, -front), (0, top)),
        ],
        things=[f"{p.ball_colour} ball", f"{p.bridge_colour} bridge", "ramp", "road", "railing of the bridge"],
        also=["railing", "kerb"],
        shown_by={"bridge": ["plank", "handrail", "leg"]},
    )


def _add_ramp(course: Course, p: Params, side: float) -> Vec3:
    """Add the ramp down to the road; return where the ball starts on it."""
    slope, thickness = float(np.radians(p.slope_deg)), 0.012
    length = p.ramp_m / np.cos(slope)
    foot = np.array([-p.flat_m, ROAD_M])
    up, normal = np.array([-np.cos(slope), np.sin(slope)]), np.array([np.sin(slope), np.cos(slope)])
    middle = foot + up * length / 2 - normal * thickness
    course.slab("ramp", (middle[0], 0, middle[1]), (length / 2, side, thickness), p.ramp_colour, falls_rad=slope)
    top = foot + up * (length - 0.03) - normal * thickness
    half_height = (top[1] - 0.008) / 2
    course.slab("ramp_post", (top[0], 0, half_height), (0.02, side * 0.8, half_height), p.ramp_colour)
    ball = foot + up * (length - 1.2 * p.radius_m) + normal * p.radius_m
    return float(ball[0]), 0.0, float(ball[1])


def _add_bridge(course: Course, p: Params) -> None:
    """Add a humped deck of planks on four legs, with a railing on either edge."""
    half_span, post, pitch, colour = p.span_m / 2, 0.014, p.span_m / p.planks, p.bridge_colour
    edges = ((0, 2 * post), (p.bridge_m - 2 * post, p.bridge_m))
    for k in range(p.planks):
        y = -half_span + (k + 0.5) * pitch
        z = p.height_m + p.hump_m * (1 - (y / half_span) ** 2)
        rail = z + SLAB_M + RAILING_M
        course.block(f"plank_{k}", (0, p.bridge_m), (y - 0.47 * pitch, y + 0.47 * pitch), (z, z + SLAB_M), colour)
        for i, along in enumerate(edges):
            course.block(f"handrail_{i}{k}", along, (y - pitch / 2, y + pitch / 2), (rail, rail + 0.03), colour)
            if k % 2 == 0:
                course.block(f"post_{i}{k}", along, (y - post / 2, y + post / 2), (z + SLAB_M, rail), colour)
            if k in (0, p.planks - 1):
                course.block(f"leg_{i}{k}", along, (y - post, y + post), (0, z), colour)


def outcome(motion: Motion, p: Params) -> Reading:
    """Read whether the ball is wholly past the bridge, or stays where it is under it."""
    return read_passage(p.direction * motion.pos("ball")[:, 0] - p.radius_m - p.bridge_m, p.radius_m)


FAMILY = scene_family(
    "under_bridge",
    category="hidden",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {ball} ball roll out from under the {bridge} bridge at the other end, yes or no?",
        "Once it is under the {bridge} bridge, does the {ball} ball get through to the far side: yes or no?",
        "Does the {ball} ball make it all the way under the {bridge} bridge and out again, yes or no?",
        yes=["it rolls out", "it gets through", "yes it gets through", "it comes out at the other end"],
        no=[
            "it does not get through",
            "no it does not get through",
            "it stays under the bridge",
            "it stops under the bridge",
        ],
    ),
    asides=[
        comes_from("On which side of the bridge is the ramp that the ball rolls down, left or right?"),
        colour_from("ball", "What colour is the ball: {choices}?", BALL_COLOURS, unlike=("ball", "bridge")),
        colour_from("bridge", "What colour is the bridge: {choices}?", BALL_COLOURS, unlike=("ball", "bridge")),
    ],
    observe=past_far_edge("ball", "bridge"),
    foresee=past_far_edge("ball", "bridge", ahead=AHEAD),
    min_margin_m=0.02,
)
