"""Make scenes harder to follow: distractors, faster events, longer rows.

The settings belong to a draw (`traps benchmark sample`). Their values for one scene is stored with its parameters,
as `difficulty`, and its speed with its physics; a record without either is as scenes were before there were settings.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import numpy as np
from pydantic import ConfigDict, Field, StrictBool, TypeAdapter, ValidationError

from traps_pipeline.protocol.datasets import EXTENSION_CATEGORIES
from traps_pipeline.scenes.parts import vary
from traps_pipeline.scenes.physics.kit import LOOK_ALIKE, Family, Inventory, Scene, Wording, rgba

if TYPE_CHECKING:
    import mujoco

Shape = Literal["ball", "puck"]
Colour = Literal["red", "green", "blue", "yellow", "orange", "cyan", "purple"]
DISTRACTOR = "distractor_"  # begins the name of a distractor's body and geom
MAX_DISTRACTORS = 3
SPEEDS = (1.0, 1.5, 2.0)  # each a whole number of simulation steps from frame to frame
# The greatest speed of each family that takes one: most draws still show half a second of motion before the occluder
# and settle after 0.8 s or more. In other families the certificates `referents` or `cut` would be lost.
MAX_SPEEDS: Mapping[str, float] = {
    **dict.fromkeys(("balance", "behind_wall", "bounce", "chain", "domino_branch", "head_on", "hidden_collision"), 2.0),
    **dict.fromkeys(("hidden_drop", "launch", "lever_gate", "roll_stop", "spinner", "under_bridge"), 2.0),
    **dict.fromkeys(("pendulum", "slide", "stack", "topple", "tower", "transfer", "wedge_push"), 1.5),
}
RADIUS = 0.026, 0.030  # of a distractor, as a share of the scene's width
LANE = 2.4  # radii from lane to lane: each distractor has one of its own, so that they pass each other
PUCK_HALF = 0.45  # of its radius
MIN_DOWN_DEG = 8.0
WAY = (0.5, 0.9)  # share of the scene's width that a distractor crosses
BALL_COLOURS: dict[str, Colour] = {colour: colour for colour in get_args(Colour)}  # by their word


@dataclass(frozen=True)
class Difficulty:
    """The settings of difficulty with which scenarios are drawn.

    distractors: their number. speed: factor on the speed of all events. longer: rows, lanes and counts from the
    longer ranges of their family. window_s: for how long two events show a settled outcome, at least; of pairs nothing.
    """

    distractors: int = 0
    speed: float = 1.0
    longer: bool = False
    window_s: float = 1.0

    def settings(self) -> dict[str, Any]:
        """Return the settings that differ from the defaults."""
        return {name: value for name, value in asdict(self).items() if value != getattr(DEFAULT_DIFFICULTY, name)}


DEFAULT_DIFFICULTY = Difficulty()


def unsupported_settings(family: Family, difficulty: Difficulty) -> list[str]:
    """Return the names of the settings that a family does not support.

    Distractors move, and the board that closes a chaotic control must hide all that moves.
    """
    is_supported = {
        "distractors": family.taxonomy == "occlusion" and family.category not in EXTENSION_CATEGORIES,
        "speed": difficulty.speed <= MAX_SPEEDS.get(family.name, 1.0),
        "longer": vary.can_be_longer(family.params),
        "window_s": False,
    }
    return [name for name in difficulty.settings() if not is_supported[name]]


_PLAUSIBLE = ConfigDict(extra="forbid", allow_inf_nan=False)
Metres = Annotated[float, Field(ge=-10, le=10)]


@dataclass(frozen=True)
class Distractor:
    """A body that crosses the floor before a scene and touches nothing.

    It starts at `place_m` (right, away) and moves to the right at `speed_m_s` of simulated time.
    """

    __pydantic_config__ = _PLAUSIBLE
    shape: Shape
    colour: Colour
    place_m: tuple[Metres, Metres]
    radius_m: Annotated[float, Field(ge=0.01, le=0.2)]
    speed_m_s: Metres


@dataclass(frozen=True)
class SceneDifficulty:
    """The values that a draw's settings take in one scene."""

    __pydantic_config__ = _PLAUSIBLE
    distractors: Annotated[tuple[Distractor, ...], Field(max_length=MAX_DISTRACTORS)] = ()
    longer: StrictBool = False

    @staticmethod
    def from_record(record: Mapping[str, Any]) -> SceneDifficulty:
        """Read the difficulty in a record's parameters. Raises ValueError for anything unknown or implausible."""
        try:
            return TypeAdapter(SceneDifficulty).validate_python(record)
        except ValidationError as error:
            first = error.errors()[0]
            raise ValueError(f"{'.'.join(map(str, ('difficulty', *first['loc'])))}: {first['msg']}") from None


