"""Film two events of one family side by side, each in a lane of its own.

A lane is a family's own scene on one half of a wide picture. A painted strip lies before it, by which a question names
it. A bench stands above or below it in the picture, for doubles of the things that decide: these come as the things
themselves do, until they are behind the board, and then slide to rest. Before the scene and before the bench is a board
each, of the same size in the picture. In a lane that is hidden the scene's board stands from the first frame to the
last and the bench's comes and goes; in a lane that is seen it is the other way round, by the same timetable. So boards,
things alike and their motion are the same on both sides, up to what is asked: whether the scene was seen, or the bench.

Boards hang on joints, so a clip is a row of poses like any other, and the renderer knows nothing of them. Nothing
throws a shadow, which would tell what a board hides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.scenes.parts.look import Look, apply_look
from traps_pipeline.scenes.physics.kit import Box, Family, Motion, Physics, Scene, Vec3, View, add_box, new_spec
from traps_pipeline.scenes.physics.simulate import replay, swept_points
from traps_pipeline.scenes.picture.camera import Camera, Occluder, WideCamera, fit_camera, fit_occluder
from traps_pipeline.scenes.worlds.outcome import Outcome, Rejected, compile_scene, read_outcome, simulated
from traps_pipeline.scenes.worlds.shot import box_around
from traps_pipeline.scenes.worlds.timetable import Timetable

if TYPE_CHECKING:
    import mujoco

LANES = ("left", "right")  # sides of the picture; names of all that is in a lane begin with it
SIDES = (-1, 1)  # of the world's middle
PLACES = ("scene", "bench")  # what a lane's two boards stand before
GAP_M = 0.14  # between the lanes
CLEAR_PX = 5.0  # between a lane's scene and its bench, in the picture
BENCH_M, BENCH_DEPTH_M = 0.04, 0.16  # thickness and depth of a bench
STRIP_M, STRIP_GAP_M = 0.09, 0.05  # depth of a lane's strip, and what is before and behind it
DOUBLES = 3  # at most
DOUBLE_GAP_M = 0.03
BENCH_EDGE_M = 0.05  # that a board reaches beyond its bench, on each side
LEG_M = 0.012  # half width of a bench's leg
BENCH_RGBA = (0.36, 0.33, 0.36, 1.0)  # of no colour that a question names
SLIDE_M = (0.06, 0.4)  # how far doubles slide
AWAY_M = 60.0  # so high hangs a board that is not there
ROUNDS = 24  # in which camera, boards and benches are fitted to each other

DAMPING = 0.5  # or benches and camera would chase each other


@dataclass(frozen=True)
class Lane:
    """What is drawn of a lane.

    strip: its colour. bench_above: whether the bench is above the scene in the picture. bench_at: where it is along the
    lane, 0 to 1. mirrored: whether doubles come from the other side than what they are doubles of. rests_at: how far
    they get, 0 to 1. sets_out_s: when those set out that are behind the board from the start. size: of doubles, 1 for
    that of the things themselves. timetable: of the board that comes and goes.
    """

    params: Any
    strip: str
    bench_above: bool
    bench_at: float
    mirrored: bool
    rests_at: float
    sets_out_s: float
    size: float
    timetable: Timetable


@dataclass(frozen=True)
class Doubles:
    """Box corners of bodies from their origin, (N, 3), by name; the geoms shown; the width side by side (m)."""

    spans: Mapping[str, np.ndarray]
    geoms: frozenset[str]
    width_m: float

    def sized(self, size: float) -> Doubles:
        """Return doubles of another size."""
        return Doubles({body: size * span for body, span in self.spans.items()}, self.geoms, size * self.width_m)

    @property
    def size_m(self) -> tuple[float, float]:
        """Depth and height of the largest (m)."""
        return max(float(np.ptp(s[:, 1])) for s in self.spans.values()), max(
            float(np.ptp(s[:, 2])) for s in self.spans.values()
        )


@dataclass(frozen=True, eq=False)
class Event:
    """A lane's event by itself, as if there were no other lane."""

    family: Family
    params: Any
    physics: Physics

    @cached_property
    def _compiled(self) -> tuple[mujoco.MjModel, Scene]:
        return compile_scene(self.family, self.params, self.physics)

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled scene."""
        return self._compiled[0]

    @property
    def scene(self) -> Scene:
        """The built scene."""
        return self._compiled[1]

    @property
    def cover(self) -> Box:
        """What a board must hide. Raises Rejected."""
        if self.scene.cover is None:
            raise Rejected(f"{self.family.name}: its scenes have nothing that a board could hide")
        return self.scene.cover

    @cached_property
    def motion(self) -> Motion:
        """Poses of all bodies. Raises Rejected."""
        return replay(self.model, self.qpos, self.physics)

    @cached_property
    def qpos(self) -> np.ndarray:
        """The trajectory, (F, nq). Raises Rejected."""
        return simulated(self.model, self.scene, self.physics)

    @cached_property
    def outcome(self) -> Outcome:
        """The outcome. Raises Rejected."""
        return read_outcome(self.family, self.motion, self.params)

    @cached_property
    def points(self) -> np.ndarray:
        """Corners of all that is ever shown, (N, 3)."""
        framed = [box.corners() for box in self.scene.framed]
        return np.concatenate([swept_points(self.model, self.qpos), *geom_corners(self.model).values(), *framed])

    @cached_property
    def doubles(self) -> Doubles:
        """The bodies that have a double on the bench: what decides, as far as there is room."""
        import mujoco

        model, corners = self.model, geom_corners(self.model)
        data, room = mujoco.MjData(model), float(np.ptp(self.cover.corners()[:, 0])) / 2
        mujoco.mj_kinematics(model, data)
        spans: dict[str, np.ndarray] = {}
        geoms: set[str] = set()
        used = 0.0
        for body in self.scene.decisive[:DOUBLES]:
            names = [model.geom(i).name for i in range(model.ngeom) if model.geom_bodyid[i] == model.body(body).id]
            own = [name for name in names if name not in self.scene.hidden] or names  # a double shows no counterweight
            span = np.concatenate([corners[name] for name in own]) - data.body(body).xpos
            width = float(np.ptp(span[:, 0])) + DOUBLE_GAP_M
            if not spans or used + width < room:
                spans[body] = span
                geoms |= {*own}
                used += width
        return Doubles(spans, frozenset(geoms), used)


def geom_corners(model: mujoco.MjModel, qpos: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Return box corners (8, 3) of every geom but planes by name, at the start or in a pose."""
    import mujoco

    data, signs = mujoco.MjData(model), Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)).corners()
    data.qpos[:] = model.qpos0 if qpos is None else qpos
    mujoco.mj_kinematics(model, data)
    corners = {}
    for geom in np.flatnonzero(model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE):
        local = model.geom_aabb[geom, :3] + signs * model.geom_aabb[geom, 3:]
        corners[model.geom(geom).name] = local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
    return corners


