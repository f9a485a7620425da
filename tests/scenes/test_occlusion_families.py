"""The promise of an occlusion pair, on one released record of each family: the void hides what decides the outcome.

Two worlds that differ in the hidden element alone give one void video and two answers.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "osmesa")

import numpy as np
import pytest

from traps_pipeline.scenes import checks
from traps_pipeline.scenes.camera import Camera, Panel
from traps_pipeline.scenes.kit import Family, Physics
from traps_pipeline.scenes.registry import get_family
from traps_pipeline.scenes.render import Renderer
from traps_pipeline.scenes.resolve import Rejected, compile_scene, decisive_geoms, read_outcome, resolve
from traps_pipeline.scenes.simulate import replay, simulate
from traps_pipeline.scenes.spec import SceneSpec, load_trajectory

RELEASED = Path(__file__).parents[2] / "scene_specs" / "released"
FAMILIES = ("domino_chain", "hidden_race")
EVERY_FIFTH = slice(None, None, 5)


@dataclass(frozen=True)
class Record:
    """A released scenario, its values restored."""

    family: Family
    spec: SceneSpec
    qpos: np.ndarray
    params: Any
    physics: Physics
    camera: Camera
    panel: Panel

    def void_of(self, params: Any, qpos: np.ndarray, panel: Panel | None = None) -> list[np.ndarray]:
        """Void frames of a world, seen by this record's camera past this record's panel."""
        model, _ = compile_scene(self.family, params, self.physics, panel or self.panel)
        with Renderer(model, self.camera) as renderer:
            return list(renderer.frames(qpos, panel=True))

    def hidden_from(self, panel: Panel) -> int | None:
        """The first frame from which the void hides everything decisive, judged on every fifth frame."""
        model, scene = compile_scene(self.family, self.params, self.physics, panel)
        decisive = decisive_geoms(model, scene.decisive)
        with Renderer(model, self.camera) as renderer:
            return checks.hidden_from(renderer, self.qpos[EVERY_FIFTH], decisive, scene.hidden)


def _restore(cls: type, values: dict[str, Any]) -> Any:
    return cls(**{key: tuple(value) if isinstance(value, list) else value for key, value in values.items()})


@pytest.fixture(scope="module", params=FAMILIES)
def record(request: pytest.FixtureRequest) -> Iterator[Record]:
    line = (RELEASED / f"{request.param}.jsonl").read_text(encoding="utf-8").splitlines()[0]
    spec = SceneSpec.model_validate(json.loads(line))
    family = get_family(spec.family)
    yield Record(
        family=family,
        spec=spec,
        qpos=load_trajectory(RELEASED / "trajectories" / f"{spec.scenario_id}.npz", spec.trajectory_sha256),
        params=family.params_from(spec.params),
        physics=Physics(**spec.physics),
        camera=_restore(Camera, spec.camera),
        panel=_restore(Panel, spec.void["panel"]),
    )


def test_the_frozen_trajectory_shows_the_released_answer(record: Record) -> None:
    model, _ = compile_scene(record.family, record.params, record.physics)
    outcome = read_outcome(record.family, replay(model, record.qpos, record.physics), record.params)
    assert outcome.label == record.spec.ground_truth
    assert outcome.commit_frame / record.physics.fps == record.spec.evidence["commit_s"]
    assert outcome.margin_m >= record.family.min_margin_m


def test_a_draw_resolves_to_the_same_record_every_time(record: Record) -> None:
    def drawn() -> str:
        rng = np.random.default_rng([20, 26])
        params = record.family.draw(rng)
        wording = record.family.word(params, rng)
        return resolve(record.family, params, wording, scenario_id=f"{record.family.name}-0001", seed=0)[0].spec_hash

    assert drawn() == drawn()


def test_nothing_decisive_has_a_pixel_once_it_is_hidden(record: Record) -> None:
    model, scene = compile_scene(record.family, record.params, record.physics, record.panel)
    decisive = decisive_geoms(model, scene.decisive)
    first = record.spec.void["hidden_from_frame"]
    with Renderer(model, record.camera) as renderer:
        from_hiding_on = renderer.visible_pixels(record.qpos[first::5], [*decisive, *scene.hidden], panel=True)
        before = renderer.visible_pixels(record.qpos[:first:5], scene.hidden, panel=True)
        control = renderer.visible_pixels(record.qpos[-1:], decisive)
    assert from_hiding_on.sum() == 0
    assert before.sum() == 0
    assert control.min() >= 150  # the control shows at its end what the void hides


def test_taking_the_hidden_things_away_changes_no_pixel_of_the_void(record: Record) -> None:
    model, scene = compile_scene(record.family, record.params, record.physics, record.panel)
    geoms = [*decisive_geoms(model, scene.decisive), *scene.hidden]
    frames = record.qpos[record.spec.void["hidden_from_frame"] :: 5]
    with Renderer(model, record.camera) as renderer:
        assert checks.ablation_pixels(renderer, frames, geoms) == 0


def test_two_worlds_with_different_answers_give_one_void_video(record: Record) -> None:
    assert record.family.twins is not None
    void = record.void_of(record.params, record.qpos[EVERY_FIFTH])
    answers = {record.spec.ground_truth}
    for twin in record.family.twins(record.params):
        model, scene = compile_scene(record.family, twin, record.physics)
        qpos = simulate(model, scene, record.physics)
        for mine, theirs in zip(void, record.void_of(twin, qpos[EVERY_FIFTH]), strict=True):
            assert np.array_equal(mine, theirs)
        answers.add(read_outcome(record.family, replay(model, qpos, record.physics), twin).label)
    assert len(answers) >= 2


def test_a_panel_of_half_the_height_is_found_out(record: Record) -> None:
    x, y, z = record.panel.centre
    across, thickness, up = record.panel.half
    lowered = replace(record.panel, centre=(x, y, z / 2), half=(across, thickness, up / 2))
    assert record.hidden_from(record.panel) is not None
    assert record.hidden_from(lowered) is None


def test_a_clip_that_ends_before_the_outcome_has_settled_is_refused(record: Record) -> None:
    model, _ = compile_scene(record.family, record.params, record.physics)
    settled = round(record.spec.evidence["commit_s"] * record.physics.fps)
    for cut in (settled, settled + 3):
        with pytest.raises(Rejected, match=r"undecided|before the end"):
            read_outcome(record.family, replay(model, record.qpos[:cut], record.physics), record.params)


@pytest.mark.parametrize("name", FAMILIES)
def test_released_questions_name_their_choices_and_no_ill_posed_text_is_used_twice(name: str) -> None:
    lines = (RELEASED / f"{name}.jsonl").read_text(encoding="utf-8").splitlines()
    specs = [SceneSpec.model_validate(json.loads(line)) for line in lines]
    assert len({spec.ill_posed_question for spec in specs}) == len(specs)
    for spec in specs:
        assert all(label in spec.question for label in spec.labels)
        assert all(label in spec.answerable_question.question for label in spec.answerable_question.labels)
