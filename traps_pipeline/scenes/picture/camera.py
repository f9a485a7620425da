"""Fit camera and occluder to a scene; neither is placed by hand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

if TYPE_CHECKING:
    from traps_pipeline.scenes.physics.kit import Box, View

Vec3 = tuple[float, float, float]  # the kit's, which records of boards are checked by, and which brings the physics
WIDTH, HEIGHT = 480, 360
WIDE = 640  # width of a clip of two lanes, in the same height
FRAME_FILL = 0.92  # share of the half-frame that the fitted points may use
OCCLUDER_MARGIN = 0.03  # the occluder reaches this much (m) beyond what it must hide, as seen from the camera
OCCLUDER_GAP = 0.02  # distance (m) between the occluder and the nearest point that it hides
OCCLUDER_HALF_THICKNESS = 0.006


@dataclass(frozen=True)
class Camera:
    """A resolved free camera. extent and centre fix MuJoCo's clipping and shadow map."""

    lookat: Vec3
    distance: float
    azimuth_deg: float
    elevation_deg: float
    fovy_deg: float
    extent: float
    centre: Vec3
    width: ClassVar[int] = WIDTH  # of its picture (px)

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Camera:
        """Return the camera of a stored spec."""
        return cls(**_tuples(record))

    def axes(self) -> np.ndarray:
        """Return unit vectors right, up and forward in the world, rows of (3, 3)."""
        return _axes(self.azimuth_deg, self.elevation_deg)

    def position(self) -> np.ndarray:
        """Return the world position of the eye, shape (3,)."""
        return np.array(self.lookat) - self.distance * self.axes()[2]

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return pixel coordinates (x right, y down) at `width` x 360 of points, (N, 2)."""
        right, up, depth = self.axes() @ (np.atleast_2d(points) - self.position()).T
        focal = HEIGHT / 2 / np.tan(np.radians(self.fovy_deg) / 2)
        return np.stack([self.width / 2 + focal * right / depth, HEIGHT / 2 - focal * up / depth], axis=1)

    def metres_a_pixel(self, point: np.ndarray) -> float:
        """Return the length of a pixel of a height of 360 at the depth of a point (3,)."""
        depth = float(self.axes()[2] @ (point - self.position()))
        return depth * float(np.tan(np.radians(self.fovy_deg) / 2)) / (HEIGHT / 2)


class WideCamera(Camera):
    """A camera whose pictures are wide enough for two lanes."""

    width: ClassVar[int] = WIDE


@dataclass(frozen=True)
class Occluder:
    """An opaque upright box facing the camera. half: across, thickness, up (m)."""

    centre: Vec3
    half: Vec3
    yaw_deg: float

    @staticmethod
    def from_record(record: Mapping[str, Any]) -> Occluder:
        """Return the occluder of a stored spec."""
        return Occluder(**_tuples(record))

    def corners(self) -> np.ndarray:
        """Return the eight corners in the world, shape (8, 3)."""
        local = (2 * np.indices((2, 2, 2)).reshape(3, 8).T - 1) * self.half  # from low to high, the last axis fastest
        c, s = np.cos(np.radians(self.yaw_deg)), np.sin(np.radians(self.yaw_deg))
        return local @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + np.array(self.centre)


@dataclass(frozen=True)
class Closing:
    """The end of a control: from this frame on an occluder stands before the outcome."""

    frame: int
    occluder: Occluder


def _tuples(record: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in record.items()}


@cache  # points are projected for every pose of every rollout
def _axes(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([np.sin(a), -np.cos(a), 0.0])
    axes = np.stack([right, np.cross(right, forward), forward])
    axes.setflags(write=False)
    return axes


def fit_camera(view: View, points: np.ndarray, kind: type[Camera] = Camera) -> Camera:
    """Return the nearest camera along the view with all points (N, 3) in FRAME_FILL.

    With the orientation given, each frame edge is a half-space for the eye: the two pairs of edges give the largest
    admissible forward position, and the eye is centred between the edges that have slack.
    """
    right, up, forward = (points @ axis for axis in _axes(view.azimuth_deg, view.elevation_deg))
    tan_v = np.tan(np.radians(view.fovy_deg) / 2) * FRAME_FILL
    tan_h = tan_v * kind.width / HEIGHT
    edges = [(np.max(x - t * forward), np.max(-x - t * forward)) for x, t in ((right, tan_h), (up, tan_v))]
    eye_forward = min(-(high + low) / (2 * t) for (high, low), t in zip(edges, (tan_h, tan_v), strict=True))
    eye_right, eye_up = ((high - low) / 2 for high, low in edges)
    axes = _axes(view.azimuth_deg, view.elevation_deg)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    distance = float(centre @ axes[2] - eye_forward)
    eye = np.array([eye_right, eye_up, eye_forward]) @ axes
    return kind(
        lookat=_vec(eye + distance * axes[2]),
        distance=round(distance, 6),
        azimuth_deg=view.azimuth_deg,
        elevation_deg=view.elevation_deg,
        fovy_deg=view.fovy_deg,
        extent=round(float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)) / 2), 6),
        centre=_vec(centre),
    )


def fit_occluder(camera: Camera, cover: Box, stage: np.ndarray | None = None) -> Occluder:
    """Return the smallest upright occluder that hides `cover`, just in front of it.

    stage: points (N, 3) that it must be in front of too, so that it passes through nothing.
    """
    eye = camera.position()
    azimuth = np.radians(camera.azimuth_deg)
    ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    across = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    corners = cover.corners()
    before = corners if stage is None else np.concatenate([corners, stage])
    front = float((before @ ahead).min()) - OCCLUDER_GAP - 2 * OCCLUDER_HALF_THICKNESS
    reach = (corners - eye) @ ahead
    plane_points = eye + (corners - eye) * ((front - eye @ ahead) / reach)[:, None]
    side = plane_points @ across
    low, high = float(side.min()) - OCCLUDER_MARGIN, float(side.max()) + OCCLUDER_MARGIN
    top = float(plane_points[:, 2].max()) + OCCLUDER_MARGIN
    centre = across * (low + high) / 2 + ahead * (front + OCCLUDER_HALF_THICKNESS) + np.array([0, 0, top / 2])
    return Occluder(
        centre=_vec(centre),
        half=(round((high - low) / 2, 6), OCCLUDER_HALF_THICKNESS, round(top / 2, 6)),
        yaw_deg=camera.azimuth_deg - 90.0,
    )


def fit_shot(view: View, points: np.ndarray, cover: Box | None) -> tuple[Camera, Occluder | None]:
    """Return a camera that has all points in frame, and an occluder in its frame."""
    camera, occluder = fit_camera(view, points), None
    if cover is None:
        return camera, None
    for _ in range(12):
        occluder = fit_occluder(camera, cover)
        camera = fit_camera(view, np.concatenate([points, occluder.corners()]))
    return camera, fit_occluder(camera, cover)


def is_in_frame(camera: Camera, points: np.ndarray) -> bool:
    """Return whether all points (N, 3) are inside the frame."""
    pixels = camera.project(points)
    return bool((pixels > 0).all() and (pixels < (camera.width, HEIGHT)).all())


def _vec(values: np.ndarray) -> Vec3:
    x, y, z = (round(float(v), 6) for v in values)
    return (x, y, z)