# --- where things stand -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Layout:
    """Where things of a lane are, in the world.

    shift: of the family's own scene. bench: the middle of the bench's upper face. boards: by `PLACES`. paths: of each
    double, how far along and above the bench's middle its own middle and foot are, (F, 2).
    """

    shift: Vec3
    bench: Vec3
    bench_half: tuple[float, float]  # across and in depth
    strip: Box
    boards: Mapping[str, Occluder]
    paths: tuple[np.ndarray, ...]

    @property
    def corners(self) -> np.ndarray:
        """Corners of strip, bench and boards, and the highest places of doubles, (N, 3)."""
        x, y, z = self.bench
        across, deep = self.bench_half
        high = max(float(path[:, 1].max()) for path in self.paths)
        bench = Box((x - across, y - deep, z - BENCH_M), (x + across, y + deep, z + high + DOUBLE_GAP_M))
        boxes = [bench.corners(), self.strip.corners(), *(board.corners() for board in self.boards.values())]
        return np.concatenate(boxes)


def fit_lanes(lanes: Sequence[Lane], worlds: Sequence[Sequence[Event]]) -> tuple[Camera, tuple[Layout, ...]]:
    """Return the nearest camera with both lanes in frame, and where everything stands.

    worlds: of each lane the event and its twin: all is fitted to both.
    """
    points = [np.concatenate([event.points for event in events]) for events in worlds]
    covers = [box_around([event.cover.corners() for event in events]).corners() for events in worlds]
    view = replace(worlds[0][0].scene.view, azimuth_deg=90.0)
    down = np.radians(-view.elevation_deg)
    benches = [_first_bench(lane, shown, down) for lane, shown in zip(lanes, points, strict=True)]
    half = max(float(np.ptp(shown[:, 0])) for shown in points) / 2 + GAP_M / 2
    layouts: list[Layout] = []
    camera = None
    for _ in range(ROUNDS):
        shifts = [(side * half - _middle(p[:, 0]), 0.0, 0.0) for side, p in zip(SIDES, points, strict=True)]
        shown = [p + shift for p, shift in zip(points, shifts, strict=True)]
        seen = [*shown, *(layout.corners for layout in layouts)]
        everything = np.concatenate(seen)
        camera = fit_camera(view, np.concatenate([everything, everything * (-1, 1, 1)]), WideCamera)
        layouts = []
        for k, lane in enumerate(lanes):
            board = fit_occluder(camera, box_around([covers[k] + shifts[k]]))
            layout = _layout(camera, lanes[k], shown[k], board, shifts[k], benches[k], worlds[k][0])
            benches[k] = _moved_apart(camera, lane.bench_above, shown[k], layout, down)
            layouts.append(layout)
        reach = max(
            float(np.abs(layout.corners[:, 0] - side * half).max()) for side, layout in zip(SIDES, layouts, strict=True)
        )
        half = max(half, reach + GAP_M / 2)
    assert camera is not None
    return camera, tuple(layouts)


