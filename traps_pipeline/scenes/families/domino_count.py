"""A row of dominoes kicks a ball into a second row: how many of that row fall?

Control: both rows are in view. Void: the occluder stands before the second row.
Hidden element: where the second row has its gap, which the fall does not bridge.
The last visible domino only kicks a ball that is behind the occluder from the start and that two posts stop after it
has struck the second row: nothing that the gap changes can push back on what is seen.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from traps_pipeline.scenes.parts import dominoes
from traps_pipeline.scenes.parts.course import Course
from traps_pipeline.scenes.parts.dominoes import Domino, Size
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import is_upper_half_in_place, surrounding_slices
from traps_pipeline.scenes.parts.questions import colour_of, comes_from, either, how_many, range_of
from traps_pipeline.scenes.parts.readings import Reading, still_from, top_m
from traps_pipeline.scenes.parts.vary import Drawn, apart, between, drawn_by, facing, is_longer, one_of
from traps_pipeline.scenes.parts.vision import blobs, colour_mask, motion_mask
from traps_pipeline.scenes.parts.wording import choices_in
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene

Ranges = tuple[tuple[int, int], ...]  # the choices: least and most dominoes of each
RANGES: tuple[Ranges, ...] = (((1, 2), (3, 4), (5, 6)), ((1, 2), (3, 5), (6, 7)))
LONGER_RANGES: tuple[Ranges, ...] = (((1, 3), (4, 6), (7, 9)), ((2, 4), (5, 7), (8, 9)))
UPRIGHT = 1.8  # times as high as wide is a domino that stands
GIVES = 0.2  # of a domino's picture: so much of one changes that falls
FALLEN = 0.6  # of a domino's height: a top below it belongs to a fallen domino
PLAY_COLOURS = apart("red", "green", "blue", "yellow", "cyan", "purple")


def _ranges(rng: np.random.Generator, so_far: Drawn) -> Ranges:
    """Draw the choices, then the right one of them, each as often."""
    pool = LONGER_RANGES if is_longer(so_far) else RANGES
    ranges = pool[int(rng.integers(len(pool)))]
    so_far["right"] = ranges[int(rng.integers(len(ranges)))]
    return ranges


def _gap_after(rng: np.random.Generator, so_far: Drawn) -> int:
    """Draw the gap's place among those for which that choice is right."""
    low, high = so_far["right"]
    return int(rng.integers(low, high + 1))


@dataclass(frozen=True)
class Params:
    """Parameters; unsuffixed lengths in domino heights; direction +1 is right."""

    direction: int = one_of(-1, 1)
    first_colour: str = PLAY_COLOURS()
    second_colour: str = PLAY_COLOURS()
    ball_colour: str = PLAY_COLOURS()
    ranges: tuple[tuple[int, int], ...] = drawn_by(_ranges, longer=True)
    height_m: float = between(0.17, 0.21)
    width: float = between(0.54, 0.66)
    thickness: float = between(0.16, 0.20)
    spacing: float = between(0.68, 0.74)
    visible: int = one_of(2, 3)  # dominoes before the hand-off
    gap_after: int = drawn_by(_gap_after)  # dominoes of the second row before its gap: the hidden element
    starter_speed_m_s: float = between(0.50, 0.70)
    plank_colour: str = one_of("wood", "grey", "black")
    azimuth_deg: float = facing(-14, 14)
    elevation_deg: float = between(-38, -28)

    @property
    def size(self) -> Size:
        """Size of each domino."""
        return Size(self.height_m, self.width, self.thickness, self.spacing)

    @property
    def second(self) -> list[str]:
        """Bodies of the second row, from the hand-off on."""
        return [f"second_{i}" for i in range(self.ranges[-1][1])]


def build(p: Params, physics: Physics) -> Scene:
    """Build both rows on a plank, a ball before each, posts that stop the second ball."""
    course = Course(physics, p.direction)
    places = [i if i < p.gap_after else i + 1 for i in range(len(p.second))]
    along = dominoes.add_rows(
        course,
        p.size,
        first=[p.first_colour] * p.visible,
        second=[Domino(name, place, p.second_colour) for name, place in zip(p.second, places, strict=True)],
        places=len(p.second),
        ball_colour=p.ball_colour,
        plank_colour=p.plank_colour,
        speed_m_s=p.starter_speed_m_s,
    )
    back = p.width / 2 + 0.65
    row = len(p.second) * p.size.spacing  # the gap may be anywhere in it
    middle = along[1] - p.height_m * (dominoes.RUN_OUT + row / 2)
    course.mark("domino", (middle, p.height_m * p.width / 2), p.second_colour)
    return course.scene(
        p,
        decisive=p.second,
        hidden=p.second,
        cover=dominoes.cover(course, p.size, along, back),
        in_view=[dominoes.in_view(course, p.size, along, back)],
        things=[f"{p.first_colour} domino", f"{p.second_colour} domino", f"{p.ball_colour} ball", "plank"],
        also=["post", "row"],
        colours=["grey"],
        shown_by={"row": ["domino"]},
    )


