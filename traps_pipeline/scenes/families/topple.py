"""A ball rolls off a ledge against a tall pillar; the question is whether the pillar topples over.

Control: ledge, pillar and the ground behind it are in view. Void: the panel stands before all of them but the ball's
run-up.
Hidden element: a prop that stands right behind the pillar or off to its side, or the pillar itself, which looks the
same but is light or heavy.
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
from traps_pipeline.scenes.vision import at_rest, track
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
COLOURS = ("red", "green", "blue", "orange", "cyan", "purple")
FELT = 2e-3  # rolling friction (m) behind the panel: no ball comes back from there
LIGHT, HEAVY = 200.0, 7000.0  # kg/m3
STILL_DEG = 0.5


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. Heights in the ball's way are shares of the pillar's height."""

    direction: int
    kind: str  # of the hidden element: 'prop' or 'pillar'
    firm: bool  # whether it keeps the pillar upright: the hidden element
    pillar_m: float
    width_m: float
    depth_m: float
    prop_height: float
    strike: float  # height at which the ball strikes
    radius_m: float
    speed_m_s: float
    run_m: float  # visible ledge before the panel
    pillar_colour: str
    ball_colour: str
    prop_colour: str
    ledge_colour: str
    mat_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def ledge_m(self) -> float:
        """Height of the ledge that the ball rolls on."""
        return self.strike * self.pillar_m - self.radius_m

    @property
    def end_m(self) -> float:
        """How far from the middle of the pillar the mat reaches that it falls on."""
        return self.width_m / 2 + self.pillar_m + 0.09


def draw(rng: np.random.Generator) -> Params:
    """Half of the pillars stand firm; nothing that can be seen tells."""
    direction = int(rng.choice([-1, 1]))
    pillar, ball, prop = distinct_colours(rng, 3, COLOURS)
    ledge, mat = rng.permutation(["wood", "grey", "white"])[:2]
    return Params(
        direction=direction,
        kind=str(rng.choice(["prop", "pillar"])),
        firm=bool(rng.integers(2)),
        pillar_m=uniform(rng, 0.32, 0.40),
        width_m=uniform(rng, 0.075, 0.09),
        depth_m=uniform(rng, 0.09, 0.13),
        prop_height=uniform(rng, 0.55, 0.70),
        strike=uniform(rng, 0.60, 0.72),
        radius_m=uniform(rng, 0.047, 0.056),
        speed_m_s=uniform(rng, 0.80, 1.0),
        run_m=uniform(rng, 0.34, 0.44),
        pillar_colour=pillar,
        ball_colour=ball,
        prop_colour=prop,
        ledge_colour=str(ledge),
        mat_colour=str(mat),
        azimuth_deg=90 - direction * uniform(rng, -14, 20),
        elevation_deg=uniform(rng, -32, -21),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Lengths run along the ball's path from the middle of the pillar, mirrored by `direction`."""
    spec = new_spec(physics)
    r, ledge, half_w = p.radius_m, p.ledge_m, p.width_m / 2
    ledge_end = -half_w - 0.025
    screened = ledge_end - 3 * r - 0.10
    start = screened - p.run_m + r
    depth = 0.17

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, mid, half, colour)

    for name, along, rolling in (
        ("ledge", (start - 0.06, screened + 2 * r), 1e-4),
        ("felt", (screened + 2 * r, ledge_end), FELT),
    ):
        deck = block(name, along, (-0.09, 0.09), (0, ledge), p.ledge_colour)
        deck.friction, deck.condim, deck.priority = [0.8, 0.005, rolling], 6, 1
    block("mat", (ledge_end, p.end_m), (-depth, depth), (0, 0.01), p.mat_colour)
    block("rim_back", (ledge_end, p.end_m), (depth, depth + 0.012), (0, 0.06), p.mat_colour)
    block("rim_front", (half_w + 0.02, p.end_m), (-depth - 0.012, -depth), (0, 0.03), p.mat_colour)
    block("rim_end", (p.end_m, p.end_m + 0.012), (-depth - 0.012, depth + 0.012), (0, 0.06), p.mat_colour)
    if p.kind == "prop":
        near = half_w + 0.004
        y = 0.0 if p.firm else depth - 0.03
        block("prop", (near, near + 0.07), (y - 0.03, y + 0.03), (0.01, p.prop_height * p.pillar_m), p.prop_colour)

    body = spec.worldbody.add_body(name="pillar", pos=[0, 0, 0.01 + p.pillar_m / 2])
    body.add_freejoint()
    pillar = add_box(body, "pillar", (0, 0, 0), (half_w, p.depth_m / 2, p.pillar_m / 2), p.pillar_colour)
    pillar.density = HEAVY if p.firm and p.kind == "pillar" else LIGHT
    pillar.friction, pillar.solref = [0.8, 0.01, 0.0005], [0.006, 1]
    ball = add_ball(spec, "ball", (p.direction * start, 0, ledge + r), r, p.ball_colour, density=1500)
    ball.friction = [0.1, 0.005, 1e-4]

    top = p.pillar_m + 0.03
    ends = sorted((p.direction * screened, p.direction * (p.end_m + 0.02)))
    right = ends[1] + (0.04 if p.direction > 0 else 0.0)
    prop_colours = (p.prop_colour,) if p.kind == "prop" else ()
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("pillar",),
        hidden=(p.kind,),
        cover=Box((ends[0], -depth - 0.02, 0.0), (right, max(depth + 0.05, 0.05 + 0.55 * p.pillar_m), top)),
        stage=(Box((ends[0], -depth - 0.012, 0.0), (ends[1], depth + 0.012, p.pillar_m)),),
        velocity={"ball": (p.direction * p.speed_m_s, 0, 0, 0, p.direction * p.speed_m_s / r, 0)},
        inventory=Inventory(
            (p.pillar_colour, p.ball_colour, *prop_colours, p.ledge_colour, p.mat_colour),
            ("ball", "pillar", "ledge", "mat", "block", "rim"),
            (
                f"{p.ball_colour} ball",
                f"{p.pillar_colour} pillar",
                "ledge",
                "mat",
                *(f"{c} block" for c in prop_colours),
            ),
        ),
    )


