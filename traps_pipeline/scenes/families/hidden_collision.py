"""Two balls roll towards each other on a track of two lanes: do they collide?

Control: the middle of the track, where the lanes are linked, is in view. Void: the occluder stands before it.
Hidden element: a switch board, which lies between the lanes or is turned so that it leads one ball to the other lane.
Which lanes the balls enter by does not tell: balls of one lane may be parted, balls of two lanes brought together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.parts.course import SHADOW_BACK, SHADOW_RIGHT, Course, Surface
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import extrapolate, small_blob
from traps_pipeline.scenes.parts.questions import yes_no
from traps_pipeline.scenes.parts.readings import Reading
from traps_pipeline.scenes.parts.vary import apart, between, drawn_by, hidden, in_front, one_of, shuffled
from traps_pipeline.scenes.parts.vision import Blob, is_at_rest
from traps_pipeline.scenes.physics.kit import AnswerableQuestion, Motion, Physics, Scene, uniform

DECK_M = 0.03
WALL_M = 0.012
# In ball radii:
HALF_PITCH = 1.4  # from the middle of the track to a lane's centre
SWITCH = (2.6, 4.5)  # across and along the lanes, when it is turned
ASIDE = 0.5  # of a ball's height in the picture: balls of different lanes are farther apart
PLAY_COLOURS = apart("red", "green", "blue", "yellow", "orange", "cyan", "purple")
PLAIN_COLOURS = shuffled("wood", "grey", "white", "black")


@dataclass(frozen=True)
class Params:
    """Parameters; pairs are the first and second ball; lane -1 is front, +1 back.

    direction: +1 if the first ball, which the switch may turn, rolls right. Lengths run along its way from the
    middle of the covered part.
    """

    deck_colour: str = PLAIN_COLOURS()
    rail_colour: str = PLAIN_COLOURS()
    switch_colour: str = PLAIN_COLOURS()
    direction: int = one_of(-1, 1)
    lanes: tuple[int, ...] = drawn_by(lambda rng, so_far: tuple(int(lane) for lane in rng.choice([-1, 1], 2)))
    turned: bool = hidden(False, True)  # whether the switch leads the first ball to the other lane
    colours: tuple[str, ...] = PLAY_COLOURS(2)
    speeds_m_s: tuple[float, ...] = drawn_by(lambda rng, so_far: (uniform(rng, 0.80, 0.92), uniform(rng, 0.62, 0.70)))
    radius_m: float = between(0.055, 0.062)
    run_m: float = between(0.64, 0.70)  # open track on either side
    middle_m: float = between(1.00, 1.10)  # covered track
    switch_m: float = between(0.11, 0.15)  # where the switch begins, from the start of the covered track
    azimuth_deg: float = in_front(-18, 18)
    elevation_deg: float = between(-38, -30)


def build(p: Params, physics: Physics) -> Scene:
    """Build a flat track with rails; each lane is closed where no ball enters."""
    course = Course(physics, p.direction)
    r, half_middle, half_width = p.radius_m, p.middle_m / 2, 2 * HALF_PITCH * p.radius_m
    end, switch_at, length = half_middle + p.run_m, -half_middle + p.switch_m, float(np.hypot(*SWITCH)) * r
    track, outer, up = (-end, end), (-half_width - WALL_M, half_width + WALL_M), (DECK_M, DECK_M + 1.1 * r)

    course.block("deck", track, (-half_width, half_width), (0, DECK_M), p.deck_colour)
    course.block("wall_front", track, (outer[0], -half_width), (0, DECK_M + 0.5 * r), p.rail_colour)
    course.block("wall_back", track, (half_width, outer[1]), (0, up[1]), p.rail_colour)
    course.block("rail_in", (-end, switch_at - 0.3 * r), (-0.004, 0.004), up, p.rail_colour)
    course.block("rail_out", (switch_at + length + 0.3 * r, end), (-0.004, 0.004), up, p.rail_colour)
    for name, at, lane in (("stop_near", -half_middle, p.lanes[0]), ("stop_far", half_middle - 0.02, p.lanes[1])):
        course.block(name, (at, at + 0.02), (-half_width, 0) if lane > 0 else (0, half_width), up, p.rail_colour)
    _add_switch(course, p, switch_at, length)
    for i, (start, speed) in enumerate(((1.5 * r - end, p.speeds_m_s[0]), (end - 1.5 * r, -p.speeds_m_s[1]))):
        at = (start, p.lanes[i] * HALF_PITCH * r, DECK_M + r)
        course.ball(f"ball_{i}", at, r, p.colours[i], speed=speed, rolling=0.001, sliding=0.5)

    high = DECK_M + 2 * r
    across = (outer[0] - 0.01, outer[1] + SHADOW_BACK * high)
    for i, colour in enumerate(p.colours):
        course.mark(f"{colour} ball", f"ball_{i}")
    return course.scene(
        p,
        decisive=["ball_0", "ball_1"],
        hidden=["switch"],
        cover=course.box((-half_middle - 0.01, half_middle + 0.01), across, (0, high), right=SHADOW_RIGHT * high),
        in_view=[course.box(track, outer, (0, high))],
        things=[*(f"{c} ball" for c in p.colours), "track", "front lane of the track", "back lane of the track"],
        also=["lane", "rail"],
        colours=p.colours,
        shown_by={"track": ["deck"]},
    )


def _add_switch(course: Course, p: Params, at: float, length: float) -> None:
    """Add the switch board: in line with the rails, or across the first ball's lane."""
    across, along = SWITCH[0] * p.radius_m, SWITCH[1] * p.radius_m
    x, y = (at + along / 2, p.lanes[0] * across / 2) if p.turned else (at + length / 2, 0.0)
    yaw = -p.direction * p.lanes[0] * float(np.arctan2(across, along)) if p.turned else 0.0
    high = 0.6 * p.radius_m
    board = course.slab("switch", (x, y, DECK_M + high), (length / 2, 0.006, high), p.switch_colour)
    board.quat = [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))]
    Surface(1e-4, sliding=0.05).on(board)


