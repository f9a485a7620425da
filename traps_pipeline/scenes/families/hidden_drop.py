"""A ball rolls along a high track into a chute and drops on a plate; the question is to which side it drops off.

Control: the plate below the chute and the two bins are in view. Void: the panel stands before them.
Hidden element: the plate is tilted to the left or to the right. The ball drops straight on its middle, whatever the
track and the chute look like; a board behind the bins catches the shadows.
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
WALL_M = 0.012
COLOURS_IN_PLAY = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """direction: +1 rolls to the right. tilt: +1 if the plate sheds the ball to the right (the hidden element)."""

    direction: int
    tilt: int
    tilt_deg: float
    radius_m: float
    speed_m_s: float
    start_m: float  # where the ball starts on the track, from the middle of the chute
    chute_m: float  # height of the chute's lower end
    chute_height_m: float
    bin_m: float  # width of each bin
    rim_m: float  # height of the bins' outer walls
    ball_colour: str
    left_colour: str
    right_colour: str
    plate_colour: str
    chute_colour: str
    board_colour: str
    azimuth_deg: float
    elevation_deg: float

    @property
    def track_m(self) -> float:
        """Height of the track: two ball diameters below the chute's upper end."""
        return self.chute_m + self.chute_height_m - 2.4 * self.radius_m


def draw(rng: np.random.Generator) -> Params:
    """The side the ball comes from and the side it drops to are independent."""
    left, right, ball = distinct_colours(rng, 3, COLOURS_IN_PLAY)
    chute, board, plate = (str(c) for c in rng.permutation(["wood", "grey", "white"]))
    direction = int(rng.choice([-1, 1]))
    return Params(
        direction=direction,
        tilt=int(rng.choice([-1, 1])),
        tilt_deg=uniform(rng, 30, 40),
        radius_m=uniform(rng, 0.042, 0.050),
        speed_m_s=uniform(rng, 0.30, 0.42),
        start_m=uniform(rng, 0.42, 0.54),
        chute_m=uniform(rng, 0.36, 0.42),
        chute_height_m=uniform(rng, 0.34, 0.42),
        bin_m=uniform(rng, 0.30, 0.38),
        rim_m=uniform(rng, 0.10, 0.14),
        ball_colour=ball,
        left_colour=left,
        right_colour=right,
        plate_colour=plate,
        chute_colour=chute,
        board_colour=board,
        azimuth_deg=90 + uniform(rng, -15, 15),
        elevation_deg=uniform(rng, -26, -20),
    )


def build(p: Params, physics: Physics) -> Scene:
    """Track on a post, chute, tilting plate on a partition, one bin on each side of it, board at the back."""
    spec = new_spec(physics)
    r = p.radius_m
    half_y, half_x = 1.5 * r, p.bin_m + WALL_M
    bore = 1.2 * r  # half the chute's inner width
    top, d = p.chute_m + p.chute_height_m, p.direction

    def block(name: str, x: Span, y: Span, z: Span, colour: str) -> mujoco.MjsGeom:
        low, high = sorted(x)
        half = ((high - low) / 2, (y[1] - y[0]) / 2, (z[1] - z[0]) / 2)
        return add_box(spec.worldbody, name, ((low + high) / 2, sum(y) / 2, sum(z) / 2), half, colour)

    across = (-half_y, half_y)
    far = -p.start_m - 0.08
    block("track", (d * far, -d * bore), (-1.1 * r, 1.1 * r), (p.track_m - 0.02, p.track_m), p.chute_colour)
    for side in (-1, 1):
        y = side * 1.1 * r
        span = (y - 0.005, y + 0.005)
        block(f"rail_{side}", (d * far, -d * bore), span, (p.track_m - 0.02, p.track_m + 0.35 * r), p.chute_colour)
    block("post", (d * (far + 0.02), d * (far + 0.06)), (-0.02, 0.02), (0, p.track_m - 0.02), p.chute_colour)
    walls = {"chute_far": d * (bore + WALL_M / 2), "chute_near": -d * (bore + WALL_M / 2)}
    for name, x in walls.items():
        upper = top if name == "chute_far" else p.track_m - 0.02
        block(name, (x - WALL_M / 2, x + WALL_M / 2), across, (p.chute_m, upper), p.chute_colour)
    for name, y in (("chute_front", -half_y - WALL_M), ("chute_back", half_y)):
        block(name, (-bore - WALL_M, bore + WALL_M), (y, y + WALL_M), (p.chute_m, top), p.chute_colour)

    plate_z = p.chute_m - 3.6 * r
    plate = add_box(
        spec.worldbody,
        "plate",
        (0, 0, plate_z),
        (2.0 * r, half_y, 0.008),
        p.plate_colour,
        euler_y=p.tilt * float(np.radians(p.tilt_deg)),
    )
    plate.friction, plate.condim, plate.priority = [0.5, 0.005, 0.0001], 6, 1
    block("partition", (-WALL_M / 2, WALL_M / 2), across, (0, plate_z - 0.02), p.chute_colour)
    for side, colour in ((-1, p.left_colour), (1, p.right_colour)):
        name = "left" if side < 0 else "right"
        floor = block(f"bin_{name}", (0, side * p.bin_m), across, (0, 0.015), colour)
        floor.friction, floor.condim, floor.priority = [0.8, 0.005, 0.004], 6, 1
        block(f"end_{name}", (side * p.bin_m, side * half_x), across, (0, p.rim_m), colour)
        block(f"front_{name}", (0, side * half_x), (-half_y - WALL_M, -half_y), (0, 0.5 * r), colour)
    shadow = 0.35 * p.chute_m
    board = (-half_x - 0.02, half_x + shadow)
    block("board", board, (half_y + WALL_M, half_y + 2 * WALL_M), (0, p.chute_m + 0.12), p.board_colour)
    ball = add_ball(spec, "ball", (-d * p.start_m, 0, p.track_m + r), r, p.ball_colour)
    ball.friction = [0.8, 0.005, 2e-5]

    cover = Box((-half_x - 0.02, -half_y - WALL_M, 0), (half_x + shadow, half_y + 2 * WALL_M, p.chute_m + 0.02))
    return Scene(
        spec=spec,
        view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
        decisive=("ball",),
        hidden=("plate",),
        cover=cover,
        stage=(cover, Box((-bore, -half_y, p.chute_m), (bore, half_y, top))),
        velocity={"ball": (d * p.speed_m_s, 0.0, 0.0, 0.0, d * p.speed_m_s / r, 0.0)},
        inventory=Inventory(
            (p.ball_colour, p.left_colour, p.right_colour, p.plate_colour, p.chute_colour, p.board_colour),
            ("ball", "bin", "chute", "track", "board", "plate", "post"),
            (f"{p.ball_colour} ball", "high track", "chute", "post"),
        ),
    )


