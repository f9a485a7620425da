"""A ball rolls off a shelf into a cup on one arm of a beam; the question is how the beam comes to rest.

Control: the whole beam is in view. Void: the panel stands before it, and only the shelf with the ball is seen.
Hidden element: the place of a counterweight on the other arm. Close to the pivot the ball outweighs it, far out it
outweighs the ball, and at one place between the beam hangs level.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
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
from traps_pipeline.scenes.vision import colour_mask, largest
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
PLACES = ("near", "even", "far")  # of the counterweight
BEAM_HALF_M = 0.012  # half thickness of the beam
CUP_M = 0.035  # height of the cup's walls
CUP_SLACK_M = 0.004
DROP_SLACK_M = 0.006
BALL_DENSITY = 1000.0
STIFFNESS = 1.6  # of the spring that pulls the beam level, in torques of the ball per radian
LEVEL_M = 0.06  # the ends of a balanced beam differ less in height
TIPPED_DEG = 5.0  # in the picture
COLOURS = ("red", "green", "blue", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 if the ball rolls to the right and drops on the left arm. Lengths are measured from the pivot."""

    direction: int
    place: str  # the hidden element: one of PLACES
    even_m: float  # where the counterweight keeps the ball in balance
    near_share: float  # of `even_m`, for the other two places
    far_share: float
    radius_m: float
    speed_m_s: float
    run_m: float
    arm_m: float  # from the pivot to the cup
    pivot_z_m: float
    tilt_deg: float  # at which the beam meets its stops
    counterweight_half_m: float
    ball_colour: str
    beam_colour: str
    counterweight_colour: str
    shelf_colour: str
    board_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def half_beam_m(self) -> float:
        """Half the length of the beam."""
        return self.arm_m + self.radius_m + 0.03

    @property
    def counterweight_at_m(self) -> float:
        """Where the counterweight sits on its arm."""
        return self.even_m * {"near": self.near_share, "even": 1.0, "far": self.far_share}[self.place]

    @property
    def drop_at_m(self) -> float:
        """Where the ball falls, before the pivot: over the cup of the raised arm."""
        tilt = np.radians(self.tilt_deg)
        return float(self.arm_m * np.cos(tilt) - (BEAM_HALF_M + self.radius_m) * np.sin(tilt))

    @property
    def shelf_z_m(self) -> float:
        """Height of the shelf's top: it clears the raised cup."""
        tilt = np.radians(self.tilt_deg)
        raised = self.half_beam_m * np.sin(tilt) + (BEAM_HALF_M + CUP_M) * np.cos(tilt)
        return float(self.pivot_z_m + raised + 0.03)


