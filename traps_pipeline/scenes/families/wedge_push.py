"""A ball pushes a wedge along a track: does the wedge get onto the mat?

Control: track, wedge and mat are in view. Void: the occluder stands before all of them but the ball's run-up.
Hidden element: a strip of the track before the mat that is slippery or rough, or a stop that stands on the track or
beside it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from traps_pipeline.scenes.parts.course import Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD, end_of, lies_on
from traps_pipeline.scenes.parts.questions import colour_of, comes_from, yes_no
from traps_pipeline.scenes.parts.readings import Reading, still_from, yes_while
from traps_pipeline.scenes.parts.vary import apart, between, drawn_by, facing, hidden, one_of
from traps_pipeline.scenes.parts.vision import largest, track
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene, add_box, uniform

TRACK_M = 0.03  # thickness of the track
HALF_TRACK_M = 0.13
STRIP_M = 0.20  # length of the strip before the mat
GRIPPING = Surface(1e-4)  # of the visible run-up
SLIPPERY = Surface(2e-3, sliding=0.05)
ROUGH = Surface(2e-3, sliding=1.0)
PLAY_COLOURS = apart("red", "green", "blue", "orange", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """Parameters; direction +1 is right."""

    direction: int = one_of(-1, 1)
    wedge_colour: str = PLAY_COLOURS()
    ball_colour: str = PLAY_COLOURS()
    mat_colour: str = PLAY_COLOURS()
    wedge_length_m: float = between(0.13, 0.16)
    kind: str = one_of("strip", "stop")  # of the hidden element
    barred: bool = hidden(False, True)  # whether it keeps the wedge from the mat
    wedge_width_m: float = between(0.10, 0.13)
    wedge_height_m: float = between(0.09, 0.11)
    radius_m: float = between(0.046, 0.054)
    speed_m_s: float = between(1.0, 1.25)
    run_m: float = between(0.76, 0.86)  # visible track before the occluder
    mat_m: float = drawn_by(lambda rng, so_far: so_far["wedge_length_m"] + uniform(rng, 0.10, 0.14))
    track_colour: str = one_of("wood", "grey", "white")
    azimuth_deg: float = facing(-16, 20)
    elevation_deg: float = between(-36, -24)

    @property
    def mat_at_m(self) -> float:
        """Position at which the mat begins, from the wedge's middle at the start."""
        return self.wedge_length_m / 2 + 0.03 + STRIP_M + 0.03


def build(p: Params, physics: Physics) -> Scene:
    """Build track, strip or stop, mat and wedge; lengths run from the wedge's middle."""
    course = Course(physics, p.direction)
    r, half_wedge, end = p.radius_m, p.wedge_length_m / 2, p.mat_at_m + p.mat_m
    strip = (half_wedge + 0.03, half_wedge + 0.03 + STRIP_M)
    occluder_at = -half_wedge - 2 * r - 0.08
    start = occluder_at - p.run_m + r
    depth_span, is_strip = (-HALF_TRACK_M, HALF_TRACK_M), p.kind == "strip"

    for name, along, surface, colour in (
        ("run_up", (start - 0.06, occluder_at + 2 * r), GRIPPING, p.track_colour),
        ("track", (occluder_at + 2 * r, strip[0]), SLIPPERY, p.track_colour),
        ("strip", strip, ROUGH if p.barred and is_strip else SLIPPERY, "black" if is_strip else p.track_colour),
        ("track_end", (strip[1], p.mat_at_m), SLIPPERY, p.track_colour),
        ("mat", (p.mat_at_m, end), SLIPPERY, p.mat_colour),
    ):
        course.block(name, along, depth_span, (0, TRACK_M), colour, surface)
    if p.kind == "stop":
        y, z = (0.0, TRACK_M) if p.barred else (HALF_TRACK_M + 0.05, 0.0)
        course.block("stop", (strip[1] - 0.03, strip[1]), (y - 0.04, y + 0.04), (z, z + 0.07), "black")
    course.block("wall_end", (end, end + 0.015), depth_span, (0, TRACK_M + 0.05), p.track_colour)
    _add_wedge(course, p)
    at = (start, 0, TRACK_M + r)
    course.ball("ball", at, r, p.ball_colour, speed=p.speed_m_s, rolling=1e-4, sliding=0.1, density=2500)

    span, top, back = (occluder_at, end + 0.015), TRACK_M + p.wedge_height_m + 0.02, HALF_TRACK_M + 0.11
    course.mark("wedge", "base", p.wedge_colour)
    course.mark("mat", "mat")
    return course.scene(
        p,
        decisive=["wedge"],
        hidden=[p.kind],
        cover=course.box(span, (-HALF_TRACK_M - 0.02, back + 0.03), (0, top), right=0.05),
        in_view=[course.box(span, (-HALF_TRACK_M, back), (0, top))],
        things=[f"{p.ball_colour} ball", f"{p.wedge_colour} wedge", f"{p.mat_colour} mat", "track", f"black {p.kind}"],
        also=["wall"],
        colours=["black"],
    )


