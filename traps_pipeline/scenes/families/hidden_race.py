"""Balls race through a tunnel in lanes of their own: which colour is first out?

Control: the far end of the tunnel and the tray behind it are in view. Void: the occluder stands before them.
Hidden element: inside the tunnel every lane but one crosses a rough board that slows its ball to a creep. The visible
run-up says nothing about which lane is clear, so the ball that enters first is only a lure.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.parts.course import SHADOW_BACK, SHADOW_RIGHT, Course, Surface, brake
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import colours_of_balls
from traps_pipeline.scenes.parts.questions import choice_of, comes_from, which_colour
from traps_pipeline.scenes.parts.readings import Reading, first_past
from traps_pipeline.scenes.parts.vary import (
    Drawn,
    apart,
    between,
    drawn_by,
    facing,
    hidden_index,
    is_longer,
    several_between,
    shuffled,
)
from traps_pipeline.scenes.parts.vision import blobs, colour_mask
from traps_pipeline.scenes.physics.kit import AnswerableQuestion, Motion, Physics, Scene, list_choices

DECK_M = 0.045  # height of the lanes; the tray lies lower, so that no ball rolls back into the tunnel
TRAY_M = 0.015
ROUGH_BOARD_M = 0.10
ARRIVING = 0.97  # share of its speed that a ball still has where the rough boards begin
MIN_LEAD_S = 0.5  # a closer finish could fall between two sampled frames
BALL_COLOURS = "red", "green", "blue", "yellow", "orange", "cyan", "purple"
PLAY_COLOURS = apart(*BALL_COLOURS)
PLAIN_COLOURS = shuffled("wood", "grey", "white")


def _direction(rng: np.random.Generator, so_far: Drawn) -> int:
    """Draw the direction, and before it the number of lanes, which no field stores."""
    so_far["lanes"] = 4 if is_longer(so_far) else int(rng.choice([2, 3, 3]))
    return int(rng.choice([-1, 1]))


@dataclass(frozen=True)
class Params:
    """Parameters by lane, front lane first; direction +1 is right."""

    direction: int = drawn_by(_direction, longer=True)
    tunnel_colour: str = PLAIN_COLOURS()
    deck_colour: str = PLAIN_COLOURS()
    tray_colour: str = PLAIN_COLOURS()
    colours: tuple[str, ...] = PLAY_COLOURS("lanes")
    speeds_m_s: tuple[float, ...] = several_between("lanes", 0.38, 0.48)
    starts_m: tuple[float, ...] = several_between("lanes", 0.04, 0.12)  # head start of each ball along its lane
    clear_lane: int = hidden_index("colours")  # the lane without a rough board
    creep_m_s: float = between(0.17, 0.22)  # speed at which a ball leaves a rough board
    radius_m: float = between(0.046, 0.056)
    run_m: float = between(0.38, 0.46)  # open lane before the tunnel
    mouth_m: float = between(0.09, 0.13)  # part of the tunnel that is seen beside the occluder
    tunnel_m: float = between(0.55, 0.61)
    tray_m: float = between(0.28, 0.34)
    azimuth_deg: float = facing(-16, 22)
    elevation_deg: float = between(-38, -26)

    @property
    def balls(self) -> list[str]:
        """Bodies of the balls, front lane first."""
        return [f"ball_{i}" for i in range(len(self.colours))]

    @property
    def exit_m(self) -> float:
        """Position of the tunnel's end along the lanes."""
        return self.run_m + self.tunnel_m


def build(p: Params, physics: Physics) -> Scene:
    """Build deck with rails, opaque tunnel, sunken tray."""
    course = Course(physics, p.direction)
    lanes, r, pitch, wall = len(p.colours), p.radius_m, 2.8 * p.radius_m, 0.012
    half_width, roof, rim, end = lanes * pitch / 2, DECK_M + 2.6 * r, TRAY_M + 0.9 * r, p.exit_m + p.tray_m
    depth_span, outer, tunnel = (-half_width, half_width), (-half_width - wall, half_width + wall), (p.run_m, p.exit_m)
    rough_at = p.run_m + p.mouth_m + 2 * r + 0.04  # no ball feels it before it is wholly behind the occluder
    rough_end = rough_at + ROUGH_BOARD_M

    course.block("deck_in", (-0.03, rough_at), depth_span, (0, DECK_M), p.deck_colour)
    course.block("deck_out", (rough_end, p.exit_m), depth_span, (0, DECK_M), p.deck_colour)
    for i in range(lanes + 1):
        y = -half_width + i * pitch
        across, up = (y - 0.004, y + 0.004), (DECK_M, DECK_M + 0.4 * r)
        course.block(f"rail_{i}", (-0.03, p.exit_m), across, up, p.tunnel_colour)
    for i, ball in enumerate(p.balls):
        y = (i - (lanes - 1) / 2) * pitch
        board = Surface(2e-5 if i == p.clear_lane else _roughness(p, i, physics))
        course.block(f"board_{i}", (rough_at, rough_end), (y - pitch / 2, y + pitch / 2), (0, DECK_M), "black", board)
        course.ball(ball, (p.starts_m[i], y, DECK_M + r), r, p.colours[i], speed=p.speeds_m_s[i])
    course.sides("tunnel", tunnel, half_width, wall, (0, roof), p.tunnel_colour)
    course.block("tunnel_roof", tunnel, outer, (roof, roof + wall), p.tunnel_colour)
    surface = Surface(4e-4)  # the balls come to rest in view
    course.block("tray", (p.exit_m, end), depth_span, (0, TRAY_M), p.tray_colour, surface)
    course.sides("tray", (p.exit_m, end), half_width, wall, (0, rim), p.tunnel_colour)
    course.block("tray_end", (end, end + wall), outer, (0, rim), p.tunnel_colour)

    along, up = (p.run_m + p.mouth_m, end + wall), (0, roof + wall)
    across = (-half_width - wall - 0.02, half_width + wall + SHADOW_BACK * roof)
    return course.scene(
        p,
        decisive=p.balls,
        hidden=[f"board_{i}" for i in range(lanes)],
        cover=course.box(along, across, up, right=course.ahead(SHADOW_RIGHT * roof)),
        in_view=[course.box(along, outer, up)],
        things=[*(f"{colour} ball" for colour in p.colours), "tunnel", "tray"],
        also=["lane"],
        colours=p.colours,
    )