def _top_m(motion: Motion, p: Params) -> np.ndarray:
    """Height of the middle of the pillar's top (m) in every frame, shape (F,)."""
    return motion.pos("pillar")[:, 2] + motion.rot("pillar")[:, 2, 2] * p.pillar_m / 2


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'yes' while the pillar's top is below half its height; 'no' while it is not, from when neither the pillar nor
    the ball moves any more."""
    top = _top_m(motion, p)
    things = (motion.pos("pillar"), motion.pos("ball"), top[:, None])
    restless = np.flatnonzero(np.any([np.linalg.norm(at - at[-1], axis=1) > 0.003 for at in things], axis=0))
    still_from = int(restless[-1]) + 1 if restless.size else 0
    return ["yes" if z < p.pillar_m / 2 else "no" if i >= still_from else None for i, z in enumerate(top)]


def margin(motion: Motion, p: Params) -> float:
    """How far (m) the pillar's top ends above or below half its height."""
    return float(abs(_top_m(motion, p)[-1] - p.pillar_m / 2))


def twins(p: Params) -> list[Params]:
    """The same pillar, standing firm or not."""
    return [replace(p, firm=not p.firm)]


QUESTIONS = (
    "Does the tall {pillar} pillar topple over, yes or no?",
    "When the ball hits it, does the {pillar} pillar fall over: yes or no?",
    "Is the {pillar} pillar lying on its side at the end, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """The pillar is named by its colour, which nothing else has."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(pillar=p.pillar_colour),
        labels=("yes", "no"),
        aliases={
            "yes it topples": "yes",
            "it topples over": "yes",
            "it falls over": "yes",
            "it lies on its side": "yes",
            "no it does not topple": "no",
            "it does not topple over": "no",
            "it stays upright": "no",
            "it is still standing": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    if rng.integers(2):
        side = "left" if p.direction > 0 else "right"
        question = "From which side does the ball roll in on the ledge, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    choices = tuple(str(c) for c in rng.permutation([p.ball_colour, p.pillar_colour, p.prop_colour]))
    question = f"What colour is the ball that rolls in on the ledge: {listed(choices)}?"
    return AnswerableQuestion(question, choices, p.ball_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """The named pillar, seen at the start and at the end: is it still about as high in the picture as it was?"""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = track(frames, values["pillar"], 80)
    first, last = path[0], path[-1]
    if first is None or last is None or not at_rest(path) or first.box[3] < 1.2 * first.box[2]:
        return None
    return "yes" if last.box[3] < 0.75 * first.box[3] else "no"


FAMILY = Family(
    name="topple",
    taxonomy="occlusion",
    category="stacks",
    sub_scenario="topple",
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
    min_margin_m=0.03,
    twins=twins,
)
