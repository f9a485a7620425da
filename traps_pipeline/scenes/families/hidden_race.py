"""Balls race through a tunnel in lanes of their own; the question is which colour comes out first.

Control: the far end of the tunnel and the tray behind it are in view. Void: the panel stands before them.
Hidden element: inside the tunnel every lane but one crosses a rough board that slows its ball to a creep. The visible
run-up says nothing about which lane is clear, so the ball that enters first is only a lure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from traps_pipeline.scenes.kit import (
    AnswerableQuestion,
    Box,
    Family,
    Inventory,
    Physics,
    Scene,
    View,
    Wording,
    add_ball,
    add_box,
    distinct_colours,
    listed,
    new_spec,
    uniform,
)
from traps_pipeline.scenes.vision import blobs, colour_mask
from traps_pipeline.scenes.wording import asked, choices_in

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
DECK_M = 0.045  # height of the lanes; the tray lies lower, so that no ball rolls back into the tunnel
TRAY_M = 0.015
ROUGH_BOARD_M = 0.10
ARRIVING = 0.97  # share of its speed that a ball still has where the rough boards begin
MIN_LEAD_S = 0.5  # a closer finish could fall between two sampled frames
BALL_COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. colours, speeds, starts: one per lane, front lane first."""

    direction: int
    colours: tuple[str, ...]
    speeds_m_s: tuple[float, ...]
    starts_m: tuple[float, ...]  # head start of each ball along its lane
    clear_lane: int  # the lane without a rough board: the hidden element
    creep_m_s: float  # speed at which a ball leaves a rough board
    radius_m: float
    run_m: float  # open lane before the tunnel
    mouth_m: float  # part of the tunnel that is seen beside the panel
    tunnel_m: float
    tray_m: float
    deck_colour: str
    tunnel_colour: str
    tray_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def pitch_m(self) -> float:
        """Distance between lane centres."""
        return 2.8 * self.radius_m

    @property
    def exit_m(self) -> float:
        """Where the tunnel ends, along the lanes."""
        return self.run_m + self.tunnel_m


