"""Define the values that make a scene family, and builders that families share.

A family file defines one `FAMILY`, put together by `parts.family`. Its functions are pure: `draw` and `word` take the
generator they draw from, `build` and `outcome` draw nothing, so that a stored spec always gives the same scene.

Units are SI (metres, kilograms, seconds, radians unless a name ends in `_deg`). World frame: x right, y away from the
default camera, z up; the floor is z = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    import mujoco

Vec3 = tuple[float, float, float]
Taxonomy = Literal["occlusion", "chaotic"]
AnswerType = Literal["binary", "direction", "colour", "count_range", "numeric"]

# The six answer colours are saturated and far apart; navy is kept for the occluder alone.
COLOURS: Mapping[str, tuple[float, float, float]] = {
    "red": (0.86, 0.10, 0.12),
    "green": (0.08, 0.62, 0.20),
    "blue": (0.12, 0.35, 0.90),
    "yellow": (0.98, 0.82, 0.08),
    "orange": (0.98, 0.50, 0.05),
    "cyan": (0.05, 0.78, 0.85),
    "purple": (0.55, 0.20, 0.70),
    "white": (0.95, 0.95, 0.95),
    "black": (0.08, 0.08, 0.09),
    "grey": (0.55, 0.55, 0.57),
    "wood": (0.72, 0.52, 0.33),
    "navy": (0.07, 0.11, 0.28),
}

READER_KEY = "read"  # key of a parameter's metadata: how its stored value is read, where that is not as it stands
OCCLUDER_GROUP = 4  # geoms of the occluder: drawn in the void only, collide with nothing
COMING_GROUP = 2  # the board that comes before a scene, until it stands
FLOOR_GROUP = 3  # planes, while they are drawn
REMOVED_GROUP = 5  # geoms taken away by an ablation: never drawn


def rgba(colour: str) -> list[float]:
    """Return RGBA in [0, 1] of a named colour."""
    return [*COLOURS[colour], 1.0]


@dataclass(frozen=True)
class Physics:
    """Solver settings and clip timing (docs/engineering-notes.md, "Physics")."""

    timestep_s: float = 0.002
    duration_s: float = 5.0
    fps: int = 10
    gravity_m_s2: float = 9.81
    iterations: int = 100
    tolerance: float = 1e-10
    impratio: float = 10.0
    speed: float = 1.0  # simulated seconds in a second of the clip: k times as fast is a scene of 1/k2 the size

    @property
    def n_frames(self) -> int:
        """Frames of the control; frame i shows time i / fps, frame 0 the initial state."""
        return round(self.duration_s * self.fps)

    @property
    def substeps(self) -> int:
        """Simulation steps from one frame to the next."""
        steps = self.speed / (self.fps * self.timestep_s)
        if abs(steps - round(steps)) > 1e-9:
            raise ValueError(f"timestep {self.timestep_s} s does not divide a frame of {self.speed / self.fps} s")
        return round(steps)


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in world coordinates (m)."""

    low: Vec3
    high: Vec3

    def corners(self) -> np.ndarray:
        """Return the eight corners, shape (8, 3)."""
        grid = np.array(np.meshgrid(*zip(self.low, self.high, strict=True), indexing="ij"))
        return grid.reshape(3, 8).T


@dataclass(frozen=True)
class View:
    """The camera's direction. Distance and aim are fitted (`camera.fit_camera`).

    Azimuth 90 looks along +y (from the front), elevation is negative when looking down: MuJoCo's free camera.
    """

    azimuth_deg: float = 90.0
    elevation_deg: float = -15.0
    fovy_deg: float = 35.0


@dataclass(frozen=True)
class Inventory:
    """The colours and things in a scene that a viewer can name; ill-posed questions use it.

    colours: every colour in view. objects: every noun, singular ('ball', 'ramp'). things: phrases that single one out
    ('red ball', 'wooden ramp'), which occlusion scenes are asked about; at least three of them.
    """

    colours: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()
    things: tuple[str, ...] = ()


@dataclass
class Scene:
    """A built scene: the model description and the roles its parts play.

    decisive: bodies whose end state is the outcome; in frame throughout, invisible in an occlusion void from hiding on.
    hidden: geoms of the hidden element (occlusion), never visible in the void.
    cover: what the occluder may hide: everything decisive from hiding on, and the hidden element (occlusion). It is
        cut to what the twin needs.
    framed: boxes that must lie in frame besides everything that moves (the outcome zone above all).
    velocity: initial velocity of free bodies: linear (m/s, world) and angular (rad/s, body); of soft bodies linear.
    inventory: what a viewer can name.
    rest: where all outcomes lie (chaotic), which an occluder hides that closes the control; None: all of the stage.
    marks: phrases ('left bin') of which a flag stands over the occluder; its geom is `flag_of(phrase)`.
    shown_by: of a noun that no geom's name begins with: the nouns that stand for it.
    """

    spec: mujoco.MjSpec
    view: View
    decisive: tuple[str, ...]
    framed: tuple[Box, ...]
    hidden: tuple[str, ...] = ()
    cover: Box | None = None
    velocity: Mapping[str, Sequence[float]] = field(default_factory=dict)
    inventory: Inventory = Inventory()
    rest: Box | None = None
    marks: tuple[str, ...] = ()
    shown_by: Mapping[str, Sequence[str]] = field(default_factory=dict)


