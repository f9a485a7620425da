"""Build a tilted board under glass on which balls run down past pegs.

Places are (across, up, out) in metres: from the middle of the board to the right, up its slope from its lower edge, and
out of it towards the glass. Everything is added in the order of the calls, which is the order of the compiled model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.scenes.parts.vary import Drawn, Group, drawn_by, together
from traps_pipeline.scenes.parts.vision import Blob, blobs, colour_mask
from traps_pipeline.scenes.physics.kit import Box, Motion, Physics, Vec3, add_ball, add_box, new_spec, rgba, uniform

if TYPE_CHECKING:
    import mujoco

Span = tuple[float, float]  # from, to (m)
LIFT_M = 0.12  # height of the board's lower edge above the floor
WALL_M = 0.008  # half the thickness of the frame
GLASS_GAP_M = 0.006  # play of a ball under the glass that keeps it on the board


# --- what varies ------------------------------------------------------------------------------------------------------


def peg_rows(least: int, most: int) -> Group:
    """Return a group of the fields `rows`, `peg_gap_m`, `row_shifts_m` of staggered rows of pegs."""

    def draw(rng: np.random.Generator, so_far: Drawn) -> tuple[int, float, tuple[float, ...]]:
        """Draw the number of rows, the gap, and shifts: half a gap in every other row."""
        rows, gap = int(rng.integers(least, most + 1)), uniform(rng, 0.126, 0.140)
        skew = uniform(rng, -0.15, 0.15) if rng.random() < 0.5 else 0.0
        shifts = tuple(round(gap * (i % 2 / 2 + i * skew + float(rng.normal(0, 0.04))), 4) for i in range(rows))
        return rows, gap, shifts

    return together(draw)


def camera_elevation(low: float, high: float) -> Any:
    """Return a field: the camera's elevation, off the normal of a board with a `tilt_deg`."""
    about = f"tilt_deg - 90 + ({low} to {high})"
    return drawn_by(lambda rng, so_far: uniform(rng, low, high) + so_far["tilt_deg"] - 90, about=about)


# --- the board --------------------------------------------------------------------------------------------------------