def draw(rng: np.random.Generator) -> Params:
    """Two or three lanes; which one is clear is independent of everything that can be seen."""
    lanes = int(rng.choice([2, 3, 3]))
    direction = int(rng.choice([-1, 1]))
    tunnel, deck, tray = rng.permutation(["wood", "grey", "white"])
    return Params(
        direction=direction,
        colours=distinct_colours(rng, lanes, BALL_COLOURS),
        speeds_m_s=tuple(uniform(rng, 0.38, 0.48) for _ in range(lanes)),
        starts_m=tuple(uniform(rng, 0.04, 0.12) for _ in range(lanes)),
        clear_lane=int(rng.integers(lanes)),
        creep_m_s=uniform(rng, 0.17, 0.22),
        radius_m=uniform(rng, 0.046, 0.056),
        run_m=uniform(rng, 0.38, 0.46),
        mouth_m=uniform(rng, 0.09, 0.13),
        tunnel_m=uniform(rng, 0.55, 0.61),
        tray_m=uniform(rng, 0.28, 0.34),
        deck_colour=str(deck),
        tunnel_colour=str(tunnel),
        tray_colour=str(tray),
        azimuth_deg=90 - direction * uniform(rng, -16, 22),
        elevation_deg=uniform(rng, -38, -26),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Deck with rails, opaque tunnel, sunken tray. Lengths run along the lanes and are mirrored by `direction`."""
    spec = new_spec(physics)
    lanes, r = len(p.colours), p.radius_m
    width = lanes * p.pitch_m
    roof = DECK_M + 2.6 * r
    rough_at = p.run_m + p.mouth_m + 2 * r + 0.04  # no ball feels it before it is wholly behind the panel
    end = p.exit_m + p.tray_m

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    side, wall = width / 2, 0.012
    after = rough_at + ROUGH_BOARD_M
    block("deck_in", (-0.03, rough_at), (-side, side), (0, DECK_M), p.deck_colour)
    block("deck_out", (after, p.exit_m), (-side, side), (0, DECK_M), p.deck_colour)
    for i in range(lanes + 1):
        y = -side + i * p.pitch_m
        block(f"rail_{i}", (-0.03, p.exit_m), (y - 0.004, y + 0.004), (DECK_M, DECK_M + 0.4 * r), p.tunnel_colour)
    for i, y in enumerate(_lanes_y(p)):
        board = block(f"board_{i}", (rough_at, after), (y - p.pitch_m / 2, y + p.pitch_m / 2), (0, DECK_M), "black")
        rolling = 2e-5 if i == p.clear_lane else _roughness(p, i, physics)
        board.friction, board.condim, board.priority = [0.8, 0.005, rolling], 6, 1
        ball = add_ball(spec, f"ball_{i}", (p.direction * p.starts_m[i], y, DECK_M + r), r, p.colours[i])
        ball.friction = [0.8, 0.005, 2e-5]
    block("tunnel_front", (p.run_m, p.exit_m), (-side - wall, -side), (0, roof), p.tunnel_colour)
    block("tunnel_back", (p.run_m, p.exit_m), (side, side + wall), (0, roof), p.tunnel_colour)
    block("tunnel_roof", (p.run_m, p.exit_m), (-side - wall, side + wall), (roof, roof + wall), p.tunnel_colour)
    tray = block("tray", (p.exit_m, end), (-side, side), (0, TRAY_M), p.tray_colour)
    tray.friction, tray.condim, tray.priority = [0.8, 0.005, 4e-4], 6, 1  # felt: the balls come to rest in view
    rim = TRAY_M + 0.9 * r
    block("tray_front", (p.exit_m, end), (-side - wall, -side), (0, rim), p.tunnel_colour)
    block("tray_back", (p.exit_m, end), (side, side + wall), (0, rim), p.tunnel_colour)
    block("tray_end", (end, end + wall), (-side - wall, side + wall), (0, rim), p.tunnel_colour)

    shadow = 0.35 * roof  # shadows fall to the right and to the back
    ends = sorted((p.direction * (p.run_m + p.mouth_m), p.direction * (end + wall)))
    high_y = side + wall + 0.55 * roof
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=tuple(f"ball_{i}" for i in range(lanes)),
        hidden=tuple(f"board_{i}" for i in range(lanes)),
        cover=Box(
            (ends[0], -side - wall - 0.02, 0.0), (ends[1] + (shadow if p.direction > 0 else 0), high_y, roof + wall)
        ),
        stage=(Box((ends[0], -side - wall, 0.0), (ends[1], side + wall, roof + wall)),),
        velocity={f"ball_{i}": _rolling(p, v) for i, v in enumerate(p.speeds_m_s)},
        inventory=Inventory(
            (*p.colours, p.deck_colour, p.tunnel_colour, p.tray_colour),
            ("ball", "tunnel", "tray", "lane"),
            (*(f"{c} ball" for c in p.colours), "tunnel", "tray"),
        ),
    )


def _lanes_y(p: Params) -> list[float]:
    return [(i - (len(p.colours) - 1) / 2) * p.pitch_m for i in range(len(p.colours))]


def _rolling(p: Params, speed: float) -> tuple[float, ...]:
    """Velocity of a ball that rolls without slipping."""
    return (p.direction * speed, 0.0, 0.0, 0.0, p.direction * speed / p.radius_m, 0.0)


def _roughness(p: Params, lane: int, physics: Physics) -> float:
    """Rolling friction (m) that brings this lane's ball down to `creep_m_s`: a solid ball slows at 5 g mu / 7 r."""
    lost = (ARRIVING * p.speeds_m_s[lane]) ** 2 - p.creep_m_s**2
    return 7 / 5 * p.radius_m * lost / (2 * ROUGH_BOARD_M * physics.gravity_m_s2)


def _ahead(motion: Motion, p: Params) -> np.ndarray:
    """How far each ball's rear is past the end of the tunnel (m), shape (F, lanes)."""
    along = [p.direction * motion.pos(f"ball_{i}")[:, 0] for i in range(len(p.colours))]
    return np.stack(along, axis=1) - p.radius_m - p.exit_m


def readings(motion: Motion, p: Params) -> list[str | None]:
    """The colour that came out first, from when its ball is wholly out. A close finish, or a ball that stays in the
    tunnel, has no reading at all."""
    out = _ahead(motion, p) > 0
    if not out[-1].all():
        return [None] * len(out)
    exits = motion.times[out.argmax(axis=0)]
    first, second = np.sort(exits)[:2]
    if second - first < MIN_LEAD_S:
        return [None] * len(out)
    winner = p.colours[int(exits.argmin())]
    return [winner if t >= first else None for t in motion.times]


def margin(motion: Motion, p: Params) -> float:
    """How far the runner-up still is from coming out when the winner is out (m)."""
    ahead = _ahead(motion, p)
    frame = int((ahead > 0).any(axis=1).argmax())
    return float(-np.sort(ahead[frame])[-2])


def twins(p: Params) -> list[Params]:
    """The same race with another lane clear."""
    return [replace(p, clear_lane=lane) for lane in range(len(p.colours)) if lane != p.clear_lane]


QUESTIONS = (
    "Which ball comes out of the tunnel first, {choices}?",
    "What colour is the first ball to come out of the tunnel: {choices}?",
    "Which colour leaves the tunnel first: {choices}?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The choices are the colours in the race, in random order."""
    choices = tuple(str(c) for c in rng.permutation(p.colours))
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(choices=listed(choices)),
        labels=choices,
        aliases={form.format(c): c for c in choices for form in ("{} ball", "{} one", "{} ball comes out first")},
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(3)
    if kind == 0:
        side = "left" if p.direction > 0 else "right"
        return AnswerableQuestion("From which side do the balls roll in, left or right?", ("left", "right"), side)
    if kind == 1:
        question = "How many balls roll into the tunnel, 2 or 3?"
        return AnswerableQuestion(question, ("2", "3"), str(len(p.colours)))
    nearest = p.colours[0]
    choices = tuple(str(c) for c in rng.permutation(p.colours))
    question = f"Which ball rolls in the lane nearest to the camera, {listed(choices)}?"
    return AnswerableQuestion(question, choices, nearest)


def observe(frames: np.ndarray, question: str) -> str | None:
    """The ball that is seen again first after it was out of sight, once all of them are."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    colours = choices_in(values["choices"])
    out = [_seen_again(frames, colour) for colour in colours]
    seen = [frame for frame in out if frame is not None]
    if len(seen) < len(out) or seen.count(min(seen)) > 1:
        return None
    return colours[seen.index(min(seen))]


def _seen_again(frames: np.ndarray, colour: str) -> int | None:
    """First frame that shows at least half of the ball after the tunnel, None if it stays out of sight."""
    areas = np.array([_ball_pixels(frame, colour) for frame in frames])
    gone = np.flatnonzero(areas == 0)
    if not gone.size or areas[-3:].min() == 0:
        return None
    back = np.flatnonzero(areas >= np.median(areas[-3:]) / 2)
    return int(back[back > gone[0]][0])


def _ball_pixels(frame: np.ndarray, colour: str) -> int:
    sizes = [blob.area for blob in blobs(colour_mask(frame, colour), 20) if max(blob.box[2:]) < 80]
    return max(sizes, default=0)


FAMILY = Family(
    name="hidden_race",
    taxonomy="occlusion",
    category="hidden",
    sub_scenario="hidden_race",
    answer_type="colour",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    observe=observe,
    min_margin_m=0.03,
    twins=twins,
)
