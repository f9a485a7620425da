"""Animate the board that closes a control: it falls into the picture and stands.

A camera that looks down on the scene sees it slide in from the side instead. It comes just in front of where a void's
own board stands, in control and void alike: neither that a board comes nor when tells the sides of an occlusion pair
apart.
"""

import math

import numpy as np

from traps_pipeline.scenes.picture.camera import HEIGHT, Camera, Closing, Occluder

ACCELERATION_M_S2 = 9.81  # as things fall; a board that slides in gains speed like one
STEEP_DEG = 45.0  # a camera that looks down by more
IN_FRONT_M = 0.002  # of the board that may stand already
STEP_M = 0.02  # to which the way is found
FURTHEST_M = 4.0

Offset = tuple[float, float, float]
LANDED: Offset = (0.0, 0.0, 0.0)
Coming = list[Offset | None]  # of each frame: how far from its place (m) the board is; None while it is not there


def coming_board(closing: Closing | None, camera: Camera, n_frames: int, fps: float) -> Coming:
    """Return the board's offset (m) in every frame of the clip, None before it comes."""
    if closing is None:
        return [None] * n_frames
    direction = _direction(closing.occluder, camera)
    distance = _out_of_picture_m(closing.occluder, camera, direction)
    speed = math.sqrt(2 * ACCELERATION_M_S2 * distance)  # m/s, as it lands

    def offset(left_s: float) -> Offset | None:
        if left_s >= speed / ACCELERATION_M_S2:
            return None
        x, y, z = (speed * left_s - ACCELERATION_M_S2 * left_s**2 / 2) * direction
        return (float(x), float(y), float(z))

    return [LANDED if i >= closing.frame else offset((closing.frame - i) / fps) for i in range(n_frames)]


def before_board(occluder: Occluder) -> np.ndarray:
    """Return the offset (m) of a coming board to a standing one, towards the camera."""
    azimuth = math.radians(occluder.yaw_deg + 90.0)
    return -(2 * occluder.half[1] + IN_FRONT_M) * np.array([math.cos(azimuth), math.sin(azimuth), 0.0])


def _direction(occluder: Occluder, camera: Camera) -> np.ndarray:
    """Return the unit vector to where a board comes from: up, or its side."""
    if camera.elevation_deg >= -STEEP_DEG:
        return np.array([0.0, 0.0, 1.0])
    right = camera.axes()[0]
    return right if camera.project(np.array(occluder.centre))[0, 0] >= camera.width / 2 else -right


def _out_of_picture_m(occluder: Occluder, camera: Camera, way: np.ndarray) -> float:
    """Return how far along its way a board is out of the picture."""
    corners = occluder.corners() + before_board(occluder)
    for distance in np.arange(0.0, FURTHEST_M, STEP_M):
        x, y = camera.project(corners + distance * way).T
        if (x < 0).all() or (x > camera.width).all() or (y < 0).all() or (y > HEIGHT).all():
            return float(distance)
    return FURTHEST_M
