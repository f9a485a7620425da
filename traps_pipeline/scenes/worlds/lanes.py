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

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from traps_pipeline.protocol.two_events import LANES
from traps_pipeline.scenes.parts.look import Look, apply_look
from traps_pipeline.scenes.physics.kit import Motion, Physics, Scene, Vec3, View, add_box, flag_of, new_spec
from traps_pipeline.scenes.physics.simulate import replay
from traps_pipeline.scenes.picture.camera import Camera, Occluder
from traps_pipeline.scenes.worlds.lane_event import LaneEvent, middle_of
from traps_pipeline.scenes.worlds.lane_layout import BENCH_M, Lane, Layout
from traps_pipeline.scenes.worlds.outcome import Outcome, decisive_geoms, read_outcome

if TYPE_CHECKING:
    import mujoco

PLACES = ("scene", "bench")  # what a lane's two boards are before
LEG_M = 0.012  # half width of a bench's leg
BENCH_RGBA = (0.36, 0.33, 0.36, 1.0)  # of no colour that a question names
FLAG_CLEAR_PX = 2.0  # of flags, over the board before a scene
AWAY_M = 60.0  # so high hangs a board that is not there


@dataclass(frozen=True, eq=False)
class TwoLanes:
    """A world of two lanes in its shot.

    events: of each lane. look: of floor and light. frozen: the trajectory as a record has it; None: to be simulated.
    """

    lanes: Sequence[Lane]
    events: Sequence[LaneEvent]
    camera: Camera
    layouts: Sequence[Layout]
    look: Look
    frozen: np.ndarray | None = None

    @property
    def physics(self) -> Physics:
        """MuJoCo's solver settings, and the seconds of simulation."""
        return self.events[0].physics

    def with_event(self, lane: int, event: LaneEvent) -> TwoLanes:
        """Return the world with another event in a lane, such as its twin."""
        events = [event if k == lane else own for k, own in enumerate(self.events)]
        return replace(self, events=events, frozen=None)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The MuJoCo model of both lanes."""
        spec = new_spec(self.physics)
        spec.light("key").castshadow = False
        apply_look(Scene(spec, View(), (), tuple(layout.strip for layout in self.layouts)), self.look)
        for name, lane, event, layout in zip(LANES, self.lanes, self.events, self.layouts, strict=True):
            frame = spec.worldbody.add_frame(pos=list(layout.shift))
            lane_spec = _lane_spec(event, layout, lane.size)
            _raise_flags(lane_spec, event, layout, self.camera)
            spec.attach(lane_spec, prefix=f"{name} ", frame=frame)
            _paint(spec, name, lane.strip, layout)
        for name, layout in zip(LANES, self.layouts, strict=True):  # last: the last columns of a pose are theirs
            for place, board in zip(PLACES, layout.boards, strict=True):
                _hang(spec, board_of(name, place), board)
        return spec.compile()

    @property
    def qpos(self) -> np.ndarray:
        """The trajectory, frozen or simulated."""
        return self.simulated if self.frozen is None else self.frozen

    @cached_property
    def simulated(self) -> np.ndarray:
        """The trajectory with all boards standing, (F, nq): each lane's is the family's own, simulated by itself.

        Nothing of one lane can touch the other. Simulated together, the solver would let rounding pass between them,
        and a twin would not leave the other lane as it is.
        """
        parts = []
        for event, layout in zip(self.events, self.layouts, strict=True):
            parts += [_shifted(event, layout.shift), *(np.array(path) for path in layout.paths)]
        boards = np.zeros((self.physics.n_frames, len(LANES) * len(PLACES)))
        return np.hstack([*parts, boards]).astype(np.float32)

    @cached_property
    def _motion(self) -> Motion:
        return replay(self.model, self.qpos, self.physics)

    def motion(self, lane: int) -> Motion:
        """Return a lane's part of the motion, in its family's own names and places."""
        prefix, shift, poses = f"{LANES[lane]} ", np.array(self.layouts[lane].shift), self._motion
        names = {name.removeprefix(prefix): name for name in poses.positions if name.startswith(prefix)}
        positions = {own: poses.positions[name] - shift for own, name in names.items()}
        return Motion(poses.times, positions, {own: poses.rotations[name] for own, name in names.items()})

    def outcome(self, lane: int) -> Outcome:
        """Return a lane's outcome, read by its family from its part of the motion."""
        return read_outcome(self.events[lane].family, self.motion(lane), self.events[lane].params)

    def clip(self, hidden: Sequence[bool]) -> np.ndarray:
        """Return the poses of the clip in which some lanes are hidden, (F, nq)."""
        qpos = self.qpos.copy()
        column = qpos.shape[1] - len(LANES) * len(PLACES)
        for lane, layout, is_hidden in zip(self.lanes, self.layouts, hidden, strict=True):
            away = lane.timetable.away(len(qpos))
            comes = column + int(is_hidden)  # the other board than the one that stands still
            lift = out_of_picture_m(layout.boards[int(is_hidden)], self.camera)
            qpos[:, comes] = np.where(away == 1, AWAY_M, away * lift)
            column += len(PLACES)
        return qpos

    def decisive(self, lane: int) -> tuple[str, ...]:
        """Return the names of the geoms of a lane's decisive bodies."""
        return decisive_geoms(self.model, [f"{LANES[lane]} {body}" for body in self.events[lane].scene.decisive])

    def hidden_element(self, lane: int) -> tuple[str, ...]:
        """Return the names of the geoms of a lane's hidden element that are not decisive ones."""
        names = [f"{LANES[lane]} {name}" for name in self.events[lane].scene.hidden]
        return tuple(name for name in names if name not in self.decisive(lane))

    def doubles(self, lane: int) -> tuple[str, ...]:
        """Return the names of the geoms of a lane's doubles."""
        names = [self.model.geom(i).name for i in range(self.model.ngeom)]
        return tuple(name for name in names if name.startswith(f"{LANES[lane]} double "))


