"""A ball rolls down a ramp and along a deck with a box at its end; the question is whether it reaches the box.

Control: the whole deck and the box are in view. Void: the panel stands before all but the beginning of the deck.
Hidden element: a board that bridges a gap in the deck, or lies on the ground below it, so that the ball falls in.
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
from traps_pipeline.scenes.vision import Blob, at_rest, blobs, colour_mask, largest
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
BOARD_M = 0.016  # thickness of ramp and board
WALL_M = 0.012
NAMED_COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. Lengths run along the deck from the foot of the ramp."""

    direction: int
    gap_open: bool  # the hidden element
    radius_m: float
    slope_deg: float
    ramp_m: float  # length of the ramp's surface
    start_m: float  # from the ramp's top to where the ball starts
    deck_m: float  # height of the deck
    mouth_m: float  # deck that is seen before the panel
    lead_m: float  # deck behind the panel before the gap
    gap_m: float
    after_m: float  # deck behind the gap
    box_m: float
    ball_colour: str
    box_colour: str
    ramp_colour: str
    deck_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def gap_span(self) -> Span:
        """Where the gap is."""
        return (self.mouth_m + self.lead_m, self.mouth_m + self.lead_m + self.gap_m)

    @property
    def deck_end_m(self) -> float:
        """Where the deck ends and the box begins."""
        return self.gap_span[1] + self.after_m