def _middle(values: np.ndarray) -> float:
    return float(values.min() + values.max()) / 2


def _first_bench(lane: Lane, shown: np.ndarray, down: float) -> tuple[float, float]:
    """Return a bench's depth and height: behind and over all that is shown, or in front of it."""
    if not lane.bench_above:
        return float(shown[:, 1].min()) - 0.5, BENCH_M
    back = float(shown[:, 1].max()) + BENCH_DEPTH_M
    top = float((shown[:, 2] * np.cos(down) + shown[:, 1] * np.sin(down)).max())
    return back, max(BENCH_M, (top - back * np.sin(down)) / np.cos(down))


def _layout(
    camera: Camera,
    lane: Lane,
    shown: np.ndarray,
    board: Occluder,
    shift: Vec3,
    bench: tuple[float, float],
    event: Event,
) -> Layout:
    """Return a lane's layout. Both boards have one size in the picture, so that each hides what is behind either."""
    (y, z), doubles = bench, event.doubles.sized(lane.size)
    deep = max(BENCH_DEPTH_M, doubles.size_m[0] + DOUBLE_GAP_M)
    front = y - deep / 2 - board.half[1]
    place = np.array([board.centre[0], front, z + board.half[2]])
    scale = camera.metres_a_pixel(place) / camera.metres_a_pixel(np.array(board.centre))
    hides = doubles.size_m[1] + deep * float(np.tan(np.radians(-camera.elevation_deg))) + DOUBLE_GAP_M
    across = max(board.half[0], ((doubles.width_m + SLIDE_M[0]) / 2 + BENCH_EDGE_M) / scale)
    up = max(board.half[2], hides / 2 / scale)
    thick = board.half[1]
    board = replace(board, half=(across, thick, up), centre=(*board.centre[:2], up))
    paths = double_paths(lane, event, board, shift, scale)
    widths = [float(np.ptp(span[:, 0])) / 2 for span in doubles.spans.values()]
    inner = across * scale - BENCH_EDGE_M
    ends = [(float(p[:, 0].min()) - half, float(p[:, 0].max()) + half) for p, half in zip(paths, widths, strict=True)]
    low, high = min(-inner, *(end[0] for end in ends)), max(inner, *(end[1] for end in ends))
    left_m, right_m = (float(end(shown[:, 0])) for end in (np.min, np.max))
    slack = max(0.0, right_m - left_m - (high - low))
    x = (left_m + right_m) / 2 + (lane.bench_at - 0.5) * slack  # the middle of the bench
    at = x - (low + high) / 2  # of its board
    bench_board = Occluder((at, front, z + up * scale), (across * scale, thick, up * scale), board.yaw_deg)
    near = min(float(shown[:, 1].min()), float(board.corners()[:, 1].min()), y - deep) - STRIP_GAP_M
    strip = Box((left_m, near - STRIP_M, 0.0), (right_m, near, 0.004))
    paths = tuple(np.round(path - ((low + high) / 2, 0.0), 4) for path in paths)
    boards = {"scene": board, "bench": bench_board}
    return Layout(shift, (x, y, z), ((high - low) / 2, deep / 2), strip, boards, paths)


