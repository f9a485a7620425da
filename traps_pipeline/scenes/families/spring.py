"""A ball rolls through a tunnel and off a deck to a plunger; the question is whether it is thrown back over a line.

Control: plunger and line are in view. Void: the panel stands before both.
Hidden element: the plunger, whose spring is lively or stuck fast in thick grease. The ball arrives the same either way;
it drops down a step behind the panel, so that what comes back stays there, and felt brings it to rest.
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
from traps_pipeline.scenes.vision import Blob, at_rest, blobs, colour_mask
from traps_pipeline.scenes.wording import asked

if TYPE_CHECKING:
    import mujoco

    from traps_pipeline.scenes.simulate import Motion

Span = tuple[float, float]
GRAVITY = 9.81
LANE_M = 0.02  # height of the lower lane
FEEL_M = 0.03  # the ball has met the plunger when it has been this near to it
WALL_M = 0.014
COILS = 4
COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. Places are along the roll, from where the ball starts."""

    direction: int
    radius_m: float
    speed_m_s: float
    run_m: float  # open deck before the panel
    step_m: float  # height of the deck over the lane
    lane_m: float  # from the step to the plunger's head
    line_m: float  # from the plunger's head to the line
    felt: float  # rolling friction of the lane (m)
    stiffness_n_m: float
    damping_n_s_m: float  # of the plunger: the hidden element
    other_damping_n_s_m: float  # what the twin has
    ball_colour: str
    line_colour: str
    deck_colour: str
    lane_colour: str
    tunnel_colour: str
    head_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def edge_m(self) -> float:
        """Where the deck ends."""
        return self.run_m + 2 * self.radius_m + 0.06

    @property
    def head_m(self) -> float:
        """Where the plunger's face is at rest."""
        return self.edge_m + self.lane_m


