"""Arms and graded cuts: each is certified on a scenario that admits it, and refused where that does not hold."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from tests.build.errors import raises
from tests.scenes import arm_table
from tests.scenes.released import load
from traps_pipeline.benchmark.filmed_arms import ARMS_BY_NAME
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.protocol.datasets import ARMS, GRADED, extra_datasets_of, sides_of
from traps_pipeline.scenes.variants import arms, graded_cuts
from traps_pipeline.scenes.worlds.outcome import Rejected


def scenario(scenario_id: str) -> arms.Scenario:
    case = load(scenario_id)
    return arms.Scenario.of_record(case.spec, case.qpos, case.twin)


# --- what there is ----------------------------------------------------------------------------------------------------


def test_every_arm_that_can_be_asked_can_be_filmed_and_asks_its_sides():
    assert set(arms.ARMS) == set(ARMS)
    plinko = load_released()["plinko-0001"]
    of_taxonomy = {name: {*extra_datasets_of(name)} & {*ARMS} for name in ("occlusion", "chaotic")}
    for name in of_taxonomy["chaotic"]:
        assert tuple(question.side for question in ARMS_BY_NAME[name].ask(plinko)) == sides_of(name)
    assert of_taxonomy["occlusion"] & of_taxonomy["chaotic"] == {"twin_control"}


def test_the_page_has_the_table_of_arms():
    assert arm_table.ON_PAGE.written() == arm_table.table() + "\n"


# --- clips ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_late_occluder_comes_just_before_the_outcome_settles():
    bounce = scenario("bounce-0001")
    control, void = bounce.control_frames, bounce.void_frames
    race = scenario("hidden_race-0001")
    with raises(Rejected, "scenes.variants.arms._late_occluder", " 0 ", f"{arms.SEEN_PX:.0f}"):
        arms.ARMS["late_occluder"].film(race)
    late = arms.ARMS["late_occluder"].film(bounce)
    at = round(late.evidence["covered_from_s"] * bounce.fps)
    assert at == bounce.control.outcome.commit_frame - 1  # never so late that the outcome was seen
    assert all(np.array_equal(a, b) for a, b in zip(late.frames[at:], void[at:], strict=True))
    way = [n for n in range(at) if not np.array_equal(late.frames[n], control[n])]  # it slides in, and does not pop
    assert len(way) >= 2 and way == [*range(way[0], at)]


@pytest.mark.slow
def test_cuts_of_a_board_are_matched_and_predictable_and_a_settled_one_is_not():
    plinko = scenario("plinko-0001")
    cut = plinko.spec.void["cut_frame"]
    matched = arms.ARMS["length_matched"].film(plinko)
    assert len(matched.frames) == cut
    assert plinko.spec.closes_frame == 45
    assert np.array_equal(matched.frames[-1], plinko.control_frames[44])  # the last one before the occluder
    predictable = arms.ARMS["predictable_cut"].film(plinko)
    assert predictable.evidence["agree"] >= arms.AGREE_SHARE * arms.FUTURES
    assert cut < len(predictable.frames) < plinko.control.outcome.commit_frame
    other = replace(plinko, spec=plinko.spec.model_copy(update={"ground_truth": plinko.spec.twin.ground_truth}))
    with raises(Rejected, "scenes.variants.arms._predictable_cut"):  # another answer is never agreed on
        arms.ARMS["predictable_cut"].film(other)


@pytest.mark.slow
def test_a_twin_that_does_not_end_as_the_record_says_is_refused():
    plinko = scenario("plinko-0001")
    twin = plinko.spec.twin.model_copy(update={"ground_truth": plinko.spec.ground_truth})
    with raises(Rejected, "scenes.variants.arms._twin", repr(plinko.spec.ground_truth)):
        arms.ARMS["twin_control"].film(replace(plinko, spec=plinko.spec.model_copy(update={"twin": twin})))


def test_what_is_wanted_is_spread_evenly_whatever_the_family() -> None:
    for family in ("plinko", "pachinko_waterfall", "seesaw_sorter", "tumbling_dice"):
        members = [spec for spec in load_released().values() if spec.family == family]
        for first in (10, len(members)):
            shares = np.sort([graded_cuts.target_probability(spec) for spec in members[:first]])
            gaps = np.diff([graded_cuts.MIN_PROBABILITY, *shares, 1.0])
            assert gaps.min() >= 0 and gaps.max() < 0.6 * 3 / first, family


def test_probabilities_are_of_the_futures_that_end_in_an_answer() -> None:
    shares = graded_cuts.probabilities(Counter({"left": 30, None: 20, "right": 10}))
    assert shares == {"left": 0.75, "right": 0.25}
    assert graded_cuts.probabilities(Counter({None: 3})) == {}


@pytest.mark.slow
@pytest.mark.promise
def test_a_graded_cut_shows_the_control_up_to_a_sampled_frame_and_knows_how_probable_each_answer_is() -> None:
    plinko = scenario("plinko-0001")
    arm = ARMS_BY_NAME[GRADED]
    take = arm.film(plinko)
    evidence, frames = take.evidence, len(take.frames)
    assert evidence["cut_s"] == frames / 10 <= evidence["settled_s"]
    assert frames >= 11 and (frames - 1) % 2 == 0
    assert np.array_equal(take.frames[-1], plinko.control_frames[frames - 1])
    posterior = evidence["posterior"]
    assert sum(posterior.values()) == pytest.approx(1) and {*posterior} <= {*plinko.spec.labels}
    assert evidence["decided"] >= 0.9 * evidence["futures"] and evidence["futures"] >= 64
    assert max(posterior.values()) == pytest.approx(evidence["wanted"], abs=0.2)
    (question,) = arm.ask(plinko.spec)
    assert (question.side, question.text) == (*sides_of(GRADED), plinko.spec.question)


def test_a_control_that_is_settled_before_the_earliest_cut_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    plinko = scenario("plinko-0001")
    monkeypatch.setattr(graded_cuts, "earliest_cut", lambda physics: physics.n_frames)
    settled_s = plinko.control.outcome.commit_frame / plinko.fps
    with raises(Rejected, "scenes.variants.graded_cuts.graded_cut", f"{settled_s:.1f} s"):
        graded_cuts.graded_cut(plinko.spec, plinko.control)


def test_graded_cuts_are_of_chaotic_scenarios_and_no_arm() -> None:
    assert GRADED in extra_datasets_of("chaotic") and GRADED not in extra_datasets_of("occlusion")
    assert GRADED not in ARMS
