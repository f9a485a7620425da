"""A ball falls on a cloth that hangs between posts: does the cloth catch it?

Control: cloth, posts and tray are in view. Void: the occluder stands before them.
Hidden element: the cloth, which is tied to the posts at both ends, so that the ball comes to lie in it, or at one end
alone, so that it hangs down there and lets the ball pass. An extension: no part of the benchmark (docs/scenes.md, "Soft
bodies").
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.parts.course import SHADOW_RIGHT, SOFT, Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import round_blob
from traps_pipeline.scenes.parts.questions import colour_of, either, yes_no
from traps_pipeline.scenes.parts.readings import Reading, lasting_from, still_from
from traps_pipeline.scenes.parts.vary import apart, between, hidden, in_front, one_of, shuffled
from traps_pipeline.scenes.parts.vision import colour_mask, is_at_rest
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene
from traps_soft_bodies.bodies import hammock

FLOOR_M = 0.02  # thickness of the tray's floor
WALL_M = 0.012
POST_M = 0.012  # radius of the posts
CELLS = (8, 6)
STILL_M = 0.02
CLOTH_PX = 300  # of the cloth, for an observer
FELT = Surface(0.004, sliding=0.6, solref=SOFT)
PLAY_COLOURS = apart("red", "green", "blue", "yellow", "orange", "cyan", "purple")
PLAIN_COLOURS = shuffled("wood", "grey", "white")


@dataclass(frozen=True)
class Params:
    """Parameters; at direction +1 the cube is right, and a half-tied cloth hangs left."""

    direction: int = one_of(-1, 1)
    ball_colour: str = PLAY_COLOURS()
    cloth_colour: str = PLAY_COLOURS()
    tray_colour: str = PLAY_COLOURS()
    cube_colour: str = PLAY_COLOURS()
    board_colour: str = PLAIN_COLOURS()
    post_colour: str = PLAIN_COLOURS()
    ends_tied: int = hidden(1, 2)
    radius_m: float = between(0.055, 0.065)
    span_m: float = between(0.44, 0.50)  # from post to post
    deep_m: float = between(0.26, 0.30)  # of the cloth
    sag_m: float = between(0.06, 0.08)
    post_m: float = between(0.38, 0.44)  # height at which the cloth is tied
    release_m: float = between(0.80, 0.88)  # height of the ball's middle at first
    toss_m_s: float = between(2.4, 2.7)
    drift_m_s: float = between(-0.04, 0.04)
    cube_m: float = between(0.12, 0.16)
    azimuth_deg: float = in_front(-16, 16)
    elevation_deg: float = between(-26, -16)


def build(p: Params, physics: Physics) -> Scene:
    """Build two pairs of posts with the cloth, the tray, a board behind, and a cube."""
    course = Course(physics, p.direction, FELT)
    end, half_width, high = p.span_m / 2 + 0.06, p.deep_m / 2 + 0.03, p.post_m + 0.02
    outer, back = end + WALL_M, half_width + WALL_M
    course.tray(
        "tray", (-end, end), (-half_width, half_width), (0, FLOOR_M), p.tray_colour, wall=WALL_M, near=0.10, far=0.10
    )
    course.block("tray_front", (-outer, outer), (-back, -half_width), (0, 0.06), p.tray_colour)
    course.block("board", (-outer, outer), (half_width, back), (0, high), p.board_colour)
    for end_name, along_sign in (("near", -1), ("far", 1)):
        for side_name, across_sign in (("front", -1), ("back", 1)):
            at = (along_sign * (p.span_m / 2 + POST_M), across_sign * p.deep_m / 2, high / 2)
            course.post(f"post_{end_name}_{side_name}", at, POST_M, high / 2, p.post_colour)
    half_cube, cube_at = p.cube_m / 2, outer + 0.12 + p.cube_m / 2 + course.ahead(0.22)
    course.block(
        "cube", (cube_at - half_cube, cube_at + half_cube), (-half_cube, half_cube), (0, p.cube_m), p.cube_colour
    )

    size, tied_ends = (p.span_m, p.deep_m), (-1, 1) if p.ends_tied == 2 else (-1,)
    hammock(course, "cloth", (0, 0, p.post_m), size, CELLS, p.cloth_colour, sag=p.sag_m, tied=tied_ends)
    course.ball("ball", (0, 0, p.release_m), p.radius_m, p.ball_colour, thrown=(p.drift_m_s, p.toss_m_s), density=350)
    course.mark("cloth", (0.55 * end, half_width), p.cloth_colour)
    course.mark("tray", (-0.55 * end, half_width), p.tray_colour)
    return course.scene(
        p,
        decisive=["ball"],
        hidden=["cloth"],
        cover=course.box((-outer, outer), (-back, back + 0.06), (0, high + 0.02), left=0.01, right=SHADOW_RIGHT * high),
        in_view=[
            course.box((-outer, outer), (-back, back), (0, high)),
            course.box((cube_at - half_cube, cube_at + half_cube), (-half_cube, half_cube), (0, p.cube_m)),
        ],
        things=[f"{p.ball_colour} ball", f"{p.cube_colour} cube", f"{p.cloth_colour} cloth", f"{p.tray_colour} tray"],
        also=["post", "board"],
    )


def outcome(motion: Motion, p: Params) -> Reading:
    """Read 'no' once the ball is below half the posts' height, 'yes' if it stays up."""
    ball = motion.pos("ball")
    over_m = ball[:, 2] - p.post_m / 2
    first = lasting_from(over_m < 0) if over_m[-1] < 0 else still_from(ball, within_m=STILL_M)
    label = "no" if over_m[-1] < 0 else "yes"
    return Reading([label if i >= first else None for i in range(len(over_m))], float(abs(over_m[-1])))


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return whether the cloth is wider than high once the ball rests, None if unseen."""
    path = [round_blob(frame, slots["ball"]) for frame in frames[-3:]]
    rows, columns = np.nonzero(colour_mask(frames[-1], slots["cloth"]))
    if len(rows) < CLOTH_PX or not is_at_rest(path, tolerance_px=4):
        return None
    width, height = (float(np.ptp(np.percentile(along, (1, 99)))) for along in (columns, rows))
    return "yes" if width > 1.2 * height else "no"


FAMILY = scene_family(
    "soft_hammock",
    category="soft_bodies",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {cloth} cloth catch the {ball} ball before it gets to the {tray} tray, yes or no?",
        "Is the {ball} ball lying in the {cloth} cloth, and not in the {tray} tray, in the end: yes or no?",
        "Thrown up, is the {ball} ball caught by the {cloth} cloth above the {tray} tray: yes or no?",
        yes=["yes it does", "it is caught", "the cloth catches it", "it lies in the cloth"],
        no=["no it does not", "it is not caught", "it falls into the tray", "it lies in the tray"],
    ),
    asides=[
        colour_of("ball", "What colour is the ball that flies up: {choices}?", ("ball", "tray", "cube")),
        either(
            "At which side of the picture is the {cube} cube, left or right?",
            ("left", "right"),
            lambda p: "right" if p.direction > 0 else "left",
        ),
    ],
    observe=observe,
    min_margin_m=0.05,
    looks=(),
)
