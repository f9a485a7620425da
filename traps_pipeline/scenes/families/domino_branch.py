"""A row of dominoes splits in two branches: at whose end does the domino fall?

Control: both branches are in view. Void: the occluder stands before them; the row is seen to fall behind it.
Hidden element: one domino of either branch, of which one stands in its branch and the other lies beside it.
The last visible domino only kicks a ball that rolls behind the occluder, drives in between the two branches and is
stopped by a post there: nothing that the gap changes can push back on what is seen.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from traps_pipeline.scenes.parts.course import SHADOW_RIGHT, Course
from traps_pipeline.scenes.parts.dominoes import BALL, BALL_AT, PLANK, STILL_M
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import end_of, is_struck, is_upper_half_in_place
from traps_pipeline.scenes.parts.questions import left_or_right
from traps_pipeline.scenes.parts.readings import Reading, still_from, top_m
from traps_pipeline.scenes.parts.vary import apart, between, drawn_by, hidden, in_front, one_of, several_between
from traps_pipeline.scenes.parts.vision import blobs, colour_mask, is_occluder, largest, track
from traps_pipeline.scenes.physics.kit import AnswerableQuestion, Motion, Physics, Scene, list_choices

STOP_AT = 2.9  # where the post stops the kicked ball's centre: behind the occluder, out of the domino's reach
PUSH = 0.10  # how far the stopped ball has pushed into either branch
SIDES = ("left", "right")
FLATTER = 1.3  # times as high for its width, at least, is a domino that stands beside one that lies
PLAY_COLOURS = apart("red", "green", "blue", "yellow", "cyan", "purple")


@dataclass(frozen=True)
class Params:
    """Parameters; unsuffixed lengths in domino heights; angles from the row."""

    row_colour: str = PLAY_COLOURS()
    ball_colour: str = PLAY_COLOURS()
    left_colour: str = PLAY_COLOURS()
    right_colour: str = PLAY_COLOURS()
    branch: int = one_of(3, 4, longer=(5, 6))  # dominoes of either branch, the last one included
    height_m: float = between(0.17, 0.21)
    width: float = between(0.46, 0.52)
    thickness: float = between(0.16, 0.19)
    spacing: float = between(0.68, 0.74)
    visible: int = one_of(2, 3, longer=(4, 5))  # dominoes before the hand-off
    angles_deg: tuple[float, float] = several_between(2, 55, 63)  # left and right branch
    gap_index: int = drawn_by(lambda rng, so_far: int(rng.integers(1, so_far["branch"] - 1)))  # what is hidden
    gap_side: str = hidden("left", "right")  # in which branch that domino lies beside
    starter_speed_m_s: float = between(0.50, 0.70)
    board_colour: str = one_of("wood", "grey", "black")
    azimuth_deg: float = in_front(-9, 9)
    elevation_deg: float = between(-44, -39)

    def bodies(self, side: str) -> list[str]:
        """Return the dominoes of a branch, from the junction on."""
        return [*(f"{side}_{i}" for i in range(self.branch - 1)), f"end_{side}"]


def build(p: Params, physics: Physics) -> Scene:
    """Build the row along -y, and two branches from where the kicked ball stops."""
    course, h = Course(physics), p.height_m
    face = (p.visible - 1) * p.spacing + p.thickness / 2
    junction = face + STOP_AT
    reach = BALL + p.thickness + (p.branch - 1) * p.spacing + 0.65  # of a branch, when its end domino has fallen
    angles = np.radians(p.angles_deg)
    left, right = (float(reach * np.sin(a) + p.width / 2) for a in angles)
    front = junction + float(reach * np.cos(angles).max()) + p.width / 2

    middle = (h * (right - left) / 2, -h * (front - 2.4) / 2, PLANK * h / 2)
    course.slab("board", middle, (h * (right + left) / 2, h * (front + 2.4) / 2, PLANK * h / 2), p.board_colour)
    for name, along in (("starter", -1.8), ("kicked", face + BALL_AT)):
        at = (0, -along * h, (PLANK + BALL) * h)
        # The board grips the ball; a domino slides over it and squeezes it out.
        course.ball(name, at, BALL * h, p.ball_colour, rolling=0.0004, sliding=0.1, density=300)
    for i in range(p.visible):
        _add_domino(course, p, f"domino_{i}", np.array([0.0, i * p.spacing]), 0.0, p.row_colour)
    for i, side in enumerate(SIDES):
        _add_branch(course, p, side, float((-1, 1)[i] * angles[i]), junction)
    course.slab("post", (0, -h * (junction + BALL + 0.03), h * (PLANK + 0.3)), (0.03 * h, 0.03 * h, 0.3 * h), "grey")

    back = -h * (junction - BALL - 0.2)
    for side in SIDES:  # either one ends a branch, fallen or not
        course.mark(f"{side} domino", f"end_{side}")
    scene = course.scene(
        p,
        decisive=[f"end_{side}" for side in SIDES],
        hidden=[f"{side}_{p.gap_index}" for side in SIDES],
        cover=course.box((-h * left, h * (right + SHADOW_RIGHT)), (-h * front, back), (0, (PLANK + 1.04) * h)),
        in_view=[course.box((-h * left, h * right), (-h * front, h * 2.3), (0, h))],
        things=[f"{p.left_colour} domino", f"{p.right_colour} domino", f"{p.ball_colour} ball", "board"],
        also=["post", "row", "branch"],
        colours=["grey"],
        shown_by={"row": ["domino"], "branch": ["domino"]},
    )
    speed = p.starter_speed_m_s  # towards the camera
    return replace(scene, velocity={"starter": (0, -speed, 0, speed / (BALL * h), 0, 0)})


def _add_branch(course: Course, p: Params, side: str, yaw: float, junction: float) -> None:
    """Add the dominoes of a branch, of which one may lie beside it, on the inner side."""
    ahead, inward = np.array([np.sin(yaw), np.cos(yaw)]), np.sign(yaw) * np.array([-np.cos(yaw), np.sin(yaw)])
    start = np.array([0.0, junction]) + (BALL - PUSH + p.thickness / 2) * ahead
    colours = [p.row_colour] * (p.branch - 1) + [p.left_colour if side == "left" else p.right_colour]
    for i, (name, colour) in enumerate(zip(p.bodies(side), colours, strict=True)):
        at, is_lying = start + i * p.spacing * ahead, i == p.gap_index and side == p.gap_side
        if is_lying:
            at = at + (p.width + 0.15) * inward
        _add_domino(course, p, name, at, yaw, colour, lying=is_lying)


def _add_domino(
    course: Course, p: Params, name: str, at: np.ndarray, yaw: float, colour: str, *, lying: bool = False
) -> None:
    """Add a free domino at (across, along), its thickness along `yaw` from the row."""
    h = p.height_m
    depth, high = (1.0, p.thickness) if lying else (p.thickness, 1.0)
    place = (float(at[0]) * h, -float(at[1]) * h, (PLANK + high / 2) * h)
    half_size = (p.width * h / 2, depth * h / 2, high * h / 2)
    body = course.free_box(name, place, half_size, colour, density=500, sliding=0.2, solref=(0.006, 1))
    body.quat = [float(np.cos(yaw / 2)), 0, 0, float(np.sin(yaw / 2))]


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the side of the only end domino that falls, once the branches are still."""
    tops = np.stack([top_m(motion, f"end_{side}", p.height_m) for side in SIDES], axis=1) - PLANK * p.height_m
    rest_frame = still_from(*(motion.pos(body) for side in SIDES for body in p.bodies(side)), within_m=STILL_M)
    sides = [("left" if left else "right") if left != right else None for left, right in tops < p.height_m / 2]
    labels = [side if i >= rest_frame else None for i, side in enumerate(sides)]
    return Reading(labels, float(np.abs(tops[-1] - p.height_m / 2).min()))


