"""Dice tumble down steps into a tray: which colour is on top of the first one?

Control: until the dice lie still. Void: the clip ends while they tumble. Edges hitting steps magnify differences that
no pixel shows; gravity is low, which nothing in view betrays, so that many tumbles come after a cut at one second.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from traps_pipeline.scenes.parts.course import Course
from traps_pipeline.scenes.parts.family import scene_family
from traps_pipeline.scenes.parts.questions import either, goes_to, which_colour
from traps_pipeline.scenes.parts.readings import Reading, undecided
from traps_pipeline.scenes.parts.vary import Drawn, between, chance, drawn_by, in_front, one_of, shuffled
from traps_pipeline.scenes.parts.vision import blobs, colour_mask
from traps_pipeline.scenes.physics.kit import AnswerableQuestion, Motion, Physics, Scene, add_box, uniform

FACES = ("red", "green", "blue", "cyan", "orange", "yellow")
EDGES = ("white", "black", "purple")  # nothing else in the scene has them
EDGE = shuffled(*EDGES)
NORMALS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))  # in the order of `faces`
WALL_M = 0.02
TRAY_M = 0.05  # height of the tray's floor
FLAT_RAD = math.radians(8)  # a die that leans more lies on no face
LEGIBLE_PIXELS = 200.0
LEAD_S = 0.2  # a closer finish could fall between two sampled frames
PLATE = 0.78  # of a face: the rest is its edge, by which a viewer tells the dice apart
GLASS, GLASS_EDGE_M = (0.50, 0.72, 0.86, 1.0), 0.006
DARK_WOOD = (0.50, 0.35, 0.22, 1.0)
STILL = 0.1  # share of its size by which a lying die may move from one frame to the next


def _direction(rng: np.random.Generator, so_far: Drawn) -> int:
    """Draw the direction, and before it the number of dice."""
    so_far["dice"] = int(rng.choice([2, 3, 3]))
    return int(rng.choice([-1, 1]))


def _width(rng: np.random.Generator, so_far: Drawn) -> float:
    """Return the width, with room for a turning die beside each wall."""
    return round(max(0.46, (2.5 * so_far["dice"] + 1.4) * so_far["half_m"]), 4)


def _turns(rng: np.random.Generator, so_far: Drawn) -> tuple[tuple[float, ...], ...]:
    """Draw the dice's turns, and before them which dice of the zigzag are ahead."""
    so_far["ahead"] = int(rng.integers(2))
    turns = rng.normal(size=(so_far["dice"], 4))
    return tuple(tuple(round(float(v), 5) for v in q / np.linalg.norm(q)) for q in turns)


def _starts(rng: np.random.Generator, so_far: Drawn) -> tuple[tuple[float, ...], ...]:
    """Draw the starts in a zigzag, so that dice do not touch before they land."""
    dice, half_edge, ahead = so_far["dice"], so_far["half_m"], so_far["ahead"]
    lanes = [(i - (dice - 1) / 2) * 2.5 * half_edge for i in range(dice)]
    return tuple(
        (uniform(rng, 0.13, 0.17) + 0.24 * ((i + ahead) % 2), round(y, 4), uniform(rng, 0.22, 0.34))
        for i, y in enumerate(lanes)
    )


def _per_die(*ranges: tuple[float, float]) -> tuple[tuple[float, ...], ...]:
    """Return a field with a number of each range for every die."""
    return drawn_by(
        lambda rng, so_far: tuple(tuple(uniform(rng, *ends) for ends in ranges) for _ in range(so_far["dice"]))
    )


def _faces(rng: np.random.Generator, so_far: Drawn) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(str(c) for c in rng.permutation(FACES)) for _ in range(so_far["dice"]))


