"""A block slides down an incline and across a slick deck; the question is whether it slides off the end.

Control: deck and tray are in view. Void: the panel stands before them, the incline is in view.
Hidden element: a rough board in the deck, which stands out of it and stops the block, or is sunk into it. A block that
leaves the deck falls into the tray behind it.
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
INCLINE_M = 0.02  # thickness of the incline
OVERLAP_M = 0.05  # the incline ends inside the deck, so that no edge catches the block
TILT_RAD = 0.015  # of the rough board: its near edge is below the deck in either position
SUNK_M = 0.012
STILL_M = 0.003  # a block that moves less than this any more is at rest
NAMED_COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 slides to the right. Lengths run along the deck from the foot of the incline."""

    direction: int
    rough: bool  # whether the board stands out of the deck: the hidden element
    block_half_m: tuple[float, float, float]  # along, across, up
    slope_deg: float
    incline_m: float  # length of the incline's surface
    start_m: float  # from the incline's top to the middle of the block
    deck_friction: float
    rough_friction: float
    deck_m: float  # height of the deck
    mouth_m: float  # deck that is seen before the panel
    lead_m: float  # deck behind the panel before the board
    board_m: float
    after_m: float  # deck behind the board
    tray_m: float
    block_colour: str
    tray_colour: str
    incline_colour: str
    deck_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def board_span(self) -> Span:
        """Where the rough board is."""
        return (self.mouth_m + self.lead_m, self.mouth_m + self.lead_m + self.board_m)

    @property
    def deck_end_m(self) -> float:
        """Where the deck ends."""
        return self.board_span[1] + self.after_m