def double_paths(lane: Lane, event: Event, board: Occluder, shift: Vec3, scale: float) -> tuple[np.ndarray, ...]:
    """Return where doubles are, along the bench from its board's middle and above it, (F, 2) each.

    A double is before its board as long as what it is a double of, and comes as that does: along, or down from above.
    Behind the board its path is its own, so that it tells nothing of an outcome.
    """
    fps, n_frames, mirror = event.physics.fps, event.physics.n_frames, -1 if lane.mirrored else 1
    inner, paths, frames = board.half[0] * scale - BENCH_EDGE_M, [], np.arange(n_frames)
    doubles = event.doubles.sized(lane.size)
    used = -doubles.width_m / 2
    for n, (body, span) in enumerate(doubles.spans.items()):
        width = float(np.ptp(span[:, 0]))
        middle = event.motion.pos(body) + np.array(shift) + (_middle(span[:, 0]), 0.0, span[:, 2].min())
        along = (middle[:, 0] - board.centre[0]) * scale * mirror
        tall, top = float(np.ptp(span[:, 2])), 2 * board.half[2] * scale
        above = np.clip(middle[:, 2] * scale, 0.0, top + tall)
        room = max(0.0, inner - width / 2)
        over = above + tall > top
        path = np.zeros((n_frames, 2))
        if abs(along[0]) > room + DOUBLE_GAP_M:  # it comes along
            first = int((np.abs(along) <= room).argmax())
            side = np.sign(along[0])
            speed = max(abs(along[first] - along[first - 1]), 0.004)
            far = 2 * room * (0.2 + 0.6 * lane.rests_at) - n * (width + DOUBLE_GAP_M)
            path[:, 0] = np.where(frames < first, along, along[first] - side * _slowing(frames - first, far, speed))
        elif over[0]:  # it comes down
            first = int((~over).argmax())
            path[:, 0] = along[0]
            fall = (
                above[first]
                - (above[first - 1] - above[first]) * (frames - first)
                - 4.9 * ((frames - first) / fps) ** 2
            )
            path[:, 1] = np.where(frames < first, above, np.maximum(fall, 0.0))
        else:
            start = used + DOUBLE_GAP_M / 2 + width / 2
            far = min(SLIDE_M[1], max(0.0, inner - doubles.width_m / 2)) * (0.4 + 0.6 * lane.rests_at)
            path[:, 0] = mirror * (start - far / 2 + _slowing(frames - round(lane.sets_out_s * fps), far, far / 5))
        used += width + DOUBLE_GAP_M
        paths.append(path)
    return tuple(paths)


def _slowing(frames: np.ndarray, far: float, speed: float) -> np.ndarray:
    """Return how far a thing has come, in frames from when it sets out, that slows down from a speed to rest."""
    far = max(far, DOUBLE_GAP_M)
    return far * (1 - np.exp(-np.maximum(frames, 0) * speed / far))


def _moved_apart(camera: Camera, above: bool, shown: np.ndarray, layout: Layout, down: float) -> tuple[float, float]:
    """Return a bench's place so that its board and the scene are just apart in the picture."""
    _, y, z = layout.bench
    rows = [
        camera.project(c)[:, 1]
        for c in (np.concatenate([shown, layout.boards["scene"].corners()]), layout.boards["bench"].corners())
    ]
    metres = camera.metres_a_pixel(np.array(layout.bench))
    if above:
        missing_px = rows[1].max() + CLEAR_PX - rows[0].min()
        return y, max(BENCH_M, z + DAMPING * missing_px * metres / float(np.cos(down)))
    missing_px = rows[0].max() + CLEAR_PX - rows[1].min()
    return y - DAMPING * missing_px * metres / float(np.sin(down)), z


