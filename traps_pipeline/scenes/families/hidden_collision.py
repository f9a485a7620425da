"""Two balls roll towards each other on a track of two lanes; the question is whether they collide.

Control: the middle of the track, where the lanes are linked, is in view. Void: the panel stands before it.
Hidden element: a switch board, which lies between the lanes or is turned so that it leads one ball to the other lane.
Which lanes the balls enter by does not tell: balls of one lane may be parted, balls of two lanes brought together.
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
    new_spec,
    uniform,
)
from traps_pipeline.scenes.vision import Blob, at_rest, blobs, colour_mask
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
DECK_M = 0.03
WALL_M = 0.012
# In ball radii:
HALF_PITCH = 1.4  # from the middle of the track to a lane's centre
SWITCH = (2.6, 4.5)  # across and along the lanes, when it is turned
BALL_COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 if the first ball, which the switch may turn aside, rolls to the right. lanes: -1 front, +1 back.

    Lengths run along the first ball's way from the middle of the covered part.
    """

    direction: int
    lanes: tuple[int, ...]  # of the first and of the second ball
    turned: bool  # whether the switch leads the first ball to the other lane (the hidden element)
    colours: tuple[str, ...]
    speeds_m_s: tuple[float, ...]
    radius_m: float
    run_m: float  # open track on either side
    middle_m: float  # covered track
    switch_m: float  # where the switch begins, from the start of the covered track
    deck_colour: str
    rail_colour: str
    switch_colour: str
    azimuth_deg: float
    elevation_deg: float


def draw(rng: np.random.Generator) -> Params:
    """Lanes and switch are independent, so that lanes that can be seen tell nothing."""
    deck, rail, switch = rng.permutation(["wood", "grey", "white", "black"])[:3]
    return Params(
        direction=int(rng.choice([-1, 1])),
        lanes=tuple(int(lane) for lane in rng.choice([-1, 1], 2)),
        turned=bool(rng.integers(2)),
        colours=distinct_colours(rng, 2, BALL_COLOURS),
        speeds_m_s=(uniform(rng, 0.80, 0.92), uniform(rng, 0.62, 0.70)),
        radius_m=uniform(rng, 0.055, 0.062),
        run_m=uniform(rng, 0.26, 0.32),
        middle_m=uniform(rng, 1.00, 1.10),
        switch_m=uniform(rng, 0.11, 0.15),
        deck_colour=str(deck),
        rail_colour=str(rail),
        switch_colour=str(switch),
        azimuth_deg=90 + uniform(rng, -18, 18),
        elevation_deg=uniform(rng, -38, -30),
    )


def build(p: Params, physics: Physics) -> Scene:
    """A flat track with rails; of each lane the end is closed by which no ball enters."""
    spec = new_spec(physics)
    r, d = p.radius_m, p.direction
    side = 2 * HALF_PITCH * r
    half = p.middle_m / 2
    end = half + p.run_m
    wall_z = (DECK_M, DECK_M + 1.1 * r)

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (d * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        size = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, size, colour)

    block("deck", (-end, end), (-side, side), (0, DECK_M), p.deck_colour)
    block("wall_front", (-end, end), (-side - WALL_M, -side), (0, DECK_M + 0.5 * r), p.rail_colour)
    block("wall_back", (-end, end), (side, side + WALL_M), (0, wall_z[1]), p.rail_colour)
    switch_at, length = -half + p.switch_m, float(np.hypot(*SWITCH)) * r
    link = (switch_at - 0.3 * r, switch_at + length + 0.3 * r)
    for name, along in (("rail_in", (-end, link[0])), ("rail_out", (link[1], end))):
        block(name, along, (-0.004, 0.004), wall_z, p.rail_colour)
    for name, at, lane in (("stop_near", -half, -p.lanes[0]), ("stop_far", half - 0.02, -p.lanes[1])):
        across = (0.0, side) if lane > 0 else (-side, 0.0)
        block(name, (at, at + 0.02), across, wall_z, p.rail_colour)
    _add_switch(spec, p, switch_at, length)
    starts = (-end + 1.5 * r, end - 1.5 * r)
    for i, start in enumerate(starts):
        at = (d * start, p.lanes[i] * HALF_PITCH * r, DECK_M + r)
        ball = add_ball(spec, f"ball_{i}", at, r, p.colours[i])
        ball.friction = [0.5, 0.005, 0.001]

    high = DECK_M + 2 * r
    ends = sorted((-half - 0.01, half + 0.01))
    cover = Box(
        (ends[0], -side - WALL_M - 0.01, 0),
        (ends[1] + 0.35 * high, side + WALL_M + 0.55 * high, high),
    )
    spin = [d * p.speeds_m_s[0], -d * p.speeds_m_s[1]]
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball_0", "ball_1"),
        hidden=("switch",),
        cover=cover,
        stage=(Box((-end, -side - WALL_M, 0), (end, side + WALL_M, high)),),
        velocity={f"ball_{i}": (v, 0.0, 0.0, 0.0, v / r, 0.0) for i, v in enumerate(spin)},
        inventory=Inventory(
            (*p.colours, p.deck_colour, p.rail_colour, p.switch_colour),
            ("ball", "track", "lane", "rail"),
            (*(f"{c} ball" for c in p.colours), "track", "front lane of the track", "back lane of the track"),
        ),
    )


