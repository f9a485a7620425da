"""What is computed of an occlusion pair is the same whichever of its worlds is the control, and a record of which that
is not so loses the certificate; the numbers are counted by hand for 50 frames at 10 a second."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from tests.scenes.released import first_of_each, load
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.certification.certificates import EXCHANGE, pair_of, stored_evidence
from traps_pipeline.scenes.certification.evidence import Pair
from traps_pipeline.scenes.worlds.outcome import compile_scene, simulated
from traps_pipeline.scenes.worlds.pace import lengths, moments, shortened
from traps_pipeline.scenes.worlds.shot import shot_of
from traps_pipeline.scenes.worlds.world import World

BOUNCE, RACE = "bounce-0002", "hidden_race-0001"


def pair(scenario_id: str) -> Pair:
    case = load(scenario_id)
    return pair_of(case.spec, case.qpos, case.twin)


def wholes(scenario_id: str) -> list[World]:
    """Control and twin of a record over their family's five seconds."""
    found = []
    for world in (pair(scenario_id).control, pair(scenario_id).other_world):
        physics = world.family.physics
        qpos = simulated(*compile_scene(world.family, world.params, physics), physics)
        found.append(replace(world, physics=physics, qpos=qpos))
    return found


# --- what is computed of two worlds -----------------------------------------------------------------------------------


def test_a_clip_is_so_long_that_the_outcome_of_neither_world_is_early_or_late() -> None:
    worlds = wholes(BOUNCE)
    assert [world.outcome.commit_frame for world in worlds] == [13, 19]
    # 13 / 0.3 = 43.3 at most, and 19 / 0.5 = 38 at least: even, in either order.
    found = {tuple(lengths(worlds, seed)) for seed in range(60)}
    assert {n for each in found for n in each} == {38, 40, 42}
    assert found == {tuple(lengths(worlds[::-1], seed)) for seed in range(60)}
    # The control alone would end after 32 frames, too; the twin alone would not end earlier at all.
    assert {n for seed in range(60) for n in lengths(worlds[:1], seed)} > {32, 42}
    assert lengths(worlds[1:], 0) == [50]


def test_a_control_closes_when_the_outcome_of_either_world_has_been_in_view_for_a_second() -> None:
    worlds = [shortened(world, 40) for world in wholes(BOUNCE)]
    drawn = [list(moments(worlds, seed)) for seed in range(30)]
    assert drawn == [list(moments(worlds[::-1], seed)) for seed in range(30)]
    assert min(min(each) for each in drawn) >= 19 + 10
    assert min(frame for seed in range(30) for frame in moments(worlds[:1], seed)) < 19 + 10


@pytest.mark.parametrize("scenario_id", [BOUNCE, "catch-0001", "ramp_gap-0001"])
def test_camera_and_occluder_of_two_worlds_are_those_of_the_worlds_exchanged(scenario_id: str) -> None:
    worlds = wholes(scenario_id)
    assert shot_of(worlds) == shot_of(worlds[::-1])


# --- released records -------------------------------------------------------------------------------------------------


def failure(found: Pair, **evidence: Any) -> str | None:
    stored = {"hidden_from_s": 0.5, "closes_s": None} | evidence
    return EXCHANGE.failure(stored | EXCHANGE.measured(found), found.claim)


FIRSTS = [pytest.param(n, marks=[pytest.mark.slow] * (not n.startswith("bounce"))) for n in first_of_each("occluder")]


@pytest.mark.parametrize("scenario_id", FIRSTS)
def test_a_pair_of_every_occlusion_family_is_exchangeable(scenario_id: str) -> None:
    spec = load_released()[scenario_id]
    evidence = {name: stored_evidence(spec)[name] for name in ("hidden_from_s", "closes_s")}
    assert failure(pair(scenario_id), **evidence) is None


def of_both(found: Pair, change: Callable[[World], World]) -> Pair:
    return replace(found, control=change(found.control), twin=change(found.other_world))


def test_a_length_that_follows_from_the_control_alone_is_found() -> None:
    found, (control, twin) = pair(BOUNCE), wholes(BOUNCE)
    early = replace(found, control=shortened(control, 36), twin=shortened(twin, 36))
    assert 36 in {n for seed in range(60) for n in lengths([control], seed)}
    assert "length" in str(failure(early))


def test_a_moment_of_closing_that_no_draw_tries_is_found() -> None:
    found = pair(BOUNCE)
    closing = found.control.closing
    assert closing is not None
    tried = set(moments((found.control, found.other_world), found.claim.seed))
    other = next(frame for frame in range(29, 39) if frame not in tried)
    moved = of_both(found, lambda world: replace(world, closing=replace(closing, frame=other)))
    said = str(failure(moved))
    assert "closing" in said and "length" not in said


def test_a_twin_that_does_not_pass_as_a_control_is_found() -> None:
    found = pair(RACE)
    lost = failure(replace(found, claim=replace(found.claim, twin_answer="teal")))
    assert "outcome: " in str(lost) and "'teal'" in str(lost)