@dataclass(frozen=True)
class Params:
    """Parameters; a die has start, turn, throw, and faces on +x, -x, +y, -y, +z, -z."""

    direction: int = drawn_by(_direction)  # +1: the steps go down to the right
    half_m: float = between(0.060, 0.068)  # half a die's edge
    steps: int = one_of(4, 5, 6, 7)
    step_m: float = drawn_by(lambda rng, so_far: round(uniform(rng, 1.35, 1.65) / so_far["steps"], 4))  # its length
    width_m: float = drawn_by(_width)  # of the steps, between the walls
    turns: tuple[tuple[float, ...], ...] = drawn_by(_turns)  # unit quaternions
    drop_m: float = drawn_by(lambda rng, so_far: round(uniform(rng, 0.55, 0.80) / so_far["steps"], 4))  # of a step
    tray_m: float = between(0.60, 0.75)
    faces: tuple[tuple[str, ...], ...] = drawn_by(_faces)
    starts_m: tuple[tuple[float, ...], ...] = drawn_by(_starts)  # along the steps, across, above the top step
    speeds_m_s: tuple[tuple[float, ...], ...] = _per_die((0.55, 0.85), (-0.06, 0.06), (1.2, 1.6))
    spins_rad_s: tuple[tuple[float, ...], ...] = _per_die((-7, 7), (-7, 7), (-7, 7))
    bounce: float = between(14, 26)  # damping of the contact: the lower, the livelier
    edge_colours: tuple[str, ...] = EDGE("dice")  # one per die, so that each can be followed
    dark_first: bool = chance(0.5)  # dark and light wood in turn, down the steps
    azimuth_deg: float = in_front(-15, 15)
    elevation_deg: float = between(-58, -46)

    @property
    def run_m(self) -> float:
        """Position at which the steps end and the tray begins."""
        return self.steps * self.step_m

    def floor_m(self, step: int) -> float:
        """Return the height of a step; the tray is one after the last."""
        return TRAY_M + (self.steps - step) * self.drop_m


def build(p: Params, physics: Physics) -> Scene:
    """Build steps and tray between two walls; lengths run down the steps."""
    course = Course(physics, p.direction)
    # The edges keep their colour in shade.
    course.spec.add_material(name="bright", emission=0.5, specular=0.0, shininess=0.0)
    half_width, end, high = p.width_m / 2, p.run_m + p.tray_m, p.floor_m(0)
    front, back = (-half_width - WALL_M, -half_width), (half_width, half_width + WALL_M)
    treads = [(i * p.step_m, (i + 1) * p.step_m) for i in range(p.steps)]

    for i, along in enumerate(treads):
        step = course.block(f"step_{i}", along, (-half_width, half_width), (0, p.floor_m(i)), "wood")
        if i % 2 != p.dark_first:
            step.rgba = DARK_WOOD
    course.block("tray", (p.run_m, end), (-half_width, half_width), (0, TRAY_M), "grey")
    rim = TRAY_M + 1.6 * p.half_m  # low, so that it hides and shades no die; glass stands on it
    course.block("tray_end", (end, end + WALL_M), (-half_width, half_width), (0, rim), "wood")
    course.block("tray_front", (p.run_m, end + WALL_M), front, (0, rim), "wood")
    course.block("wall_back", (-WALL_M, end + WALL_M), back, (0, high + 2 * p.half_m), "wood")
    for i, along in enumerate(treads):  # a low front wall that follows the steps, so that it hides nothing
        course.block(f"front_{i}", along, front, (0, p.floor_m(i) + 0.5 * p.half_m), "wood")
    full_width = (-WALL_M, end + WALL_M)
    panes = {"front": (full_width, front), "back": (full_width, back)}
    panes |= {"top": ((-WALL_M, 0), (-half_width, half_width)), "end": ((end, end + WALL_M), (-half_width, half_width))}
    for name, (along, across) in panes.items():
        glass = course.block(f"fence_{name}", along, across, (0, high + 1.0), "white")
        glass.rgba = [1, 1, 1, 0]  # nothing leaves the steps; a drawn pane would tint the faces: its edges are drawn
    _add_glass_edges(course, (0, end), half_width, (TRAY_M, high + 1.0))
    for i in range(len(p.faces)):
        _add_die(course, p, i)
    dice = [f"die_{i}" for i in range(len(p.faces))]
    scene = course.scene(
        p,
        decisive=dice,
        in_view=[course.box(full_width, (front[0], back[1]), (0, TRAY_M))],
        also=["die", "step", "tray", "wall", "face"],
        colours=sorted({*FACES, *p.edge_colours, "grey", "wood"}),
    )
    throws = [(p.direction * along, across, up) for along, across, up in p.speeds_m_s]
    velocity = {d: (*v, *w) for d, v, w in zip(dice, throws, p.spins_rad_s, strict=True)}
    return replace(scene, velocity=velocity, rest=course.box((p.run_m, end), (-half_width, half_width), (0, rim)))