def _add_switch(spec: mujoco.MjSpec, p: Params, at: float, length: float) -> None:
    """The switch board: in line with the rails, or across the first ball's lane."""
    r, d = p.radius_m, p.direction
    across, along = SWITCH[0] * r, SWITCH[1] * r
    centre = (at + along / 2, p.lanes[0] * across / 2) if p.turned else (at + length / 2, 0.0)
    yaw = -d * p.lanes[0] * float(np.arctan2(across, along)) if p.turned else 0.0
    height = 0.6 * r
    mid = (d * centre[0], centre[1], DECK_M + height)
    geom = add_box(spec.worldbody, "switch", mid, (length / 2, 0.006, height), p.switch_colour)
    geom.quat = [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))]
    geom.friction, geom.condim, geom.priority = [0.05, 0.005, 0.0001], 6, 1


def _apart(motion: Motion, p: Params) -> np.ndarray:
    """How far the second ball is ahead on the first one's way (m): negative once they have passed, shape (F,)."""
    return p.direction * (motion.pos("ball_1")[:, 0] - motion.pos("ball_0")[:, 0])


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'no' from when the balls have passed each other; 'yes' from when they are closest, if they touch."""
    distance = np.linalg.norm(motion.pos("ball_1") - motion.pos("ball_0"), axis=1)
    closest = int(distance.argmin())
    met = distance[closest] < 2 * p.radius_m + 0.01
    apart = _apart(motion, p)
    return ["no" if x < -p.radius_m else "yes" if met and i >= closest else None for i, x in enumerate(apart)]


def margin(motion: Motion, p: Params) -> float:
    """How far apart the balls end along the track (m)."""
    return float(abs(_apart(motion, p)[-1]))


def twins(p: Params) -> list[Params]:
    """The same track with the switch set the other way."""
    return [replace(p, turned=not p.turned)]


QUESTIONS = (
    "Do the {first} ball and the {second} ball collide, yes or no?",
    "Does the {first} ball run into the {second} ball on the track: yes or no?",
    "Do the two balls, the {first} one and the {second} one, bump into each other, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The balls are named by their colours, in random order."""
    first, second = (str(c) for c in rng.permutation(p.colours))
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(first=first, second=second),
        labels=("yes", "no"),
        aliases={
            "they collide": "yes",
            "yes they collide": "yes",
            "they touch": "yes",
            "they bump into each other": "yes",
            "they do not collide": "no",
            "no they do not collide": "no",
            "they pass each other": "no",
            "they miss each other": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind, i = rng.integers(3), int(rng.integers(2))
    if kind == 0:
        side = "left" if (p.direction > 0) == (i == 0) else "right"
        question = f"From which side does the {p.colours[i]} ball roll in, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    if kind == 1:
        lane = "front" if p.lanes[i] < 0 else "back"
        question = f"Does the {p.colours[i]} ball start in the front lane or in the back lane?"
        return AnswerableQuestion(question, ("front", "back"), lane)
    same = "same" if p.lanes[0] == p.lanes[1] else "different"
    question = "Do the balls start in the same lane or in different lanes?"
    return AnswerableQuestion(question, ("same", "different"), same)


def observe(frames: np.ndarray, question: str) -> str | None:
    """'no' if the balls end in the other order from left to right than they start in."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    paths = [[_ball(frame, values[name]) for frame in frames] for name in ("first", "second")]
    starts = [next((blob.x for blob in path if blob), None) for path in paths]
    ends = [path[-1].x for path in paths if path[-1] and at_rest(path, tolerance_px=4)]
    if len(ends) < 2 or starts[0] is None or starts[1] is None:
        return None
    return "yes" if (starts[0] < starts[1]) == (ends[0] < ends[1]) else "no"


def _ball(frame: np.ndarray, colour: str) -> Blob | None:
    """The region of the ball's colour that is no larger than a ball."""
    found = blobs(colour_mask(frame, colour), 60)
    return next((blob for blob in found if max(blob.box[2:]) < 80), None)


FAMILY = Family(
    name="hidden_collision",
    taxonomy="occlusion",
    category="hidden",
    sub_scenario="hidden_collision",
    answer_type="binary",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    observe=observe,
    min_margin_m=0.06,
    twins=twins,
)