def draw(rng: np.random.Generator) -> Params:
    """Half of the boards stand out; nothing that can be seen tells."""
    direction = int(rng.choice([-1, 1]))
    block, tray = distinct_colours(rng, 2, NAMED_COLOURS)
    deck = str(rng.choice(["wood", "grey"]))
    incline = str(rng.choice([c for c in ("wood", "grey", "black") if c != deck]))
    half = (uniform(rng, 0.048, 0.060), uniform(rng, 0.045, 0.055), uniform(rng, 0.026, 0.034))
    return Params(
        direction=direction,
        rough=bool(rng.integers(2)),
        block_half_m=half,
        slope_deg=uniform(rng, 19, 25),
        incline_m=uniform(rng, 0.40, 0.48),
        start_m=uniform(rng, 0.08, 0.14),
        deck_friction=uniform(rng, 0.03, 0.06),
        rough_friction=uniform(rng, 0.75, 0.95),
        deck_m=uniform(rng, 0.12, 0.16),
        mouth_m=uniform(rng, 0.03, 0.08),
        lead_m=2 * half[0] + uniform(rng, 0.05, 0.09),
        board_m=uniform(rng, 0.24, 0.30),
        after_m=uniform(rng, 0.10, 0.15),
        tray_m=uniform(rng, 0.28, 0.34),
        block_colour=block,
        tray_colour=tray,
        incline_colour=incline,
        deck_colour=deck,
        azimuth_deg=90 - direction * uniform(rng, -18, 10),
        elevation_deg=uniform(rng, -36, -25),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Incline, deck with the board in it, tray. Lengths are mirrored by `direction`."""
    spec = new_spec(physics)
    side, wall, end = p.block_half_m[1] + 0.04, 0.012, p.deck_end_m + p.tray_m

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    deck = block("deck", (-OVERLAP_M, p.deck_end_m), (-side, side), (0, p.deck_m), p.deck_colour)
    incline = _add_incline(spec, p, side)
    for geom in (deck, incline):
        geom.friction, geom.priority = [p.deck_friction, 0.001, 0.0001], 1
    board = _add_board(spec, p, side)
    board.friction, board.priority = [p.rough_friction, 0.005, 0.0001], 2

    tray = (p.deck_end_m, end)
    block("tray_floor", tray, (-side, side), (0, wall), p.tray_colour)
    block("tray_front", tray, (-side - wall, -side), (0, 0.03), p.tray_colour)
    block("tray_back", tray, (side, side + wall), (0, 0.07), p.tray_colour)
    block("tray_end", (end, end + wall), (-side - wall, side + wall), (0, p.deck_m + 0.02), p.tray_colour)

    high = p.deck_m + 2 * max(p.block_half_m) + 0.01
    ends = sorted((p.direction * p.mouth_m, p.direction * (end + wall)))
    shadow = 0.35 * high if p.direction > 0 else 0.0  # shadows fall to the right and to the back
    foot, rise = float(p.incline_m * np.cos(_slope(p))), float(p.incline_m * np.sin(_slope(p)))
    ramp = sorted((0.0, -p.direction * foot))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("block",),
        hidden=("board",),
        cover=Box((ends[0], -side - wall - 0.01, 0.0), (ends[1] + shadow, side + wall + 0.5 * high, high)),
        stage=(
            Box((ends[0], -side - wall, 0.0), (ends[1], side + wall, p.deck_m)),
            Box((ramp[0], -side, 0.0), (ramp[1], side, p.deck_m + rise)),
        ),
        inventory=Inventory(
            (p.block_colour, p.tray_colour, p.incline_colour, p.deck_colour),
            ("block", "incline", "deck", "tray", "end"),
            (f"{p.block_colour} block", f"{p.tray_colour} tray", "incline", "deck"),
        ),
    )


def _slope(p: Params) -> float:
    return float(np.radians(p.slope_deg))


def _add_incline(spec: mujoco.MjSpec, p: Params, side: float) -> mujoco.MjsGeom:
    """The incline with its support, and the block (body `block`) on it."""
    slope, d = _slope(p), p.direction
    sin, cos = float(np.sin(slope)), float(np.cos(slope))

    def on_incline(up: float, above: float) -> tuple[float, float, float]:
        """The point `up` along the incline from its foot and `above` over its surface."""
        return (d * (above * sin - up * cos), 0.0, p.deck_m + up * sin + above * cos)

    half = ((p.incline_m + OVERLAP_M / 2) / 2, side, INCLINE_M / 2)
    middle = on_incline((p.incline_m - OVERLAP_M / 2) / 2, -INCLINE_M / 2)
    incline = add_box(spec.worldbody, "incline", middle, half, p.incline_colour, euler_y=d * slope)
    x, _, z = on_incline(p.incline_m - 0.05, -INCLINE_M)
    add_box(spec.worldbody, "support", (x, 0, z / 2), (0.02, 0.8 * side, z / 2), p.deck_colour)
    body = spec.worldbody.add_body(name="block", pos=on_incline(p.incline_m - p.start_m, p.block_half_m[2]))
    body.quat = [float(np.cos(slope / 2)), 0.0, d * float(np.sin(slope / 2)), 0.0]
    body.add_freejoint()
    geom = add_box(body, "block", (0, 0, 0), p.block_half_m, p.block_colour)  # type: ignore[arg-type]
    geom.density = 600
    return incline


def _add_board(spec: mujoco.MjSpec, p: Params, side: float) -> mujoco.MjsGeom:
    """The rough board, tilted up a little along the deck: it rises out of the deck, or stays below its surface."""
    start, end = p.board_span
    half, thick = (end - start) / 2, 0.03
    rise = half * TILT_RAD - 0.001  # of its middle over the deck when the near edge is just below the surface
    z = p.deck_m + rise - thick / 2 - (0.0 if p.rough else SUNK_M)
    x = p.direction * (start + half)
    size = (half, side - 0.002, thick / 2)
    return add_box(spec.worldbody, "board", (x, 0, z), size, "black", euler_y=-p.direction * TILT_RAD)


def _past_deck_m(motion: Motion, p: Params) -> np.ndarray:
    """How far the middle of the block is past the end of the deck (m), shape (F,)."""
    return p.direction * motion.pos("block")[:, 0] - p.deck_end_m


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'yes' from when the block has fallen past the deck; 'no' while it has not, from when it moves no more."""
    past, pos = _past_deck_m(motion, p), motion.pos("block")
    off = (past > 0) & (pos[:, 2] < p.deck_m)
    restless = np.flatnonzero(np.linalg.norm(pos - pos[-1], axis=1) > STILL_M)
    still_from = int(restless[-1]) + 1 if restless.size else 0
    return ["yes" if down else "no" if i >= still_from else None for i, down in enumerate(off)]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the middle of the block ends from the end of the deck."""
    return float(abs(_past_deck_m(motion, p)[-1]))


def twins(p: Params) -> list[Params]:
    """The same deck with the board sunk, or standing out."""
    return [replace(p, rough=not p.rough)]


QUESTIONS = (
    "Does the {block} block slide off the end of the deck into the {tray} tray, yes or no?",
    "Does the sliding {block} block end up in the {tray} tray: yes or no?",
    "Does the {block} block keep sliding until it drops into the {tray} tray, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Block and tray are named by their colours, which nothing else has."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(block=p.block_colour, tray=p.tray_colour),
        labels=("yes", "no"),
        aliases={
            "yes it does": "yes",
            "it slides off": "yes",
            "it drops into the tray": "yes",
            "no it does not": "no",
            "it stops on the deck": "no",
            "it stays on the deck": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(3)
    if kind == 0:
        side = "left" if p.direction > 0 else "right"
        question = "From which side does the block start to slide, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    if kind == 1:
        others = [c for c in NAMED_COLOURS if c not in (p.block_colour, p.tray_colour)]
        choices = tuple(str(c) for c in rng.permutation([p.block_colour, *rng.permutation(others)[:2]]))
        return AnswerableQuestion(f"What colour is the sliding block: {listed(choices)}?", choices, p.block_colour)
    names = {"wood": "brown", "grey": "grey", "black": "black"}
    choices = tuple(str(c) for c in rng.permutation(list(names.values())))
    question = f"What colour is the incline that the block slides down: {listed(choices)}?"
    return AnswerableQuestion(question, choices, names[p.incline_colour])


def observe(frames: np.ndarray, question: str) -> str | None:
    """Where the block rests: within the tray from left to right, or not."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = [_block(frame, values["block"]) for frame in frames]
    tray, last = largest(frames[-1], values["tray"], 60), path[-1]
    if tray is None or last is None or not at_rest(path):
        return None
    left, width = tray.box[0], tray.box[2]
    return "yes" if left - 2 <= last.x <= left + width + 2 else "no"


def _block(frame: np.ndarray, colour: str) -> Blob | None:
    """The largest region of a colour that may be the block: compact, and small beside the frame."""
    for blob in blobs(colour_mask(frame, colour), 60):
        if blob.area < 4500 and 0.3 < blob.box[2] / blob.box[3] < 3.5 and blob.fill > 0.4:
            return blob
    return None


FAMILY = Family(
    name="slide",
    taxonomy="occlusion",
    category="ramps_rolling",
    sub_scenario="slide",
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
