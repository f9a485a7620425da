"""A rope is tossed up and falls onto a peg: does it stay hanging there?

Control: the peg in the board and the tray below are in view. Void: the occluder stands before them.
Hidden element: the peg, which sticks out of the board below the middle of the rope, where the rope comes to hang over
it, or below one end, where the rope slides off into the tray. No part of the rope is seen any more when it meets the
peg. An extension: no part of the benchmark (docs/scenes.md, "Soft bodies").
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.parts.course import SOFT, Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.questions import colour_of, either, yes_no
from traps_pipeline.scenes.parts.readings import Reading, lasting_from, still_from
from traps_pipeline.scenes.parts.vary import apart, between, hidden, in_front, one_of, shuffled
from traps_pipeline.scenes.parts.vision import is_at_rest, largest
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene
from traps_soft_bodies.bodies import rope

FLOOR_M = 0.02  # thickness of the tray's floor
WALL_M = 0.012
DEPTH_M = 0.10  # half of the tray's depth
PEG_RADIUS_M = 0.022
PEG_FROM_M = -0.07  # how far before the board the peg reaches
STILL_M = 0.02
PLAY_COLOURS = apart("red", "green", "blue", "yellow", "orange", "cyan", "purple")
PLAIN_COLOURS = shuffled("wood", "grey", "white")


@dataclass(frozen=True)
class Params:
    """Parameters; at direction +1 the cube is right, and so is an off-centre peg."""

    direction: int = one_of(-1, 1)
    rope_colour: str = PLAY_COLOURS()
    tray_colour: str = PLAY_COLOURS()
    cube_colour: str = PLAY_COLOURS()
    board_colour: str = PLAIN_COLOURS()
    peg_colour: str = PLAIN_COLOURS()
    peg_in_middle: bool = hidden(False, True)
    length_m: float = between(0.66, 0.76)
    radius_m: float = between(0.011, 0.0125)
    peg_m: float = between(0.46, 0.54)  # height of the peg
    off_m: float = between(0.25, 0.29)  # how far from the middle the peg is otherwise
    release_m: float = between(0.88, 0.98)  # height of the rope at first
    toss_m_s: float = between(2.4, 2.7)
    drift_m_s: float = between(-0.02, 0.02)
    cube_m: float = between(0.10, 0.14)
    azimuth_deg: float = in_front(-16, 16)
    elevation_deg: float = between(-24, -14)


def build(p: Params, physics: Physics) -> Scene:
    """Build a board with the peg in it, the tray before it, and a cube to one side."""
    course = Course(physics, p.direction)
    end, high = p.length_m / 2 + 0.08, p.peg_m + 0.06
    outer, depth_span = end + WALL_M, (-DEPTH_M, DEPTH_M)
    floor = ((-end, end), depth_span, (0, FLOOR_M))
    course.tray("tray", *floor, p.tray_colour, wall=WALL_M, near=0.08, far=0.08, front=0.05, floor=Surface(solref=SOFT))
    course.block("board", (-outer, outer), (DEPTH_M, DEPTH_M + WALL_M), (0, high), p.board_colour)
    along = 0.0 if p.peg_in_middle else p.off_m
    peg = course.rod("peg", (along, PEG_FROM_M, p.peg_m), (along, DEPTH_M, p.peg_m), PEG_RADIUS_M, p.peg_colour)
    peg.friction, peg.priority = [0.4, 0.005, 0.0001], 2

    half_cube, cube_at = p.cube_m / 2, outer + 0.12 + p.cube_m / 2
    course.block(
        "cube", (cube_at - half_cube, cube_at + half_cube), (-half_cube, half_cube), (0, p.cube_m), p.cube_colour
    )
    rope(course, "rope", (0, 0, p.release_m), p.length_m, p.radius_m, p.rope_colour, thrown=(p.drift_m_s, p.toss_m_s))
    course.mark("peg", (0.0, DEPTH_M), p.peg_colour)
    course.mark("tray", (-0.7 * end, DEPTH_M), p.tray_colour)
    return course.scene(
        p,
        decisive=["rope"],
        hidden=["peg"],
        cover=course.box((-outer, outer), (-DEPTH_M, DEPTH_M + 0.06), (0, high + 0.02), left=0.01, right=0.04),
        in_view=[
            course.box((-outer, outer), (-DEPTH_M, DEPTH_M + WALL_M), (0, high)),
            course.box((cube_at - half_cube, cube_at + half_cube), (-half_cube, half_cube), (0, p.cube_m)),
        ],
        things=[f"{p.rope_colour} rope", f"{p.cube_colour} cube", f"{p.tray_colour} tray"],
        also=["peg", "board"],
    )


def outcome(motion: Motion, p: Params) -> Reading:
    """Read 'no' once the rope is below half the peg's height, 'yes' if it stays above."""
    rope = motion.vertices["rope"]
    top = rope[:, :, 2].max(axis=1) - p.peg_m / 2
    first = lasting_from(top < 0) if top[-1] < 0 else still_from(rope, within_m=STILL_M)
    label = "no" if top[-1] < 0 else "yes"
    return Reading([label if i >= first else None for i in range(len(top))], float(abs(top[-1])))


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return whether the resting rope is tall and ends over the tray, None if unseen."""
    path = [largest(frame, slots["rope"], 60) for frame in frames[-3:]]
    end = path[-1]
    if end is None or not is_at_rest(path, tolerance_px=4):
        return None
    return "yes" if end.box[3] > 0.5 * end.box[2] else "no"


FAMILY = scene_family(
    "soft_rope",
    category="soft_bodies",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {rope} rope stay hanging over the peg above the {tray} tray, yes or no?",
        "Thrown up, does the {rope} rope come to hang over the peg in the end: yes or no?",
        "Is the {rope} rope hanging over the peg, and not lying in the {tray} tray, in the end: yes or no?",
        yes=["yes it does", "it hangs over the peg", "the rope hangs over the peg", "it stays hanging"],
        no=["no it does not", "it lies in the tray", "it slides off", "the rope falls into the tray"],
    ),
    asides=[
        colour_of("rope", "What colour is the rope: {choices}?", ("rope", "tray", "cube")),
        either(
            "On which side of the picture does the {cube} cube stand, left or right?",
            ("left", "right"),
            lambda p: "right" if p.direction > 0 else "left",
        ),
    ],
    observe=observe,
    min_margin_m=0.08,
    looks=(),
)
