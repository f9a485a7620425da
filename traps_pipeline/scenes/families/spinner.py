"""A ball strikes the pointer of a spinner; the question is which coloured sector the pointer stops in.

Control: spinner and ball are in view from above. Void: the panel stands before the whole spinner; only the ball's
run-up is seen.
Hidden element: the peg that stops the pointer, which may stand in any of the sectors.
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
    rgba,
    uniform,
)
from traps_pipeline.scenes.vision import Blob, at_rest, blobs, colour_mask
from traps_pipeline.scenes.wording import asked, choices_in

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
COLOURS = ("red", "green", "blue", "yellow", "cyan", "purple")
POINTER_COLOUR = "black"
TABLE_M = 0.03  # thickness of the table
FIRST_DEG, LAST_DEG = 48.0, 312.0  # where the sectors begin and end, from the near side onwards
LANE = 0.76  # distance of the ball's path from the hub, in disc radii
POINTER = 0.80  # length of the pointer, likewise
PEG_AT_M, PEG_M, POINTER_HALF_M = 0.085, 0.008, 0.012
STILL_RAD = 0.02


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right and turns the pointer anticlockwise. sectors: in the order it passes them."""

    direction: int
    sectors: tuple[str, ...]
    stop_sector: int  # where the peg stands: the hidden element
    stop_at: float  # place of the stopped pointer within its sector: 0.5 is the middle
    disc_m: float
    radius_m: float
    speed_m_s: float
    run_m: float  # visible lane before the panel
    ball_colour: str
    table_colour: str
    rim_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def sector_deg(self) -> float:
        """Angle of a sector."""
        return (LAST_DEG - FIRST_DEG) / len(self.sectors)


def draw(rng: np.random.Generator) -> Params:
    """Three or four sectors; where the pointer stops is independent of everything that can be seen."""
    direction = int(rng.choice([-1, 1]))
    count = int(rng.integers(3, 5))
    sectors = distinct_colours(rng, count, COLOURS)
    free = [c for c in ("red", "green", "blue", "orange", "purple", "cyan") if c not in sectors]
    table, rim = rng.permutation(["wood", "grey", "white"])[:2]
    return Params(
        direction=direction,
        sectors=sectors,
        stop_sector=int(rng.integers(count)),
        stop_at=uniform(rng, 0.40, 0.58),
        disc_m=uniform(rng, 0.30, 0.34),
        radius_m=uniform(rng, 0.042, 0.050),
        speed_m_s=uniform(rng, 0.95, 1.2),
        run_m=uniform(rng, 0.30, 0.40),
        ball_colour=str(rng.choice(free)),
        table_colour=str(table),
        rim_colour=str(rim),
        azimuth_deg=90 - direction * uniform(rng, -12, 18),
        elevation_deg=uniform(rng, -48, -38),
    )