# --- the world --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TwoLanes:
    """A world of two lanes in its shot. worlds: the event of each lane."""

    lanes: tuple[Lane, Lane]
    events: tuple[Event, Event]
    camera: Camera
    layouts: tuple[Layout, ...]
    look: Look  # of floor and light

    @property
    def physics(self) -> Physics:
        """Solver settings and timing."""
        return self.events[0].physics

    def with_event(self, lane: int, event: Event) -> TwoLanes:
        """Return the world with another event in a lane, such as its twin."""
        events = tuple(event if k == lane else self.events[k] for k in range(len(self.events)))
        return replace(self, events=events)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled world."""
        spec = new_spec(self.physics)
        spec.light("key").castshadow = False
        apply_look(Scene(spec, View(), (), tuple(layout.strip for layout in self.layouts)), self.look)
        for name, lane, event, layout in zip(LANES, self.lanes, self.events, self.layouts, strict=True):
            frame = spec.worldbody.add_frame(pos=list(layout.shift))
            spec.attach(_lane_spec(event, layout, lane.size), prefix=f"{name} ", frame=frame)
            _paint(spec, name, lane.strip, layout)
        for name, layout in zip(LANES, self.layouts, strict=True):  # last: the last columns of a pose are theirs
            for place in PLACES:
                _hang(spec, board_of(name, place), layout.boards[place])
        return spec.compile()

    @cached_property
    def qpos(self) -> np.ndarray:
        """The trajectory with all boards standing, (F, nq): each lane's is the family's own, simulated by itself.

        Nothing of one lane can touch the other. Simulated together, the solver would let rounding pass between them,
        and a twin would not leave the other lane as it is.
        """
        parts = []
        for event, layout in zip(self.events, self.layouts, strict=True):
            parts += [_shifted(event, layout.shift), *layout.paths]
        boards = np.zeros((self.physics.n_frames, len(LANES) * len(PLACES)))
        return np.hstack([*parts, boards]).astype(np.float32)

    def motion(self, lane: int) -> Motion:
        """Return the poses of a lane's bodies, as its family knows them."""
        poses, prefix, shift = self._motion, f"{LANES[lane]} ", np.array(self.layouts[lane].shift)
        names = {name.removeprefix(prefix): name for name in poses.positions if name.startswith(prefix)}
        positions = {short: poses.positions[name] - shift for short, name in names.items()}
        return Motion(poses.times, positions, {short: poses.rotations[name] for short, name in names.items()})

    @cached_property
    def _motion(self) -> Motion:
        return replay(self.model, self.qpos, self.physics)

    def outcome(self, lane: int) -> Outcome:
        """Return a lane's outcome, read by its family."""
        return read_outcome(self.events[lane].family, self.motion(lane), self.events[lane].params)

    def clip(self, hidden: Sequence[bool]) -> np.ndarray:
        """Return the poses of the clip in which some lanes are hidden, (F, nq)."""
        qpos = self.qpos.copy()
        columns = iter(range(qpos.shape[1] - len(LANES) * len(PLACES), qpos.shape[1]))
        for lane, layout, is_hidden in zip(self.lanes, self.layouts, hidden, strict=True):
            for place in PLACES:
                away = lane.timetable.away(len(qpos)) if standing_before(is_hidden) != place else np.zeros(len(qpos))
                lift = out_of_picture_m(layout.boards[place], self.camera)
                qpos[:, next(columns)] = np.where(away == 1, AWAY_M, away * lift)
        return qpos

    def geoms(self, lane: int, *, hidden_element: bool = True) -> tuple[str, ...]:
        """Return the names of the geoms that decide a lane's outcome."""
        prefix, scene, model = f"{LANES[lane]} ", self.events[lane].scene, self.model
        ids = [model.body(prefix + body).id for body in scene.decisive]
        names = [model.geom(i).name for i in range(model.ngeom) if int(model.geom_bodyid[i]) in ids]
        return (*names, *(prefix + name for name in scene.hidden if hidden_element))

    def doubles(self, lane: int) -> tuple[str, ...]:
        """Return the names of the geoms of a lane's doubles."""
        prefix = f"{LANES[lane]} double "
        return tuple(
            name for name in (self.model.geom(i).name for i in range(self.model.ngeom)) if name.startswith(prefix)
        )


def standing_before(is_hidden: bool) -> str:
    """Return before what a lane's still board stands."""
    return PLACES[0] if is_hidden else PLACES[1]


def board_of(lane: str, place: str) -> str:
    """Return the name of a board, its body and its geom."""
    return f"board {lane} {place}"