def draw(rng: np.random.Generator) -> Params:
    """Half of the springs are stuck; nothing that can be seen tells."""
    direction = int(rng.choice([-1, 1]))
    ball, line, deck, head = distinct_colours(rng, 4, COLOURS)
    dampings = (uniform(rng, 0.4, 1.0), uniform(rng, 60, 90))
    lane, tunnel = rng.permutation(["grey", "white", "black"])[:2]
    first = int(rng.integers(2))
    return Params(
        direction=direction,
        radius_m=uniform(rng, 0.054, 0.062),
        speed_m_s=uniform(rng, 0.95, 1.15),
        run_m=uniform(rng, 0.50, 0.62),
        step_m=uniform(rng, 0.06, 0.08),
        lane_m=uniform(rng, 0.50, 0.56),
        line_m=uniform(rng, 0.21, 0.24),
        felt=uniform(rng, 0.0024, 0.0030),
        stiffness_n_m=uniform(rng, 90, 140),
        damping_n_s_m=dampings[first],
        other_damping_n_s_m=dampings[1 - first],
        ball_colour=ball,
        line_colour=line,
        deck_colour=deck,
        lane_colour=str(lane),
        tunnel_colour=str(tunnel),
        head_colour=head,
        azimuth_deg=90 - direction * uniform(rng, -10, 20),
        elevation_deg=uniform(rng, -36, -26),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Deck, step, lower lane with a line across, plunger. Lengths run along the roll, mirrored by `direction`."""
    spec = new_spec(physics)
    r, wide = p.radius_m, 1.9 * p.radius_m
    deck, end = LANE_M + p.step_m, p.head_m + 0.32

    def block(name: str, along: Span, across: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        mid = (p.direction * sum(along) / 2, sum(across) / 2, sum(z) / 2)
        half = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (z[1] - z[0]) / 2)
        geom = add_box(spec.worldbody, name, mid, half, colour)
        geom.solref, geom.friction, geom.condim, geom.priority = [0.01, 1], [0.8, 0.005, 2e-5], 6, 1
        return geom

    block("deck", (-r, p.edge_m), (-wide, wide), (0, deck), p.deck_colour)
    lane = block("lane", (p.edge_m, end), (-wide, wide), (0, LANE_M), p.lane_colour)
    lane.friction = [0.8, 0.005, p.felt]
    tunnel, roof = (p.run_m - 2.6 * r, p.run_m + 2 * r), deck + 2.4 * r
    block("tunnel_front", tunnel, (-wide, -wide + WALL_M), (deck, roof), p.tunnel_colour)
    block("tunnel_back", tunnel, (wide - WALL_M, wide), (deck, roof), p.tunnel_colour)
    block("tunnel_roof", tunnel, (-wide, wide), (roof, roof + WALL_M), p.tunnel_colour)
    line = p.head_m - p.line_m
    paint = block("line", (line - 0.016, line + 0.016), (-wide, wide), (LANE_M, LANE_M + 0.001), p.line_colour)
    paint.contype = paint.conaffinity = 0
    block("back", (-r, end), (wide, wide + WALL_M), (0, deck + 0.4 * r), p.lane_colour)
    block("front", (p.edge_m, end), (-wide - WALL_M, -wide), (0, LANE_M + 0.3 * r), p.lane_colour)
    block("housing", (end - 0.13, end), (-wide, wide), (LANE_M, LANE_M + 2.3 * r), p.tunnel_colour)
    _add_plunger(spec, p)
    ball = add_ball(spec, "ball", (0, 0, deck + r), r, p.ball_colour)
    ball.friction = [0.8, 0.005, 2e-5]

    high = max(deck + 2.2 * r, LANE_M + 2.4 * r)
    ends = sorted((p.direction * p.run_m, p.direction * end))
    whole = sorted((-p.direction * r, p.direction * end))
    shadow = 0.35 * (deck + 2 * r)  # shadows fall to the right and to the back
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        hidden=("head", "rod", *(f"coil_{i}" for i in range(COILS))),
        cover=Box((ends[0], -wide - WALL_M, 0.0), (ends[1] + shadow, wide + 0.55 * (deck + 2 * r), high)),
        stage=(Box((whole[0], -wide - WALL_M, 0.0), (whole[1], wide + WALL_M, high)),),
        velocity={"ball": _rolling(p)},
        inventory=Inventory(
            (p.ball_colour, p.line_colour, p.deck_colour, p.lane_colour, p.tunnel_colour, p.head_colour, "grey"),
            ("ball", "spring", "plunger", "line", "deck", "lane", "step", "tunnel"),
            (f"{p.ball_colour} ball", f"{p.line_colour} line", f"{p.deck_colour} deck", "tunnel", "spring"),
        ),
    )


def _add_plunger(spec: mujoco.MjSpec, p: Params) -> None:
    """Head and rod on a sprung slide joint; the rod and the spring's coils slide into the housing behind them."""
    import mujoco

    r, z = p.radius_m, LANE_M + 1.1 * p.radius_m
    body = spec.worldbody.add_body(name="plunger", pos=[p.direction * p.head_m, 0, z])
    joint = body.add_joint(name="plunger", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[p.direction, 0, 0])
    joint.stiffness[0] = p.stiffness_n_m
    joint.damping[0] = p.damping_n_s_m
    head = add_box(body, "head", (p.direction * 0.012, 0, 0), (0.012, 1.5 * r, 0.95 * r), p.head_colour)
    head.density, head.condim, head.priority = 200, 3, 1
    head.friction, head.solref = [0.05, 0.005, 0.0001], [0.006, 1]
    parts = [("rod", 0.12, 0.012, 0.10)] + [(f"coil_{i}", 0.05 + 0.042 * i, 0.7 * r, 0.007) for i in range(COILS)]
    for name, along, radius, half in parts:
        part = body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_CYLINDER, rgba=rgba("grey"))
        part.pos, part.size, part.density = [p.direction * along, 0, 0], [radius, half, 0], 10
        part.quat = [0.5**0.5, 0, 0.5**0.5, 0]
        part.contype = part.conaffinity = 0


