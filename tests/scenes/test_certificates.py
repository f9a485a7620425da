"""One scenario of every occlusion family is certified on its sampled frames; whatever is altered is found out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.scenes.released import Released, first_of_each, load
from traps_pipeline.scenes.certify import certify
from traps_pipeline.scenes.outcome import Rejected, compile_scene, read_outcome
from traps_pipeline.scenes.simulate import replay
from traps_pipeline.scenes.spec import SceneSpec, trajectory_digest


@pytest.mark.parametrize("scenario_id", first_of_each("occluder"))
def test_a_scenario_of_every_occlusion_family_is_certified(scenario_id: str) -> None:
    case = load(scenario_id)
    verdict = certify(case.spec, case.qpos, case.twin, frame_step=2)
    assert verdict.failures == {}
    assert verdict.measured["twin_px"] == verdict.measured["ablation_px"] == 0
    assert verdict.measured["least_visible_px"] >= 150
    assert verdict.measured["hidden_from_s"] < verdict.measured["commit_s"] <= 4.9 - 0.6 + 1e-9


def altered(spec: SceneSpec, **changes: Any) -> SceneSpec:
    return spec.model_copy(update=changes)


@pytest.fixture(scope="module")
def race() -> Released:
    return load("hidden_race-0001")


def failures(case: Released, spec: SceneSpec) -> dict[str, str]:
    return dict(certify(spec, case.qpos, case.twin, frame_step=10).failures)


def test_a_lowered_panel_hides_nothing_and_betrays_the_twin(race: Released) -> None:
    panel = dict(race.spec.void["panel"])
    x, y, z = panel["centre"]
    across, thickness, up = panel["half"]
    low = panel | {"centre": [x, y, z / 4], "half": [across, thickness, up / 4]}
    found = failures(race, altered(race.spec, void=race.spec.void | {"panel": low}))
    assert {"hidden", "ablation", "twin"} <= set(found)
    assert "pixels" in found["hidden"]


def test_a_changed_answer_is_not_what_the_control_shows(race: Released) -> None:
    other = next(label for label in race.spec.labels if label != race.spec.ground_truth)
    found = failures(race, altered(race.spec, ground_truth=other))
    assert f"the control shows {race.spec.ground_truth!r}" in found["outcome"]


def test_another_hidden_element_is_not_the_scene_of_the_trajectory(race: Released) -> None:
    lanes = len(race.spec.params["colours"])
    params = race.spec.params | {"clear_lane": (race.spec.params["clear_lane"] + 1) % lanes}
    found = failures(race, altered(race.spec, params=params))
    assert "physics" in found or "twin" in found
    assert "simulated here, the scene ends in" in found["physics"]


def test_a_twin_that_differs_in_what_is_seen_is_no_twin(race: Released) -> None:
    assert race.spec.twin.params is not None
    seen = race.spec.twin.params | {"deck_colour": "purple"}
    twin = race.spec.twin.model_copy(update={"params": seen})
    assert "more, or in less, than the hidden element" in failures(race, altered(race.spec, twin=twin))["twin"]


def test_a_camera_that_looks_away_loses_the_scene(race: Released) -> None:
    camera = race.spec.camera | {"distance": race.spec.camera["distance"] / 2}
    assert "in_frame" in failures(race, altered(race.spec, camera=camera))


def test_an_answerable_question_is_not_ill_posed(race: Released) -> None:
    found = failures(race, altered(race.spec, ill_posed_question="Which ball is in front?"))
    assert "nothing shows that 'Which ball is in front?' has no answer" in found["words"]
    found = failures(race, altered(race.spec, question="How much does the ball weigh?"))
    assert "reads as ill-posed: mass" in found["words"]


def test_physics_that_differs_in_the_last_bits_is_told_and_changes_no_verdict(race: Released) -> None:
    nudged = race.qpos + np.float32(1e-7)
    spec = altered(race.spec, trajectory_sha256=trajectory_digest(nudged))
    verdict = certify(spec, nudged, race.twin + np.float32(1e-7), frame_step=10)
    assert not verdict.same_physics
    assert "physics" not in verdict.failures
    assert "outcome" not in verdict.failures


def test_a_clip_that_ends_before_the_outcome_has_settled_is_refused(race: Released) -> None:
    model, _ = compile_scene(race.family, race.params, race.physics)
    settled = round(race.spec.evidence["commit_s"] * race.physics.fps)
    for cut in (settled, settled + 3):
        with pytest.raises(Rejected, match=r"undecided|before the end"):
            read_outcome(race.family, replay(model, race.qpos[:cut], race.physics), race.params)


def test_a_margin_below_the_familys_is_refused(race: Released) -> None:
    strict = replace(race.family, min_margin_m=9.0)
    model, _ = compile_scene(race.family, race.params, race.physics)
    with pytest.raises(Rejected, match="has a margin of"):
        read_outcome(strict, replay(model, race.qpos, race.physics), race.params)