def flag_of(phrase: str) -> str:
    """Return the name of the geom of a flag over what a question names."""
    return f"flag {phrase}"


@dataclass(frozen=True)
class Motion:
    """The poses of all named bodies at the frame times.

    times: (F,) seconds. positions: body -> (F, 3) m. rotations: body -> (F, 3, 3), columns are the body's axes.
    vertices: soft body -> (F, V, 3) m.
    """

    times: np.ndarray
    positions: Mapping[str, np.ndarray]
    rotations: Mapping[str, np.ndarray]
    vertices: Mapping[str, np.ndarray] = field(default_factory=dict)

    def pos(self, body: str) -> np.ndarray:
        """Return the position of a body, or the mean of a soft body's vertices, (F, 3)."""
        return self.vertices[body].mean(axis=1) if body in self.vertices else self.positions[body]

    def rot(self, body: str) -> np.ndarray:
        """Return rotation matrices of a body, shape (F, 3, 3)."""
        return self.rotations[body]

    def places(self, body: str, beside_m: float) -> np.ndarray:
        """Return points of a body, its middle and three beside it, or vertices, (F, N, 3)."""
        if body in self.vertices:
            return self.vertices[body]
        offsets = np.pad(self.rot(body).swapaxes(1, 2), ((0, 0), (1, 0), (0, 0)))
        return self.pos(body)[:, None] + beside_m * offsets


@dataclass(frozen=True)
class Reading:
    """A simulation's label in every frame, None while undecided, and its margin.

    margin_m: distance (m) of the end state from the nearest other outcome. in_order: of a question for the order of two
    events, the frames from which the first one and the second one have happened. turns_deg: how far the thing turns
    that the scene is about, where there is one.
    """

    labels: Sequence[str | None]
    margin_m: float
    in_order: tuple[int, int] | None = None
    turns_deg: float | None = None


@dataclass(frozen=True)
class AnswerableQuestion:
    """A question that even the void answers (`occlusion_answerable`)."""

    question: str
    labels: tuple[str, ...]
    answer: str


@dataclass(frozen=True)
class Wording:
    """Words of a scenario. aliases: other wording -> label."""

    question: str
    labels: tuple[str, ...]
    aliases: Mapping[str, str]
    answerable_question: AnswerableQuestion


@dataclass(frozen=True)
class Family:
    """A scene family: its variation, construction and outcome (docs/spec.md 2.2).

    params: a frozen dataclass of plain values with units in the names.
    draw(rng, longer=False): parameters of one scenario.
    build(params, physics): the scene. Draws nothing.
    outcome(motion, params): the run's outcome.
    word(params, rng): the question and its companions.
    questions: the templates that `word` fills; no other family has the same.
    observe(frames, question): the answer by the 5 FPS frames (N, 360, 480, 3) RGB and the question alone;
        None if the decisive thing is not to be seen.
    legible(motion, params): groups of geoms that must be seen at the end and the minimum pixels of each; by default
        each decisive body's geoms and 150.
    twins(params): the same scene with only the hidden element changed, so that the outcome may differ (occlusion).
    """

    name: str
    taxonomy: Taxonomy
    category: str
    sub_scenario: str
    answer_type: AnswerType
    params: type
    draw: Callable[..., Any]
    build: Callable[[Any, Physics], Scene]
    outcome: Callable[[Motion, Any], Reading]
    word: Callable[[Any, np.random.Generator], Wording]
    questions: tuple[str, ...] = ()
    observe: Callable[[np.ndarray, str], str | None] | None = None
    legible: Callable[[Motion, Any], Sequence[tuple[tuple[str, ...], float]]] | None = None
    physics: Physics = Physics()
    min_margin_m: float = 0.005
    twins: Callable[[Any], Sequence[Any]] | None = None
    looks: tuple[str, ...] = ()  # parts of the look (`look.PARTS`) that are drawn with every scenario
    perturbation: float = 1e-4  # chaotic: standard deviation of an initial-state perturbation (m, rad)
    check: Callable[[Any], None] = lambda params: None  # raises ValueError where a file's parameters are not plausible

    def params_from(self, values: Mapping[str, Any]) -> Any:
        """Return parameters from a stored mapping. Raises ValueError naming a wrong one."""
        field_of = {f.name: f for f in fields(self.params)}
        required_names = {name for name, f in field_of.items() if f.default is MISSING}
        unknown, missing = sorted(set(values) - set(field_of)), sorted(required_names - set(values))
        if unknown or missing:
            raise ValueError(
                f"family {self.name}: unknown parameters {unknown}, missing parameters {missing}; "
                f"known: {sorted(field_of)}"
            )
        reader_of = {name: field_of[name].metadata.get(READER_KEY, _as_tuple) for name in values}
        params = self.params(**{name: reader_of[name](value) for name, value in values.items()})
        self.check(params)
        return params


