"""A record's parameters, physics, camera and void are of their types and near what is drawn, or named."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.worlds.spec import SceneSpec


def record(scenario_id: str) -> dict[str, Any]:
    return load_released()[scenario_id].model_dump(mode="json")


@pytest.mark.parametrize(
    ("name", "value", "complaint"),
    [
        ("speed_m_s", 900.0, r"speed_m_s is 900\.0; it is drawn from 0\.5 to 0\.66"),
        ("speed_m_s", "0.6", "speed_m_s is '0.6': Input should be a valid number"),
        ("speed_m_s", float("nan"), "speed_m_s is nan; it must be finite"),
        ("azimuth_deg", float("inf"), "azimuth_deg is inf; it must be finite"),
        ("direction", 2, "direction is 2; it is one of -1, 1"),
        ("lively", 1, "lively is 1: Input should be a valid boolean"),
        ("ball_colour", "navy", "ball_colour is 'navy'; it is one of red, green, blue"),
        ("ball_colour", ["red"], r"ball_colour is \('red',\): Input should be a valid string"),
    ],
)
def test_a_parameter_that_no_scene_has_is_named(name: str, value: Any, complaint: str) -> None:
    params = record("bounce-0001")["params"] | {name: value}
    with pytest.raises(ValueError, match=complaint):
        get_family("bounce").params_from(params)


def test_a_correction_may_go_a_little_beyond_what_is_drawn() -> None:
    params = record("bounce-0001")["params"] | {"speed_m_s": 0.80}  # drawn from 0.50 to 0.66
    assert get_family("bounce").params_from(params).speed_m_s == 0.80


def test_every_number_of_several_is_looked_at() -> None:
    scenario = next(id_ for id_ in load_released() if id_.startswith("tumbling_dice"))
    params = record(scenario)["params"]
    turns = [[1.0, 0.0, 0.0, float("inf")], *params["turns"][1:]]
    with pytest.raises(ValueError, match=r"parameter turns is .*; it must be finite"):
        get_family("tumbling_dice").params_from(params | {"turns": turns})


@pytest.mark.parametrize(
    ("scenario_id", "part", "changes", "complaint"),
    [
        ("bounce-0001", "physics", {"fps": 0}, r"physics\.fps: Input should be greater than or equal to 1"),
        ("bounce-0001", "physics", {"timestep_s": "0.001"}, r"physics\.timestep_s: Input should be a valid number"),
        ("bounce-0001", "physics", {"wind": 1.0}, r"physics\.wind: "),
        ("bounce-0001", "camera", {"distance": float("inf")}, r"camera\.distance: Input should be a finite number"),
        ("bounce-0001", "camera", {"lookat": [0.0, 0.0]}, r"camera\.lookat: List should have at least 3 items"),
        ("bounce-0001", "void", {"hidden_from_frame": 50}, r"void: frame 50 is not in a clip of 5\.0 s at 10 FPS"),
        ("bounce-0001", "void", {"panel": {}}, r"void\.panel\.centre: Field required"),
        ("plinko-0001", "void", {"cut_frame": True}, r"void\.cut_frame: Input should be a valid integer"),
        ("plinko-0001", "void", {"hidden_from_frame": 3}, r"void\.hidden_from_frame: "),
        ("plinko-0001", "control", {"closes_frame": 50}, r"control: frame 50 is not in a clip of 5\.0 s at 10 FPS"),
        ("plinko-0001", "control", {"panel": {}}, r"control\.panel\.centre: Field required"),
        ("bounce-0001", "control", {"closes_frame": 4.5}, r"control\.closes_frame: Input should be a valid integer"),
        ("bounce-0001", "control", {"panel": {}}, r"control\.panel: "),
    ],
)
def test_a_part_of_a_record_that_no_scene_has_is_named(
    scenario_id: str, part: str, changes: dict[str, Any], complaint: str
) -> None:
    whole = record(scenario_id)
    with pytest.raises(ValidationError, match=complaint):
        SceneSpec.model_validate(whole | {part: whole[part] | changes})


def test_a_panel_that_closes_a_cut_scene_is_its_own() -> None:
    whole = record("plinko-0001")
    with pytest.raises(ValidationError, match=r"control\.panel: Field required"):
        SceneSpec.model_validate(whole | {"control": {"closes_frame": whole["control"]["closes_frame"]}})
    assert SceneSpec.model_validate(whole | {"control": None}).closes_frame is None


def test_a_void_without_its_frame_is_named() -> None:
    whole = record("plinko-0001")
    with pytest.raises(ValidationError, match=r"void\.cut_frame: Field required"):
        SceneSpec.model_validate(whole | {"void": {}})
