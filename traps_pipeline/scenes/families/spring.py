"""A ball rolls off a deck to a plunger: is it thrown back over a line?

Control: plunger and line are in view. Void: the occluder stands before both.
Hidden element: the plunger, whose spring is lively or stuck fast in thick grease. The ball arrives the same either way;
it drops down a step behind the occluder, so that what comes back stays there, and felt brings it to rest.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from traps_pipeline.scenes.parts.course import SHADOW_BACK, SHADOW_RIGHT, SOFT, Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import AHEAD, end_of, round_blob
from traps_pipeline.scenes.parts.questions import colour_of, comes_from, yes_no
from traps_pipeline.scenes.parts.readings import Reading, side_while
from traps_pipeline.scenes.parts.vary import Drawn, apart, between, facing, one_of, together
from traps_pipeline.scenes.parts.vision import blobs, colour_mask
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene, add_box, rgba, uniform

LANE_M = 0.02  # height of the lower lane
FEEL_M = 0.03  # the ball has met the plunger when it has been this near to it
WALL_M = 0.014
COILS = [f"coil_{i}" for i in range(4)]
PARTS = ("ball", "deck", "line")
PLAY_COLOURS = apart("red", "green", "blue", "yellow", "orange", "cyan", "purple")


def _plungers(rng: np.random.Generator, so_far: Drawn) -> tuple[float, float, str, str]:
    """Draw a lively and a stuck damping, and the colours of lane and tunnel."""
    dampings = (uniform(rng, 0.4, 1.0), uniform(rng, 60, 90))
    lane, tunnel = rng.permutation(["grey", "white", "black"])[:2]
    first = int(rng.integers(2))
    return dampings[first], dampings[1 - first], str(lane), str(tunnel)


PLUNGER = together(_plungers)


@dataclass(frozen=True)
class Params:
    """Parameters; lengths run from where the ball starts; direction +1 is right."""

    direction: int = one_of(-1, 1)
    ball_colour: str = PLAY_COLOURS()
    line_colour: str = PLAY_COLOURS()
    deck_colour: str = PLAY_COLOURS()
    head_colour: str = PLAY_COLOURS()
    damping_n_s_m: float = PLUNGER()  # of the plunger: the hidden element
    other_damping_n_s_m: float = PLUNGER()  # what the twin has
    lane_colour: str = PLUNGER()
    tunnel_colour: str = PLUNGER()
    radius_m: float = between(0.054, 0.062)
    speed_m_s: float = between(0.95, 1.15)
    run_m: float = between(0.78, 0.88)  # open deck before the occluder
    step_m: float = between(0.06, 0.08)  # height of the deck over the lane
    lane_m: float = between(0.50, 0.56)  # from the step to the plunger's head
    line_m: float = between(0.21, 0.24)  # from the plunger's head to the line
    felt: float = between(0.0024, 0.0030)  # rolling friction of the lane (m)
    stiffness_n_m: float = between(90, 140)
    azimuth_deg: float = facing(-10, 20)
    elevation_deg: float = between(-36, -26)

    @property
    def edge_m(self) -> float:
        """Position of the deck's end."""
        return self.run_m + 2 * self.radius_m + 0.06

    @property
    def head_m(self) -> float:
        """Rest position of the plunger's face."""
        return self.edge_m + self.lane_m


def build(p: Params, physics: Physics) -> Scene:
    """Build deck with tunnel, step, lower lane with a line across, and plunger."""
    course = Course(physics, p.direction, Surface(2e-5, solref=SOFT))
    r, half_width = p.radius_m, 1.9 * p.radius_m
    deck, end, line = LANE_M + p.step_m, p.head_m + 0.32, p.head_m - p.line_m
    depth_span, outer = (-half_width, half_width), (-half_width - WALL_M, half_width + WALL_M)

    course.block("deck", (-r, p.edge_m), depth_span, (0, deck), p.deck_colour)
    course.block("lane", (p.edge_m, end), depth_span, (0, LANE_M), p.lane_colour, Surface(p.felt, solref=SOFT))
    tunnel, roof = (p.run_m - 2.6 * r, p.run_m + 2 * r), deck + 2.4 * r
    course.block("tunnel_front", tunnel, (-half_width, -half_width + WALL_M), (deck, roof), p.tunnel_colour)
    course.block("tunnel_back", tunnel, (half_width - WALL_M, half_width), (deck, roof), p.tunnel_colour)
    course.block("tunnel_roof", tunnel, depth_span, (roof, roof + WALL_M), p.tunnel_colour)
    paint = (LANE_M, LANE_M + 0.001)
    course.block("line", (line - 0.016, line + 0.016), depth_span, paint, p.line_colour, solid=False)
    course.block("back", (-r, end), (half_width, outer[1]), (0, deck + 0.4 * r), p.lane_colour)
    course.block("front", (p.edge_m, end), (outer[0], -half_width), (0, LANE_M + 0.3 * r), p.lane_colour)
    course.block("housing", (end - 0.13, end), depth_span, (LANE_M, LANE_M + 2.3 * r), p.tunnel_colour)
    _add_plunger(course, p)
    course.ball("ball", (0, 0, deck + r), r, p.ball_colour, speed=p.speed_m_s)

    high, shading = max(deck + 2.2 * r, LANE_M + 2.4 * r), deck + 2 * r
    across = (outer[0], half_width + SHADOW_BACK * shading)
    course.mark("line", "line")
    course.mark("spring", "housing")
    return course.scene(
        p,
        decisive=["ball"],
        hidden=["head", "rod", *COILS],
        cover=course.box((p.run_m, end), across, (0, high), right=SHADOW_RIGHT * shading),
        in_view=[course.box((-r, end), outer, (0, high))],
        things=[f"{p.ball_colour} ball", f"{p.line_colour} line", f"{p.deck_colour} deck", "tunnel", "spring"],
        also=["plunger", "lane", "step"],
        colours=["grey"],
    )