def draw(rng: np.random.Generator) -> Params:
    """Half of the gaps are open; nothing that can be seen tells."""
    direction = int(rng.choice([-1, 1]))
    ball, box = distinct_colours(rng, 2, NAMED_COLOURS)
    ramp, deck = (str(c) for c in rng.permutation(["wood", "grey", "black"])[:2])
    radius = uniform(rng, 0.045, 0.054)
    return Params(
        direction=direction,
        gap_open=bool(rng.integers(2)),
        radius_m=radius,
        slope_deg=uniform(rng, 11, 18),
        ramp_m=uniform(rng, 0.36, 0.46),
        start_m=uniform(rng, 0.06, 0.13),
        deck_m=uniform(rng, 0.13, 0.17),
        mouth_m=uniform(rng, 0.04, 0.10),
        lead_m=2 * radius + uniform(rng, 0.06, 0.11),
        gap_m=uniform(rng, 3.3, 3.8) * radius,
        after_m=uniform(rng, 0.12, 0.26),
        box_m=uniform(rng, 0.19, 0.24),
        ball_colour=ball,
        box_colour=box,
        ramp_colour=ramp,
        deck_colour=deck,
        azimuth_deg=90 - direction * uniform(rng, -18, 12),
        elevation_deg=uniform(rng, -36, -25),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Ramp, deck in two parts with the gap between them, box. Lengths are mirrored by `direction`."""
    spec = new_spec(physics)
    r, side, end = p.radius_m, 1.7 * p.radius_m, p.deck_end_m + p.box_m

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    _add_ramp(spec, p, side)
    gap, deck = p.gap_span, (0.0, p.deck_m)
    block("deck_in", (-0.01, gap[0]), (-side, side), deck, p.deck_colour)
    block("deck_out", (gap[1], p.deck_end_m), (-side, side), deck, p.deck_colour)
    top = BOARD_M if p.gap_open else p.deck_m
    board = block("board", gap, (-side, side), (top - BOARD_M, top), p.deck_colour)
    board.friction = [0.8, 0.005, 0.002]
    for name, y in (("front", -side), ("back", side)):
        block(f"pit_{name}", gap, (y - 0.005, y + 0.005), (0, 0.022), p.deck_colour)
    floor = block("box_floor", (p.deck_end_m, end), (-side, side), (0, WALL_M), p.box_colour)
    floor.friction = [0.8, 0.005, 0.004]
    block("box_front", (p.deck_end_m, end), (-side - WALL_M, -side), (0, 0.035), p.box_colour)
    block("box_back", (p.deck_end_m, end), (side, side + WALL_M), (0, 0.09), p.box_colour)
    block("box_end", (end, end + WALL_M), (-side - WALL_M, side + WALL_M), (0, p.deck_m + 0.03), p.box_colour)

    high = p.deck_m + 2 * r + 0.01
    ends = sorted((p.direction * p.mouth_m, p.direction * (end + WALL_M)))
    shadow = 0.35 * high if p.direction > 0 else 0.0  # shadows fall to the right and to the back
    low_y, high_y = -side - WALL_M, side + WALL_M
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        hidden=("board",),
        cover=Box((ends[0], low_y - 0.01, 0.0), (ends[1] + shadow, high_y + 0.5 * high, high)),
        stage=(Box((ends[0], low_y, 0.0), (ends[1], high_y, p.deck_m)), _ramp_box(p, side)),
        inventory=Inventory(
            (p.ball_colour, p.box_colour, p.ramp_colour, p.deck_colour),
            ("ball", "ramp", "deck", "box", "end"),
            (f"{p.ball_colour} ball", f"{p.box_colour} box", "ramp", "deck"),
        ),
    )


def _add_ramp(spec: mujoco.MjSpec, p: Params, side: float) -> None:
    """The ramp with its rails and support, and the ball (body `ball`) at rest on it."""
    slope = float(np.radians(p.slope_deg))
    sin, cos, d = float(np.sin(slope)), float(np.cos(slope)), p.direction

    def on_ramp(up: float, above: float) -> tuple[float, float, float]:
        """The point `up` along the ramp from its foot and `above` over its surface."""
        return (d * (above * sin - up * cos), 0.0, p.deck_m + up * sin + above * cos)

    x, _, z = on_ramp(p.ramp_m / 2, -BOARD_M / 2)
    half = (p.ramp_m / 2, side, BOARD_M / 2)
    add_box(spec.worldbody, "ramp", (x, 0, z), half, p.ramp_colour, euler_y=d * slope)
    x, _, z = on_ramp(p.ramp_m / 2, 0)
    for name, y in (("front", -side), ("back", side)):
        half = (p.ramp_m / 2, 0.005, 0.4 * p.radius_m)
        add_box(spec.worldbody, f"rail_{name}", (x, y, z), half, p.ramp_colour, euler_y=d * slope)
    x, _, z = on_ramp(p.ramp_m - 0.05, -BOARD_M)
    add_box(spec.worldbody, "support", (x, 0, z / 2), (0.02, 0.8 * side, z / 2), p.deck_colour)
    ball = add_ball(spec, "ball", on_ramp(p.ramp_m - p.start_m, p.radius_m), p.radius_m, p.ball_colour)
    ball.friction = [0.8, 0.005, 2e-5]


def _ramp_box(p: Params, side: float) -> Box:
    slope = np.radians(p.slope_deg)
    ends = sorted((0.0, -p.direction * float(p.ramp_m * np.cos(slope))))
    return Box((ends[0], -side, 0.0), (ends[1], side, p.deck_m + float(p.ramp_m * np.sin(slope))))


def _past_deck_m(motion: Motion, p: Params) -> np.ndarray:
    """How far the ball is past the end of the deck (m), shape (F,)."""
    return p.direction * motion.pos("ball")[:, 0] - p.deck_end_m


def _sunk_m(motion: Motion, p: Params) -> np.ndarray:
    """How deep the ball is below its height on the deck (m), shape (F,)."""
    return p.deck_m + p.radius_m - motion.pos("ball")[:, 2]


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'yes' from when the ball is past the end of the deck, 'no' from when it is half its radius down in the gap."""
    past, sunk = _past_deck_m(motion, p), _sunk_m(motion, p)
    return ["yes" if x > 0 else "no" if z > 0.5 * p.radius_m else None for x, z in zip(past, sunk, strict=True)]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the ball ends past the deck, or below it."""
    past = float(_past_deck_m(motion, p)[-1])
    return past if past > 0 else float(_sunk_m(motion, p)[-1])


def twins(p: Params) -> list[Params]:
    """The same deck with the gap bridged, or opened."""
    return [replace(p, gap_open=not p.gap_open)]


QUESTIONS = (
    "Does the {ball} ball reach the {box} box at the end of the deck, yes or no?",
    "Does the {ball} ball that rolls down the ramp get into the {box} box: yes or no?",
    "Is the {ball} ball in the {box} box at the end of the deck in the end, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Ball and box are named by their colours, which nothing else has."""
    question = str(rng.choice(QUESTIONS)).format(ball=p.ball_colour, box=p.box_colour)
    return Wording(
        question=question,
        labels=("yes", "no"),
        aliases={
            "yes it does": "yes",
            "it reaches the box": "yes",
            "it lands in the box": "yes",
            "no it does not": "no",
            "it does not reach the box": "no",
            "it falls into the gap": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(3)
    if kind == 0:
        side = "left" if p.direction > 0 else "right"
        return AnswerableQuestion("At which side is the ramp, left or right?", ("left", "right"), side)
    if kind == 1:
        others = [c for c in NAMED_COLOURS if c not in (p.ball_colour, p.box_colour)]
        choices = tuple(str(c) for c in rng.permutation([p.ball_colour, *rng.permutation(others)[:2]]))
        return AnswerableQuestion(f"What colour is the ball: {listed(choices)}?", choices, p.ball_colour)
    names = {"wood": "brown", "grey": "grey", "black": "black"}
    choices = tuple(str(c) for c in rng.permutation(list(names.values())))
    return AnswerableQuestion(f"What colour is the ramp: {listed(choices)}?", choices, names[p.ramp_colour])


def observe(frames: np.ndarray, question: str) -> str | None:
    """Where the ball rests: within the box from left to right, or not."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = [_ball(frame, values["ball"]) for frame in frames]
    box, ball = largest(frames[-1], values["box"], 60), path[-1]
    if box is None or ball is None or not at_rest(path):
        return None
    left, width = box.box[0], box.box[2]
    return "yes" if left - 2 <= ball.x <= left + width + 2 else "no"


def _ball(frame: np.ndarray, colour: str) -> Blob | None:
    """The largest region of a colour that may be a ball: compact, and small beside the frame."""
    for blob in blobs(colour_mask(frame, colour), 60):
        if blob.area < 4000 and 0.4 < blob.box[2] / blob.box[3] < 2.5 and blob.fill > 0.5:
            return blob
    return None


FAMILY = Family(
    name="ramp_gap",
    taxonomy="occlusion",
    category="ramps_rolling",
    sub_scenario="ramp_gap",
    answer_type="binary",
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