def _past_middle(motion: Motion) -> np.ndarray:
    """How far the ball is to the right of the partition (m), shape (F,)."""
    return motion.pos("ball")[:, 0]


def readings(motion: Motion, p: Params) -> list[str | None]:
    """The side of the bin in which the ball is, from when it is below the plate's lower edge."""
    below = motion.pos("ball")[:, 2] < p.rim_m + p.radius_m
    return [("right" if x > 0 else "left") if low else None for x, low in zip(_past_middle(motion), below, strict=True)]


def margin(motion: Motion, p: Params) -> float:
    """How far the ball ends from the partition (m)."""
    return float(abs(_past_middle(motion)[-1]) - p.radius_m)


def twins(p: Params) -> list[Params]:
    """The same scene with the plate tilted the other way."""
    return [replace(p, tilt=-p.tilt)]


QUESTIONS = (
    "Where does the {ball} ball drop out of the chute: left into the {left} bin or right into the {right} bin?",
    "Does the {ball} ball land in the {left} bin on the left or in the {right} bin on the right?",
    "To which side does the {ball} ball fall from the chute, left ({left} bin) or right ({right} bin)?",
)


def word(p: Params, rng: np.random.Generator) -> Wording:
    """Ball and bins are named by their colours, which nothing else has."""
    sides = (("left", p.left_colour), ("right", p.right_colour))
    forms = ("to the {0}", "{0} bin", "{0} side", "{1}", "{1} bin", "the {1} bin")
    return Wording(
        question=str(rng.choice(QUESTIONS)).format(ball=p.ball_colour, left=p.left_colour, right=p.right_colour),
        labels=("left", "right"),
        aliases={form.format(side, colour): side for side, colour in sides for form in forms},
        answerable_question=_answerable(p, rng),
    )


def _answerable(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    if rng.integers(2):
        side = "left" if p.direction > 0 else "right"
        return AnswerableQuestion("From which side does the ball roll in, left or right?", ("left", "right"), side)
    others = [c for c in COLOURS_IN_PLAY if c not in (p.ball_colour, p.left_colour, p.right_colour)]
    choices = tuple(str(c) for c in rng.permutation([p.ball_colour, *rng.permutation(others)[:2]]))
    return AnswerableQuestion(f"What colour is the ball on the track: {listed(choices)}?", choices, p.ball_colour)


def observe(frames: np.ndarray, question: str) -> str | None:
    """The bin that the ball lies in at the end: the side of the nearer of the two colours."""
    values = asked(QUESTIONS, question)
    if values is None:
        return None
    path = [_ball(frame, values["ball"]) for frame in frames[-3:]]
    left, right = (largest(frames[-1], values[side], 60) for side in ("left", "right"))
    ball = path[-1]
    if ball is None or left is None or right is None or not at_rest(path, tolerance_px=4):
        return None
    return "left" if abs(ball.x - left.x) < abs(ball.x - right.x) else "right"


def _ball(frame: np.ndarray, colour: str) -> Blob | None:
    """The region of the ball's colour that is no larger than a ball."""
    found = blobs(colour_mask(frame, colour), 60)
    return next((blob for blob in found if max(blob.box[2:]) < 80), None)


FAMILY = Family(
    name="hidden_drop",
    taxonomy="occlusion",
    category="hidden",
    sub_scenario="hidden_drop",
    answer_type="direction",
    params=Params,
    draw=draw,
    build=build,
    readings=readings,
    margin=margin,
    word=word,
    questions=QUESTIONS,
    observe=observe,
    min_margin_m=0.02,
    twins=twins,
)
