"""Boards pass through nothing, numbers beside voids tell no outcome, and questions name what is seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.released import load
from traps_pipeline.base.paths import RELEASED
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.certification.certificates import REFERENTS, pair_of
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.physics.kit import Physics
from traps_pipeline.scenes.physics.simulate import standing_points
from traps_pipeline.scenes.worlds.world import World

CHAOTIC = ("pachinko_waterfall", "plinko", "seesaw_sorter", "tumbling_dice")


@pytest.mark.parametrize("family", CHAOTIC)
def test_a_board_that_closes_a_control_stands_before_all_that_stands_there(family: str) -> None:
    closed = [spec for spec in load_released(RELEASED).values() if spec.family == family and spec.control is not None]
    for spec in closed[:8]:
        world = World.of_record(spec, load(spec.scenario_id).qpos)
        assert world.closing is not None
        board, azimuth = world.closing.occluder, np.radians(world.camera.azimuth_deg)
        ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        scene = standing_points(world.model, world.qpos[-1])
        assert (board.corners() @ ahead).max() < (scene @ ahead).min(), spec.scenario_id


def test_what_the_record_says_of_a_void_is_the_same_of_both_its_worlds() -> None:
    case = load("slide-0001")
    pair = pair_of(case.spec, case.qpos, case.twin)
    swapped = replace(pair, control=pair.other_world, twin=pair.control)
    assert REFERENTS.measured(pair)["panel_covers"] == REFERENTS.measured(swapped)["panel_covers"]


def test_a_question_calls_a_cylinder_a_cylinder_and_a_box_a_block() -> None:
    transfers = [spec for spec in load_released(RELEASED).values() if spec.family == "transfer"]
    named = {(spec.params["shape"], "cylinder" in spec.question, "block" in spec.question) for spec in transfers}
    assert named == {("box", False, True), ("cylinder", True, False)}


def test_every_flag_stands_for_what_the_question_names() -> None:
    for spec in load_released(RELEASED).values():
        if spec.void_kind == "occluder":
            family = get_family(spec.family)
            marks = family.build(family.params_from(spec.params), Physics(**spec.physics)).marks
            words = f"{spec.question} {' '.join(spec.labels)}".lower()
            assert all(phrase.split()[-1] in words for phrase in marks), spec.scenario_id