def build(p: Params, physics: Physics) -> Scene:
    """The hub is at the origin; lengths along x are mirrored by `direction`."""
    spec = new_spec(physics)
    r, disc = p.radius_m, p.disc_m
    lane, side = -LANE * disc, disc + 0.025
    start = -side - p.run_m
    end = side + 0.12

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    for name, along, across, rolling in (
        ("lane", (start - 0.07, -side), (lane - 1.5 * r, lane + 1.5 * r), 1e-4),
        ("table", (-side, side), (-side, side), 1e-4),
        ("tray", (side, end), (-side, side), 4e-3),
    ):
        floor = block(name, along, across, (0, TABLE_M), p.table_colour)
        floor.friction, floor.condim, floor.priority = [0.8, 0.005, rolling], 6, 1
    rim = TABLE_M + 0.035
    block("rim_front", (-side, end), (-side - 0.015, -side), (0, rim), p.rim_colour)
    block("rim_back", (-side, end), (side, side + 0.015), (0, rim), p.rim_colour)
    block("rim_end", (end, end + 0.015), (-side - 0.015, side + 0.015), (0, TABLE_M + 0.06), p.rim_colour)
    for i, colour in enumerate(p.sectors):
        _add_sector(spec, p, i, colour)
    _add_pointer(spec, p)
    _add_peg(spec, p)
    ball = add_ball(spec, "ball", (p.direction * start, lane, TABLE_M + r), r, p.ball_colour, density=2500)
    ball.friction = [0.1, 0.005, 1e-4]

    ends = sorted((-p.direction * side, p.direction * (end + 0.015)))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("pointer",),
        hidden=("peg",),
        cover=Box((ends[0], -side - 0.02, 0.0), (ends[1] + 0.03, side + 0.03, 0.10)),
        stage=(Box((ends[0], -side - 0.015, 0.0), (ends[1], side + 0.015, 0.09)),),
        velocity={"ball": (p.direction * p.speed_m_s, 0, 0, 0, p.direction * p.speed_m_s / r, 0)},
        inventory=Inventory(
            (*p.sectors, p.ball_colour, POINTER_COLOUR, p.table_colour, p.rim_colour),
            ("ball", "pointer", "spinner", "sector", "table", "rim", "peg"),
            (f"{p.ball_colour} ball", "black pointer", "spinner", *(f"{c} sector" for c in p.sectors)),
        ),
    )


def _direction(p: Params, angle_deg: float) -> np.ndarray:
    """Unit vector (x, y) at an angle from the near side, turning the way the ball drives the pointer."""
    a = np.radians(angle_deg)
    return np.array([p.direction * np.sin(a), -np.cos(a)])


def _add_sector(spec: mujoco.MjSpec, p: Params, i: int, colour: str) -> None:
    """A thin coloured sector on the table, which nothing touches."""
    import mujoco

    angles = np.linspace(FIRST_DEG + i * p.sector_deg, FIRST_DEG + (i + 1) * p.sector_deg, 13)
    rim = [p.disc_m * _direction(p, a) for a in angles]
    corners = [0.03 * _direction(p, angles[0]), 0.03 * _direction(p, angles[-1]), *rim]
    vertices = [(x, y, z) for z in (TABLE_M - 0.008, TABLE_M + 0.002) for x, y in corners]
    spec.add_mesh(name=f"sector_{i}", uservert=np.array(vertices).ravel())
    geom = spec.worldbody.add_geom(name=f"sector_{i}", type=mujoco.mjtGeom.mjGEOM_MESH, rgba=rgba(colour))
    geom.meshname = f"sector_{i}"
    geom.contype = geom.conaffinity = 0


def _add_pointer(spec: mujoco.MjSpec, p: Params) -> None:
    """A bar that turns about the hub; at the start it points to the near side, across the ball's path."""
    import mujoco

    length = POINTER * p.disc_m
    body = spec.worldbody.add_body(name="pointer", pos=[0, 0, TABLE_M + 0.03])
    joint = body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, p.direction])
    joint.damping, joint.frictionloss, joint.armature = [2e-4, 0, 0], 0.003, 0.002
    bar = add_box(body, "pointer", (0, -length / 2, 0), (POINTER_HALF_M, length / 2, 0.016), POINTER_COLOUR)
    bar.density, bar.friction = 300, [0.1, 0.005, 0.0001]
    hub = body.add_geom(name="hub", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.026, 0.022, 0])
    hub.rgba, hub.density = rgba(POINTER_COLOUR), 300


def _add_peg(spec: mujoco.MjSpec, p: Params) -> None:
    """The peg stands just past the angle at which it is to stop the pointer."""
    import mujoco

    wide = np.degrees(np.arcsin((PEG_M + POINTER_HALF_M) / PEG_AT_M))
    angle = FIRST_DEG + (p.stop_sector + p.stop_at) * p.sector_deg + wide
    x, y = PEG_AT_M * _direction(p, float(angle))
    peg = spec.worldbody.add_geom(
        name="peg", type=mujoco.mjtGeom.mjGEOM_CYLINDER, pos=[x, y, TABLE_M + 0.03], size=[PEG_M, 0.03, 0]
    )
    peg.rgba, peg.solref, peg.priority = rgba("white"), [0.02, 4], 1  # overdamped: the pointer does not bounce back


