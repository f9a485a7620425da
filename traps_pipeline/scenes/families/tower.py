"""A ball rolls along a ledge towards a tower: is its top block knocked down?

Control: ledge, tower and tray are in view. Void: the occluder stands before all of them but the ball's run-up.
Hidden element: a stop that stands in the ball's way or beside it, or a strip of the ledge that is rough or smooth:
the ball strikes the tower near its top, or never reaches it.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.parts.course import SHADOW_BACK, SHADOW_RIGHT, Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import end_of
from traps_pipeline.scenes.parts.questions import choice_of, comes_from, yes_no
from traps_pipeline.scenes.parts.readings import Reading, still_from, yes_while
from traps_pipeline.scenes.parts.vary import apart, between, drawn_by, facing, hidden, one_of, shuffled
from traps_pipeline.scenes.parts.vision import colour_mask, is_at_rest, largest, track
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene, uniform

STRIP_M = 0.16  # length of the strip that is rough or smooth
FELT = Surface(2e-3)  # behind the occluder: no ball comes back from there
HALF_DEPTH_M = 0.11
STILL_M = 0.003
COLOURS = "red", "green", "blue", "yellow", "orange", "cyan", "purple"
PLAY_COLOURS, PLAIN_COLOURS = apart(*COLOURS), shuffled("wood", "grey", "white")

FALL_SHARE = 0.25  # of its width: a block that is so far from its place falls


@dataclass(frozen=True)
class Params:
    """Parameters; direction +1 is right. Only the top block's colour is unique."""

    direction: int = one_of(-1, 1)
    blocks: int = one_of(3, 4, longer=(5,))
    top_colour: str = PLAY_COLOURS()
    ball_colour: str = PLAY_COLOURS()
    block_colours: tuple[str, ...] = PLAY_COLOURS(2)
    ledge_colour: str = PLAIN_COLOURS()
    tray_colour: str = PLAIN_COLOURS()
    kind: str = one_of("stop", "strip")  # of the hidden element
    barred: bool = hidden(False, True)  # whether it keeps the ball from the tower
    block_height_m: float = drawn_by(
        lambda rng, so_far: uniform(rng, 0.088, 0.102) * (1.0 if so_far["blocks"] == 3 else 0.8)
    )
    block_width_m: float = between(0.075, 0.09)
    radius_m: float = between(0.046, 0.054)
    strike: float = drawn_by(  # height at which the ball strikes, in blocks
        lambda rng, so_far: so_far["blocks"] - uniform(rng, 0.45, 0.60)
    )
    speed_m_s: float = between(0.85, 1.05)
    run_m: float = between(0.66, 0.76)  # visible ledge before the occluder
    tray_m: float = between(0.32, 0.38)
    azimuth_deg: float = facing(-14, 20)
    elevation_deg: float = between(-32, -21)

    @property
    def tower_m(self) -> float:
        """Height of the tower."""
        return self.blocks * self.block_height_m

    @property
    def names(self) -> list[str]:
        """Names of the tower's bodies, from the ground up."""
        return [f"block_{i}" for i in range(self.blocks)]