def _roughness(p: Params, lane: int, physics: Physics) -> float:
    """Return rolling friction (m) that brings this lane's ball down to `creep_m_s`."""
    loss = (ARRIVING * p.speeds_m_s[lane]) ** 2 - p.creep_m_s**2
    return brake(p.radius_m, loss, ROUGH_BOARD_M, physics)


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the colour that came out first, from when its ball is wholly out."""
    along = [p.direction * motion.pos(ball)[:, 0] for ball in p.balls]
    return first_past(motion, np.stack(along, axis=1) - p.radius_m - p.exit_m, p.colours, MIN_LEAD_S)


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return the ball seen first after it was out of sight, once all are seen again."""
    colours = colours_of_balls(frames, slots, BALL_COLOURS)
    returns = [_return_frame(frames, colour) for colour in colours]
    return_frames = [frame for frame in returns if frame is not None]
    if not return_frames or len(return_frames) < len(returns) or return_frames.count(min(return_frames)) > 1:
        return None
    return colours[return_frames.index(min(return_frames))]


def _return_frame(frames: np.ndarray, colour: str) -> int | None:
    """Return the first frame with half of the ball after the tunnel, None if none."""
    areas = np.array([_ball_pixels(frame, colour) for frame in frames])
    frames_out_of_sight = np.flatnonzero(areas == 0)
    if not frames_out_of_sight.size or areas[-3:].min() == 0:
        return None
    half_seen = np.flatnonzero(areas >= np.median(areas[-3:]) / 2)
    return int(half_seen[half_seen > frames_out_of_sight[0]][0])


def _ball_pixels(frame: np.ndarray, colour: str) -> int:
    sizes = [blob.area for blob in blobs(colour_mask(frame, colour), 20) if max(blob.box[2:]) < 80]
    return max(sizes, default=0)


def foresee(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Predict the ball of which any part is seen first after the tunnel."""
    returned_at: dict[str, int] = {}
    for colour in colours_of_balls(frames, slots, BALL_COLOURS):
        hidden_frames = [i for i, frame in enumerate(frames) if _ball_pixels(frame, colour) == 0]
        after_tunnel = (
            [i for i in range(hidden_frames[0], len(frames)) if _ball_pixels(frames[i], colour)]
            if hidden_frames
            else []
        )
        if after_tunnel:
            returned_at[colour] = after_tunnel[0]
    first = [colour for colour, i in returned_at.items() if i == min(returned_at.values())]
    return first[0] if len(first) == 1 else None


def _ask_count(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    numbers = ("2", "3") if len(p.colours) < 4 else ("3", "4")
    question = f"How many balls roll into the tunnel, {list_choices(numbers)}?"
    return AnswerableQuestion(question, numbers, str(len(p.colours)))


FAMILY = scene_family(
    "hidden_race",
    category="hidden",
    params=Params,
    build=build,
    outcome=outcome,
    question=which_colour(
        "Which ball comes out of the tunnel first, {choices}?",
        "What colour is the first ball to come out of the tunnel: {choices}?",
        "Which colour leaves the tunnel first: {choices}?",
        colours=lambda p: p.colours,
        forms=["{} ball", "{} one", "{} ball comes out first"],
    ),
    asides=[
        comes_from("From which side do the balls roll in, left or right?"),
        _ask_count,
        choice_of(
            "Which ball rolls in the lane nearest to the camera, {choices}?",
            choices=lambda p: p.colours,
            answer=lambda p: p.colours[0],
        ),
    ],
    observe=observe,
    foresee=foresee,
    min_margin_m=0.03,
)