def _rolling(p: Params) -> tuple[float, ...]:
    """Velocity of a ball that rolls without slipping."""
    speed = p.direction * p.speed_m_s
    return (speed, 0.0, 0.0, 0.0, speed / p.radius_m, 0.0)


def _back_m(motion: Motion, p: Params) -> np.ndarray:
    """How far the ball's centre is from the line, away from the plunger (m), shape (F,)."""
    return p.head_m - p.line_m - p.direction * motion.pos("ball")[:, 0]


def readings(motion: Motion, p: Params) -> list[str | None]:
    """'yes' from when the ball is back over the line after it has met the plunger, 'no' while it is not; None before
    it has met the plunger."""
    back = _back_m(motion, p)
    met = np.maximum.accumulate(-back) > p.line_m - p.radius_m - FEEL_M
    return [("yes" if b > 0 else "no") if m else None for b, m in zip(back, met, strict=True)]


def margin(motion: Motion, p: Params) -> float:
    """How far the ball's centre ends from the line (m)."""
    return float(abs(_back_m(motion, p)[-1]))


def twins(p: Params) -> list[Params]:
    """The same roll with the other plunger."""
    return [replace(p, damping_n_s_m=p.other_damping_n_s_m, other_damping_n_s_m=p.damping_n_s_m)]


QUESTIONS = (
    "Does the spring throw the {ball} ball back over the {line} line, yes or no?",
    "Is the {ball} ball sent back across the {line} line by the spring: yes or no?",
    "Does the {ball} ball come back from the spring far enough to cross the {line} line again, yes or no?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Ball and line are named by colours that nothing else has."""
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(ball=p.ball_colour, line=p.line_colour),
        labels=("yes", "no"),
        aliases={
            "yes it does": "yes",
            "it is thrown back": "yes",
            "it crosses the line": "yes",
            "it comes back over the line": "yes",
            "no it does not": "no",
            "it is not thrown back": "no",
            "it stays at the spring": "no",
            "it does not cross the line": "no",
        },
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    kind = rng.integers(3)
    if kind == 0:
        side = "left" if p.direction > 0 else "right"
        question = "From which side does the ball roll towards the spring, left or right?"
        return AnswerableQuestion(question, ("left", "right"), side)
    choices = tuple(str(c) for c in rng.permutation([p.ball_colour, p.deck_colour, p.line_colour]))
    if kind == 1:
        question = f"What colour is the ball that rolls along the deck: {listed(choices)}?"
        return AnswerableQuestion(question, choices, p.ball_colour)
    return AnswerableQuestion(f"What colour is the deck under the ball: {listed(choices)}?", choices, p.deck_colour)


def _ball_like(blob: Blob) -> bool:
    """Whether a region may be a ball: neither as large nor as rectangular as a panel."""
    return 60 <= blob.area <= 4000 and blob.fill < 0.9 and max(blob.box[2:]) < 1.9 * min(blob.box[2:])


def _ball(frame: np.ndarray, colour: str) -> Blob | None:
    return next(filter(_ball_like, blobs(colour_mask(frame, colour))), None)


def observe(frames: np.ndarray, question: str) -> str | None:
    """Whether the resting ball is on the side of the line that it came from."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = [_ball(frame, values["ball"]) for frame in frames[-3:]]
    start, end = _ball(frames[0], values["ball"]), path[-1]
    parts = [b for b in blobs(colour_mask(frames[-1], values["line"]), 15) if b.area < 4000]
    if start is None or end is None or not at_rest(path) or not parts:
        return None
    line = sum(part.x * part.area for part in parts) / sum(part.area for part in parts)
    return "yes" if (start.x - line) * (end.x - line) > 0 else "no"


FAMILY = Family(
    name="spring",
    taxonomy="occlusion",
    category="other",
    sub_scenario="spring",
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
