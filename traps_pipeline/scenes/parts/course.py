"""Build a world with one path (course) through it, and the things along that path.

Places are (along, across, up) in metres: along the way, away from the camera, above the floor. `direction` is +1 for a
way to the right, -1 for one to the left: a course mirrors all that is placed on it, so that a family is written once.
Everything is added in the order of the calls, which is the order of the compiled model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.scenes.physics.kit import (
    Box,
    Inventory,
    Physics,
    Scene,
    Vec3,
    View,
    add_ball,
    add_box,
    flag_of,
    new_spec,
    rgba,
)

if TYPE_CHECKING:
    import mujoco

Span = tuple[float, float]  # from, to (m)
Point = tuple[float, float]  # along, up (m)

# The key light falls to the right and to the back: a thing so high throws a shadow of so many times its height.
SHADOW_RIGHT = 0.35
SHADOW_BACK = 0.55
FLAG, FLAG_SHAPE = 0.065, 0.75  # width of a flag, as a share of what the camera shows; its height, of its width
FLAG_CLEAR_M = 0.045  # over the line of sight past the occluder, which itself stands out by a margin
RIM = 0.06  # width of a flag's rim, of the flag's: a white one would not show before a pale floor
MAST = (0.20, 0.20, 0.21, 1.0)  # neither black nor grey to an observer


# --- surfaces ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Surface:
    """Contact properties of a surface.

    rolling: friction (m) that brings a rolling ball to rest. sliding: Coulomb friction, no unit. spinning: friction
    (m) against turning on the spot. solref: MuJoCo's contact, (-stiffness, -damping) or (time constant in s, damping
    ratio); None leaves MuJoCo's own. priority: of two surfaces that touch, the one with the higher counts.
    """

    rolling: float = 1e-4
    sliding: float = 0.8
    spinning: float = 0.005
    solref: tuple[float, float] | None = None
    priority: int = 1

    def on(self, geom: mujoco.MjsGeom) -> mujoco.MjsGeom:
        """Give a geom this surface; return the geom."""
        geom.condim = 6  # with less, MuJoCo leaves rolling friction out
        geom.priority = self.priority
        geom.friction = [self.sliding, self.spinning, self.rolling]
        if self.solref is not None:
            geom.solref = list(self.solref)
        return geom


DEAD = (-4000.0, -160.0)  # solref of a contact without rebound
SOFT = (0.01, 1.0)  # solref of a contact that swallows a fall


def brake(radius_m: float, loss: float, length_m: float, physics: Physics) -> float:
    """Return rolling friction (m) that takes `loss` (m2/s2) off v^2 over a length.

    A solid ball slows at 5 g mu / 7 r.
    """
    return 7 / 5 * radius_m * loss / (2 * length_m * physics.gravity_m_s2)


# --- the course -------------------------------------------------------------------------------------------------------


class Course:
    """A world under construction along one path. surface: default of blocks; None is MuJoCo's own."""

    def __init__(self, physics: Physics, direction: int = 1, surface: Surface | None = None) -> None:
        self.spec = new_spec(physics)
        self.direction = direction
        self.surface = surface
        self._velocity: dict[str, tuple[float, ...]] = {}
        self._marks: dict[str, tuple[Vec3, Sequence[float]]] = {}  # phrase -> foot in the world, colour

    def towards(self, direction: int) -> Course:
        """Return a copy of the course that builds towards a side (+1: right), so that a family writes one side."""
        course = copy(self)
        course.direction = direction
        return course

    # --- what stands still ---

    def block(
        self,
        name: str,
        along: Span,
        across: Span,
        up: Span,
        colour: str,
        surface: Surface | None = None,
        *,
        solid: bool = True,
    ) -> mujoco.MjsGeom:
        """Add a static box from its three spans and return it; without solid, paint only."""
        middle = (self.direction * sum(along) / 2, sum(across) / 2, sum(up) / 2)
        half_size = ((along[1] - along[0]) / 2, (across[1] - across[0]) / 2, (up[1] - up[0]) / 2)
        geom = add_box(self.spec.worldbody, name, middle, half_size, colour)
        surface = surface or self.surface
        if surface is not None:
            surface.on(geom)
        if not solid:
            geom.contype = geom.conaffinity = 0
        return geom

    def sides(
        self,
        name: str,
        along: Span,
        half_width: float,
        thick: float,
        up: Span,
        colour: str,
        surface: Surface | None = None,
    ) -> None:
        """Add the walls `<name>_front` and `<name>_back` outside a width."""
        for part, across in (("front", (-half_width - thick, -half_width)), ("back", (half_width, half_width + thick))):
            self.block(f"{name}_{part}", along, across, up, colour, surface)

    def plank(self, name: str, a: Point, b: Point, half_width: float, colour: str) -> mujoco.MjsGeom:
        """Add a plank, 16 mm thick, whose upper face runs from point to point, and return it."""
        (xa, za), (xb, zb) = sorted(((self.direction * u, z) for u, z in (a, b)))
        angle, half_thick = -float(np.arctan2(zb - za, xb - xa)), 0.008
        centre = ((xa + xb) / 2 - half_thick * np.sin(angle), 0.0, (za + zb) / 2 - half_thick * np.cos(angle))
        half_size = (float(np.hypot(xb - xa, zb - za)) / 2, half_width, half_thick)
        return add_box(self.spec.worldbody, name, centre, half_size, colour, euler_y=angle)

    def slab(self, name: str, centre: Vec3, half: Vec3, colour: str, *, falls_rad: float = 0.0) -> mujoco.MjsGeom:
        """Add a static box from its centre and half sizes and return it; falls_rad tilts it downhill."""
        at = (self.direction * centre[0], centre[1], centre[2])
        return add_box(self.spec.worldbody, name, at, half, colour, euler_y=self.direction * falls_rad)

    def tray(
        self,
        name: str,
        along: Span,
        across: Span,
        up: Span,
        colour: str,
        *,
        wall: float,
        near: float | None = None,
        far: float | None = None,
        back: float | None = None,
        front: float | None = None,
        floor: Surface | None = None,
    ) -> tuple[str, ...]:
        """Add a floor, and walls with an upper edge (m) given; return the geoms' names.

        Walls stand on the level of the floor's lower face: near and far outside `along`, back and front inside
        `across`.
        """
        spans = {
            "near": ((along[0] - wall, along[0]), across, near),
            "far": ((along[1], along[1] + wall), across, far),
            "back": (along, (across[1] - wall, across[1]), back),
            "front": (along, (across[0], across[0] + wall), front),
        }
        self.block(f"{name}_floor", along, across, up, colour, floor)
        walls = [part for part, (_, _, top) in spans.items() if top is not None]
        for part in walls:
            wall_along, wall_across, top = spans[part]
            assert top is not None
            self.block(f"{name}_{part}", wall_along, wall_across, (up[0], top), colour)
        return tuple(f"{name}_{part}" for part in ("floor", *walls))

    def rod(
        self,
        name: str,
        a: Vec3,
        b: Vec3,
        radius: float,
        colour: str,
        *,
        solid: bool = True,
        body: mujoco.MjsBody | None = None,
    ) -> mujoco.MjsGeom:
        """Add a round rod between two places (of `body` if given) and return it."""
        import mujoco

        ends = [value for at in (a, b) for value in (self.direction * at[0], at[1], at[2])]
        geom = (body or self.spec.worldbody).add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=ends)
        geom.size, geom.rgba = [radius, 0, 0], rgba(colour)
        if not solid:
            geom.contype = geom.conaffinity = 0
        return geom

    def post(
        self, name: str, at: Vec3, radius: float, half: float, colour: str, *, body: mujoco.MjsBody | None = None
    ) -> mujoco.MjsGeom:
        """Add an upright cylinder of a half height around a place and return it; `body` as in `rod`."""
        import mujoco

        geom = (body or self.spec.worldbody).add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_CYLINDER)
        geom.pos, geom.size, geom.rgba = [self.direction * at[0], at[1], at[2]], [radius, half, 0], rgba(colour)
        return geom

    def hull(
        self, name: str, corners: Sequence[Vec3], colour: str, *, body: mujoco.MjsBody | None = None
    ) -> mujoco.MjsGeom:
        """Add a convex body around corners, without contact, and return it; `body` as in `rod`."""
        import mujoco

        places = [value for at in corners for value in (self.direction * at[0], at[1], at[2])]
        self.spec.add_mesh(name=name, uservert=places)
        geom = (body or self.spec.worldbody).add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, rgba=rgba(colour))
        geom.meshname = name
        geom.contype = geom.conaffinity = 0
        return geom

    # --- what moves ---

    def ball(
        self,
        name: str,
        at: Vec3,
        radius: float,
        colour: str,
        *,
        speed: float = 0.0,
        thrown: tuple[float, float] | None = None,
        rolling: float = 2e-5,
        sliding: float = 0.8,
        density: float = 1000.0,
    ) -> mujoco.MjsGeom:
        """Add a free ball with its centre at a place, and return it.

        speed: along the way (m/s), rolling without slipping. thrown: speeds along and up (m/s), without spin, instead.
        rolling, sliding: friction as in `Surface`. density: kg/m3.
        """
        geom = add_ball(self.spec, name, (self.direction * at[0], at[1], at[2]), radius, colour, density=density)
        geom.friction = [sliding, 0.005, rolling]
        if thrown is not None:
            self.throw(name, *thrown)
        elif speed:
            along = self.direction * speed
            self._velocity[name] = (along, 0.0, 0.0, 0.0, along / radius, 0.0)
        return geom

    def throw(self, name: str, along: float, up: float) -> None:
        """Let a free or soft body begin with speeds (m/s) along and up, without spin."""
        self._velocity[name] = (self.direction * along, 0.0, up, 0.0, 0.0, 0.0)

    def free_box(
        self,
        name: str,
        at: Vec3,
        half: Vec3,
        colour: str,
        *,
        density: float,
        sliding: float | None = None,
        solref: tuple[float, float] | None = None,
    ) -> mujoco.MjsBody:
        """Add a free box, body and geom `name`, with its centre at a place, and return it. density: kg/m3.

        sliding, solref: as in `Surface`; None leaves MuJoCo's own.
        """
        body = self.spec.worldbody.add_body(name=name, pos=[self.direction * at[0], at[1], at[2]])
        body.add_freejoint()
        geom = add_box(body, name, (0, 0, 0), half, colour)
        geom.density = density
        if sliding is not None:
            geom.friction = [sliding, 0.005, 0.0001]
        if solref is not None:
            geom.solref = list(solref)
        return body

    def tower(
        self,
        names: Sequence[str],
        half: Vec3,
        colours: Sequence[str],
        *,
        density: float,
        sliding: float | None = None,
        solref: tuple[float, float] | None = None,
        base: float = 0.0,
    ) -> None:
        """Stack free boxes at the origin, from the ground or from a base (m)."""
        height = 2 * half[2]
        for i, (name, colour) in enumerate(zip(names, colours, strict=True)):
            at = (0.0, 0.0, base + (i + 0.5) * height)
            self.free_box(name, at, half, colour, density=density, sliding=sliding, solref=solref)

    def hinge(
        self, name: str, at: Vec3, *, axis: Vec3 = (0, 1, 0), damping: float = 0.0, range_deg: Span | None = None
    ) -> mujoco.MjsBody:
        """Add a body that turns about an axis and return it; add its parts with `add_box` and `rod`.

        damping: N m s/rad. range_deg: how far it turns, as MuJoCo counts it; None turns freely. A spring is set on
        `body.first_joint()`.
        """
        import mujoco

        body = self.spec.worldbody.add_body(name=name, pos=[self.direction * at[0], at[1], at[2]])
        joint = body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=list(axis), damping=[damping, 0, 0])
        if range_deg is not None:
            joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_TRUE, list(range_deg)
        return body

    # --- what stands for hidden things ---

    def mark(self, phrase: str, at: str | tuple[float, float], colour: str | None = None) -> None:
        """Add a flag over the occluder for what a question names and the occluder hides.

        It is only drawn, and is the same in every world, so put it only where something is, or begins, in every world.

        at: the geom, or the body at its start, behind which it stands, or a place (along, across). colour: None takes
        that geom's.
        """
        if isinstance(at, tuple):
            assert colour is not None, f"the flag of {phrase} needs a colour"
            self._marks[phrase] = ((self.direction * at[0], at[1], 0.0), rgba(colour))
            return
        geom, body = self.spec.geom(at), self.spec.body(at)
        geom = geom if body is None else body.first_geom()
        assert np.isnan(geom.fromto[0]), f"{at} has two ends; give a place"
        x, y, _ = (float(v) for v in (geom.pos if body is None else np.add(body.pos, geom.pos)))
        back = y + float(geom.size[1] or geom.size[0])
        self._marks[phrase] = ((x, back, 0.0), list(geom.rgba) if colour is None else rgba(colour))

    def _raise_flags(self, p: Any, cover: Box, in_view: Sequence[Box]) -> list[Box]:
        """Draw the flags of all marks; return what the camera must see of them.

        A line of sight over the occluder falls as it goes back: it meets the upper edges of `cover`, and the flag flies
        where it passes over the mark. Flags side by side fly at different heights.
        """
        azimuth, down = np.radians(p.azimuth_deg), np.radians(-p.elevation_deg)
        ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        across = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
        points = np.concatenate([box.corners() for box in (*in_view, cover)])
        up_vector = np.array([0.0, 0.0, np.cos(down)]) + ahead * np.sin(down)
        scale = max(np.ptp(_project(points, across)), np.ptp(_project(points, up_vector)) * 4 / 3)
        width, height = FLAG * scale, FLAG_SHAPE * FLAG * scale / float(np.cos(down))
        corners, flags, boxes = cover.corners(), [], []
        for phrase, (foot, colour) in sorted(self._marks.items(), key=lambda mark: float(_project(mark[1][0], across))):
            place = np.array(foot)
            top_z = float((corners[:, 2] + _project(corners - place, ahead) * np.tan(down)).max())
            top_z += FLAG_CLEAR_M + height / 2
            at = float(_project(place, across))
            top_z += height * 1.2 * max((n + 1 for n, flag_at in flags if abs(at - flag_at) < 1.15 * width), default=0)
            flags.append((int(any(abs(at - flag_at) < 1.15 * width for _, flag_at in flags)), at))
            centre = place + across * width / 2 + np.array([0, 0, top_z - place[2]])
            boxes.append(self._add_flag(phrase, place, centre, (width, height), p.azimuth_deg, colour))
        return boxes

    def _add_flag(
        self,
        phrase: str,
        foot: np.ndarray,
        centre: np.ndarray,
        size: tuple[float, float],
        azimuth_deg: float,
        colour: Sequence[float],
    ) -> Box:
        """Add a mast and its flag, without mass or contact; return the flag's box."""
        import mujoco

        top, half_turn = float(centre[2] + size[1] / 2), np.radians(azimuth_deg - 90) / 2
        mast = self.spec.worldbody.add_geom(name=f"mast {phrase}", type=mujoco.mjtGeom.mjGEOM_CYLINDER)
        mast.pos, mast.size = [foot[0], foot[1], (foot[2] + top) / 2], [0.05 * size[0], (top - foot[2]) / 2, 0]
        flag = self.spec.worldbody.add_geom(name=flag_of(phrase), type=mujoco.mjtGeom.mjGEOM_BOX)
        flag.pos, flag.size = centre.tolist(), [size[0] / 2, 0.02 * size[0], size[1] / 2]
        flag.quat = [float(np.cos(half_turn)), 0.0, 0.0, float(np.sin(half_turn))]
        rim = self.spec.worldbody.add_geom(name=f"rim {phrase}", type=mujoco.mjtGeom.mjGEOM_BOX)
        rim.pos, rim.size = centre.tolist(), [(0.5 + RIM) * size[0], 0.01 * size[0], size[1] / 2 + RIM * size[0]]
        rim.quat = flag.quat
        for geom, paint in ((mast, MAST), (flag, colour), (rim, MAST)):
            geom.rgba, geom.contype, geom.conaffinity, geom.mass = list(paint), 0, 0, 0
        (x, y, z), reach, half_high = (float(value) for value in centre), size[0] / 2, size[1] / 2
        return Box((x - reach, y - reach, z - half_high), (x + reach, y + reach, z + half_high))

    # --- what occluder and camera must reach ---

    def box(self, along: Span, across: Span, up: Span, *, left: float = 0.0, right: float = 0.0) -> Box:
        """Return a box in the world, longer (m) at its left and right end for shadows."""
        low, high = sorted((self.direction * along[0], self.direction * along[1]))
        return Box((low - left, across[0], up[0]), (high + right, across[1], up[1]))

    def ahead(self, length: float) -> float:
        """Return the length if the path leads to the right, as shadows fall, else 0."""
        return length if self.direction > 0 else 0.0

    def cover(self, along: Span, across: Span, high: float) -> Box:
        """Return the box that the occluder must hide for things up to `high` m, with their shadows."""
        right = SHADOW_RIGHT * high if self.direction > 0 else 0.01
        return self.box(along, (across[0], across[1] + SHADOW_BACK * high), (0, high), left=0.01, right=right)

    # --- done ---

    def scene(
        self,
        p: Any,
        *,
        decisive: Sequence[str],
        hidden: Sequence[str] = (),
        cover: Box | None = None,
        in_view: Sequence[Box],
        things: Sequence[str] = (),
        also: Sequence[str] = (),
        colours: Sequence[str] = (),
        shown_by: Mapping[str, Sequence[str]] = MappingProxyType({}),
    ) -> Scene:
        """Return the finished scene: compiled model, roles of bodies, camera.

        decisive, hidden, cover, in_view: `kit.Scene` (there, in_view is `framed`). things: phrases that single out one
        thing in view, each ends in its noun ('red ball'). also: further nouns in view. colours: those in view that no
        field `<part>_colour` of the parameters has. shown_by: as in `kit.Scene`.
        """
        flags = [] if cover is None else self._raise_flags(p, cover, in_view)
        nouns = [thing.split()[-1] for thing in things]
        return Scene(
            spec=self.spec,
            view=View(azimuth_deg=p.azimuth_deg, elevation_deg=p.elevation_deg),
            decisive=tuple(decisive),
            hidden=tuple(hidden),
            cover=cover,
            framed=(*in_view, *flags),
            marks=tuple(self._marks),
            shown_by=dict(shown_by),
            velocity=self._velocity,
            inventory=Inventory(
                tuple(dict.fromkeys([*part_colours(p).values(), *colours])),
                tuple(dict.fromkeys([*nouns, *also])),
                tuple(things),
            ),
        )


def part_colours(p: Any) -> dict[str, str]:
    """Return the colour of each part, from the fields `<part>_colour` of the parameters."""
    names = [member.name for member in fields(p) if member.name.endswith("_colour")]
    return {name.removesuffix("_colour"): getattr(p, name) for name in names}


def _project(points: Any, axis: np.ndarray) -> np.ndarray:
    """Return how far points (..., 3) lie along an axis (3,), summed in one order.

    The last bit of a matrix product differs between CPUs, and these numbers go into the model.
    """
    return (np.asarray(points) * axis).sum(axis=-1)