def draw_distractors(
    rng: np.random.Generator, count: int, scene: Scene, points: np.ndarray, wording: Wording, p: Any, duration_s: float
) -> tuple[Distractor, ...]:
    """Return random distractors for a simulated scene: pucks and balls in turn.

    A puck has a named colour; a ball has a colour easily taken for a named one that no words of the scenario offer, and
    rolls the scene's way from its beginning, so that whatever is asked of "the ball" has one answer. They hide nothing:
    they are so far before the scene that the camera sees all of it over them, and so no shadow of it falls on them
    either. points: (N, 3), around what the camera must show or the occluder hides. duration_s: simulated time of a
    whole clip.
    """
    low, high, front = float(points[:, 0].min()), float(points[:, 0].max()), float(points[:, 1].min())
    hidden_depth = 2 / np.tan(np.radians(max(-scene.view.elevation_deg, MIN_DOWN_DEG)))  # so many radii behind a ball
    max_radius = RADIUS[1] * (high - low)
    texts = (wording.question, wording.answerable_question.question)
    words = {*re.findall(r"\w+", " ".join((*texts, *wording.answerable_question.labels, *wording.labels)).lower())}
    question_words = re.findall(r"\w+", wording.question)
    colour_words = dict.fromkeys((*question_words, *scene.inventory.colours))
    named_colours: list[Colour] = [BALL_COLOURS[word] for word in colour_words if word in BALL_COLOURS]
    taken_colours = words | {*scene.inventory.colours}
    things = list[Distractor]()
    for number, lane in enumerate(rng.permutation(count)):
        like = named_colours[(number // 2) % len(named_colours)]
        similar_colours = (
            [] if number % 2 == 0 else _like_and_free(like, taken_colours | {thing.colour for thing in things})
        )
        shape: Shape = "ball" if similar_colours else "puck"
        ahead = getattr(p, "direction", 0) if shape == "ball" else 0
        radius, direction = rng.uniform(*RADIUS) * (high - low), ahead or int(rng.choice([-1, 1]))
        path_share, start_share = rng.uniform(*WAY), 0.0 if ahead else rng.uniform(0.0, 1.0)
        room = high - low - 2 * radius
        start = start_share * (1 - path_share) * room
        x = low + radius + start if direction > 0 else high - radius - start
        y = front - max_radius * (1 + hidden_depth + LANE * int(lane))
        colour = similar_colours[int(rng.integers(len(similar_colours)))] if similar_colours else like
        speed = direction * path_share * room / duration_s
        things.append(Distractor(shape, colour, (round(x, 4), round(y, 4)), round(radius, 4), round(speed, 4)))
    return tuple(things)


def _like_and_free(colour: str, taken: Collection[str]) -> list[Colour]:
    """Return free colours that are easily taken for a colour, else all free ones."""
    free: list[Colour] = [other for word, other in BALL_COLOURS.items() if word not in taken]
    similar_colours: list[Colour] = [other for other in free if {colour, other} in LOOK_ALIKE]
    return similar_colours or free


def add_distractors(scene: Scene, p: Any) -> Scene:
    """Return a built scene with the distractors of its parameters.

    Each slides along its lane at a constant speed, whatever happens in the scene.
    """
    difficulty: SceneDifficulty | None = getattr(p, "difficulty", None)
    if difficulty is None or not difficulty.distractors:
        return scene
    velocity = dict(scene.velocity)
    for number, thing in enumerate(difficulty.distractors):
        name = f"{DISTRACTOR}{number}"
        _add(scene.spec, name, thing)
        velocity[name] = (thing.speed_m_s,)
    inventory = _with_things(scene.inventory, difficulty.distractors)
    return replace(scene, velocity=velocity, inventory=inventory)


def _add(spec: mujoco.MjSpec, name: str, thing: Distractor) -> None:
    import mujoco

    ball = thing.shape == "ball"
    half_height = thing.radius_m if ball else PUCK_HALF * thing.radius_m
    body = spec.worldbody.add_body(name=name, pos=[*thing.place_m, half_height])
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0])
    geom = body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_SPHERE if ball else mujoco.mjtGeom.mjGEOM_CYLINDER)
    geom.size, geom.rgba = [thing.radius_m, 0 if ball else half_height, 0], rgba(thing.colour)
    geom.contype = geom.conaffinity = 0


def _with_things(inventory: Inventory, things: Sequence[Distractor]) -> Inventory:
    colours = dict.fromkeys([*inventory.colours, *(thing.colour for thing in things)])
    nouns = dict.fromkeys([*inventory.objects, *(thing.shape for thing in things)])
    return replace(inventory, colours=tuple(colours), objects=tuple(nouns))
