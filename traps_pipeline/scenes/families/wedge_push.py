"""A ball strikes a wedge and pushes it along a track; the question is whether the wedge gets onto the mat.

Control: track, wedge and mat are in view. Void: the panel stands before all of them but the ball's run-up.
Hidden element: a strip of the track before the mat that is slippery or rough, or a stop that stands on the track or
beside it.
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
    rgba,
    uniform,
)
from traps_pipeline.scenes.vision import at_rest, largest, track
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
COLOURS = ("red", "green", "blue", "orange", "cyan", "purple")
TRACK_M = 0.03  # thickness of the track
HALF_TRACK_M = 0.13
STRIP_M = 0.20  # length of the strip before the mat
SLIPPERY, ROUGH = 0.05, 1.0  # sliding friction
STILL_M = 0.002


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right."""

    direction: int
    kind: str  # of the hidden element: 'strip' or 'stop'
    barred: bool  # whether it keeps the wedge from the mat: the hidden element
    wedge_length_m: float
    wedge_width_m: float
    wedge_height_m: float
    radius_m: float
    speed_m_s: float
    run_m: float  # visible track before the panel
    mat_m: float
    wedge_colour: str
    ball_colour: str
    mat_colour: str
    track_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def mat_at_m(self) -> float:
        """Where the mat begins, from the middle of the wedge at the start."""
        return self.wedge_length_m / 2 + 0.03 + STRIP_M + 0.03


