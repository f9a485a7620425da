"""A ball rolls off a ledge against a tall pillar: does the pillar topple over?

Control: ledge, pillar and the ground behind it are in view. Void: the occluder stands before all of them but the ball's
run-up.
Hidden element: a prop that stands right behind the pillar or off to its side, or the pillar itself, which looks the
same but is light or heavy.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from traps_pipeline.scenes.parts.course import SHADOW_BACK, Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import lies_flat
from traps_pipeline.scenes.parts.questions import colour_of, comes_from, yes_no
from traps_pipeline.scenes.parts.readings import Reading, still_from, top_m, yes_while
from traps_pipeline.scenes.parts.vary import apart, between, facing, hidden, one_of, shuffled
from traps_pipeline.scenes.parts.vision import is_at_rest, largest, track
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene

FELT = Surface(2e-3)  # behind the occluder: no ball comes back from there
LIGHT, HEAVY = 200.0, 7000.0  # kg/m3
MAT_M = 0.01  # thickness of the mat
HALF_DEPTH_M = 0.17  # of the mat
RIM_M = 0.012
PLAY_COLOURS, PLAIN_COLOURS = (
    apart("red", "green", "blue", "orange", "cyan", "purple"),
    shuffled("wood", "grey", "white"),
)


@dataclass(frozen=True)
class Params:
    """Parameters; heights are shares of the pillar's; direction +1 is right."""

    direction: int = one_of(-1, 1)
    pillar_colour: str = PLAY_COLOURS()
    ball_colour: str = PLAY_COLOURS()
    prop_colour: str = PLAY_COLOURS()
    ledge_colour: str = PLAIN_COLOURS()
    mat_colour: str = PLAIN_COLOURS()
    kind: str = one_of("prop", "pillar")  # of the hidden element
    firm: bool = hidden(False, True)  # whether it keeps the pillar upright
    pillar_m: float = between(0.32, 0.40)
    width_m: float = between(0.075, 0.09)
    depth_m: float = between(0.09, 0.13)
    prop_height: float = between(0.55, 0.70)
    strike: float = between(0.60, 0.72)  # height at which the ball strikes
    radius_m: float = between(0.047, 0.056)
    speed_m_s: float = between(0.80, 1.0)
    run_m: float = between(0.64, 0.74)  # visible ledge before the occluder
    azimuth_deg: float = facing(-14, 20)
    elevation_deg: float = between(-32, -21)