def build(p: Params, physics: Physics) -> Scene:
    """Build ledge, stop or strip, tower and tray."""
    course = Course(physics, p.direction)
    r, half_w, depth_span = p.radius_m, p.block_width_m / 2, (-HALF_DEPTH_M, HALF_DEPTH_M)
    ledge = p.strike * p.block_height_m - r  # height of the ledge that the ball rolls on
    ledge_end, end = -half_w - 0.02, half_w + p.tray_m
    strip = (ledge_end - 2 * r - 0.03 - STRIP_M, ledge_end - 2 * r - 0.03)
    occluder_at = strip[0] - 2 * r - 0.05
    start = occluder_at - p.run_m + r

    is_strip, rough_surface = p.kind == "strip", Surface(0.03)
    for name, along, surface, colour in (
        ("ledge_in", (start - 0.06, occluder_at + 2 * r), Surface(1e-4), p.ledge_colour),
        ("felt", (occluder_at + 2 * r, strip[0]), FELT, p.ledge_colour),
        ("strip", strip, rough_surface if p.barred and is_strip else FELT, "black" if is_strip else p.ledge_colour),
        ("ledge_out", (strip[1], ledge_end), FELT, p.ledge_colour),
    ):
        course.block(name, along, depth_span, (0, ledge), colour, surface)
    if p.kind == "stop":
        y = 0.0 if p.barred else HALF_DEPTH_M - 0.018
        course.block("stop", (strip[1] - 0.05, strip[1]), (y - 0.018, y + 0.018), (ledge, ledge + 1.6 * r), "black")
    course.block("wall_back", (half_w + 0.02, end), (0.15, 0.165), (0, 0.10), p.tray_colour)
    course.block("wall_front", (half_w + 0.02, end), (-0.165, -0.15), (0, 0.03), p.tray_colour)
    course.block("wall_end", (end, end + 0.015), (-0.165, 0.165), (0, 0.16), p.tray_colour)
    colours = [p.block_colours[i % len(p.block_colours)] for i in range(p.blocks - 1)] + [p.top_colour]
    half_size = (half_w, half_w, p.block_height_m / 2)
    course.tower(p.names, half_size, colours, density=300, sliding=0.35, solref=(0.006, 1))
    at = (start, 0, ledge + r)
    course.ball("ball", at, r, p.ball_colour, speed=p.speed_m_s, rolling=1e-4, sliding=0.3, density=2500)

    view_box = course.box((occluder_at, end + 0.02), (-0.165, 0.165), (0, p.tower_m))
    right = max(view_box.high[0], SHADOW_RIGHT * p.tower_m + half_w) + course.ahead(0.07) - view_box.high[0]
    across = (-0.17, half_w + SHADOW_BACK * p.tower_m)
    course.mark("block", p.names[-1])
    return course.scene(
        p,
        decisive=[p.names[-1]],
        hidden=[p.kind],
        cover=course.box((occluder_at, end + 0.02), across, (0, p.tower_m + 0.02), right=right),
        in_view=[view_box],
        things=[f"{p.ball_colour} ball", f"{p.top_colour} block", f"{p.block_colours[0]} block", "ledge", "tower"],
        also=["tray", "wall", "top"],
        colours=[*p.block_colours, "black"],
        shown_by={"tower": ["block"], "top": ["block"]},
    )


def outcome(motion: Motion, p: Params) -> Reading:
    """Read whether the top block is on the ground; 'no' only once ball and block rest."""
    top = motion.pos(p.names[-1])
    down, up = top[:, 2] < 1.3 * p.block_height_m, top[:, 2] > p.tower_m - 0.6 * p.block_height_m
    rest_frame = still_from(top, motion.pos("ball"), within_m=STILL_M)
    middle = (p.tower_m - p.block_height_m / 2 + p.block_width_m / 2) / 2
    return Reading(yes_while(down, rest_frame, no_where=up), float(abs(top[-1, 2] - middle)))


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return whether the named block has come down by more than its own size."""
    path = track(frames, slots["top"], 60)
    first, last = path[0], path[-1]
    if first is None or last is None or not is_at_rest(path):
        return None
    if first.area > 0.08 * colour_mask(frames[0], slots["top"]).size:
        return None
    return "yes" if last.y - first.y > 0.7 * first.box[3] else "no"


def foresee(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Predict a fall: the block has left its place at the top, or leans over."""
    first, last = largest(frames[0], slots["top"], 60), largest(frames[-1], slots["top"], 60)
    if first is None or last is None:
        return None
    return "yes" if abs(last.x - first.x) + abs(last.y - first.y) > FALL_SHARE * first.box[2] else "no"


def look(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return whether another colour's block is higher in the end than the top block."""
    top = end_of(track(frames, slots["top"], 60))
    if top is None:
        return None
    blocks = [largest(frames[-1], colour, top.area // 3) for colour in COLOURS if colour != slots["top"]]
    higher = [block for block in blocks if block is not None and block.y < top.y - 0.5 * top.box[3]]
    return "yes" if higher else "no"


FAMILY = scene_family(
    "tower",
    category="stacks",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Is the {top} block at the top of the tower knocked to the ground, yes or no?",
        "Does the {top} block fall off the top of the tower: yes or no?",
        "Does the tower lose its {top} top block in the end, yes or no?",
        yes=["yes it falls", "it falls", "it falls off", "it is knocked off"],
        no=["no it does not fall", "it stays on top", "it does not fall", "the tower stays standing"],
    ),
    asides=[
        choice_of(
            "What colour is the ball that comes in on the ledge: {choices}?",
            choices=lambda p: [p.ball_colour, p.top_colour, p.block_colours[0]],
            answer=lambda p: p.ball_colour,
        ),
        comes_from("From which side does the ball come in on the ledge, left or right?"),
    ],
    observe=observe,
    foresee=foresee,
    look=look,
    physics=Physics(timestep_s=0.001),
    min_margin_m=0.03,
)