def _add_wedge(course: Course, p: Params) -> None:
    """Add a wedge, high end to the ball; a base and a back plate inside it collide."""
    half_length, width, height = p.wedge_length_m / 2, p.wedge_width_m / 2, p.wedge_height_m
    profile = ((-half_length, 0.0), (half_length, 0.0), (half_length, 0.025), (-half_length, height))
    body = course.spec.worldbody.add_body(name="wedge", pos=[0, 0, TRACK_M])
    body.add_freejoint()
    course.hull("wedge", [(x, y, z) for y in (-width, width) for x, z in profile], p.wedge_colour, body=body).mass = 0.0
    base = (half_length - 0.001, width - 0.001, 0.012)
    add_box(body, "base", (0, 0, 0.0121), base, p.wedge_colour, density=900)
    plate_at, plate = (-p.direction * (half_length - 0.011), 0, height * 0.42), (0.01, width - 0.001, height * 0.42)
    add_box(body, "back", plate_at, plate, p.wedge_colour, density=900)


def outcome(motion: Motion, p: Params) -> Reading:
    """Read whether the wedge's middle is on the mat; 'no' only once both bodies rest."""
    wedge = motion.pos("wedge")
    past_m = p.direction * wedge[:, 0] - p.mat_at_m
    rest_frame = still_from(wedge, motion.pos("ball"), within_m=0.002)
    return Reading(yes_while(past_m > 0, rest_frame), float(abs(past_m[-1]) - p.wedge_length_m / 2))


def observe(frames: np.ndarray, slots: Mapping[str, str], ahead: float | None = None) -> str | None:
    """Return whether the resting wedge is on the mat as the first frame shows it."""
    path, mat = track(frames, slots["wedge"], 100), largest(frames[0], slots["mat"], 100)
    last = end_of(path, ahead)
    if path[0] is None or last is None or mat is None:
        return None
    return "yes" if abs(last.x - mat.x) < mat.box[2] / 2 else "no"


FAMILY = scene_family(
    "wedge_push",
    category="other",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {wedge} wedge get pushed onto the {mat} mat, yes or no?",
        "Is the {wedge} wedge on the {mat} mat at the end: yes or no?",
        "Does the ball push the {wedge} wedge as far as the {mat} mat, yes or no?",
        yes=["yes it does", "it is on the mat", "on the mat", "it reaches the mat"],
        no=["no it does not", "it stops before the mat", "it does not reach the mat", "not on the mat"],
    ),
    asides=[
        colour_of(
            "ball", "What colour is the ball that rolls in along the track: {choices}?", ("ball", "wedge", "mat")
        ),
        comes_from("From which side does the ball roll in along the track, left or right?"),
    ],
    observe=observe,
    foresee=partial(observe, ahead=AHEAD),
    look=lies_on("wedge", "mat"),
    physics=Physics(timestep_s=0.001),
    min_margin_m=0.02,
)