def _add_glass_edges(course: Course, along: tuple[float, float], side: float, up: tuple[float, float]) -> None:
    """Add the edges of the glass box: four upright ones, and the rails around it."""
    bars = [((x, y, up[0]), (x, y, up[1])) for x in along for y in (-side, side)]
    bars += [((along[0], y, up[1]), (along[1], y, up[1])) for y in (-side, side)]
    bars += [((x, -side, up[1]), (x, side, up[1])) for x in along]
    for i, (a, b) in enumerate(bars):
        course.rod(f"glass_{i}", a, b, GLASS_EDGE_M, "white", solid=False).rgba = GLASS


def _add_die(course: Course, p: Params, i: int) -> None:
    """Add a cube in the edge colour with a thin plate, only drawn, on every face."""
    (along, across, height), h, edge = p.starts_m[i], p.half_m, p.edge_colours[i]
    body = course.free_box(f"die_{i}", (along, across, p.floor_m(0) + height), (h, h, h), edge, density=600.0)
    body.quat, cube = list(p.turns[i]), body.first_geom()
    if edge != "black":
        cube.material = "bright"
    cube.friction, cube.solref, cube.priority, cube.condim = [0.5, 0.003, 0.0001], [-6000.0, -p.bounce], 1, 4
    for colour, normal in zip(p.faces[i], NORMALS, strict=True):
        half_size = [0.0015 if n else PLATE * h for n in normal]
        add_box(body, f"die_{i}_{colour}", [h * n for n in normal], half_size, colour, contype=0, conaffinity=0, mass=0)


def _short_of_tray(motion: Motion, p: Params) -> tuple[np.ndarray, np.ndarray]:
    """Return how far (m) each die is before the tray and above it, (F, dice)."""
    places = np.stack([motion.pos(f"die_{i}") for i in range(len(p.faces))], axis=1)
    return p.run_m - p.direction * places[..., 0], places[..., 2] - TRAY_M - 2.1 * p.half_m


def _first_die(motion: Motion, p: Params) -> tuple[int, int] | None:
    """Return the first die in the tray and its frame, if it is first by two rules.

    By the look of it, a die may reach the tray when it is past the steps or when it lands.
    """
    along, height = _short_of_tray(motion, p)
    first_arrivals = [
        _first_arrival(has_reached, motion.times) for has_reached in (along <= 0, np.maximum(along, height) <= 0)
    ]
    return (
        first_arrivals[1]
        if first_arrivals[0] and first_arrivals[1] and first_arrivals[0][0] == first_arrivals[1][0]
        else None
    )


def _first_arrival(has_reached: np.ndarray, times: np.ndarray) -> tuple[int, int] | None:
    """Return the first die (column) to reach something, and the frame; None if close."""
    arrival_times = np.where(has_reached.any(axis=0), times[has_reached.argmax(axis=0)], math.inf)
    first, second = np.sort(arrival_times)[:2]
    if math.isinf(first) or second - first < LEAD_S - 1e-9:
        return None
    die = int(arrival_times.argmin())
    return die, int(has_reached[:, die].argmax())


