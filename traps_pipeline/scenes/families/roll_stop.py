"""A ball rolls along a track with a line across it: does it pass the line?

Control: the whole track is in view. Void: the occluder stands before all but its first part.
Hidden element: a patch of the track before the line, rough enough to stop the ball, or as smooth as the track.
A ball that passes the line stays at the felt before the end wall.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from traps_pipeline.scenes.parts.course import SHADOW_RIGHT, Course, brake
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD, compact_blob, end_of
from traps_pipeline.scenes.parts.questions import colour_of, comes_from, yes_no
from traps_pipeline.scenes.parts.readings import Reading, clear_m, still_from, yes_while
from traps_pipeline.scenes.parts.vary import apart, between, drawn_by, facing, hidden, one_of, shuffled
from traps_pipeline.scenes.parts.vision import colour_mask
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene, uniform

TRACK_M = 0.04  # height of the track
WALL_M = 0.014
LINE_M = 0.035  # width of a painted line
STILL_M = 0.003  # a ball that moves less than this any more is at rest
PLAY_COLOURS = apart("red", "green", "blue", "yellow", "orange", "cyan", "purple")
PLAIN_COLOURS = shuffled("wood", "grey", "white")
PARTS = ("ball", "start", "line")


@dataclass(frozen=True)
class Params:
    """Parameters; lengths run from the track's beginning; direction +1 is right."""

    direction: int = one_of(-1, 1)
    ball_colour: str = PLAY_COLOURS()
    start_colour: str = PLAY_COLOURS()  # of the line outside the occluder
    line_colour: str = PLAY_COLOURS()
    track_colour: str = PLAIN_COLOURS()
    wall_colour: str = PLAIN_COLOURS()
    radius_m: float = between(0.048, 0.058)
    rough: bool = hidden(False, True)
    speed_m_s: float = between(0.55, 0.80)
    run_m: float = between(0.56, 0.66)  # track before the occluder
    lead_m: float = drawn_by(  # track behind the occluder before the patch
        lambda rng, so_far: 2 * so_far["radius_m"] + uniform(rng, 0.04, 0.08)
    )
    patch_m: float = between(0.22, 0.30)
    stop_share: float = between(0.45, 0.85)  # where on a rough patch the ball stops
    line_at_m: float = between(0.08, 0.14)  # from the patch to the middle of the line
    felt_m: float = between(0.24, 0.32)  # from the line to the end wall
    half_width_m: float = between(0.11, 0.17)
    azimuth_deg: float = facing(-20, 20)
    elevation_deg: float = between(-40, -28)

    @property
    def line_m(self) -> float:
        """Position of the line's middle."""
        return self.run_m + self.lead_m + self.patch_m + self.line_at_m


def build(p: Params, physics: Physics) -> Scene:
    """Build track with kerbs, patch, two lines and end wall."""
    course = Course(physics, p.direction)
    r, half_width, end = p.radius_m, p.half_width_m, p.line_m + p.felt_m
    depth_span, outer, track = (-half_width, half_width), (-half_width - WALL_M, half_width + WALL_M), (0, TRACK_M)
    patch = (p.run_m + p.lead_m, p.run_m + p.lead_m + p.patch_m)
    rolling_friction = brake(r, p.speed_m_s**2, p.stop_share * p.patch_m, physics) if p.rough else 2e-5

    course.block("track_in", (-0.02, patch[0]), depth_span, track, p.track_colour)
    mat = course.block("patch", patch, depth_span, track, "black" if p.rough else p.track_colour)
    mat.friction = [4.0, 0.005, rolling_friction]
    course.block("track_out", (patch[1], p.line_m), depth_span, track, p.track_colour)
    course.block("felt", (p.line_m, end), depth_span, track, p.track_colour).friction = [0.8, 0.005, 0.006]
    for name, middle, colour in (("start_line", 0.6 * p.run_m, p.start_colour), ("line", p.line_m, p.line_colour)):
        line_span = (middle - LINE_M / 2, middle + LINE_M / 2)
        course.block(name, line_span, depth_span, (0, TRACK_M + 0.001), colour, solid=False)
    course.sides("kerb", (-0.02, end), half_width, WALL_M, (0, TRACK_M + 0.012), p.wall_colour)
    course.block("end_wall", (end, end + WALL_M), outer, (0, TRACK_M + 2 * r), p.wall_colour)
    course.ball("ball", (0.05, 0, TRACK_M + r), r, p.ball_colour, speed=p.speed_m_s)

    high, along, across = TRACK_M + 2 * r + 0.01, (p.run_m, end + WALL_M), (outer[0] - 0.01, outer[1] + 0.03)
    course.mark("line", "line")
    return course.scene(
        p,
        decisive=["ball"],
        hidden=["patch"],
        cover=course.box(along, across, (0, high), right=course.ahead(SHADOW_RIGHT * high)),
        in_view=[course.box(along, outer, (0, high)), course.box((-0.02, 0.02), outer, track)],
        things=[f"{p.ball_colour} ball", f"{p.line_colour} line", f"{p.start_colour} line", "track"],
        also=["wall", "kerb", "end"],
    )


def outcome(motion: Motion, p: Params) -> Reading:
    """Read whether the ball's middle is past the line; 'no' only once it rests."""
    past_m = p.direction * motion.pos("ball")[:, 0] - p.line_m - LINE_M / 2
    return Reading(yes_while(past_m > 0, still_from(past_m, within_m=STILL_M)), clear_m(past_m, LINE_M))


def observe(frames: np.ndarray, slots: Mapping[str, str], ahead: float | None = None) -> str | None:
    """Return whether the ball rests on the other side of the line than it came from."""
    path = [compact_blob(frame, slots["ball"], shape=(0.5, 2.0)) for frame in frames]
    first, last = next((ball for ball in path if ball is not None), None), end_of(path, ahead)
    if first is None or last is None:
        return None
    ys, xs = np.nonzero(colour_mask(frames[-1], slots["line"]))
    if len(xs) < 60 or np.ptp(ys) < 10:
        return None
    slope, offset = np.polyfit(ys, xs, 1)  # the line in the picture, x as a function of y
    foot = last.y + 0.4 * last.box[3]
    return "yes" if (last.x - slope * foot - offset) * (last.x - first.x) > 0 else "no"


FAMILY = scene_family(
    "roll_stop",
    category="ramps_rolling",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {ball} ball roll past the {line} line, yes or no?",
        "Does the rolling {ball} ball get across the {line} line before it stops: yes or no?",
        "Is the {ball} ball beyond the {line} line when it comes to a stop, yes or no?",
        yes=["yes it does", "it passes the line", "it rolls past the line"],
        no=["no it does not", "it stops before the line", "it does not pass the line"],
    ),
    asides=[
        comes_from("From which side does the ball come, left or right?"),
        colour_of("ball", "What colour is the rolling ball: {choices}?", PARTS),
        colour_of("start", "What colour is the first line that the ball rolls across: {choices}?", PARTS),
    ],
    observe=observe,
    foresee=partial(observe, ahead=AHEAD),
    min_margin_m=0.03,
)
