"""Dice tumble down steps into a tray; the question is which colour lies on top of the first die to get there.

Control: until the dice lie still. Void: the clip ends while they tumble. Edges hitting steps magnify differences that
no pixel shows; gravity is low, which nothing in view betrays, so that many tumbles come after a cut at one second.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
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
    listed,
    new_spec,
    uniform,
)

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
FACES = ("red", "green", "blue", "cyan", "orange", "yellow")
EDGES = ("white", "black", "purple", "grey")
NORMALS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))  # in the order of `faces`
WALL_M = 0.02
TRAY_M = 0.05  # height of the tray's floor
FLAT_RAD = math.radians(8)  # a die that leans more lies on no face
LEAD_S = 0.2  # a closer finish could fall between two sampled frames
STILL = 0.1  # share of its size by which a lying die may move from one frame to the next


@dataclass(frozen=True)
class Params:
    """Per die: start, turn and throw. faces: the colours on +x, -x, +y, -y, +z, -z of every die."""

    direction: int  # +1: the steps go down to the right
    steps: int
    step_m: float  # length of a step
    drop_m: float  # height of a step
    width_m: float  # of the steps, between the walls
    tray_m: float
    half_m: float  # half a die's edge
    faces: tuple[tuple[str, ...], ...]
    starts_m: tuple[tuple[float, ...], ...]  # along the steps, across, above the top step
    turns: tuple[tuple[float, ...], ...]  # unit quaternions
    speeds_m_s: tuple[tuple[float, ...], ...]
    spins_rad_s: tuple[tuple[float, ...], ...]
    bounce: float  # damping of the contact: the lower, the livelier
    edge_colours: tuple[str, ...]  # one per die, so that each can be followed
    step_colours: tuple[str, str]  # in turn, down the steps
    azimuth_deg: float
    elevation_deg: float

    @property
    def run_m(self) -> float:
        """Where the steps end and the tray begins."""
        return self.steps * self.step_m

    @property
    def tray_colour(self) -> str:
        """A colour that no step has."""
        return next(c for c in ("black", "white", "grey") if c not in self.step_colours)

    def floor_m(self, step: int) -> float:
        """Height of a step, the tray being one after the last."""
        return TRAY_M + (self.steps - step) * self.drop_m


def draw(rng: np.random.Generator) -> Params:
    """Two to four dice, thrown up in a zigzag so that they do not touch before they land."""
    dice, direction = int(rng.choice([2, 3, 3, 4])), int(rng.choice([-1, 1]))
    half, steps = uniform(rng, 0.060, 0.068), int(rng.integers(4, 8))
    step = round(uniform(rng, 1.35, 1.65) / steps, 4)
    width = round(max(0.46, (2.5 * dice + 1.4) * half), 4)  # room for a turning die beside each wall
    lanes = [(i - (dice - 1) / 2) * 2.5 * half for i in range(dice)]
    ahead = int(rng.integers(2))
    turns = rng.normal(size=(dice, 4))
    light, dark = ("white", "wood"), ("grey", "black")
    return Params(
        direction=direction,
        steps=steps,
        step_m=step,
        drop_m=round(uniform(rng, 0.55, 0.80) / steps, 4),
        width_m=width,
        tray_m=uniform(rng, 0.60, 0.75),
        half_m=half,
        faces=tuple(tuple(str(c) for c in rng.permutation(FACES)) for _ in range(dice)),
        starts_m=tuple(
            (uniform(rng, 0.13, 0.17) + 0.24 * ((i + ahead) % 2), round(y, 4), uniform(rng, 0.22, 0.34))
            for i, y in enumerate(lanes)
        ),
        turns=tuple(tuple(round(float(v), 5) for v in q / np.linalg.norm(q)) for q in turns),
        speeds_m_s=tuple(
            (uniform(rng, 0.55, 0.85), uniform(rng, -0.06, 0.06), uniform(rng, 1.2, 1.6)) for _ in range(dice)
        ),
        spins_rad_s=tuple(tuple(uniform(rng, -7, 7) for _ in range(3)) for _ in range(dice)),
        bounce=uniform(rng, 14, 26),
        edge_colours=tuple(str(c) for c in rng.permutation(EDGES)[:dice]),
        step_colours=(str(rng.choice(light)), str(rng.choice(dark))) if rng.random() < 0.5 else ("grey", "wood"),
        azimuth_deg=90 + uniform(rng, -22, 22),
        elevation_deg=uniform(rng, -58, -46),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Steps and tray between two walls. Lengths run down the steps and are mirrored by `direction`."""
    spec = new_spec(physics)
    side, end, high = p.width_m / 2, p.run_m + p.tray_m, p.floor_m(0)

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    for i in range(p.steps):
        along = (i * p.step_m, (i + 1) * p.step_m)
        block(f"step_{i}", along, (-side, side), (0, p.floor_m(i)), p.step_colours[i % 2])
    block("tray", (p.run_m, end), (-side, side), (0, TRAY_M), p.tray_colour)
    low_rim, rim = TRAY_M + 1.6 * p.half_m, TRAY_M + 4 * p.half_m
    block("tray_end", (end, end + WALL_M), (-side, side), (0, rim), "wood")
    block("tray_front", (p.run_m, end + WALL_M), (-side - WALL_M, -side), (0, low_rim), "wood")
    block("wall_back", (-WALL_M, end + WALL_M), (side, side + WALL_M), (0, high + 2 * p.half_m), "wood")
    for i in range(p.steps):  # a low front wall that follows the steps, so that it hides nothing
        along = (i * p.step_m, (i + 1) * p.step_m)
        block(f"front_{i}", along, (-side - WALL_M, -side), (0, p.floor_m(i) + 0.5 * p.half_m), "wood")
    fence = ((-WALL_M, -side - WALL_M), (end + WALL_M, side + WALL_M))
    for name, across in (("fence_front", (-side - WALL_M, -side)), ("fence_back", (side, side + WALL_M))):
        glass = block(name, (fence[0][0], fence[1][0]), across, (0, high + 1.0), "white")
        glass.rgba = [1, 1, 1, 0]  # never drawn: nothing leaves the steps
    for name, along in (("fence_top", (-WALL_M, 0)), ("fence_end", (end, end + WALL_M))):
        glass = block(name, along, (-side, side), (0, high + 1.0), "white")
        glass.rgba = [1, 1, 1, 0]
    for i in range(len(p.faces)):
        _add_die(spec, p, i)
    ends = sorted((p.direction * -WALL_M, p.direction * (end + WALL_M)))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=tuple(f"die_{i}" for i in range(len(p.faces))),
        stage=(Box((ends[0], -side - WALL_M, 0), (ends[1], side + WALL_M, TRAY_M)),),
        velocity={f"die_{i}": _throw(p, i) for i in range(len(p.faces))},
        inventory=_inventory(p),
    )


