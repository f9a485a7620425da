"""Soft bodies move, are seen, hidden and certified as other bodies are, and stay out of the benchmark."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, replace

import numpy as np
import pytest

from tests.conftest import ROOT
from tests.scenes.released import SAMPLED, load
from traps_pipeline.base.paths import OWN_SPECS
from traps_pipeline.benchmark.composition import load_composition
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.protocol.datasets import EXTENSION_CATEGORIES
from traps_pipeline.scenes.certification.certificates import HIDDEN, SAME_START_M, pair_of
from traps_pipeline.scenes.certification.certify_record import certify
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.parts.course import Course
from traps_pipeline.scenes.parts.soft_bodies import hammock, rope, soft_ball
from traps_pipeline.scenes.physics.kit import Box, Physics, Scene
from traps_pipeline.scenes.physics.simulate import replay, simulate, swept_points
from traps_pipeline.scenes.picture.checks import differing_pixels
from traps_pipeline.scenes.worlds.outcome import decisive_geoms, moving_geoms, read_outcome
from traps_pipeline.scenes.worlds.world import World

RELEASED = OWN_SPECS / "extensions" / "soft_bodies" / "released"
FAMILIES = ("soft_ball", "soft_hammock", "soft_rope")
FIRSTS = [f"{family}-0001" for family in FAMILIES]
SHORT = Physics(duration_s=0.4)  # frames at 0, 0.1, 0.2 and 0.3 s


@dataclass(frozen=True)
class Seen:
    """What `Course.scene` needs of a family's parameters."""

    azimuth_deg: float = 90.0
    elevation_deg: float = -20.0


def scene_of(course: Course, soft: str) -> Scene:
    return course.scene(Seen(), decisive=[soft], in_view=[Box((-0.1, -0.1, 0.0), (0.1, 0.1, 0.1))])


# --- how they move ----------------------------------------------------------------------------------------------------


def test_a_soft_ball_that_is_thrown_falls_as_any_body_does() -> None:
    course = Course(SHORT, direction=-1)
    soft_ball(course, "ball", (0.2, 0, 1.0), 0.07, "red", thrown=(0.5, 2.0), young=4000.0, mass=0.4)
    scene = scene_of(course, "ball")
    model = scene.spec.compile()
    middle = replay(model, simulate(model, scene, SHORT), SHORT).pos("ball")
    t = np.arange(4) / 10
    # The way leads to the left; 1 + 2 t - 9.81 t^2 / 2, but for the step of 2 ms by which speed and place differ.
    assert middle[:, 0] == pytest.approx(-0.2 - 0.5 * t, abs=2e-3)
    assert middle[:, 2] == pytest.approx(1.0 + 2.0 * t - 4.905 * t**2, abs=9.81 * 0.002 * 0.3)
    assert middle[:, 1] == pytest.approx(0.0, abs=1e-6)


BUILD = """
import sys
from traps_pipeline.scenes.physics.kit import Physics
from traps_pipeline.scenes.parts.soft_bodies import soft_ball
from traps_pipeline.scenes.parts.course import Course
for radius in map(float, sys.argv[1:]):
    course = Course(Physics())
    soft_ball(course, "ball", (0, 0, 1.0), radius, "red", thrown=(0.0, 0.0), young=4000.0, mass=0.4)
    model = course.spec.compile()
print(model.body_mass.tobytes().hex(), model.flex_stiffness.tobytes().hex())
"""


def test_a_soft_ball_is_the_same_to_the_last_bit_whatever_a_process_built_before() -> None:
    built = [
        subprocess.run([sys.executable, "-c", BUILD, *radii], cwd=ROOT, capture_output=True, text=True, check=True)
        for radii in (["0.0731"], ["0.0787", "0.0731"])
    ]
    assert built[0].stdout == built[1].stdout != ""


def test_a_hammock_stays_where_it_is_tied_and_falls_where_it_is_not() -> None:
    course = Course(SHORT)
    hammock(course, "cloth", (0, 0, 0.5), (0.4, 0.2), (4, 2), "red", sag=0.06, tied=(-1,))
    scene = scene_of(course, "cloth")
    model = scene.spec.compile()
    cloth = replay(model, simulate(model, scene, SHORT), SHORT).vertices["cloth"]
    assert cloth.shape == (4, 5 * 3, 3)
    assert cloth[0, :, 2].min() == pytest.approx(0.44) and cloth[0, :, 2].max() == pytest.approx(0.5)
    corners = np.flatnonzero((abs(cloth[0, :, 0]) > 0.199) & (abs(cloth[0, :, 1]) > 0.099))
    fallen = cloth[0, corners, 2] - cloth[-1, corners, 2]
    tied = cloth[0, corners, 0] < 0
    assert tied.sum() == 2 and abs(fallen[tied]).max() < 0.01 and fallen[~tied].min() > 0.1


def test_a_ropes_swept_boxes_are_those_of_its_links() -> None:
    course = Course(SHORT)
    rope(course, "rope", (0, 0, 0.9), 0.6, 0.01, "red", thrown=(0.0, 0.0), links=6)
    scene = scene_of(course, "rope")
    model = scene.spec.compile()
    boxes = swept_points(model, simulate(model, scene, SHORT)[:1]).reshape(-1, 8, 3)
    # Six links of 0.1 m side by side, each 0.01 m thicker to all sides.
    assert len(boxes) == 6
    assert boxes.min(axis=(0, 1)) == pytest.approx([-0.31, -0.01, 0.89], abs=1e-6)
    assert boxes.max(axis=(0, 1)) == pytest.approx([0.31, 0.01, 0.91], abs=1e-6)
    assert np.ptp(boxes[:, :, 0], axis=1) == pytest.approx([0.12] * 6, abs=1e-6)
    assert decisive_geoms(model, ["rope"]) == moving_geoms(model) == ("rope",)


# --- how they are seen ------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("scenario_id", sorted(load_released(RELEASED)))
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
def test_a_soft_body_that_is_seen_over_a_lower_panel_loses_the_certificate() -> None:
    case = load("soft_rope-0001", RELEASED)
    pair = pair_of(case.spec, case.qpos, case.twin, frame_step=5)
    panel = pair.control.panel
    assert panel is not None
    (x, y, _), (wide, thick, tall) = panel.centre, panel.half
    low = replace(panel, centre=(x, y, tall / 4), half=(wide, thick, tall / 4))
    found = HIDDEN.measured(replace(pair, control=replace(pair.control, panel=low)))
    failure = HIDDEN.failure(found | {"commit_s": case.spec.evidence["commit_s"]}, pair.claim)
    assert failure is not None and "seen past it" in failure