def board_of(lane: str, place: str) -> str:
    """Return the name of a board, its body and its geom."""
    return f"board {lane} {place}"


def out_of_picture_m(board: Occluder, camera: Camera) -> float:
    """Return how far a board rises until it is out of the picture (m)."""
    corners, lifts = board.corners(), np.arange(0.0, AWAY_M / 4, 0.02)
    rows = [camera.project(corners + np.array([0.0, 0.0, lift]))[:, 1].max() for lift in lifts]
    return float(lifts[int((np.array(rows) < 0).argmax())])


# --- parts of a lane --------------------------------------------------------------------------------------------------


def _lane_spec(event: LaneEvent, layout: Layout, size: float) -> mujoco.MjSpec:
    """Return a family's scene without floor, sky and light of its own, and with doubles on its bench."""
    import mujoco

    spec = event.family.build(event.params, event.physics).spec
    planes = [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE]
    floors = [material for material in spec.materials if material.name == "floor"]
    for element in (*planes, *spec.lights, *spec.textures, *floors):
        spec.delete(element)
    data = mujoco.MjData(event.model)
    mujoco.mj_kinematics(event.model, data)
    x, y, z = np.subtract(layout.bench, layout.shift)
    doubles = [*event.doubles(size).items()][: len(layout.paths)]  # as many as the record has
    for n, (body, span) in enumerate(doubles):
        place = [float(at) for at in (x - middle_of(span[:, 0]), y - middle_of(span[:, 1]), z - span[:, 2].min())]
        double = spec.worldbody.add_body(name=f"double {n}", pos=place, quat=data.body(body).xquat)
        for axis in ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)):
            turned = data.body(body).xmat.reshape(3, 3).T @ axis
            double.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=turned.tolist())
        double.mass, double.inertia, double.explicitinertial = 1.0, [1.0, 1.0, 1.0], True
        for name in event.copied_geoms(body):
            _copy_geom(spec, double, spec.geom(name), f"double {n} {name}", size)
    return spec


def _raise_flags(spec: mujoco.MjSpec, event: LaneEvent, layout: Layout, camera: Camera) -> None:
    """Raise a lane's flags together until the board before its scene hides none of them."""
    flags = [spec.geom(flag_of(mark)) for mark in event.scene.marks]
    feet = [np.array(flag.pos) + layout.shift - (0.0, 0.0, flag.size[2]) for flag in flags]
    edge = camera.project(layout.boards[0].corners())[:, 1].min() - FLAG_CLEAR_PX
    down = float(np.cos(np.radians(camera.elevation_deg)))
    lifts = [float(camera.project(foot)[0, 1] - edge) * camera.metres_a_pixel(foot) / down for foot in feet]
    lift = max([0.0, *lifts])
    for mark in event.scene.marks:
        for part in (flag_of(mark), f"rim {mark}"):
            spec.geom(part).pos[2] += lift
        mast = spec.geom(f"mast {mark}")
        mast.pos[2], mast.size[1] = mast.pos[2] + lift / 2, mast.size[1] + lift / 2


def _copy_geom(spec: mujoco.MjSpec, body: mujoco.MjsBody, geom: mujoco.MjsGeom, name: str, size: float) -> None:
    """Add a copy of a geom, of another size, without contact or mass."""
    half, place = size * np.array(geom.size), size * np.array(geom.pos)
    copied = body.add_geom(name=name, type=geom.type, size=half, pos=place, quat=geom.quat, rgba=geom.rgba)
    if not np.isnan(geom.fromto[0]):
        copied.fromto = size * np.array(geom.fromto)
    if geom.meshname:
        copied.meshname = spec.add_mesh(name=name, uservert=size * np.array(spec.mesh(geom.meshname).uservert)).name
    copied.contype, copied.conaffinity, copied.mass = 0, 0, 0


def _shifted(event: LaneEvent, shift: Vec3) -> np.ndarray:
    """Return an event's trajectory where its lane is: places of free bodies are those of the world."""
    import mujoco

    qpos = event.qpos.astype(float)
    for joint in np.flatnonzero(event.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        address = event.model.jnt_qposadr[joint]
        qpos[:, address : address + 3] += shift
    return qpos


def _paint(spec: mujoco.MjSpec, name: str, colour: str, layout: Layout) -> None:
    """Add a lane's strip and its bench, a plate on two legs, without contact."""
    (x, y, z), (across, deep) = layout.bench, layout.bench_half
    low, high = np.array(layout.strip.low), np.array(layout.strip.high)
    leg = (z - BENCH_M) / 2
    parts = {
        "strip": ((low + high) / 2, (high - low) / 2),
        "bench": (np.array([x, y, z - BENCH_M / 2]), np.array([across, deep, BENCH_M / 2])),
    }
    if leg > 0:
        at = {f"leg {n}": x + side * (across - LEG_M) for n, side in enumerate((-1, 1))}
        parts |= {part: (np.array([along, y, leg]), np.array([LEG_M, LEG_M, leg])) for part, along in at.items()}
    for part, (centre, half) in parts.items():
        geom = add_box(spec.worldbody, f"{name} lane {part}", centre, half, colour, contype=0, conaffinity=0)
        if part != "strip":
            geom.rgba = BENCH_RGBA


def _hang(spec: mujoco.MjSpec, name: str, board: Occluder) -> None:
    """Hang a board on an upright joint."""
    import mujoco

    body = spec.worldbody.add_body(name=name, pos=list(board.centre))
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
    add_box(body, name, (0, 0, 0), board.half, "navy", contype=0, conaffinity=0)
