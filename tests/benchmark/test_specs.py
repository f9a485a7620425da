"""Corrected parameters: which words a scene keeps, and that it is simulated once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import RELEASED
from traps_pipeline.benchmark.corrections import Correction, Scenario, apply_corrections
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.benchmark.specs import ResolvedScenario, resolve_scenario, unsettled_outcomes
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace.create(tmp_path, Study())


def corrected(*changes: dict) -> Scenario:
    decisions = [
        Correction.model_validate({"action": "correct", "who": "t", "when": "2026-11-21", "why": "t", **change})
        for change in changes
    ]
    corrected_scenarios = apply_corrections(
        load_released(), [(f"review.jsonl:{n}", decision) for n, decision in enumerate(decisions, 1)]
    )
    return corrected_scenarios[decisions[0].scenario_id]


@pytest.mark.slow
def test_another_camera_keeps_every_word(workspace: Workspace) -> None:
    scenario_id = "domino_chain-0002"
    released = load_released()[scenario_id]
    azimuth = released.params["azimuth_deg"] + 2.0
    spec = resolve_scenario(workspace, corrected({"scenario_id": scenario_id, "params": {"azimuth_deg": azimuth}})).spec
    words = ("question", "labels", "aliases", "ill_posed_question", "answerable_question", "ground_truth")
    assert {name: getattr(spec, name) for name in words} == {name: getattr(released, name) for name in words}
    assert spec.scene_hash != released.scene_hash


@pytest.mark.slow
def test_another_colour_brings_the_words_for_it(workspace: Workspace) -> None:
    released = load_released()["domino_chain-0001"]
    old = released.params["last_colour"]
    new = next(c for c in ("red", "green", "blue") if c not in released.params.values())
    assert old in released.question
    change = {"scenario_id": "domino_chain-0001", "params": {"last_colour": new}}
    spec = resolve_scenario(workspace, corrected(change)).spec
    assert new in spec.question
    assert old not in spec.question


@pytest.mark.slow  # resolves a scene
def test_words_corrected_later_find_the_scene_that_was_simulated(workspace: Workspace) -> None:
    azimuth = load_released()["hidden_race-0001"].params["azimuth_deg"] + 2.0
    scene = {"scenario_id": "hidden_race-0001", "params": {"azimuth_deg": azimuth}}
    first = resolve_scenario(workspace, corrected(scene))
    simulated = {path: path.stat().st_mtime_ns for path in workspace.trajectories.iterdir()}
    words = {"scenario_id": "hidden_race-0001", "question": "Which one leads when the balls leave the tunnel?"}
    second = resolve_scenario(workspace, corrected(scene, words))
    assert second.spec.question == words["question"]
    assert second.spec.scene_hash == first.spec.scene_hash
    assert {path: path.stat().st_mtime_ns for path in workspace.trajectories.iterdir()} == simulated


@pytest.mark.slow  # resolves a scene
def test_an_answer_that_the_simulation_contradicts_is_refused(workspace: Workspace) -> None:
    released = load_released()["domino_chain-0001"]
    wrong = next(label for label in released.labels if label != released.ground_truth)
    azimuth = released.params["azimuth_deg"] + 2.0
    change = {"scenario_id": "domino_chain-0001", "params": {"azimuth_deg": azimuth}, "answer": wrong}
    by, answers = "benchmark.specs.resolve_scenario", (repr(wrong), repr(released.ground_truth))
    with raises(TrapsError, by, "review.jsonl:1", *answers):
        resolve_scenario(workspace, corrected(change))


@pytest.mark.slow  # compiles a scene
def test_a_corrected_question_replays_no_scene_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    spec = load_released()["plinko-0003"]
    trajectory, absent = RELEASED / "trajectories" / "plinko-0003.npz", tmp_path / "absent.npz"
    other_evidence = spec.model_copy(update={"evidence": {**spec.evidence, "commit_s": 0.0}})
    assert len(unsettled_outcomes([ResolvedScenario(other_evidence, trajectory)])) == 1
    with raises(ValueError, "scenes.worlds.spec.load_trajectory", str(absent)):
        unsettled_outcomes([ResolvedScenario(spec, absent)])
    assert unsettled_outcomes([ResolvedScenario(spec, trajectory)]) == []
    asked = spec.model_copy(update={"ill_posed_question": "How heavy is the blue square?"})
    assert unsettled_outcomes([ResolvedScenario(asked, absent)]) == []
    assert len(unsettled_outcomes([ResolvedScenario(other_evidence, trajectory)])) == 1