def _add_plunger(course: Course, p: Params) -> None:
    """Add head and rod on a sprung slide joint, and the housing behind them."""
    import mujoco

    r, direction = p.radius_m, p.direction
    body = course.spec.worldbody.add_body(name="plunger", pos=[direction * p.head_m, 0, LANE_M + 1.1 * r])
    joint = body.add_joint(name="plunger", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[direction, 0, 0])
    joint.stiffness[0], joint.damping[0] = p.stiffness_n_m, p.damping_n_s_m
    head = add_box(body, "head", (direction * 0.012, 0, 0), (0.012, 1.5 * r, 0.95 * r), p.head_colour)
    head.density, head.condim, head.priority = 200, 3, 1
    head.friction, head.solref = [0.05, 0.005, 0.0001], [0.006, 1]
    coils = [(name, 0.05 + 0.042 * i, 0.7 * r, 0.007) for i, name in enumerate(COILS)]
    for name, along, radius, half_length in [("rod", 0.12, 0.012, 0.10), *coils]:
        part = body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_CYLINDER, rgba=rgba("grey"))
        part.pos, part.size, part.density = [direction * along, 0, 0], [radius, half_length, 0], 10
        part.quat = [0.5**0.5, 0, 0.5**0.5, 0]
        part.contype = part.conaffinity = 0


def outcome(motion: Motion, p: Params) -> Reading:
    """Read whether the ball is back over the line; None before it meets the plunger."""
    back = p.head_m - p.line_m - p.direction * motion.pos("ball")[:, 0]
    has_met = np.maximum.accumulate(-back) > p.line_m - p.radius_m - FEEL_M
    return Reading(side_while(has_met, back), float(abs(back[-1])))


def observe(frames: np.ndarray, slots: Mapping[str, str], ahead: float | None = None) -> str | None:
    """Return whether the resting ball is on the side of the line that it came from."""
    path = [round_blob(frame, slots["ball"]) for frame in frames[-3:]]
    start, end = round_blob(frames[0], slots["ball"]), end_of(path, ahead)
    parts = [blob for blob in blobs(colour_mask(frames[-1], slots["line"]), 15) if blob.area < 4000]
    if start is None or end is None or not parts:
        return None
    line = sum(part.x * part.area for part in parts) / sum(part.area for part in parts)
    return "yes" if (start.x - line) * (end.x - line) > 0 else "no"


FAMILY = scene_family(
    "spring",
    category="other",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the spring throw the {ball} ball back over the {line} line, yes or no?",
        "Is the {ball} ball sent back across the {line} line by the spring: yes or no?",
        "Does the {ball} ball come back from the spring far enough to cross the {line} line again, yes or no?",
        yes=["yes it does", "it is thrown back", "it crosses the line", "it comes back over the line"],
        no=["no it does not", "it is not thrown back", "it stays at the spring", "it does not cross the line"],
    ),
    asides=[
        comes_from("From which side does the ball roll towards the spring, left or right?"),
        colour_of("ball", "What colour is the ball that rolls along the deck: {choices}?", PARTS),
        colour_of("deck", "What colour is the deck under the ball: {choices}?", PARTS),
    ],
    observe=observe,
    foresee=partial(observe, ahead=AHEAD),
    # The same roll with the other plunger.
    twins=lambda p: [replace(p, damping_n_s_m=p.other_damping_n_s_m, other_damping_n_s_m=p.damping_n_s_m)],
    min_margin_m=0.06,
)