def outcome(motion: Motion, p: Params) -> Reading:
    """Read 'no' once the balls have passed each other, 'yes' once they touch."""
    between_them = motion.pos("ball_1") - motion.pos("ball_0")
    ahead = p.direction * between_them[:, 0]  # of the second ball on the first one's way
    distance = np.linalg.norm(between_them, axis=1)
    closest = int(distance.argmin())
    has_touched = distance[closest] < 2 * p.radius_m + 0.01
    labels = ["no" if x < -p.radius_m else "yes" if has_touched and i >= closest else None for i, x in enumerate(ahead)]
    return Reading(labels, float(abs(ahead[-1])))


def _shuffle_colours(p: Params, rng: np.random.Generator) -> Mapping[str, str]:
    first, second = (str(c) for c in rng.permutation(p.colours))
    return {"first": first, "second": second}


def _ask_aside(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    """Ask for one ball's side or lane (always drawn), or if both lanes are the same."""
    kind, i = rng.integers(3), int(rng.integers(2))
    if kind == 0:
        question = f"From which side does the {p.colours[i]} ball roll in, left or right?"
        return AnswerableQuestion(question, ("left", "right"), "left" if (p.direction > 0) == (i == 0) else "right")
    if kind == 1:
        question = f"Does the {p.colours[i]} ball start in the front lane or in the back lane?"
        return AnswerableQuestion(question, ("front", "back"), "front" if p.lanes[i] < 0 else "back")
    question = "Do the balls start in the same lane or in different lanes?"
    return AnswerableQuestion(question, ("same", "different"), "same" if p.lanes[0] == p.lanes[1] else "different")


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Return 'no' once the balls have changed their order, 'yes' if they rest before."""
    starts, ends, all_rest = [], [], True
    for name in ("first", "second"):
        path = [small_blob(frame, slots[name]) for frame in frames]
        start, end = next((blob for blob in path if blob), None), path[-1]
        if start is None or end is None:
            return None
        starts.append(start.x)
        ends.append(end.x)
        all_rest &= is_at_rest(path, tolerance_px=4)
    if (starts[0] < starts[1]) != (ends[0] < ends[1]):
        return "no"
    return "yes" if all_rest else None


def foresee(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Predict a collision: the balls are in one lane when they are side by side."""
    paths = [[small_blob(frame, slots[name]) for frame in frames] for name in ("first", "second")]
    a, b = (extrapolate(path, 0.0) for path in paths)
    a_next, b_next = (extrapolate(path, 1.0) for path in paths)
    if a is None or b is None or a_next is None or b_next is None:
        return None
    gap, closing = np.array([b.x - a.x, b.y - a.y]), np.array([b_next.x - a_next.x, b_next.y - a_next.y])
    direction = _direction(paths)
    if direction is None:
        return None
    normal = np.array([-direction[1], direction[0]])
    if (gap @ direction) * (closing @ direction) < 0:  # they will have passed in the next frame
        share = (gap @ direction) / ((gap - closing) @ direction)
        gap = gap + share * (closing - gap)
    return "yes" if abs(gap @ normal) < ASIDE * max(a.box[3], b.box[3]) else "no"


def _direction(paths: Sequence[Sequence[Blob | None]]) -> np.ndarray | None:
    """Return the track's direction in the picture, from the balls' first places."""
    first, second = (next((blob for blob in path if blob), None) for path in paths)
    if first is None or second is None:
        return None
    direction = np.array([second.x - first.x, second.y - first.y])
    return direction / np.linalg.norm(direction)


FAMILY = scene_family(
    "hidden_collision",
    category="hidden",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Do the {first} ball and the {second} ball collide, yes or no?",
        "Does the {first} ball run into the {second} ball on the track: yes or no?",
        "Do the two balls, the {first} one and the {second} one, bump into each other, yes or no?",
        yes=["they collide", "yes they collide", "they touch", "they bump into each other"],
        no=["they do not collide", "no they do not collide", "they pass each other", "they miss each other"],
        fills=_shuffle_colours,
    ),
    asides=[_ask_aside],
    observe=observe,
    foresee=foresee,
    min_margin_m=0.06,
)