def _lean(motion: Motion, die: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the uppermost face's index and its angle to the horizontal (rad), (F,)."""
    heights = motion.rot(f"die_{die}").swapaxes(1, 2) @ np.array([0, 0, 1.0])
    faces = np.stack([heights, -heights], axis=2).reshape(len(heights), 6)
    return faces.argmax(axis=1), np.arccos(np.clip(faces.max(axis=1), -1, 1))


def outcome(motion: Motion, p: Params) -> Reading:
    """Read the upper colour of the first die in the tray, while it lies still.

    The margin is the smaller of two distances: how far the next die was from the tray when the first came, and how much
    an edge of the lying die would have to rise for another face to come up.
    """
    first = _first_die(motion, p)
    if first is None:
        return Reading(undecided(motion), 0.0)
    die, arrival = first
    top, lean_angle = _lean(motion, die)
    steps = np.linalg.norm(np.diff(motion.pos(f"die_{die}"), axis=0, prepend=math.inf), axis=1)
    is_lying = (lean_angle < FLAT_RAD) & (steps < STILL * 2 * p.half_m) & (np.arange(len(top)) > arrival)
    lead_m = np.min(np.delete(np.maximum(*_short_of_tray(motion, p))[arrival], die))
    rise = 2 * p.half_m * math.sin(max(0.0, math.pi / 4 - lean_angle[-1]))
    labels = [p.faces[die][face] if does_lie else None for face, does_lie in zip(top, is_lying, strict=True)]
    return Reading(labels, float(min(lead_m, rise)), _in_order(motion, p, die))


def _in_order(motion: Motion, p: Params, die: int) -> tuple[int, int]:
    """Return the frames from which the first die, and another, are past the steps."""
    is_past = _short_of_tray(motion, p)[0] <= 0
    is_other_past: np.ndarray = np.delete(is_past, die, axis=1).max(axis=1)
    return int(is_past[:, die].argmax()), int(is_other_past.argmax()) if is_other_past.any() else len(is_past)


def legible(motion: Motion, p: Params) -> list[tuple[tuple[str, ...], float]]:
    """Return the face that lies on top of the first die in the tray."""
    first = _first_die(motion, p)
    if first is None:
        return []
    die = first[0]
    return [((f"die_{die}_{p.faces[die][_lean(motion, die)[0][-1]]}",), LEGIBLE_PIXELS)]


def _edges(p: Params, rng: np.random.Generator) -> AnswerableQuestion:
    edge = str(rng.choice(EDGES))
    question = f"Does one of the dice have {edge} edges, yes or no?"
    return AnswerableQuestion(question, ("yes", "no"), "yes" if edge in p.edge_colours else "no")


# --- what one sees ----------------------------------------------------------------------------------------------------

NEAR_PX = 3.5  # of the place where a die lies
LAST_STEP_PX = 5.0  # between two sampled frames, when a die slides to rest


@dataclass(frozen=True)
class _Sight:
    """A die in one frame (pixels): the middle, size and mask of its outline."""

    x: float
    y: float
    size: float
    outline: np.ndarray


def observe(frames: np.ndarray, slots: Mapping[str, str]) -> str | None:
    """Read the upper face of the first die past the steps, once it has slid to a stop."""
    paths = {colour: [_sight(frame, colour) for frame in frames] for colour in EDGES}
    dice = [path for path in paths.values() if sum(sight is not None for sight in path) >= len(frames) / 2]
    path = _first_past_edge(_tray_edge(frames), dice)
    if path is None or not _has_come_to_rest(frames, path):
        return None
    tops = {_upper_face(frame, sight) for frame, sight in zip(frames[-3:], path[-3:], strict=True) if sight is not None}
    return tops.pop() if len(tops) == 1 else None


def _sight(frame: np.ndarray, edge: str) -> _Sight | None:
    """Return the die with edges of a colour, whose outline holds much vivid face."""
    high, low = frame.max(axis=2).astype(int), frame.min(axis=2)
    is_vivid = (high - low > 0.68 * high) & (high > 60)
    if edge == "white":
        mask = (low > 220) & (high - low < 30)
    else:
        mask = high < 52 if edge == "black" else colour_mask(frame, edge)
    count, names = cv2.connectedComponents(cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)))
    sizes = np.bincount(names[mask], minlength=count)
    for region in np.argsort(-sizes)[:5]:
        hull = cv2.convexHull(cv2.findNonZero((names == region).astype(np.uint8)))
        outline = cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), hull, 1) > 0
        if sizes[region] >= 40 and outline.sum() < 2500 and is_vivid[outline].mean() > 0.25:
            y, x = np.nonzero(outline)
            return _Sight(float(x.mean()), float(y.mean()), math.sqrt(len(x)), outline)
    return None