def _add_die(spec: mujoco.MjSpec, p: Params, i: int) -> None:
    """A cube in the edge colour with a thin plate, drawn only, on every face."""
    along, across, above = p.starts_m[i]
    body = spec.worldbody.add_body(
        name=f"die_{i}", pos=[p.direction * along, across, p.floor_m(0) + above], quat=list(p.turns[i])
    )
    body.add_freejoint()
    h = p.half_m
    cube = add_box(body, f"die_{i}", (0, 0, 0), (h, h, h), p.edge_colours[i], density=600.0, condim=4)
    cube.friction, cube.solref, cube.priority = [0.5, 0.003, 0.0001], [-6000.0, -p.bounce], 1
    for colour, normal in zip(p.faces[i], NORMALS, strict=True):
        half = [0.0015 if n else 0.84 * h for n in normal]
        add_box(body, f"die_{i}_{colour}", [h * n for n in normal], half, colour, contype=0, conaffinity=0, mass=0)


def _throw(p: Params, i: int) -> tuple[float, ...]:
    along, across, up = p.speeds_m_s[i]
    return (p.direction * along, across, up, *p.spins_rad_s[i])


def _short_of_tray(motion: Motion, p: Params) -> np.ndarray:
    """How far (m) each die is from being past the last step and low enough to touch the tray, (F, dice)."""
    places = np.stack([motion.pos(f"die_{i}") for i in range(len(p.faces))], axis=1)
    return np.maximum(p.run_m - p.direction * places[..., 0], places[..., 2] - TRAY_M - 2.1 * p.half_m)