def slope(tilt_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors up the board and out of it, in the world."""
    tilt = math.radians(tilt_deg)
    return np.array([0, math.cos(tilt), math.sin(tilt)]), np.array([0, -math.sin(tilt), math.cos(tilt)])


def turn_quaternion(angle_rad: float, axis: int) -> list[float]:
    """Return the quaternion of a turn about the x axis (1), y axis (2) or z axis (3)."""
    return [math.cos(angle_rad / 2), *(math.sin(angle_rad / 2) * (i == axis) for i in (1, 2, 3))]


class Board:
    """A pegboard whose pegs, walls and bins are being placed.

    spec: MuJoCo's description of its world. body: the board's body, whose y axis runs up the slope and whose z axis
    stands on it. deep: how far the glass is from the board (m). light: brightness of the key light, which comes almost
    from the front, where the usual one would bleach the colours. friction: of every block; None leaves MuJoCo's own.
    bounce: direct stiffness and damping of the posts.
    """

    def __init__(
        self,
        physics: Physics,
        *,
        tilt_deg: float,
        width_m: float,
        ball_radius_m: float,
        light: tuple[float, float, float],
        bounce: tuple[float, float],
        friction: tuple[float, float, float] | None = None,
    ) -> None:
        self.spec = new_spec(physics)
        self.spec.visual.quality.numslices = self.spec.visual.quality.numstacks = 16  # pegs: half the drawing time
        self.physics, self.tilt_deg, self.ball_radius_m = physics, tilt_deg, ball_radius_m
        self.side, self.outer = width_m / 2, width_m / 2 + 2 * WALL_M  # inner and outer face of the frame
        self.deep = 2 * ball_radius_m + GLASS_GAP_M
        self._bounce, self._friction = bounce, friction
        self.up, self.normal = slope(tilt_deg)
        key = self.spec.light("key")
        key.dir = (-self.normal + [0.12, 0, 0]).tolist()
        key.castshadow = False  # long shadows of pegs would clutter the board
        key.diffuse = list(light)
        self.body = self.spec.worldbody.add_body(
            name="board", pos=[0, 0, LIFT_M], quat=turn_quaternion(math.radians(tilt_deg), 1)
        )

    def block(self, name: str, across: Span, up: Span, out: Span, colour: str, *, solid: bool = True) -> mujoco.MjsGeom:
        """Add a box of the board from its three spans and return it; without solid, paint only."""
        spans = (across, up, out)
        centre, half_size = [sum(s) / 2 for s in spans], [(s[1] - s[0]) / 2 for s in spans]
        geom = add_box(self.body, name, centre, half_size, colour)
        if self._friction is not None:
            geom.friction = list(self._friction)
        if not solid:
            geom.contype = geom.conaffinity = 0
        return geom

    def paint(self, name: str, centre: Vec3, half: Vec3, colour: str) -> mujoco.MjsGeom:
        """Add a box from its centre and half sizes, which collides with nothing, and return it."""
        return add_box(self.body, name, centre, half, colour, contype=0, conaffinity=0)

    def frame(self, bottom: float, top: float, colour: str, *, sill: bool = True) -> None:
        """Add sill, head and sides from `bottom` to `top`, and the glass, never drawn."""
        side, outer, depth_span = self.side, self.outer, (0, self.deep)
        if sill:
            self.block("sill", (-outer, outer), (bottom - 2 * WALL_M, bottom), depth_span, colour)
        self.block("head", (-outer, outer), (top, top + 2 * WALL_M), depth_span, colour)
        self.block("left", (-outer, -side), (bottom, top), depth_span, colour)
        self.block("right", (side, outer), (bottom, top), depth_span, colour)
        glass = self.block("glass", (-outer, outer), (bottom, top), (self.deep, self.deep + 0.02), "white")
        glass.rgba, glass.friction, glass.priority = [1, 1, 1, 0], [0, 0, 0], 1

    def post(self, name: str, at: tuple[float, float], radius: float, colour: str, *, square: bool) -> None:
        """Add a lively post up to the glass: round, or square with a corner up."""
        import mujoco

        half_depth = self.deep / 2
        post = self.body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX if square else mujoco.mjtGeom.mjGEOM_CYLINDER,
            pos=[*at, half_depth],
            size=[radius, radius if square else half_depth, half_depth],
            rgba=rgba(colour),
        )
        post.solref, post.priority, post.condim, post.friction = list(self._bounce), 1, 6, [0.3, 0.002, 0.0001]
        if square:
            post.quat = turn_quaternion(math.pi / 4, 3)

    def divider(self, i: int, x: float, up: Span, half_m: float, colour: str) -> None:
        """Add a wall `wall_<i>` between buckets, and a post on it: a flat end holds balls."""
        self.block(f"wall_{i}", (x - half_m, x + half_m), up, (0, self.deep), colour)
        self.post(f"tip_{i}", (x, up[1]), half_m, colour, square=True)

    def pegs(
        self,
        heights: Sequence[float],
        shifts: Sequence[float],
        gap: float,
        radius: float,
        colour: str,
        *,
        square: bool,
        where: Callable[[float, float], bool] = lambda across, up: True,
    ) -> None:
        """Add rows of pegs, without those that leave a ball just room to jam at a side.

        heights: up the board; shifts: sideways; one a row. gap: distance of neighbouring pegs. where: whether a peg may
        stand at a place (across, up).
        """
        reach = self.side - radius
        for row, (height, shift) in enumerate(zip(heights, shifts, strict=True)):
            for k in range(-20, 21):
                x = shift + k * gap
                room = reach - abs(x)
                if room < 0 or 0.4 * self.ball_radius_m < room < 2.3 * self.ball_radius_m or not where(x, height):
                    continue
                self.post(f"peg_{row}_{k + 20}", (x, height), radius, colour, square=square)

    def ball(
        self, name: str, at: tuple[float, float], colour: str, friction: tuple[float, float, float] = (0.5, 0.005, 2e-4)
    ) -> mujoco.MjsGeom:
        """Add a free ball that lies on the board at (across, up), and return it."""
        centre = self.up * at[1] + self.normal * self.ball_radius_m + np.array([at[0], 0, LIFT_M])
        geom = add_ball(self.spec, name, centre.tolist(), self.ball_radius_m, colour)
        geom.friction = list(friction)
        return geom

    def throw(self, push_m_s: float, rise_m: float) -> tuple[float, ...]:
        """Return the velocity of a ball that rolls sideways and so far up the slope."""
        slowing = 5 / 7 * self.physics.gravity_m_s2 * math.sin(math.radians(self.tilt_deg))
        velocity = self.up * math.sqrt(2 * slowing * rise_m) + np.array([push_m_s, 0, 0])
        return (*velocity.tolist(), *(np.cross(self.normal, velocity) / self.ball_radius_m).tolist())

    def region(self, up: Span, out: float) -> Box:
        """Return the box around a strip of the board from side to side, `out` thick (m)."""
        corners = np.array([self.up * height + self.normal * distance for height in up for distance in (0.0, out)])
        (_, near_y, low), (_, far_y, high) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
        return Box((-self.outer, near_y, low + LIFT_M), (self.outer, far_y, high + LIFT_M))

    def ends(self, top: float) -> tuple[Box, ...]:
        """Return the board's lower and the frame's upper edge, which must be in frame."""
        edges = [(self.up * height).tolist() for height in (0.0, top + 2 * WALL_M)]
        return tuple(Box((-self.outer, y, z + LIFT_M), (self.outer, y, z + LIFT_M)) for _, y, z in edges)


def place(motion: Motion, body: str, tilt_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the place of a body across the board's middle and up it (m), each (F,)."""
    position = motion.pos(body) - np.array([0, 0, LIFT_M])
    return position[:, 0], position @ slope(tilt_deg)[0]


# --- what an observer sees --------------------------------------------------------------------------------------------


def round_ball(frame: np.ndarray, colour: str) -> Blob | None:
    """Return the largest round region of a colour and of a ball's size."""
    candidates = blobs(colour_mask(frame, colour), min_area=90)
    return next((b for b in candidates if b.area < 900 and b.fill > 0.6 and 0.7 < b.box[2] / b.box[3] < 1.4), None)
