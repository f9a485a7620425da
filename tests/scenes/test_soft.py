"""Soft bodies move, are seen, hidden and certified as other bodies are, and stay out of the benchmark."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from tests.build.packages import install_soft_bodies
from tests.conftest import ROOT
from tests.scenes.released import SAMPLED, load
from traps_pipeline.base.paths import OWN_SPECS
from traps_pipeline.benchmark.composition import load_composition
from traps_pipeline.benchmark.records import load_released, released_lines
from traps_pipeline.protocol.datasets import EXTENSION_CATEGORIES
from traps_pipeline.scenes.certification.certificates import HIDDEN, SAME_START_M, pair_of
from traps_pipeline.scenes.certification.certify_record import certify
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.picture.checks import differing_pixels
from traps_pipeline.scenes.worlds.outcome import read_outcome
from traps_pipeline.scenes.worlds.world import World

RELEASED = OWN_SPECS / "extensions" / "soft_bodies" / "released"
FAMILIES = ("soft_ball", "soft_hammock", "soft_rope")
FIRSTS = [f"{family}-0001" for family in FAMILIES]


@pytest.fixture(scope="module", autouse=True)
def soft_bodies(tmp_path_factory: pytest.TempPathFactory) -> None:
    install_soft_bodies(tmp_path_factory.mktemp("soft_bodies"))


BUILD = """
import sys
from traps_pipeline.scenes.physics.kit import Physics
from traps_soft_bodies.bodies import soft_ball
from traps_pipeline.scenes.parts.course import Course
for radius in map(float, sys.argv[1:]):
    course = Course(Physics())
    soft_ball(course, "ball", (0, 0, 1.0), radius, "red", thrown=(0.0, 0.0), young=4000.0, mass=0.4)
    model = course.spec.compile()
print(model.body_mass.tobytes().hex(), model.flex_stiffness.tobytes().hex())
"""


@pytest.mark.slow
def test_a_soft_ball_is_the_same_to_the_last_bit_whatever_a_process_built_before() -> None:
    built = [
        subprocess.run([sys.executable, "-c", BUILD, *radii], cwd=ROOT, capture_output=True, text=True, check=True)
        for radii in (["0.0731"], ["0.0787", "0.0731"])
    ]
    assert built[0].stdout == built[1].stdout != ""


def test_a_soft_body_is_counted_and_taken_away_like_a_geom() -> None:
    case = load("soft_rope-0001", RELEASED)
    world = World.of_record(case.spec, case.qpos)
    with world.renderer() as renderer:
        seen = renderer.visible_pixels(case.qpos[:1], ["rope", "peg"])[0]
        with_it, again = (list(renderer.frames(case.qpos[:1])) for _ in range(2))
        without = list(renderer.frames(case.qpos[:1], without=["rope"]))
        gone = differing_pixels(with_it, without)[0]
    assert differing_pixels(with_it, again)[0] == 0
    assert min(seen) > 100
    assert gone > seen[0]  # its shadow goes, too


# --- the extension ----------------------------------------------------------------------------------------------------


def test_the_extension_is_a_benchmark_of_its_own_beside_the_1404_pairs() -> None:
    assert not set(load_composition()) & set(FAMILIES)
    assert not {spec.category for spec in load_released().values()} & set(EXTENSION_CATEGORIES)
    soft = load_released(RELEASED).values()
    assert {spec.family for spec in soft} == set(FAMILIES)
    assert {(spec.category, spec.taxonomy, spec.void_kind) for spec in soft} == {
        ("soft_bodies", "occlusion", "occluder")
    }
    assert {get_family(name).category for name in FAMILIES} == {"soft_bodies"}


@pytest.mark.parametrize("scenario_id", sorted(released_lines(RELEASED)))
def test_every_frozen_trajectory_and_its_twin_end_as_the_record_says(scenario_id: str) -> None:
    case = load(scenario_id, RELEASED)
    for qpos, twin, answer in (
        (case.qpos, False, case.spec.ground_truth),
        (case.twin, True, case.spec.twin.ground_truth),
    ):
        world = World.of_record(case.spec, qpos, twin=twin)
        assert read_outcome(world.family, world.motion, world.params).label == answer


def test_simulating_a_rope_again_gives_its_start_and_its_outcome() -> None:
    case = load("soft_rope-0001", RELEASED)
    world = World.of_record(case.spec, case.qpos)
    here = world.resimulated
    assert np.array_equal(here, replace(world).resimulated)
    assert abs(here[:4] - case.qpos[:4]).max() < SAME_START_M
    assert replace(world, qpos=here).outcome.label == case.spec.ground_truth


@pytest.mark.slow
@pytest.mark.parametrize("scenario_id", FIRSTS)
def test_a_record_is_certified_and_its_observer_sees_the_control_alone(scenario_id: str) -> None:
    case = load(scenario_id, RELEASED)
    assert certify(case.spec, case.qpos, case.twin, frame_step=5).failures == {}
    observe = case.family.observe
    assert observe is not None
    assert observe(case.control_frames, case.spec.question) == case.spec.ground_truth
    assert observe(case.void, case.spec.question) is None
    assert len(case.void) == len(case.qpos[SAMPLED])


@pytest.mark.slow
def test_a_soft_body_that_is_seen_over_a_lower_occluder_loses_the_certificate() -> None:
    case = load("soft_rope-0001", RELEASED)
    pair = pair_of(case.spec, case.qpos, case.twin, frame_step=5)
    occluder = pair.control.occluder
    assert occluder is not None
    (x, y, _), (wide, thick, tall) = occluder.centre, occluder.half
    low = replace(occluder, centre=(x, y, tall / 4), half=(wide, thick, tall / 4))
    found = HIDDEN.measured(replace(pair, control=replace(pair.control, occluder=low)))
    failure = HIDDEN.failure(found | {"commit_s": case.spec.evidence["commit_s"]}, pair.claim)
    assert found["past_panel_px"] > 0 and f"{found['past_panel_px']:.0f}" in str(failure)
