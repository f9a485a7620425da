"""Build two rows of dominoes; the second never pushes back on the first.

A rolling ball sets off the first row, which is in view. Its last domino only kicks a second ball, which is behind the
occluder from the start and which two posts stop after it has struck the second row. Lengths are in domino heights
unless a name ends in `_m`; they run along the way from the first domino on.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from traps_pipeline.scenes.parts.course import SHADOW_RIGHT, Course, Span
from traps_pipeline.scenes.physics.kit import Box

PLANK = 0.07  # thickness of the plank that everything stands on
BALL = 0.40  # radius of both balls
BALL_AT = 0.55 + BALL  # centre of the kicked ball, from the front face of the last visible domino
POSTS_AT = 1.75  # near face of the posts, from there as well: the stopped ball is past that domino's reach
RUN_UP = 2.3  # plank before the first domino
RUN_OUT = 1.15  # plank behind the second row
STILL_M = 0.002  # a domino that moves less than this any more is at rest


@dataclass(frozen=True)
class Size:
    """The size of a domino: height in metres, the rest, and the row's spacing, in heights."""

    height_m: float
    width: float
    thickness: float
    spacing: float


@dataclass(frozen=True)
class Domino:
    """A domino of the second row. place: in spacings; aside: it lies flat behind."""

    name: str
    place: int
    colour: str
    aside: bool = False


def add_rows(
    course: Course,
    size: Size,
    *,
    first: Sequence[str],
    second: Sequence[Domino],
    places: int,
    ball_colour: str,
    plank_colour: str,
    speed_m_s: float,
) -> Span:
    """Add plank, balls, both rows and posts; return the covered part's span (m).

    first: the colours of the first row, whose bodies are `domino_0` and so on. places: how many spacings the second row
    is long. speed_m_s: speed of the first ball.
    """
    h = size.height_m
    last = (len(first) - 1) * size.spacing
    face = last + size.thickness / 2
    second_at = last + (POSTS_AT + 0.09 + size.thickness)  # in this order: records depend on the last bit
    end = second_at + places * size.spacing + RUN_OUT

    half_plank = (h * (end + RUN_UP) / 2, (size.width / 2 + 0.06) * h, PLANK * h / 2)
    course.slab("plank", (h * (end - RUN_UP) / 2, 0, PLANK * h / 2), half_plank, plank_colour)
    for name, along, speed in (("starter", -1.8, speed_m_s), ("kicked", face + BALL_AT, 0.0)):
        at = (h * along, 0, (PLANK + BALL) * h)
        # The plank grips the ball; a domino slides over it and squeezes it out.
        course.ball(name, at, BALL * h, ball_colour, speed=speed, rolling=0.0004, sliding=0.1, density=300)
    for i, colour in enumerate(first):
        add_domino(course, size, Domino(f"domino_{i}", i, colour), 0.0)
    for domino in second:
        add_domino(course, size, domino, second_at)
    for side in (-1, 1):
        y = side * h * (0.8 * BALL + 0.06)  # closer together than the ball is wide: it leans through, and stops
        post = (h * (face + POSTS_AT + 0.03), y, 0.5 * h)
        course.slab(f"post_{side}", post, (0.03 * h, 0.06 * h, 0.5 * h), "grey")
    return h * (face + BALL_AT - BALL - 0.03), h * end


def add_domino(course: Course, size: Size, domino: Domino, row_at: float) -> None:
    """Add a free domino, body and geom of its name, to a row that begins at `row_at`."""
    h = size.height_m
    x = (row_at + domino.place * size.spacing) * h
    at = (x, h * (size.width + 0.10), size.thickness * h / 2) if domino.aside else (x, 0.0, (PLANK + 0.5) * h)
    half_size = (size.thickness * h / 2, size.width * h / 2, h / 2)
    body = course.free_box(domino.name, at, half_size, domino.colour, density=500, sliding=0.2, solref=(0.006, 1))
    if domino.aside:
        body.quat = [0.5**0.5, 0, 0.5**0.5, 0]


def cover(course: Course, size: Size, along: Span, back: float) -> Box:
    """Return the box that the occluder must hide, `back` heights deep, with shadows."""
    h = size.height_m
    across = (-h * (size.width / 2 + 0.10), h * back)
    return course.box(along, across, (0, (PLANK + 1.04) * h), right=course.ahead(SHADOW_RIGHT * h))


def in_view(course: Course, size: Size, along: Span, back: float) -> Box:
    """Return the box of the part behind the occluder that the camera must have in frame."""
    h = size.height_m
    return course.box(along, (-h * (size.width / 2 + 0.10), h * back), (0, (PLANK + 1.0) * h))