def draw(rng: np.random.Generator) -> Params:
    """Half of the ways to the mat are barred; nothing that can be seen tells."""
    direction = int(rng.choice([-1, 1]))
    wedge, ball, mat = distinct_colours(rng, 3, COLOURS)
    length = uniform(rng, 0.13, 0.16)
    return Params(
        direction=direction,
        kind=str(rng.choice(["strip", "stop"])),
        barred=bool(rng.integers(2)),
        wedge_length_m=length,
        wedge_width_m=uniform(rng, 0.10, 0.13),
        wedge_height_m=uniform(rng, 0.09, 0.11),
        radius_m=uniform(rng, 0.046, 0.054),
        speed_m_s=uniform(rng, 1.0, 1.25),
        run_m=uniform(rng, 0.34, 0.44),
        mat_m=length + uniform(rng, 0.10, 0.14),
        wedge_colour=wedge,
        ball_colour=ball,
        mat_colour=mat,
        track_colour=str(rng.choice(["wood", "grey", "white"])),
        azimuth_deg=90 - direction * uniform(rng, -16, 20),
        elevation_deg=uniform(rng, -36, -24),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Lengths run along the track from the middle of the wedge, mirrored by `direction`."""
    spec = new_spec(physics)
    r, half = p.radius_m, p.wedge_length_m / 2
    strip = (half + 0.03, half + 0.03 + STRIP_M)
    screened = -half - 2 * r - 0.08
    start = screened - p.run_m + r
    end = p.mat_at_m + p.mat_m

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        size = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, size, colour)

    strip_slides = ROUGH if p.barred and p.kind == "strip" else SLIPPERY
    strip_colour = "black" if p.kind == "strip" else p.track_colour
    for name, along, slide, rolling, colour in (
        ("run_up", (start - 0.06, screened + 2 * r), 0.8, 1e-4, p.track_colour),
        ("track", (screened + 2 * r, strip[0]), SLIPPERY, 2e-3, p.track_colour),
        ("strip", strip, strip_slides, 2e-3, strip_colour),
        ("track_end", (strip[1], p.mat_at_m), SLIPPERY, 2e-3, p.track_colour),
        ("mat", (p.mat_at_m, end), SLIPPERY, 2e-3, p.mat_colour),
    ):
        floor = block(name, along, (-HALF_TRACK_M, HALF_TRACK_M), (0, TRACK_M), colour)
        floor.friction, floor.condim, floor.priority = [slide, 0.005, rolling], 6, 1
    if p.kind == "stop":
        y = 0.0 if p.barred else HALF_TRACK_M + 0.05
        z = TRACK_M if p.barred else 0.0
        block("stop", (strip[1] - 0.03, strip[1]), (y - 0.04, y + 0.04), (z, z + 0.07), "black")
    block("wall_end", (end, end + 0.015), (-HALF_TRACK_M, HALF_TRACK_M), (0, TRACK_M + 0.05), p.track_colour)
    _add_wedge(spec, p)
    ball = add_ball(spec, "ball", (p.direction * start, 0, TRACK_M + r), r, p.ball_colour, density=2500)
    ball.friction = [0.1, 0.005, 1e-4]

    ends = sorted((p.direction * screened, p.direction * (end + 0.015)))
    top, back = TRACK_M + p.wedge_height_m + 0.02, HALF_TRACK_M + 0.11
    things = ("black strip",) if p.kind == "strip" else ("black stop",)
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("wedge",),
        hidden=(p.kind,),
        cover=Box((ends[0], -HALF_TRACK_M - 0.02, 0.0), (ends[1] + 0.05, back + 0.03, top)),
        stage=(Box((ends[0], -HALF_TRACK_M, 0.0), (ends[1], back, top)),),
        velocity={"ball": (p.direction * p.speed_m_s, 0, 0, 0, p.direction * p.speed_m_s / r, 0)},
        inventory=Inventory(
            (p.wedge_colour, p.ball_colour, p.mat_colour, p.track_colour, "black"),
            ("ball", "wedge", "mat", "track", "wall", p.kind),
            (f"{p.ball_colour} ball", f"{p.wedge_colour} wedge", f"{p.mat_colour} mat", "track", *things),
        ),
    )


def _add_wedge(spec: mujoco.MjSpec, p: Params) -> None:
    """A free body that looks like a wedge, high end towards the ball; a base and a back plate inside it collide."""
    import mujoco

    half, wide, high = p.wedge_length_m / 2, p.wedge_width_m / 2, p.wedge_height_m
    profile = ((-half, 0.0), (half, 0.0), (half, 0.025), (-half, high))
    vertices = [(p.direction * x, y, z) for y in (-wide, wide) for x, z in profile]
    spec.add_mesh(name="wedge", uservert=np.array(vertices).ravel())
    body = spec.worldbody.add_body(name="wedge", pos=[0, 0, TRACK_M])
    body.add_freejoint()
    shape = body.add_geom(name="wedge", type=mujoco.mjtGeom.mjGEOM_MESH, rgba=rgba(p.wedge_colour))
    shape.meshname, shape.mass = "wedge", 0.0
    shape.contype = shape.conaffinity = 0
    inside = (
        ("base", (0.0, 0.0, 0.0121), (half - 0.001, wide - 0.001, 0.012)),
        ("back", (-p.direction * (half - 0.011), 0.0, high * 0.42), (0.01, wide - 0.001, high * 0.42)),
    )
    for name, centre, size in inside:
        geom = add_box(body, name, centre, size, p.wedge_colour)
        geom.density = 900


def _along(motion: Motion, p: Params) -> np.ndarray:
    """How far the wedge has come (m), shape (F,)."""
    return p.direction * motion.pos("wedge")[:, 0]


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'yes' while the middle of the wedge is past the edge of the mat; 'no' while it is not, from when neither the
    wedge nor the ball moves any more."""
    things = (motion.pos("wedge"), motion.pos("ball"))
    restless = np.flatnonzero(np.any([np.linalg.norm(at - at[-1], axis=1) > STILL_M for at in things], axis=0))
    still_from = int(restless[-1]) + 1 if restless.size else 0
    along = _along(motion, p)
    return ["yes" if x > p.mat_at_m else "no" if i >= still_from else None for i, x in enumerate(along)]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the nearer end of the wedge is from the edge of the mat."""
    return float(abs(_along(motion, p)[-1] - p.mat_at_m) - p.wedge_length_m / 2)


def twins(p: Params) -> list[Params]:
    """The same track, barred or free."""
    return [replace(p, barred=not p.barred)]


QUESTIONS = (
    "Does the {wedge} wedge get pushed onto the {mat} mat, yes or no?",
    "Is the {wedge} wedge on the {mat} mat at the end: yes or no?",
    "Does the ball push the {wedge} wedge as far as the {mat} mat, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Wedge and mat are named by their colours, which nothing else has."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(wedge=p.wedge_colour, mat=p.mat_colour),
        labels=("yes", "no"),
        aliases={
            "yes it does": "yes",
            "it is on the mat": "yes",
            "on the mat": "yes",
            "it reaches the mat": "yes",
            "no it does not": "no",
            "it stops before the mat": "no",
            "it does not reach the mat": "no",
            "not on the mat": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    if rng.integers(2):
        side = "left" if p.direction > 0 else "right"
        question = "From which side does the ball roll in along the track, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    choices = tuple(str(c) for c in rng.permutation([p.ball_colour, p.wedge_colour, p.mat_colour]))
    question = f"What colour is the ball that rolls in along the track: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.ball_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """Whether the wedge, once at rest, stands before or within the mat as the first frame shows it."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = track(frames, values["wedge"], 100)
    first, last = path[0], path[-1]
    mat = largest(frames[0], values["mat"], 100)
    if first is None or last is None or mat is None or not at_rest(path):
        return None
    return "yes" if abs(last.x - mat.x) < mat.box[2] / 2 else "no"


FAMILY = Family(
    name="wedge_push",
    taxonomy="occlusion",
    category="other",
    sub_scenario="wedge_push",
    answer_type="binary",
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