def build(p: Params, physics: Physics) -> Scene:
    """Build ledge, pillar, mat and prop; lengths run from the middle of the pillar."""
    course = Course(physics, p.direction)
    r, half_w, half_depth = p.radius_m, p.width_m / 2, HALF_DEPTH_M
    ledge = p.strike * p.pillar_m - r  # height of the ledge that the ball rolls on
    ledge_end, end = -half_w - 0.025, half_w + p.pillar_m + 0.09  # the pillar falls onto the mat between them
    occluder_at = ledge_end - 3 * r - 0.10
    start = occluder_at - p.run_m + r

    course.block("ledge", (start - 0.06, occluder_at + 2 * r), (-0.09, 0.09), (0, ledge), p.ledge_colour, Surface(1e-4))
    course.block("felt", (occluder_at + 2 * r, ledge_end), (-0.09, 0.09), (0, ledge), p.ledge_colour, FELT)
    course.block("mat", (ledge_end, end), (-half_depth, half_depth), (0, MAT_M), p.mat_colour)
    course.block("rim_back", (ledge_end, end), (half_depth, half_depth + RIM_M), (0, 0.06), p.mat_colour)
    course.block("rim_front", (half_w + 0.02, end), (-half_depth - RIM_M, -half_depth), (0, 0.03), p.mat_colour)
    course.block("rim_end", (end, end + RIM_M), (-half_depth - RIM_M, half_depth + RIM_M), (0, 0.06), p.mat_colour)
    has_prop = p.kind == "prop"
    if has_prop:
        prop_x, y = half_w + 0.004, 0.0 if p.firm else half_depth - 0.03
        height = p.prop_height * p.pillar_m
        course.block("prop", (prop_x, prop_x + 0.07), (y - 0.03, y + 0.03), (MAT_M, height), p.prop_colour)
    at, half_size = (0, 0, MAT_M + p.pillar_m / 2), (half_w, p.depth_m / 2, p.pillar_m / 2)
    density = HEAVY if p.firm and p.kind == "pillar" else LIGHT
    pillar = course.free_box("pillar", at, half_size, p.pillar_colour, density=density, solref=(0.006, 1))
    pillar.first_geom().friction = [0.8, 0.01, 0.0005]
    at = (start, 0, ledge + r)
    course.ball("ball", at, r, p.ball_colour, speed=p.speed_m_s, rolling=1e-4, sliding=0.1, density=1500)

    along, top = (occluder_at, end + 0.02), p.pillar_m + 0.03
    across = (-half_depth - 0.02, max(half_depth + 0.05, 0.05 + SHADOW_BACK * p.pillar_m))
    props = [f"{p.prop_colour} block"] if has_prop else []
    course.mark("pillar", "pillar")
    scene = course.scene(
        p,
        decisive=["pillar"],
        hidden=[p.kind],
        cover=course.box(along, across, (0, top), right=course.ahead(0.04)),
        in_view=[course.box(along, (-half_depth - RIM_M, half_depth + RIM_M), (0, p.pillar_m))],
        things=[f"{p.ball_colour} ball", f"{p.pillar_colour} pillar", "ledge", "mat", *props],
        also=["block", "rim"],
    )
    # Without a prop, nothing in view has its colour.
    colours = [colour for colour in scene.inventory.colours if has_prop or colour != p.prop_colour]
    return replace(scene, inventory=replace(scene.inventory, colours=tuple(colours)))


def outcome(motion: Motion, p: Params) -> Reading:
    """Read whether the pillar's top is low; 'no' only once pillar and ball rest."""
    top = top_m(motion, "pillar", p.pillar_m)
    rest_frame = still_from(motion.pos("pillar"), motion.pos("ball"), top, within_m=0.003)
    return Reading(yes_while(top < p.pillar_m / 2, rest_frame), float(abs(top[-1] - p.pillar_m / 2)))


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return whether the pillar is lower at the end than at the start, None if unseen."""
    path = track(frames, slots["pillar"], 80)
    first, last = path[0], path[-1]
    if first is None or last is None or not is_at_rest(path) or first.box[3] < 1.2 * first.box[2]:
        return None
    return "yes" if last.box[3] < 0.75 * first.box[3] else "no"


def foresee(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Predict a fall: the pillar is wider in the picture than it was, or lower."""
    first, last = largest(frames[0], slots["pillar"], 80), largest(frames[-1], slots["pillar"], 80)
    if first is None or last is None or first.box[3] < 1.2 * first.box[2]:
        return None
    return "yes" if last.box[2] > 1.3 * first.box[2] or last.box[3] < 0.75 * first.box[3] else "no"


FAMILY = scene_family(
    "topple",
    category="stacks",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the tall {pillar} pillar topple over, yes or no?",
        "When the ball hits it, does the {pillar} pillar fall over: yes or no?",
        "Is the {pillar} pillar lying on its side at the end, yes or no?",
        yes=["yes it topples", "it topples over", "it falls over", "it lies on its side"],
        no=["no it does not topple", "it does not topple over", "it stays upright", "it is still standing"],
    ),
    asides=[
        colour_of("ball", "What colour is the ball that rolls in on the ledge: {choices}?", ("ball", "pillar", "prop")),
        comes_from("From which side does the ball roll in on the ledge, left or right?"),
    ],
    observe=observe,
    foresee=foresee,
    look=lies_flat("pillar"),
    physics=Physics(timestep_s=0.001),
    min_margin_m=0.03,
)