def _tray_edge(frames: np.ndarray) -> tuple[int, float, float] | None:
    """Return the steps' end, x = slope y + offset, and the tray's side (+1: right)."""
    median_frame = np.median(frames, axis=0).astype(np.uint8)
    shade = median_frame.mean(axis=2)
    grey = (np.ptp(median_frame, axis=2) < 22) & (shade > 125) & (shade < 185)
    wooden = colour_mask(median_frame, "wood").astype(np.uint8)
    wood = np.nonzero(wooden)[1]
    wood_points = cv2.findNonZero(cv2.morphologyEx(wooden, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8)))
    if wood_points is None:
        return None
    hull = cv2.convexHull(wood_points)
    grey &= cv2.fillConvexPoly(np.zeros(grey.shape, np.uint8), hull, 1) > 0  # a floor may be grey as well
    tray = next(iter(blobs(grey, 400)), None)
    if tray is None:
        return None
    side = 1 if tray.x > wood.mean() else -1
    left, top, width, height = tray.box
    rows = [y for y in range(top + height // 5, top + 4 * height // 5) if grey[y, left : left + width].any()]
    edge = np.array([left + np.flatnonzero(grey[y, left : left + width])[0 if side > 0 else -1] for y in rows])
    if len(rows) < 5:
        return None
    slope, offset = np.polyfit(rows, edge, 1)
    is_near = np.abs(edge - slope * np.array(rows) - offset) < 6
    if is_near.sum() < 5:
        return None
    slope, offset = np.polyfit(np.array(rows)[is_near], edge[is_near], 1)
    return side, float(slope), float(offset)


def _first_past_edge(
    edge: tuple[int, float, float] | None, dice: Sequence[Sequence[_Sight | None]]
) -> Sequence[_Sight | None] | None:
    """Return the path of the die that is first, or farther, past the edge."""
    if edge is None or not dice:
        return None
    side, slope, offset = edge
    for sights in zip(*dice, strict=True):
        is_past = [
            -math.inf if s is None else side * (s.x - slope * (s.y + 0.3 * s.size) - offset)  # where it stands
            for s in sights
        ]
        if max(is_past) > 0:
            return dice[int(np.argmax(is_past))]
    return None


def _has_come_to_rest(frames: np.ndarray, path: Sequence[_Sight | None]) -> bool:
    """Return whether a die lies still by itself; a frozen clip stops all at once."""
    places = np.array([(math.nan, math.nan) if sight is None else (sight.x, sight.y) for sight in path])
    is_lying = np.linalg.norm(places - np.median(places[-3:], axis=0), axis=1) <= NEAR_PX
    if is_lying.all() or not is_lying[-3:].all():
        return False
    rest_frame = int(np.flatnonzero(~is_lying)[-1]) + 1
    changes = np.abs(np.diff(frames[rest_frame:].astype(np.int16), axis=0)).max(axis=3) > 40
    if (changes.sum(axis=(1, 2)) > 60).sum() >= 2:
        return True
    steps = np.linalg.norm(np.diff(places[max(rest_frame - 2, 0) : rest_frame + 1], axis=0), axis=1)
    return bool(steps[-1] <= LAST_STEP_PX and steps[0] <= 2 * LAST_STEP_PX)


def _upper_face(frame: np.ndarray, die: _Sight) -> str | None:
    """Return the colour of the upper face, the highest in the picture."""
    faces = {colour: blobs(colour_mask(frame, colour) & die.outline, 60) for colour in FACES}
    heights = {colour: blobs_of_face[0].y for colour, blobs_of_face in faces.items() if blobs_of_face}
    return min(heights, key=lambda colour: heights[colour], default=None)


FAMILY = scene_family(
    "tumbling_dice",
    category="tumbling_dice",
    params=Params,
    build=build,
    outcome=outcome,
    question=which_colour(
        "Which colour is on top of the first die to reach the tray, once it lies still: {choices}?",
        "The first die to land in the tray comes to rest with which colour facing up: {choices}?",
        "Which colour face is up when the first die to reach the tray has stopped: {choices}?",
        colours=lambda p: FACES,
        forms=("{} face", "{} side", "{} on top", "{} face up"),
        also={"teal": "cyan", "turquoise": "cyan", "aqua": "cyan", "light blue": "cyan", "dark blue": "blue"},
    ),
    asides=[
        either("How many dice are there, 2 or 3?", ("2", "3"), lambda p: str(len(p.faces))),
        goes_to("Do the steps go down to the left or to the right?"),
        _edges,
    ],
    observe=observe,
    legible=legible,
    physics=Physics(timestep_s=0.001, gravity_m_s2=4.4),
    min_margin_m=0.03,
    perturbation=1e-6,
    looks=("bystanders", "floor", "light", "material", "panel"),
)
