"""The rules abstain by their cue and by nothing else, and see neither record nor side."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.scenes.released import load
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.models.asking.answers import _secret
from traps_pipeline.models.asking.backends import make_backend
from traps_pipeline.models.baselines.reference import ABSTENTION
from traps_pipeline.models.baselines.shortcut_rules import CUES, CUT_FRAMES, OCCLUDER_PX, RULES, has_no_choices
from traps_pipeline.models.registry.entries import get_model
from traps_pipeline.models.request import Request
from traps_pipeline.scenes.parts.look import MATERIALS, OCCLUDERS, Look
from traps_pipeline.scenes.parts.vision import largest_board
from traps_pipeline.scenes.physics.kit import COLOURS
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.outcome import compile_scene
from traps_pipeline.scenes.worlds.world import World
from traps_pipeline.video.encode import encode

FLOOR, NAVY = (200, 200, 188), tuple(round(255 * part) for part in COLOURS["navy"])
CHOICES, OPEN = "Is the ball in the tray, yes or no?", "What did the ball cost?"


def clip(folder: Path, name: str, frames: int = 50, patch: int = 0, from_frame: int = 0) -> Path:
    """A clip of an empty floor, with a square of navy of that side from a frame on."""
    shown = np.full((frames, 360, 480, 3), FLOOR, np.uint8)
    shown[from_frame:, 100 : 100 + patch, 100 : 100 + patch] = NAVY
    encode(list(shown), folder / name, 10)
    return folder / name


def said(rule: str, media: Path, question: str, **secret: Any) -> str:
    """The text that a rule gives; the observer sees nothing on an empty floor."""
    entry = get_model(f"{rule}-rule")
    about = {"item_id": "i", "model": entry.id, "regime": "standard", "run": 1}
    given = secret or {"commonest_answer": "no"}
    request = Request(entry.id, "rule", entry.params, "", question, about, media=media, media_digest=str(media))
    request = Request(**{**vars(request), "secret": given})
    return str(asyncio.run(make_backend(entry).ask(request)).text)


def abstains(rule: str, media: Path, question: str) -> bool:
    text = said(rule, media, question)
    assert (ABSTENTION in text) != ("The answer is: no." in text)
    return ABSTENTION in text


@pytest.mark.parametrize(
    ("what", "question", "abstaining"),
    [
        ({}, CHOICES, set()),
        ({"patch": 60}, CHOICES, {"occluder", "any"}),
        ({"frames": 23}, CHOICES, {"length", "any"}),
        ({"frames": 24}, CHOICES, set()),
        ({}, OPEN, {"wording", "any"}),
        ({"patch": 60, "frames": 20}, OPEN, {*RULES}),
        ({"patch": 20}, CHOICES, set()),  # 400 pixels of dark blue are a shade and no occluder
        ({"patch": 60, "from_frame": 30}, CHOICES, set()),  # the first frame alone is looked at
    ],
)
def test_a_rule_abstains_by_its_own_cue_and_by_no_other(
    tmp_path: Path, what: dict[str, int], question: str, abstaining: set[str]
) -> None:
    media = clip(tmp_path, "clip.mp4", **what)
    assert {rule for rule in RULES if abstains(rule, media, question)} == abstaining


@pytest.mark.slow  # fifteen renderers
@pytest.mark.parametrize("occluder", OCCLUDERS)
def test_the_occluder_rule_sees_occluders_of_every_colour_and_material_and_no_occluder_where_there_is_none(
    occluder: str,
) -> None:
    case = load("bounce-0001")
    for material in MATERIALS:
        look = Look(panel=occluder, material=material, light=(0.8, 0.82, 0.85))
        world = replace(World.of_record(case.spec, case.qpos), params=replace(case.params, look=look))
        with world.renderer() as renderer:
            (control,) = renderer.frames(case.qpos[:1])
            control = control.copy()
            (void,) = renderer.frames(case.qpos[:1], occluder=True)
        assert largest_board(control, OCCLUDER_PX) is None
        board = largest_board(void, OCCLUDER_PX)
        assert board is not None and board.area > 0.8 * (void != control).any(axis=2).sum()


def test_without_its_cue_a_rule_says_what_the_observer_sees_and_else_the_commonest_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    media = clip(tmp_path, "clip.mp4")
    assert said("any", media, CHOICES, commonest_answer="maybe").endswith("The answer is: maybe.")
    monkeypatch.setattr(
        "traps_pipeline.models.baselines.shortcut_rules.observer_answer", lambda digest, clip, question, frames: "yes"
    )
    assert said("any", media, CHOICES, commonest_answer="maybe").endswith("The answer is: yes.")


def test_a_rule_is_told_the_commonest_answer_and_nothing_of_the_item_besides() -> None:
    item = {"side": "void", "labels": ["yes"], "ground_truth": "yes", "commonest_answer": "no"}
    for rule in RULES:
        assert _secret(get_model(f"{rule}-rule"), item) == {"commonest_answer": "no"}
    assert _secret(get_model("observer"), item) == {}


def test_every_released_question_names_its_choices_and_most_ill_posed_ones_do_not() -> None:
    specs = load_released().values()
    assert not any(has_no_choices(spec.question) for spec in specs)
    caught = [has_no_choices(spec.ill_posed_question) for spec in specs]
    assert (sum(caught), len(caught)) == (468, 702)  # "Is the ramp hollow or solid?" names some all the same


def test_every_released_chaotic_void_is_shorter_than_a_control() -> None:
    cuts = [spec.void["cut_frame"] for spec in load_released().values() if spec.void_kind == "truncation"]
    assert len(cuts) == 500
    assert max(cuts) < CUT_FRAMES


@pytest.mark.slow
@pytest.mark.parametrize("scenario_id", ["stack-0001", "transfer-0001", "topple-0001"])  # dark blue specks, no occluder
def test_the_occluder_is_seen_in_an_occlusion_void_and_not_in_its_control(tmp_path: Path, scenario_id: str) -> None:
    case = load(scenario_id)
    model, _ = compile_scene(case.family, case.params, case.physics, case.occluder)
    with Renderer(model, case.camera) as renderer:
        for side, occluder in (("control", False), ("void", True)):
            media = tmp_path / f"{scenario_id}-{side}.mp4"
            encode(list(renderer.frames(case.qpos[:1], occluder=occluder)), media, 10)
            assert CUES["occluder"](str(media), media, case.spec.question) == occluder
