"""A record's parameters, physics, camera and void are of their types and near what is drawn, or named."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from tests.build.errors import raises
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.worlds.spec import SceneSpec


def record(scenario_id: str) -> dict[str, Any]:
    return load_released()[scenario_id].model_dump(mode="json")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("speed_m_s", 900.0),
        ("speed_m_s", "0.6"),
        ("speed_m_s", float("nan")),
        ("azimuth_deg", float("inf")),
        ("direction", 2),
        ("lively", 1),
        ("ball_colour", "navy"),
        ("ball_colour", ["red"]),
    ],
)
def test_a_parameter_that_no_scene_has_is_named(name: str, value: Any) -> None:
    params = record("bounce-0001")["params"] | {name: value}
    with raises(ValueError, "scenes.parts.vary"):
        get_family("bounce").params_from(params)


def test_a_correction_may_go_a_little_beyond_what_is_drawn() -> None:
    params = record("bounce-0001")["params"] | {"speed_m_s": 0.80}  # drawn from 0.50 to 0.66
    assert get_family("bounce").params_from(params).speed_m_s == 0.80


def test_every_number_of_several_is_looked_at() -> None:
    scenario = next(id_ for id_ in load_released() if id_.startswith("tumbling_dice"))
    params = record(scenario)["params"]
    turns = [[1.0, 0.0, 0.0, float("inf")], *params["turns"][1:]]
    with raises(ValueError, "scenes.parts.vary.check", "turns"):
        get_family("tumbling_dice").params_from(params | {"turns": turns})


@pytest.mark.parametrize(
    ("scenario_id", "part", "changes"),
    [
        ("bounce-0001", "physics", {"fps": 0}),
        ("bounce-0001", "physics", {"timestep_s": "0.001"}),
        ("bounce-0001", "physics", {"wind": 1.0}),
        ("bounce-0001", "camera", {"distance": float("inf")}),
        ("bounce-0001", "camera", {"lookat": [0.0, 0.0]}),
        ("bounce-0001", "void", {"hidden_from_frame": 50}),
        ("bounce-0001", "void", {"panel": {}}),
        ("plinko-0001", "void", {"cut_frame": True}),
        ("plinko-0001", "void", {"hidden_from_frame": 3}),
        ("plinko-0001", "control", {"closes_frame": 50}),
        ("plinko-0001", "control", {"panel": {}}),
        ("bounce-0001", "control", {"closes_frame": 4.5}),
        ("bounce-0001", "control", {"panel": {}}),
    ],
)
def test_a_part_of_a_record_that_no_scene_has_is_named(scenario_id: str, part: str, changes: dict[str, Any]) -> None:
    whole = record(scenario_id)
    with raises(ValidationError, "SceneSpec"):
        SceneSpec.model_validate(whole | {part: whole[part] | changes})


def test_an_occluder_that_closes_a_cut_scene_is_its_own() -> None:
    whole = record("plinko-0001")
    with raises(ValidationError, "SceneSpec"):
        SceneSpec.model_validate(whole | {"control": {"closes_frame": whole["control"]["closes_frame"]}})
    assert SceneSpec.model_validate(whole | {"control": None}).closes_frame is None


def test_a_void_without_its_frame_is_named() -> None:
    whole = record("plinko-0001")
    with raises(ValidationError, "SceneSpec"):
        SceneSpec.model_validate(whole | {"void": {}})
