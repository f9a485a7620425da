"""A soft ball falls between two pairs of bars: on which does it get stuck?

Control: both pairs and the tray below are in view. Void: the occluder stands before them.
Hidden element: how far apart the bars are. No gap is as wide as the ball: through the wider ones it squeezes, on the
narrow ones it stays. An extension: no part of the benchmark (docs/scenes.md, "Soft bodies").
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.parts.course import SOFT, Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import round_blob
from traps_pipeline.scenes.parts.questions import colour_from, either, which_colour
from traps_pipeline.scenes.parts.readings import Reading, still_from
from traps_pipeline.scenes.parts.vary import apart, between, hidden, in_front, one_of, shuffled
from traps_pipeline.scenes.parts.vision import colour_mask, is_at_rest
from traps_pipeline.scenes.parts.wording import choices_in
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene
from traps_soft_bodies.bodies import soft_ball

FLOOR_M = 0.02  # thickness of the tray's floor
WALL_M = 0.012
DEPTH_M = 0.13  # half of the tray's depth
BAR_M = 0.026  # radius of the bars
PIECES = 6
STILL_M = 0.015
COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")
PLAY_COLOURS, PLAIN_COLOURS = apart(*COLOURS), shuffled("wood", "grey", "white")


@dataclass(frozen=True)
class Params:
    """Parameters; passes counts pairs of bars; wide and narrow are in ball diameters."""

    ball_colour: str = PLAY_COLOURS()
    upper_colour: str = PLAY_COLOURS()
    lower_colour: str = PLAY_COLOURS()
    tray_colour: str = PLAY_COLOURS()
    cube_colour: str = PLAIN_COLOURS()
    board_colour: str = PLAIN_COLOURS()
    passes: int = hidden(0, 1, 2)
    radius_m: float = between(0.072, 0.080)
    young_pa: float = between(3500.0, 4500.0)
    wide: float = between(0.84, 0.88)
    narrow: float = between(0.40, 0.46)
    upper_m: float = between(0.41, 0.45)  # height of the upper bars' middle
    lower_m: float = between(0.21, 0.24)
    half_m: float = between(0.30, 0.36)  # of the tray's width
    release_m: float = between(0.82, 0.88)  # height of the ball's middle at first
    toss_m_s: float = between(2.6, 2.8)
    drift_m_s: float = between(-0.01, 0.01)
    cube_side: int = one_of(-1, 1)
    cube_m: float = between(0.12, 0.16)
    azimuth_deg: float = in_front(-16, 16)
    elevation_deg: float = between(-24, -16)

    def gap_m(self, pair: int) -> float:
        """Return the gap between the bars of the upper pair (0) or the lower one (1)."""
        return 2 * self.radius_m * (self.wide if pair < self.passes else self.narrow)


def build(p: Params, physics: Physics) -> Scene:
    """Build two pairs of bars on a board, the tray below, and a cube to one side."""
    course = Course(physics, surface=Surface(solref=SOFT))
    end, high = p.half_m, p.upper_m + 0.10
    outer, depth_span = end + WALL_M, (-DEPTH_M, DEPTH_M)
    course.tray(
        "tray", (-end, end), depth_span, (0, FLOOR_M), p.tray_colour, wall=WALL_M, near=0.10, far=0.10, front=0.04
    )
    course.block("board", (-outer, outer), (DEPTH_M, DEPTH_M + WALL_M), (0, high), p.board_colour)
    bars = []
    for pair, (name, height, colour) in enumerate(
        (("upper", p.upper_m, p.upper_colour), ("lower", p.lower_m, p.lower_colour))
    ):
        for side, sign in (("left", -1), ("right", 1)):
            along = sign * (p.gap_m(pair) / 2 + BAR_M)
            bar = course.rod(f"{name}_{side}", (along, -0.9 * DEPTH_M, height), (along, DEPTH_M, height), BAR_M, colour)
            bar.friction, bar.priority = [0.05, 0.005, 0.0001], 2
            bars.append(bar.name)
    half_cube = p.cube_m / 2
    cube_at = p.cube_side * (outer + 0.12 + half_cube + (0.14 if p.cube_side > 0 else 0.0))
    course.block(
        "cube", (cube_at - half_cube, cube_at + half_cube), (-half_cube, half_cube), (0, p.cube_m), p.cube_colour
    )
    soft_ball(
        course,
        "ball",
        (0, 0, p.release_m),
        p.radius_m,
        p.ball_colour,
        thrown=(p.drift_m_s, p.toss_m_s),
        young=p.young_pa,
        mass=0.4,
        pieces=PIECES,
    )
    course.mark("upper bars", (-0.95 * end, DEPTH_M), p.upper_colour)
    course.mark("lower bars", (-0.6 * end, DEPTH_M), p.lower_colour)
    course.mark("tray", (0.6 * end, DEPTH_M), p.tray_colour)
    return course.scene(
        p,
        decisive=["ball"],
        hidden=bars,
        cover=course.box((-outer, outer), (-DEPTH_M, DEPTH_M + 0.08), (0, high + 0.02), left=0.01, right=0.06),
        in_view=[
            course.box((-outer, outer), (-DEPTH_M, DEPTH_M + WALL_M), (0, high)),
            course.box((cube_at - half_cube, cube_at + half_cube), (-half_cube, half_cube), (0, p.cube_m)),
        ],
        things=[f"{p.ball_colour} ball", f"{p.cube_colour} cube", f"{p.tray_colour} tray"],
        also=["bar", "board"],
        shown_by={"bar": ["bars"]},
    )


def outcome(motion: Motion, p: Params) -> Reading:
    """Read what is nearest below the resting ball: a pair of bars, or the tray."""
    height = motion.pos("ball")[:, 2]
    rest_heights = [p.upper_m + 0.9 * p.radius_m, p.lower_m + 0.9 * p.radius_m, FLOOR_M + p.radius_m]
    halfway = [(rest_heights[0] + rest_heights[1]) / 2, (rest_heights[1] + rest_heights[2]) / 2]
    colours = (p.upper_colour, p.lower_colour, p.tray_colour)
    label = colours[sum(height[-1] < line for line in halfway)]
    first = still_from(motion.vertices["ball"], within_m=STILL_M)
    margin = min(abs(float(height[-1]) - line) for line in halfway)
    return Reading([label if i >= first else None for i in range(len(height))], margin)


def _height(frame: np.ndarray, colour: str) -> float | None:
    """Return the mean row (px) of all that has a colour, None if there is little."""
    rows = np.flatnonzero(colour_mask(frame, colour).any(axis=1))
    return float(rows.mean()) if len(rows) >= 4 else None


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return the offered colour nearest to the resting ball's underside, None if none."""
    if "choices" not in slots:
        return None
    path = [round_blob(frame, slots["ball"]) for frame in frames[-3:]]
    end = path[-1]
    heights = {colour: _height(frames[-1], colour) for colour in choices_in(slots["choices"])}
    if end is None or not is_at_rest(path, tolerance_px=4) or None in heights.values():
        return None
    underside_y = end.box[1] + end.box[3]
    return min(heights, key=lambda colour: abs((heights[colour] or 0.0) - underside_y))


FAMILY = scene_family(
    "soft_ball",
    category="soft_bodies",
    params=Params,
    build=build,
    outcome=outcome,
    question=which_colour(
        "The soft {ball} ball comes to rest on bars or in the tray: which colour has what it rests on, {choices}?",
        "On bars or in a tray of which colour does the soft {ball} ball lie in the end: {choices}?",
        "Which colour have the bars that stop the soft {ball} ball, or the tray if no bars do: {choices}?",
        colours=lambda p: (p.upper_colour, p.lower_colour, p.tray_colour),
        forms=["the {} one", "the {} ones", "on {}"],
    ),
    asides=[
        colour_from("ball", "What colour is the soft ball: {choices}?", COLOURS, unlike=("ball", "upper", "lower")),
        either(
            "At which side of the bars is the {cube} cube, left or right?",
            ("left", "right"),
            lambda p: "right" if p.cube_side > 0 else "left",
        ),
    ],
    observe=observe,
    min_margin_m=0.03,
    looks=(),
)
