"""Build ramps along the path or towards the camera, and locate points on them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from traps_pipeline.scenes.parts.course import Course
from traps_pipeline.scenes.physics.kit import Vec3, add_box

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class Ramp:
    """A slope, from its foot: `up` it, `over` its surface, `aside` of its middle (m).

    foot_m: position of the foot, along the path or, towards the camera, in y. height_m: height of the
    surface at the foot. towards_camera: the ramp falls towards the camera and its middle is at `middle_m` in x; else it
    falls along the path.
    """

    slope_deg: float
    height_m: float
    foot_m: float = 0.0
    towards_camera: bool = False
    middle_m: float = 0.0

    @property
    def slope_rad(self) -> float:
        """Angle of the slope."""
        return float(np.radians(self.slope_deg))

    def at(self, up: float, over: float = 0.0, aside: float = 0.0) -> Vec3:
        """Return a point on the slope in the course's coordinates."""
        sin, cos = float(np.sin(self.slope_rad)), float(np.cos(self.slope_rad))
        distance, height = self.foot_m + up * cos - over * sin, self.height_m + up * sin + over * cos
        return (self.middle_m + aside, distance, height) if self.towards_camera else (-distance, aside, height)

    def board(
        self, course: Course, name: str, up: float, over: float, half: Vec3, colour: str, *, aside: float = 0.0
    ) -> mujoco.MjsGeom:
        """Add a box on the slope and return it. half: half sizes up the slope, across it, out of it."""
        centre = self.at(up, over, aside)
        if not self.towards_camera:
            return course.slab(name, centre, half, colour, falls_rad=self.slope_rad)
        geom = add_box(course.spec.worldbody, name, centre, (half[1], half[0], half[2]), colour)
        geom.quat = [float(np.cos(self.slope_rad / 2)), float(np.sin(self.slope_rad / 2)), 0.0, 0.0]
        return geom

    def support(self, course: Course, name: str, up: float, under: float, half_width: float, colour: str) -> None:
        """Add a post from the ground to a depth under the surface."""
        x, y, z = self.at(up, -under)
        half_size = (half_width, 0.02, z / 2) if self.towards_camera else (0.02, half_width, z / 2)
        course.slab(name, (x, y, z / 2), half_size, colour)


@dataclass(frozen=True)
class SteppedRamp:
    """A ramp that ends in a step above the deck: nothing comes back up.

    length_m: length along the ground. height_m: height of its lower end.
    """

    length_m: float
    slope_deg: float
    height_m: float

    def at(self, along: float, over: float = 0.0) -> Vec3:
        """Return the point at a distance along the path and above the surface."""
        slope = np.radians(self.slope_deg)
        high = self.height_m + (self.length_m - along) * np.tan(slope)
        return (float(along + over * np.sin(slope)), 0.0, float(high + over * np.cos(slope)))

    def add(self, course: Course, half_width: float, colour: str) -> mujoco.MjsGeom:
        """Add the board `ramp` and the `prop` under its upper end; return the board."""
        slope, half_thick = np.radians(self.slope_deg), 0.012
        half_size = (self.length_m / 2 / float(np.cos(slope)), half_width, half_thick)
        ramp = course.slab("ramp", self.at(self.length_m / 2, -half_thick), half_size, colour, falls_rad=float(slope))
        top = self.at(0.05)[2] / 2 - 0.012
        course.slab("prop", (0.05, 0, top), (0.012, half_width, top), colour)
        return ramp