def _draw_aside(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    """Draw a question: what starts the fall, or what falls first."""
    choices = tuple(str(c) for c in rng.permutation([p.row_colour, p.ball_colour, p.left_colour, p.right_colour]))
    if rng.integers(2):
        question = f"What colour is the ball that sets off the row of dominoes: {list_choices(choices)}?"
        return AnswerableQuestion(question, choices, p.ball_colour)
    question = f"What colour is the domino that falls first: {list_choices(choices)}?"
    return AnswerableQuestion(question, choices, p.row_colour)


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return the side of the only end domino that has left its initial place."""
    is_standing = [_is_standing(frames, slots[side]) for side in SIDES]
    if None in is_standing or is_standing[0] == is_standing[1]:
        return None
    return "right" if is_standing[0] else "left"


def foresee(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Predict the side of the only end domino that has left its place or will soon."""
    predictions = []
    for colour in (slots["left"], slots["right"]):
        dominoes = blobs(colour_mask(frames[0], colour), 60)
        predictions.append(
            any(
                not is_upper_half_in_place(frames, colour, domino) or is_struck(frames, domino, 0.0)
                for domino in dominoes
            )
        )
    return None if predictions[0] == predictions[1] else "left" if predictions[0] else "right"


def look(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return the side whose end domino rests and is the flatter of the two."""
    ends = [end_of(track(frames, slots[side], 60)) for side in SIDES]
    heights = [end.box[3] / end.box[2] for end in ends if end is not None]
    if len(heights) < 2 or max(heights) < FLATTER * min(heights):
        return None
    return SIDES[int(np.argmin(heights))]


def _is_standing(frames: np.ndarray, colour: str) -> bool | None:
    """Return whether a colour's upper half is where it was; None if out of view."""
    first, last = largest(frames[0], colour, 60), largest(frames[-1], colour, 60)
    if first is None or last is None or is_occluder(first) or is_occluder(last):
        return None
    return is_upper_half_in_place(frames, colour, first)


FAMILY = scene_family(
    "domino_branch",
    category="dominoes",
    params=Params,
    build=build,
    outcome=outcome,
    question=left_or_right(
        "Which end domino falls over, the {left} one on the left or the {right} one on the right: left or right?",
        "The left branch ends in a {left} domino, the right one in a {right} domino: "
        "which of them falls, left or right?",
        "In which branch is the last domino knocked over, left (the {left} one) or right (the {right} one)?",
        forms=["the {0} one", "{0} branch", "the {0} branch", "{1}", "{1} domino", "the {1} one"],
        colours=lambda p: (p.left_colour, p.right_colour),
    ),
    asides=[_draw_aside],
    observe=observe,
    foresee=foresee,
    look=look,
    physics=Physics(timestep_s=0.001, tolerance=0.0),  # a solver that stops early makes rounding visible in the twin
    min_margin_m=0.03,
)
