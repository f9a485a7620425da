"""Graded cuts: evenly wanted, cut where the futures say so, and refused where they say nothing."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from tests.scenes.released import load
from traps_pipeline.benchmark.filmed_arms import arm_of
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.protocol.datasets import GRADED, arms_of, beside_of, sides_of
from traps_pipeline.scenes.variants import graded
from traps_pipeline.scenes.variants.arms import Scenario
from traps_pipeline.scenes.worlds.outcome import Rejected


def test_what_is_wanted_is_spread_evenly_whatever_the_family() -> None:
    for family in ("plinko", "pachinko_waterfall", "seesaw_sorter", "tumbling_dice"):
        members = [spec for spec in load_released().values() if spec.family == family]
        for first in (10, len(members)):
            shares = np.sort([graded.wanted(spec) for spec in members[:first]])
            gaps = np.diff([graded.LEAST, *shares, 1.0])
            assert gaps.min() >= 0 and gaps.max() < 0.6 * 3 / first, family


def test_probabilities_are_of_the_futures_that_end_in_an_answer() -> None:
    shares = graded.probabilities(Counter({"left": 30, None: 20, "right": 10}))
    assert shares == {"left": 0.75, "right": 0.25}
    assert graded.probabilities(Counter({None: 3})) == {}


@pytest.mark.slow
@pytest.mark.promise
def test_a_graded_cut_shows_the_control_up_to_a_sampled_frame_and_knows_how_probable_each_answer_is() -> None:
    case = load("plinko-0001")
    scenario = Scenario.of_record(case.spec, case.qpos, case.twin)
    arm = arm_of(case.spec, GRADED)
    take = arm.film(scenario)
    evidence, frames = take.evidence, len(take.frames)
    assert evidence["cut_s"] == frames / 10 <= evidence["settled_s"]
    assert frames >= 11 and (frames - 1) % 2 == 0
    assert np.array_equal(take.frames[-1], scenario.control_frames[frames - 1])
    posterior = evidence["posterior"]
    assert sum(posterior.values()) == pytest.approx(1) and {*posterior} <= {*case.spec.labels}
    assert evidence["decided"] >= 0.9 * evidence["futures"] and evidence["futures"] >= 64
    assert max(posterior.values()) == pytest.approx(evidence["wanted"], abs=0.2)
    (question,) = arm.ask(case.spec)
    assert (question.side, question.text) == (*sides_of(GRADED), case.spec.question)


def test_a_control_that_is_settled_before_the_earliest_cut_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    case = load("plinko-0001")
    monkeypatch.setattr(graded, "earliest_cut", lambda physics: physics.n_frames)
    with pytest.raises(Rejected, match="before the earliest cut"):
        graded.graded_cut(case.spec, Scenario.of_record(case.spec, case.qpos, case.twin).control)


def test_graded_cuts_are_of_chaotic_scenarios_and_no_arm() -> None:
    assert GRADED in beside_of("chaotic") and GRADED not in beside_of("occlusion")
    assert GRADED not in arms_of("chaotic")