def params_to_dict(params: Any) -> dict[str, Any]:
    """Return a family's parameters as a plain mapping, without a missing look."""
    unset = {m.name for m in fields(params) if m.default is None and getattr(params, m.name) is None}
    return {name: value for name, value in asdict(params).items() if name not in unset}


def _as_tuple(value: Any) -> Any:
    return tuple(_as_tuple(v) for v in value) if isinstance(value, list | tuple) else value


# --- builders shared by families -------------------------------------------------------------------------------------


def new_spec(physics: Physics) -> mujoco.MjSpec:
    """Return an empty world: sky, floor, key light, robust contact settings."""
    import mujoco

    spec = mujoco.MjSpec()
    option = spec.option
    option.timestep = physics.timestep_s
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = physics.impratio
    option.iterations = physics.iterations
    option.tolerance = physics.tolerance
    option.gravity = [0, 0, -physics.gravity_m_s2]
    _set_look(spec)
    floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.5])
    floor.material = "floor"
    floor.condim = 6
    floor.friction = [0.8, 0.005, 0.0001]
    return spec


def _set_look(spec: mujoco.MjSpec) -> None:
    import mujoco

    spec.visual.quality.shadowsize = 1024
    spec.visual.map.shadowclip = 3.0  # in extents: at 2.0 the edge of the shadow map speckles the floor in view
    spec.visual.quality.offsamples = 0
    spec.visual.headlight.ambient = [0.38, 0.38, 0.40]
    spec.visual.headlight.diffuse = [0.25, 0.25, 0.25]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    sky = mujoco.mjtTexture.mjTEXTURE_SKYBOX
    spec.add_texture(
        name="sky",
        type=sky,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.62, 0.74, 0.88],
        rgb2=[0.93, 0.95, 0.97],
        width=128,
        height=128,
    )
    spec.add_material(name="floor", rgba=[0.80, 0.78, 0.75, 1], specular=0.0, shininess=0.0, reflectance=0.0)
    light = spec.worldbody.add_light(name="key", pos=[-1.5, -3, 5])
    light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    light.dir = [0.35, 0.55, -1.0]
    light.diffuse = [0.62, 0.61, 0.58]
    light.specular = [0.15, 0.15, 0.15]
    light.castshadow = True


def add_box(
    parent: mujoco.MjsBody,
    name: str,
    centre: Sequence[float],
    half: Sequence[float],
    colour: str,
    *,
    euler_y: float = 0.0,
    **attributes: Any,
) -> mujoco.MjsGeom:
    """Add a box geom to a body, or to `spec.worldbody`, tilted about y (rad), and return it."""
    import mujoco

    geom = parent.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_BOX, pos=list(centre), size=list(half), rgba=rgba(colour)
    )
    if euler_y:
        geom.quat = [float(np.cos(euler_y / 2)), 0.0, float(np.sin(euler_y / 2)), 0.0]
    for key, value in attributes.items():
        setattr(geom, key, value)
    return geom


def add_ball(
    spec: mujoco.MjSpec, name: str, centre: Sequence[float], radius: float, colour: str, *, density: float = 1000.0
) -> mujoco.MjsGeom:
    """Add a free ball, body and geom `name`, that friction brings to rest, and return it."""
    import mujoco

    body = spec.worldbody.add_body(name=name, pos=list(centre))
    body.add_freejoint()
    geom = body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], rgba=rgba(colour))
    geom.density = density
    geom.condim = 6
    geom.friction = [0.8, 0.005, 0.0002]
    return geom


# --- draws and words shared by families ------------------------------------------------------------------------------


def uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a plain float between two bounds, rounded to 0.0001."""
    return round(float(rng.uniform(low, high)), 4)


# Pairs that a viewer may take for each other in shade, or that lean towards the navy of the occluder.
LOOK_ALIKE = (
    {"red", "orange"},
    {"orange", "yellow"},
    {"orange", "wood"},
    {"blue", "purple"},
    {"blue", "cyan"},
    {"green", "cyan"},
    {"grey", "white"},
)


def distinct_colours(rng: np.random.Generator, count: int, pool: Sequence[str]) -> tuple[str, ...]:
    """Return `count` colours of the pool, no two of which look alike."""
    for _ in range(1000):
        colours = tuple(str(c) for c in rng.permutation(list(pool))[:count])
        if len(colours) == count and not any(pair <= set(colours) for pair in LOOK_ALIKE):
            return colours
    raise ValueError(f"no {count} distinct colours among {list(pool)}; enlarge the pool")


def list_choices(choices: Sequence[str]) -> str:
    """Return the choices as they are read out: 'red, blue or green'."""
    return ", ".join(choices[:-1]) + " or " + choices[-1]