def out_of_picture_m(board: Occluder, camera: Camera) -> float:
    """Return how far a board rises until it is out of the picture (m)."""
    corners = board.corners()
    lifts = np.arange(0.0, AWAY_M / 4, 0.02)
    rows = np.array([camera.project(corners + np.array([0.0, 0.0, lift]))[:, 1].max() for lift in lifts])
    return float(lifts[int((rows < 0).argmax())])


# --- parts of a lane --------------------------------------------------------------------------------------------------


def _lane_spec(event: Event, layout: Layout, size: float) -> mujoco.MjSpec:
    """Return a family's scene without floor, sky and light of its own, and with doubles on its bench."""
    import mujoco

    spec = event.family.build(event.params, event.physics).spec
    for geom in [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE]:
        spec.delete(geom)
    own = [*spec.lights, *spec.textures, *(material for material in spec.materials if material.name == "floor")]
    for element in own:
        spec.delete(element)
    data = mujoco.MjData(event.model)
    mujoco.mj_kinematics(event.model, data)
    x, y, z = np.subtract(layout.bench, layout.shift)
    for n, (body, span) in enumerate(event.doubles.sized(size).spans.items()):
        place = (x - _middle(span[:, 0]), y - _middle(span[:, 1]), z - span[:, 2].min())
        copied = spec.worldbody.add_body(
            name=f"double {n}", pos=[float(at) for at in place], quat=data.body(body).xquat
        )
        for axis in ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)):
            turned = data.body(body).xmat.reshape(3, 3).T @ axis
            copied.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=turned.tolist())
        copied.mass, copied.inertia, copied.explicitinertial = 1.0, [1.0, 1.0, 1.0], True
        for i, geom in enumerate(geom for geom in spec.body(body).geoms if geom.name in event.doubles.geoms):
            _copy_geom(copied, geom, f"double {n} {i}", size)
    return spec


def _shifted(event: Event, shift: Vec3) -> np.ndarray:
    """Return an event's trajectory where its lane is: places of free bodies are those of the world."""
    import mujoco

    qpos = event.qpos.astype(float)
    for joint in np.flatnonzero(event.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        address = event.model.jnt_qposadr[joint]
        qpos[:, address : address + 3] += shift
    return qpos


def _copy_geom(body: mujoco.MjsBody, geom: mujoco.MjsGeom, name: str, size: float) -> None:
    """Add a copy of a geom, of another size, without contact or mass. Raises Rejected for a mesh."""
    if geom.meshname:
        raise Rejected("a mesh decides, which has no double of another size")
    half, place = size * np.array(geom.size), size * np.array(geom.pos)
    copied = body.add_geom(name=name, type=geom.type, size=half, pos=place, quat=geom.quat, rgba=geom.rgba)
    if not np.isnan(geom.fromto[0]):
        copied.fromto = size * np.array(geom.fromto)
    copied.contype, copied.conaffinity, copied.mass = 0, 0, 0


def _paint(spec: mujoco.MjSpec, name: str, colour: str, layout: Layout) -> None:
    """Add a lane's strip and its bench, a plate on two legs, without contact."""
    (x, y, z), (half, deep) = layout.bench, layout.bench_half
    low, high = np.array(layout.strip.low), np.array(layout.strip.high)
    parts = [
        ("mark", (low + high) / 2, (high - low) / 2),
        ("bench", (x, y, z - BENCH_M / 2), (half, deep, BENCH_M / 2)),
    ]
    if z > BENCH_M:
        legs = ((n, x + side * (half - LEG_M)) for n, side in enumerate(SIDES))
        parts += [(f"leg {n}", (at, y, (z - BENCH_M) / 2), (LEG_M, LEG_M, (z - BENCH_M) / 2)) for n, at in legs]
    for part, centre, size in parts:
        geom = add_box(spec.worldbody, f"{name} lane {part}", centre, size, colour, contype=0, conaffinity=0)
        if part != "mark":
            geom.rgba = BENCH_RGBA


def _hang(spec: mujoco.MjSpec, name: str, board: Occluder) -> None:
    """Hang a board on an upright joint; it falls by itself for nothing."""
    import mujoco

    body = spec.worldbody.add_body(name=name, pos=list(board.centre), gravcomp=1)
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
    add_box(body, name, (0, 0, 0), board.half, "navy", contype=0, conaffinity=0)