def draw(rng: np.random.Generator) -> Params:
    """The counterweight's place is drawn by itself; the side that the ball comes from as well."""
    direction = int(rng.choice([-1, 1]))
    ball, beam, counterweight = distinct_colours(rng, 3, COLOURS)
    shelf, board = rng.permutation(["wood", "grey"])
    return Params(
        direction=direction,
        place=str(rng.choice(PLACES)),
        even_m=uniform(rng, 0.21, 0.24),
        near_share=uniform(rng, 0.40, 0.50),
        far_share=uniform(rng, 1.42, 1.52),
        radius_m=uniform(rng, 0.045, 0.052),
        speed_m_s=uniform(rng, 0.36, 0.48),
        run_m=uniform(rng, 0.42, 0.52),
        arm_m=uniform(rng, 0.34, 0.38),
        pivot_z_m=uniform(rng, 0.19, 0.22),
        tilt_deg=uniform(rng, 12, 15),
        counterweight_half_m=uniform(rng, 0.036, 0.042),
        ball_colour=ball,
        beam_colour=beam,
        counterweight_colour=counterweight,
        shelf_colour=str(shelf),
        board_colour=str(board),
        azimuth_deg=90 - direction * uniform(rng, -12, 14),
        elevation_deg=uniform(rng, -28, -18),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Shelf and beam before a board that carries the beam and catches the shadows; `direction` mirrors it."""
    spec = new_spec(physics)
    r, side = p.radius_m, 1.7 * p.radius_m
    edge, stop = -p.drop_at_m - r - DROP_SLACK_M, -p.drop_at_m + r + DROP_SLACK_M
    panel_at = -p.half_beam_m - 0.03
    end, start, z = p.half_beam_m + 0.03, panel_at - p.run_m, p.shelf_z_m
    high = z + 2 * r + 0.02

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    block("table", (start, panel_at), (-side, side), (0, z), p.shelf_colour)
    block("shelf", (panel_at, edge), (-side, side), (z - 0.012, z), p.shelf_colour)
    block("shelf_front", (start, edge), (-side, -side + 0.012), (z, z + 0.3 * r), p.board_colour)
    block("shelf_back", (start, edge), (side - 0.012, side), (z, z + 0.3 * r), p.board_colour)
    backstop = block("backstop", (stop, stop + 0.012), (-0.6 * side, side), (z - 0.01, z + 1.5 * r), p.shelf_colour)
    backstop.priority, backstop.solref = 1, [-4000.0, -160.0]
    block("board", (panel_at, end), (side, side + 0.015), (0, high), p.board_colour)
    block("base", (-p.half_beam_m, p.half_beam_m), (-side - 0.02, side), (0, 0.025), "black")
    axle = block("axle", (-0.016, 0.016), (-0.05, side), (p.pivot_z_m - 0.016, p.pivot_z_m + 0.016), "white")
    axle.contype = axle.conaffinity = 0
    _add_beam(spec, p)
    ball = add_ball(spec, "ball", (p.direction * (start + 1.2 * r), 0, z + r), r, p.ball_colour, density=BALL_DENSITY)
    ball.friction = [0.8, 0.005, 2e-5]

    ends = sorted((p.direction * panel_at, p.direction * end))
    back = sorted((p.direction * start, p.direction * end))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("beam",),
        hidden=("counterweight",),
        cover=Box((ends[0], -side - 0.02, 0.0), (ends[1] + 0.02, side + 0.03, high + 0.02)),
        stage=(Box((back[0], -side, 0.0), (back[1], side, high)),),
        velocity={"ball": _rolling(p)},
        inventory=Inventory(
            (p.ball_colour, p.beam_colour, p.counterweight_colour, p.shelf_colour, p.board_colour, "black", "white"),
            ("ball", "beam", "counterweight", "shelf", "cup", "board", "base"),
            (f"{p.ball_colour} ball", f"{p.beam_colour} beam", "shelf", "counterweight", "cup"),
        ),
    )


def _add_beam(spec: mujoco.MjSpec, p: Params) -> None:
    """The beam with cup and counterweight, hinged about y; it starts at the stop to which the counterweight pulls."""
    import mujoco

    half = p.direction * float(np.radians(p.tilt_deg)) / 2
    body = spec.worldbody.add_body(name="beam", pos=[0, 0, p.pivot_z_m])
    body.quat = [float(np.cos(half)), 0.0, float(np.sin(half)), 0.0]
    low, high = sorted((-2 * p.direction * p.tilt_deg, 0.0))  # degrees, as MuJoCo compiles them
    joint = body.add_joint(
        type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0], range=[low, high], limited=True, damping=[0.5, 0, 0]
    )
    torque = _ball_kg(p) * 9.81 * p.arm_m
    joint.stiffness, joint.springref = [STIFFNESS * torque, 0, 0], -p.direction * p.tilt_deg
    add_box(body, "beam", (0, 0, 0), (p.half_beam_m, 0.03, BEAM_HALF_M), p.beam_colour, density=300)

    inner, thin = p.radius_m + CUP_SLACK_M, 0.005
    up = BEAM_HALF_M + CUP_M / 2
    for i, (dx, dy) in enumerate(((-1, 0), (1, 0), (0, -1), (0, 1))):
        centre = (-p.direction * p.arm_m + dx * (inner + thin), dy * (inner + thin), up)
        size = (thin if dx else inner + 2 * thin, thin if dy else inner + 2 * thin, CUP_M / 2)
        wall = add_box(body, f"cup_{i}", centre, size, "white", density=1)
        wall.priority, wall.condim, wall.friction, wall.solref = 1, 6, [0.8, 0.01, 2e-3], [-4000.0, -160.0]
    size = p.counterweight_half_m
    centre = (p.direction * p.counterweight_at_m, 0, BEAM_HALF_M + size)
    add_box(body, "counterweight", centre, (size, size, size), p.counterweight_colour, density=_density(p))


def _ball_kg(p: Params) -> float:
    return float(BALL_DENSITY * 4 / 3 * np.pi * p.radius_m**3)


def _density(p: Params) -> float:
    """Of the counterweight, such that it keeps the ball in balance at `even_m`."""
    return _ball_kg(p) * p.arm_m / (p.even_m * 8 * p.counterweight_half_m**3)


def _rolling(p: Params) -> tuple[float, ...]:
    """Velocity of a ball that rolls without slipping."""
    speed = p.direction * p.speed_m_s
    return (speed, 0.0, 0.0, 0.0, speed / p.radius_m, 0.0)


def _right_end_m(motion: Motion, p: Params) -> np.ndarray:
    """How much higher the right end of the beam is than its left end (m), shape (F,)."""
    return 2 * p.half_beam_m * motion.rot("beam")[:, 2, 0]


def _label(rise: float) -> str:
    return "balanced" if abs(rise) < LEVEL_M else "left" if rise > 0 else "right"


def readings(motion: Motion, p: Params) -> list[str | None]:
    """The lower end, or 'balanced', from when the ball lies in the cup. A ball that misses the cup has no reading."""
    held = motion.pos("ball") - motion.pos("beam")
    local = np.einsum("fji,fj->fi", motion.rot("beam"), held)
    cup = np.array([-p.direction * p.arm_m, 0.0, BEAM_HALF_M + p.radius_m])
    outside = np.flatnonzero(np.linalg.norm(local - cup, axis=1) > 0.02)
    landed = int(outside[-1]) + 1 if outside.size else 0
    return [_label(float(rise)) if i >= landed else None for i, rise in enumerate(_right_end_m(motion, p))]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the height difference of the beam's ends is from the one that parts tipped from balanced."""
    return float(abs(abs(_right_end_m(motion, p)[-1]) - LEVEL_M))


def twins(p: Params) -> list[Params]:
    """The same run with the counterweight in another place."""
    return [replace(p, place=place) for place in PLACES if place != p.place]


QUESTIONS = (
    "Which end of the {beam} beam is lower in the end, left or right, or is the beam balanced?",
    "How does the {beam} beam come to rest: tipped to the left, tipped to the right or balanced?",
    "To which side does the {beam} beam tip for good: left, right, or does it end up balanced?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The beam is named by its colour."""
    aliases = {form.format(side): side for side in ("left", "right") for form in _SIDE_FORMS}
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(beam=p.beam_colour),
        labels=("left", "right", "balanced"),
        aliases={**aliases, "level": "balanced", "it is balanced": "balanced", "in balance": "balanced"},
        answerable_question=_answerable(p, rng),
    )


_SIDE_FORMS = ("the {} end", "{} end", "to the {}", "tipped to the {}", "the {} side", "the {} end is lower")


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    if rng.integers(2):
        side = "left" if p.direction > 0 else "right"
        question = "From which side does the ball roll along the shelf, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    choices = tuple(str(c) for c in rng.permutation([p.ball_colour, p.beam_colour, p.counterweight_colour]))
    question = f"What colour is the ball that rolls along the shelf: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.ball_colour)


def _slope_deg(frame: np.ndarray, colour: str, min_area: int) -> float | None:
    """Slope of the largest region of a colour, positive if it falls to the right; None unless it is a long strip."""
    mask = colour_mask(frame, colour)
    blob = largest(frame, colour, min_area)
    if blob is None or blob.box[2] < 80:
        return None
    x, y, width, height = blob.box
    _, labels = cv2.connectedComponents(mask[y : y + height, x : x + width].astype(np.uint8), connectivity=8)
    strip = labels == np.bincount(labels[labels > 0]).argmax()
    columns = np.flatnonzero(strip.any(axis=0))
    rows = np.array([np.flatnonzero(strip[:, c]).mean() for c in columns])
    return float(np.degrees(np.arctan(np.polyfit(columns, rows, 1)[0])))


def observe(frames: np.ndarray, question: str) -> str | None:
    """The slope of the beam against that of the black base below it, in the last frames; None while the beam is not
    to be seen."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    tilts = []
    for frame in frames[-3:]:
        beam, base = _slope_deg(frame, values["beam"], 200), _slope_deg(frame, "black", 100)
        if beam is None or base is None:
            return None
        tilts.append(beam - base)
    if max(tilts) - min(tilts) > TIPPED_DEG:
        return None
    tilt = float(np.median(tilts))
    return "balanced" if abs(tilt) < TIPPED_DEG else "right" if tilt > 0 else "left"


FAMILY = Family(
    name="balance",
    taxonomy="occlusion",
    category="pendulums_levers",
    sub_scenario="balance",
    answer_type="direction",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    observe=observe,
    physics=Physics(timestep_s=0.001),
    min_margin_m=0.02,
    twins=twins,
)