def _first_die(motion: Motion, p: Params) -> tuple[int, int] | None:
    """The first die in the tray and the frame it is there; None if there is none or the next one comes too soon."""
    inside = _short_of_tray(motion, p) <= 0
    arrivals = np.where(inside.any(axis=0), motion.times[inside.argmax(axis=0)], math.inf)
    first, second = np.sort(arrivals)[:2]
    if math.isinf(first) or second - first < LEAD_S - 1e-9:
        return None
    die = int(arrivals.argmin())
    return die, int(inside[:, die].argmax())


def _lean(motion: Motion, die: int) -> tuple[np.ndarray, np.ndarray]:
    """Index of the uppermost face and its angle to the horizontal (rad), each (F,)."""
    heights = motion.rot(f"die_{die}").swapaxes(1, 2) @ np.array([0, 0, 1.0])
    faces = np.stack([heights, -heights], axis=2).reshape(len(heights), 6)
    return faces.argmax(axis=1), np.arccos(np.clip(faces.max(axis=1), -1, 1))


def readings(motion: Motion, p: Params) -> list[str | None]:
    """The upper colour of the first die in the tray, while it lies flat and still (by displacement)."""
    found = _first_die(motion, p)
    if found is None:
        return [None] * len(motion.times)
    die, arrival = found
    top, lean = _lean(motion, die)
    moved = np.linalg.norm(np.diff(motion.pos(f"die_{die}"), axis=0, prepend=math.inf), axis=1)
    lies = (lean < FLAT_RAD) & (moved < STILL * 2 * p.half_m) & (np.arange(len(top)) > arrival)
    return [p.faces[die][face] if lying else None for face, lying in zip(top, lies, strict=True)]


def margin(motion: Motion, p: Params) -> float:
    """The smaller of two distances (m): how far the next die was from the tray when the first came, and how much an
    edge of the lying die would have to rise for another face to come up."""
    found = _first_die(motion, p)
    if found is None:
        return 0.0
    die, arrival = found
    lead = np.min(np.delete(_short_of_tray(motion, p)[arrival], die))
    lean = _lean(motion, die)[1][-1]
    return float(min(lead, 2 * p.half_m * math.sin(max(0.0, math.pi / 4 - lean))))


QUESTIONS = (
    "Which colour is on top of the first die to reach the tray, once it lies still: {choices}?",
    "The first die to land in the tray comes to rest with which colour facing up: {choices}?",
    "Which colour face is up when the first die to reach the tray has stopped: {choices}?",
)


def _inventory(p: Params) -> Inventory:
    colours = sorted({*FACES, *p.edge_colours, *p.step_colours, p.tray_colour, "wood"})
    return Inventory(tuple(colours), ("die", "step", "tray", "wall", "face"))


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The choices are the six colours of a die, in random order."""
    choices = tuple(str(c) for c in rng.permutation(FACES))
    aliases = {form.format(c): c for c in FACES for form in ("{} face", "{} side", "{} on top", "{} face up")}
    aliases |= {"teal": "cyan", "turquoise": "cyan", "aqua": "cyan", "light blue": "cyan", "dark blue": "blue"}
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(choices=listed(choices)),
        labels=choices,
        aliases=aliases,
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(3)
    if kind == 0:
        return AnswerableQuestion("How many dice are there, 2, 3 or 4?", ("2", "3", "4"), str(len(p.faces)))
    if kind == 1:
        side = "left" if p.direction < 0 else "right"
        return AnswerableQuestion("Do the steps go down to the left or to the right?", ("left", "right"), side)
    edge = str(rng.choice(EDGES))
    return AnswerableQuestion(
        f"Does one of the dice have {edge} edges, yes or no?",
        ("yes", "no"),
        "yes" if edge in p.edge_colours else "no",
    )


FAMILY = Family(
    name="tumbling_dice",
    taxonomy="chaotic",
    category="tumbling_dice",
    sub_scenario="tumbling_dice",
    answer_type="colour",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    physics=Physics(timestep_s=0.001, gravity_m_s2=4.4),
    min_margin_m=0.03,
    perturbation=1e-6,
)
