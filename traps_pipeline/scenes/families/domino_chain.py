"""A row of dominoes is set off by a rolling ball: does the last one fall?

Control: the whole row is in view. Void: the occluder stands before its second part.
Hidden element: one domino of the second part, which stands in the row or lies beside it and leaves a gap.
The last visible domino only kicks a ball that is behind the occluder from the start and that two posts stop after it
has struck the second part: nothing that the gap changes can push back on what is seen.
"""

from dataclasses import dataclass

import numpy as np

from traps_pipeline.scenes.parts import dominoes
from traps_pipeline.scenes.parts.course import Course
from traps_pipeline.scenes.parts.dominoes import Domino, Size
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.observers import has_begun, has_fallen, lies_flat
from traps_pipeline.scenes.parts.questions import colour_of, comes_from, yes_no
from traps_pipeline.scenes.parts.readings import Reading, still_from, top_m, yes_while
from traps_pipeline.scenes.parts.vary import Drawn, apart, between, drawn_by, facing, hidden, one_of
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene

PLAY_COLOURS = apart("red", "green", "blue", "yellow", "orange", "cyan", "purple")


def _plank_colour(rng: np.random.Generator, so_far: Drawn) -> str:
    """Draw a colour; never wood beside orange, which it looks like."""
    return str(rng.choice(["grey", "black"] if "orange" in so_far.values() else ["wood", "grey", "black"]))


@dataclass(frozen=True)
class Params:
    """Parameters; unsuffixed lengths in domino heights; direction +1 is right."""

    direction: int = one_of(-1, 1)
    concealed: int = one_of(3, 4, longer=(5, 6))  # dominoes after the hand-off, the last one included
    first_colour: str = PLAY_COLOURS()
    row_colour: str = PLAY_COLOURS()
    last_colour: str = PLAY_COLOURS()
    ball_colour: str = PLAY_COLOURS()
    height_m: float = between(0.17, 0.21)
    width: float = between(0.54, 0.66)
    thickness: float = between(0.16, 0.20)
    spacing: float = between(0.68, 0.74)
    visible: int = one_of(3, 4, longer=(5, 6))  # dominoes before the hand-off
    gap_index: int = drawn_by(lambda rng, so_far: int(rng.integers(1, so_far["concealed"] - 1)))  # what is hidden
    gap_open: bool = hidden(False, True)  # whether that domino lies beside the row
    starter_speed_m_s: float = between(0.50, 0.70)
    plank_colour: str = drawn_by(_plank_colour)
    azimuth_deg: float = facing(-32, 18)
    elevation_deg: float = between(-36, -24)

    @property
    def size(self) -> Size:
        """Size of each domino."""
        return Size(self.height_m, self.width, self.thickness, self.spacing)

    @property
    def second(self) -> list[str]:
        """Bodies of the concealed dominoes."""
        return [f"concealed_{i}" for i in range(self.concealed - 1)] + ["last"]


def build(p: Params, physics: Physics) -> Scene:
    """Build both parts of the row, a ball before each, and posts that stop the second."""
    course = Course(physics, p.direction)
    colours = [p.row_colour] * (p.concealed - 1) + [p.last_colour]
    second = [
        Domino(name, i, colour, aside=p.gap_open and i == p.gap_index)
        for i, (name, colour) in enumerate(zip(p.second, colours, strict=True))
    ]
    along = dominoes.add_rows(
        course,
        p.size,
        first=[p.first_colour] + [p.row_colour] * (p.visible - 1),
        second=second,
        places=p.concealed - 1,
        ball_colour=p.ball_colour,
        plank_colour=p.plank_colour,
        speed_m_s=p.starter_speed_m_s,
    )
    back = 1.5 * p.width + 0.20
    course.mark("domino", "last")
    return course.scene(
        p,
        decisive=["last"],
        hidden=[p.second[p.gap_index]],
        cover=dominoes.cover(course, p.size, along, back),
        in_view=[dominoes.in_view(course, p.size, along, back)],
        things=[f"{p.first_colour} domino", f"{p.last_colour} domino", f"{p.ball_colour} ball", "plank"],
        also=["post"],
        colours=["grey"],
    )


def outcome(motion: Motion, p: Params) -> Reading:
    """Read whether the last domino's top is low; 'no' only once the others are still."""
    top = top_m(motion, "last", p.height_m, dominoes.PLANK * p.height_m)
    rest_frame = still_from(*(motion.pos(body) for body in p.second), within_m=dominoes.STILL_M)
    return Reading(yes_while(top < p.height_m / 2, rest_frame), float(abs(top[-1] - p.height_m / 2)))


FAMILY = scene_family(
    "domino_chain",
    category="dominoes",
    params=Params,
    build=build,
    outcome=outcome,
    question=yes_no(
        "Does the {last} domino at the end of the row fall over, yes or no?",
        "Does the last domino, the {last} one, get knocked over: yes or no?",
        "Is the {last} domino at the far end of the row knocked down in the end, yes or no?",
        yes=["yes it falls", "it falls", "it falls over", "falls"],
        no=["no it does not fall", "it does not fall", "it stays standing", "stays upright"],
    ),
    asides=[
        comes_from("From which side does the ball roll towards the first domino, left or right?"),
        colour_of(
            "first", "What colour is the domino that the ball strikes first: {choices}?", ("first", "row", "ball")
        ),
        colour_of("ball", "What colour is the ball that rolls into the dominoes: {choices}?", ("first", "row", "ball")),
    ],
    observe=has_fallen("last"),
    foresee=has_begun("last", reach=0.25),
    look=lies_flat("last"),
    physics=Physics(timestep_s=0.001, tolerance=0.0),  # a solver that stops early makes rounding visible in the twin
    min_margin_m=0.03,
)