def _angle_deg(motion: Motion, p: Params) -> np.ndarray:
    """Where the pointer points, in degrees from the near side (0 to 360), shape (F,)."""
    tip = -motion.rot("pointer")[:, :2, 1]
    return np.degrees(np.arctan2(p.direction * tip[:, 0], -tip[:, 1])) % 360


def readings(motion: Motion, p: Params) -> list[str | None]:
    """The sector that the pointer is in, from when it turns no more."""
    angles = _angle_deg(motion, p)
    moved = np.abs(np.radians(angles - angles[-1] + 180) % (2 * np.pi) - np.pi) > STILL_RAD
    restless = np.flatnonzero(moved)
    still_from = int(restless[-1]) + 1 if restless.size else 0
    index = np.floor((angles - FIRST_DEG) / p.sector_deg).astype(int)
    return [p.sectors[k] if i >= still_from and 0 <= k < len(p.sectors) else None for i, k in enumerate(index)]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the tip of the pointer ends from the nearest edge of its sector."""
    within = (_angle_deg(motion, p)[-1] - FIRST_DEG) % p.sector_deg
    return float(np.radians(min(within, p.sector_deg - within)) * POINTER * p.disc_m)


def twins(p: Params) -> list[Params]:
    """The same spinner with the peg in another sector."""
    return [replace(p, stop_sector=k) for k in range(len(p.sectors)) if k != p.stop_sector]


QUESTIONS = (
    "In which sector does the black pointer of the spinner stop, {choices}?",
    "What colour is the sector that the black pointer points to at the end: {choices}?",
    "On which colour does the spinner come to rest: {choices}?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The choices are the colours of the sectors, in random order."""
    choices = tuple(str(c) for c in rng.permutation(p.sectors))
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(choices=listed(choices)),
        labels=choices,
        aliases={form.format(c): c for c in choices for form in ("{} sector", "the {} sector", "on {}")},
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    if rng.integers(2):
        side = "left" if p.direction > 0 else "right"
        question = "From which side does the ball roll towards the spinner, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    others = [c for c in ("red", "green", "purple", "orange", "cyan") if c != p.ball_colour]
    choices = tuple(str(c) for c in rng.permutation([p.ball_colour, *rng.permutation(others)[:2]]))
    question = f"What colour is the ball that rolls towards the spinner: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.ball_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """The colour that surrounds the black pointer once it is at rest."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    pointers = [_pointer(frame) for frame in frames[-3:]]
    if not at_rest([found for found, _ in pointers]):
        return None
    ring = cv2.dilate(pointers[-1][1], np.ones((15, 15), np.uint8)).astype(bool)
    counts = {c: int((ring & colour_mask(frames[-1], c)).sum()) for c in choices_in(values["choices"])}
    best = max(counts, key=lambda c: counts[c])
    return best if counts[best] > 0.45 * sum(counts.values()) else None


def _pointer(frame: np.ndarray) -> tuple[Blob | None, np.ndarray]:
    """The largest black thing, with the gap that the peg may cut into it closed, and its mask."""
    black = colour_mask(frame, POINTER_COLOUR).astype(np.uint8)
    black = cv2.morphologyEx(black, cv2.MORPH_CLOSE, np.ones((11, 11), np.uint8))
    found = next(iter(blobs(black, 150)), None)
    mask = np.zeros_like(black)
    if found is not None:
        x, y, width, height = found.box
        mask[y : y + height, x : x + width] = black[y : y + height, x : x + width]
    return found, mask


FAMILY = Family(
    name="spinner",
    taxonomy="occlusion",
    category="other",
    sub_scenario="spinner",
    answer_type="colour",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    observe=observe,
    physics=Physics(timestep_s=0.001),
    min_margin_m=0.03,
    twins=twins,
)