def twins(p: Params) -> list[Params]:
    """Return other worlds behind the same void: the gap stands where another count is right."""
    right, places = range_of(p.ranges, p.gap_after), range(1, len(p.second) + 1)
    return [replace(p, gap_after=n) for n in places if range_of(p.ranges, n) != right]


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the choice for the number of low tops, once the second row is still."""
    tops = np.stack([top_m(motion, body, p.height_m) for body in p.second], axis=1) - dominoes.PLANK * p.height_m
    n_fallen = (tops < FALLEN * p.height_m).sum(axis=1)
    rest_frame = still_from(*(motion.pos(body) for body in p.second), within_m=dominoes.STILL_M)
    labels = [range_of(p.ranges, int(n)) if i >= rest_frame else None for i, n in enumerate(n_fallen)]
    return Reading(labels, float(np.abs(tops[-1] - FALLEN * p.height_m).min()))


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Count the second row's dominoes that no longer stand in their initial places."""
    colour = slots["second"]
    mask_before, close, mask_after = (colour_mask(frames[i], colour) for i in (0, -3, -1))
    dominoes = blobs(mask_before, min_area=60)
    ranges = _choices(slots, len(dominoes))
    if (
        ranges is None
        or mask_after.sum() < 0.3 * mask_before.sum()
        or (mask_after != close).sum() > 0.1 * mask_after.sum()
    ):
        return None
    return range_of(ranges, sum(not is_upper_half_in_place(frames, colour, domino) for domino in dominoes))


def foresee(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Count the second row's dominoes that are out of place or about to be struck."""
    dominoes, change = blobs(colour_mask(frames[0], slots["second"]), min_area=60), motion_mask(frames)
    ranges = _choices(slots, len(dominoes))
    if ranges is None:
        return None
    is_falling = [
        not is_upper_half_in_place(frames, slots["second"], domino)
        or change[surrounding_slices(domino, 0.0)].mean() > GIVES
        for domino in dominoes
    ]
    return range_of(ranges, sum(is_falling))


def look(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Count fallen dominoes: the choices' largest number less those that still stand."""
    close, mask_after = (colour_mask(frames[i], slots["second"]) for i in (-3, -1))
    if "choices" not in slots or not mask_after.any() or (mask_after != close).sum() > 0.1 * mask_after.sum():
        return None
    ranges = [[int(n) for n in choice.split("-")] for choice in choices_in(slots["choices"])]
    n_standing = sum(domino.box[3] > UPRIGHT * domino.box[2] for domino in blobs(mask_after, min_area=60))
    return range_of(ranges, ranges[-1][1] - n_standing)


def _choices(slots: Mapping[str, str], dominoes_seen: int) -> Sequence[Sequence[int]] | None:
    """Return the offered ranges; with a count, None if they do not span that row."""
    if "choices" in slots:
        offered: Sequence[Sequence[int]] = [
            [int(n) for n in choice.split("-")] for choice in choices_in(slots["choices"])
        ]
        return offered if offered[-1][1] == dominoes_seen else None
    return next((ranges for ranges in RANGES if ranges[-1][1] == dominoes_seen), None)


FAMILY = scene_family(
    "domino_count",
    category="dominoes",
    params=Params,
    build=build,
    outcome=outcome,
    question=how_many(
        "How many of the {second} dominoes of the second row fall over, {choices}?",
        "How many {second} dominoes are knocked down in the end: {choices}?",
        "Count the {second} dominoes that have fallen at the end: are they {choices}?",
        ranges=lambda p: p.ranges,
    ),
    asides=[
        either("How many {first} dominoes are there, 2 or 3?", ("2", "3"), lambda p: str(p.visible)),
        comes_from("Does the ball start to the left or to the right of the {first} dominoes?"),
        colour_of(
            "first",
            "Which colour are the dominoes that the rolling ball strikes: {choices}?",
            ("first", "second", "ball"),
        ),
    ],
    observe=observe,
    foresee=foresee,
    look=look,
    physics=Physics(timestep_s=0.001, tolerance=0.0),  # a solver that stops early makes rounding visible in the twin
    min_margin_m=0.03,
    twins=twins,
)
