"""Camera and occluder are fitted: everything that must be seen is seen, everything that must be hidden is hidden."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from traps_pipeline.scenes.physics.kit import Box, Physics, View, add_box, new_spec
from traps_pipeline.scenes.picture.camera import (
    FRAME_FILL,
    HEIGHT,
    OCCLUDER_GAP,
    WIDTH,
    Camera,
    Occluder,
    fit_camera,
    fit_occluder,
    fit_shot,
    is_in_frame,
)

VIEWS = [View(), View(20.0, -5.0, 45.0), View(90.0, -60.0, 30.0), View(200.0, -25.0, 60.0), View(-75.0, -15.0, 20.0)]


def fill(camera: Camera, points: np.ndarray) -> tuple[float, float]:
    """The largest share of the half-frame that points use, across and up."""
    offset = np.abs(camera.project(points) - (WIDTH / 2, HEIGHT / 2)) / (WIDTH / 2, HEIGHT / 2)
    return float(offset[:, 0].max()), float(offset[:, 1].max())


def test_projection_by_hand() -> None:
    camera = Camera((0, 0, 0), 2.0, 90.0, 0.0, 90.0, 1.0, (0, 0, 0))  # eye at y = -2, looking along +y, half-angle 45
    assert np.allclose(camera.position(), (0, -2, 0))
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [-1, 2, -1]])
    # focal length 180 px: 1 m at a depth of 2 m is 90 px, at 4 m 45 px
    assert np.allclose(camera.project(points), [[240, 180], [330, 180], [240, 90], [195, 225]])
    assert np.allclose([camera.metres_a_pixel(point) for point in points], [1 / 90, 1 / 90, 1 / 90, 1 / 45])


def test_projection_is_mujocos_own() -> None:
    """A marker drawn by MuJoCo lies on the pixel that `project` says."""
    from traps_pipeline.scenes.picture.render import Renderer

    where = (0.31, -0.12, 0.42)
    spec = new_spec(Physics())
    add_box(spec.worldbody, "dot", where, (0.015, 0.015, 0.015), "red")
    model = spec.compile()
    camera = fit_camera(View(70.0, -25.0, 40.0), Box((-0.5, -0.5, 0.0), (0.5, 0.5, 0.8)).corners())
    with Renderer(model, camera) as renderer:
        frame = next(renderer.frames(np.zeros((1, 0)))).astype(int)
    rows, columns = np.nonzero(frame[..., 0] - frame[..., 1:].max(axis=2) > 60)
    assert np.allclose([columns.mean() + 0.5, rows.mean() + 0.5], camera.project(np.array([where]))[0], atol=1.0)


@pytest.mark.parametrize("view", VIEWS)
def test_all_points_are_in_frame_and_the_tightest_edges_touch_the_limit(view: View) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        points = rng.normal(size=(40, 3)) * rng.uniform(0.05, 2, size=3) + rng.uniform(-3, 3, size=3)
        camera = fit_camera(view, points)
        across, up = fill(camera, points)
        assert max(across, up) == pytest.approx(FRAME_FILL, abs=1e-4)
        assert is_in_frame(camera, points)


def test_a_nearer_camera_of_that_direction_would_lose_a_point() -> None:
    points = np.random.default_rng(2).normal(size=(30, 3))
    camera = fit_camera(View(), points)
    right, up, forward = camera.axes()
    for step in ((0.0, 0.0), (0.03, 0.0), (-0.03, 0.0), (0.0, 0.03), (0.0, -0.03)):
        lookat = np.array(camera.lookat) + 0.02 * forward + step[0] * right + step[1] * up
        nearer = replace(camera, lookat=tuple(lookat))
        assert max(fill(nearer, points)) > FRAME_FILL + 1e-4


def test_a_point_at_the_edge_of_the_frame_is_out() -> None:
    camera = Camera((0, 0, 0), 2.0, 90.0, 0.0, 90.0, 1.0, (0, 0, 0))
    edge = 2 * WIDTH / HEIGHT  # across, at a depth of 2 m
    assert is_in_frame(camera, np.array([[edge - 0.01, 0, 0], [0, 0, 1.99]]))
    assert not is_in_frame(camera, np.array([[edge + 0.01, 0, 0]]))
    assert not is_in_frame(camera, np.array([[0, 0, -2.01]]))


def assert_hidden(camera: Camera, occluder: Occluder, cover: Box) -> None:
    """Rays from the eye to points all over the cover box meet the occluder's front face first."""
    yaw = np.radians(occluder.yaw_deg)
    across, ahead = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
    eye = camera.position()
    inside = np.random.default_rng(4).uniform(cover.low, cover.high, size=(200, 3))
    points = np.concatenate([cover.corners(), inside])
    front = occluder.centre @ ahead - occluder.half[1]
    depth = (points - eye) @ ahead
    meets = (front - eye @ ahead) / depth
    assert ((meets > 0) & (meets < 1)).all()
    hits = eye + (points - eye) * meets[:, None] - occluder.centre
    assert (np.abs(hits @ across) <= occluder.half[0] + 1e-6).all()
    assert (np.abs(hits[:, 2]) <= occluder.half[2] + 1e-6).all()


@pytest.mark.parametrize("view", VIEWS)
def test_the_occluder_hides_the_whole_cover_box_and_stands_in_front_of_it(view: View) -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        low = np.array([*rng.uniform(-1, 1, size=2), rng.uniform(0.0, 0.3)])
        cover = Box(tuple(low), tuple(low + rng.uniform(0.05, 0.8, size=3)))  # type: ignore[arg-type]
        everything = np.concatenate([cover.corners(), rng.uniform((-1.5, -1.5, 0), (1.5, 1.5, 3), size=(10, 3))])
        camera = fit_camera(view, everything)
        occluder = fit_occluder(camera, cover)
        assert_hidden(camera, occluder, cover)
        assert occluder.centre[2] == pytest.approx(occluder.half[2], abs=1e-5)  # it stands on the floor
        yaw = np.radians(occluder.yaw_deg)
        ahead = np.array([-np.sin(yaw), np.cos(yaw), 0])
        gap = (cover.corners() @ ahead).min() - (occluder.corners() @ ahead).max()
        assert gap == pytest.approx(OCCLUDER_GAP, abs=1e-5)


@pytest.mark.parametrize("view", VIEWS)
def test_camera_and_occluder_fit_together(view: View) -> None:
    cover = Box((-0.6, -0.3, 0.0), (0.2, 0.3, 0.5))
    points = np.concatenate([cover.corners(), Box((-0.8, -0.2, 0.0), (0.9, 0.2, 0.6)).corners()])
    camera, occluder = fit_shot(view, points, cover)
    assert occluder is not None
    assert_hidden(camera, occluder, cover)
    assert is_in_frame(camera, np.concatenate([points, occluder.corners()]))
    alone, none = fit_shot(view, points, None)
    assert none is None
    assert alone == fit_camera(view, points)
