"""A clip ends early enough that its outcome settles after 30 % of it or later, control and void alike, and is drawn so
that it settles after 80 % or earlier; the numbers of frames are counted by hand for 50 frames at 10 a second."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.released import load
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.models.baselines.shortcut_rules import CUT_FRAMES
from traps_pipeline.scenes.certification.certificates import PACE, pair_of, stored_evidence
from traps_pipeline.scenes.physics.kit import Physics
from traps_pipeline.scenes.worlds.outcome import compile_scene, simulated
from traps_pipeline.scenes.worlds.pace import lengths, settles_share, shortened
from traps_pipeline.scenes.worlds.world import World

EARLY, LATE = "catch-0001", "domino_branch-0001"


def whole(scenario_id: str) -> World:
    """A record's control over its family's five seconds."""
    case = load(scenario_id)
    physics = case.family.physics
    qpos = simulated(*compile_scene(case.family, case.params, physics), physics)
    return replace(World.of_record(case.spec, qpos), physics=physics)


def test_an_early_outcome_ends_the_clip_after_a_second_and_six_tenths_more_and_before_it_is_too_early() -> None:
    world = whole(EARLY)
    assert world.outcome.commit_frame == 8
    # 8 / 0.3 = 26.7 at most, and 8 + 16 = 24 at least: both even.
    found = [lengths([world], seed) for seed in range(40)]
    assert {tuple(each) for each in found} == {(24, 26), (26,)}
    assert all(settles_share(8, n) >= 0.3 for each in found for n in each)


@pytest.mark.slow
def test_an_outcome_that_is_not_early_leaves_the_clip_as_long_as_it_is() -> None:
    world = whole(LATE)
    assert world.outcome.commit_frame >= 15
    assert lengths([world], 0) == [50]
    assert shortened(world, 50) is world


def test_the_outcome_of_every_released_world_settles_between_three_and_eight_tenths_of_its_clip() -> None:
    for spec in load_released().values():
        evidence, physics = stored_evidence(spec), Physics(**spec.physics)
        assert CUT_FRAMES <= physics.n_frames <= 50, spec.scenario_id
        for when in ("commit_s", "twin_commit_s") if spec.void_kind == "occluder" else ("commit_s",):
            share = round(evidence[when] * physics.fps) / physics.n_frames
            assert 0.3 <= share <= 0.8, (spec.scenario_id, when)


def test_a_clip_that_ends_earlier_is_the_beginning_of_the_same_motion() -> None:
    case = load(EARLY)
    assert np.array_equal(case.qpos, whole(EARLY).qpos[: len(case.qpos)])
    assert len(case.qpos) == len(case.twin) < 50


def test_a_clip_that_goes_on_for_too_long_loses_the_certificate() -> None:
    case, said = load(EARLY), []
    for n_frames in (50, 24):
        pair = replace(pair_of(case.spec, case.qpos, case.twin), control=shortened(whole(EARLY), n_frames))
        said.append(PACE.failure(PACE.measured(pair), pair.claim))
    assert "16%" in str(said[0]) and said[1] is None
