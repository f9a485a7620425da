"""What is at rest is not drawn again, and looks as if it were."""

from __future__ import annotations

from unittest.mock import patch

import mujoco
import numpy as np
import pytest

from tests.scenes.released import load
from traps_pipeline.scenes.picture import render
from traps_pipeline.scenes.worlds.world import World


@pytest.mark.slow
def test_a_pose_that_stays_is_drawn_once_and_looks_as_if_drawn_again() -> None:
    case = load("hidden_drop-0001")
    world = World.of_record(case.spec, case.qpos)
    last = case.qpos[-4:]
    assert (last == last[0]).all()  # the ball lies
    with patch.object(mujoco, "mjr_render", wraps=mujoco.mjr_render) as drawn, world.renderer() as renderer:
        (before,) = renderer.frames(case.qpos[:1])
        already = drawn.call_count
        resting = list(renderer.frames(last))
        assert drawn.call_count == already + 1
        # Behind the occluder, without a part, and by segments the same pose is another picture.
        (behind,) = renderer.frames(last[:1], occluder=True)
        (without,) = renderer.frames(last[:1], without=world.concealed_geoms)
        seen = renderer.visible_pixels(last[:2], world.geoms)
        (again,) = renderer.frames(last[:1])
        assert drawn.call_count == already + 5
    assert (seen[0] == seen[1]).all() and seen.sum() > 0
    for frame in (*resting, again):
        assert np.array_equal(frame, resting[0])
    others = (before, behind, without)
    assert not any(np.array_equal(frame, resting[0]) for frame in others)
    with world.renderer() as renderer:  # each after another pose
        order = [case.qpos[0], last[0], case.qpos[0], last[1]]
        assert all(np.array_equal(frame, resting[0]) for frame in list(renderer.frames(order))[1::2])


@pytest.mark.slow
@pytest.mark.parametrize("scenario_id", ["balance-0001", "tumbling_dice-0001"])  # one with a horizon
def test_a_finite_floor_looks_as_an_infinite_one_with_haze_and_texture(scenario_id: str) -> None:
    case = load(scenario_id)
    with World.of_record(case.spec, case.qpos).renderer() as renderer:
        (finite,) = renderer.frames(case.qpos[-1:])
    infinite = World.of_record(case.spec, case.qpos)
    plane = infinite.model.geom("floor").id
    assert not infinite.model.geom_size[plane, :2].any()
    with patch.object(render, "_make_floors_finite"), infinite.renderer() as renderer:
        (wanted,) = renderer.frames(case.qpos[-1:])
    assert not infinite.model.geom_size[plane, :2].any()  # as MuJoCo draws it by itself
    apart = np.abs(finite.astype(int) - wanted).max(axis=-1)
    assert (apart > 0).mean() < 0.01 and (apart > 2).mean() < 0.0005
