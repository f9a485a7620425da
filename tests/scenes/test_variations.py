"""Variations: each changes one thing, is certified on a scenario that admits it, and refused where it does not hold."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tests.build.errors import raises
from tests.scenes.released import load
from tests.scenes.variation_table import ON_PAGE
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.protocol.datasets import (
    FRAMINGS,
    LABEL_DOSES,
    OCCLUDER_DOSES,
    SCHEMAS,
    VARIATIONS,
    extra_datasets_of,
    sides_of,
)
from traps_pipeline.scenes.observe import family_asking
from traps_pipeline.scenes.parts.vision import largest
from traps_pipeline.scenes.variants import variations
from traps_pipeline.scenes.variants.arms import SEEN_PX, Scenario
from traps_pipeline.scenes.variants.variations import SEEN_LEVELS, with_labels
from traps_pipeline.scenes.worlds.outcome import Rejected


def scenario(scenario_id: str) -> Scenario:
    case = load(scenario_id)
    return Scenario.of_record(case.spec, case.qpos, case.twin)


# --- what there is ----------------------------------------------------------------------------------------------------
def test_every_variation_that_can_be_asked_is_defined_and_asks_its_sides():
    assert {*variations.VARIATIONS} == {*VARIATIONS}
    race = load_released()["hidden_race-0001"]
    for name in VARIATIONS:
        assert tuple(question.side for question in variations.VARIATIONS[name].ask(race)) == sides_of(name)
    of_chaotic = {name for name in extra_datasets_of("chaotic") if name in VARIATIONS}
    assert of_chaotic == {*LABEL_DOSES, *SCHEMAS, *FRAMINGS}  # what has no occluder has no look of it


def test_the_page_has_the_table_of_variations():
    assert ON_PAGE.written() == variations.variation_table() + "\n"


# --- the asking -------------------------------------------------------------------------------------------------------
def test_what_varies_the_asking_shows_the_pairs_own_clips_and_asks_its_own_question():
    plinko = load_released()["plinko-0001"]
    for name in (*SCHEMAS, *FRAMINGS):
        control, void = variations.VARIATIONS[name].ask(plinko)
        assert (control.clip, control.text, control.answer) == ("control", plinko.question, plinko.ground_truth)
        assert (void.clip, void.text, void.answer) == ("void", plinko.question, None)


def test_a_question_offers_as_many_answers_as_asked_for_and_always_those_of_both_worlds():
    admitted = 0
    for spec in load_released().values():
        try:
            asked = {count: with_labels(spec, count) for count in (2, 3, 6)}
        except Rejected:
            continue
        admitted += 1
        for count, (question, labels) in asked.items():
            assert len(set(labels)) == count and {spec.ground_truth, spec.twin.ground_truth} <= set(labels)
            offered = " or ".join([", ".join(labels[:-1]), labels[-1]])
            assert question.count(offered) == 1 and spec.question.split(":")[0].split(",")[0] in question
            family = family_asking(question)
            assert family is not None and family.name == spec.family  # the observer still understands it
        assert set(asked[2][1]) <= set(asked[3][1]) <= set(asked[6][1])
    assert admitted > 200


@pytest.mark.parametrize("scenario_id", ["bounce-0001", "plinko-0001", "domino_count-0001"])
def test_a_question_whose_answers_are_no_colours_keeps_its_answers(scenario_id: str):
    with raises(Rejected, "scenes.variants.variations.with_labels"):
        variations.VARIATIONS["labels_two"].ask(load_released()[scenario_id])


def test_the_right_answer_is_not_always_offered_in_the_same_place():
    places = set()
    for number in range(1, 30):
        spec = load_released()[f"tumbling_dice-{number:04d}"]
        places.add(with_labels(spec, 6)[1].index(spec.ground_truth))
    assert len(places) == 6


# --- the occluder -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_occluder_of_another_look_hides_as_much_and_one_that_lets_light_through_does_not():
    bounce = scenario("bounce-0001")
    grey = variations.VARIATIONS["occluder_grey"].film(bounce)
    assert grey.evidence["twin_px"] == 0 and len(grey.frames) == len(bounce.control_frames)
    assert largest(grey.frames[0], "navy", 1000) is None  # the cue of the occluder rule is gone
    assert grey.evidence["contrast"] < 30  # against 65 of the pair's own occluder, which is larger here
    large = variations.VARIATIONS["occluder_large"].film(bounce)
    assert large.evidence["wide"] == variations.WIDTH_FACTOR
    assert large.evidence["panel_px"] > grey.evidence["panel_px"]
    sheer = variations.VARIATIONS["occluder_alpha_50"].film(bounce)
    assert sheer.evidence["seen_through_px"] >= SEEN_PX and sheer.evidence["levels"] >= SEEN_LEVELS
    assert sides_of("occluder_alpha_50") == ("control",) and "occluder_alpha_50" in OCCLUDER_DOSES


@pytest.mark.slow
def test_an_occluder_through_which_the_worlds_can_be_told_apart_is_no_void():
    bounce = scenario("bounce-0001")
    with raises(Rejected, "scenes.variants.variations._void_with") as refused:
        variations._void_with(bounce, variations.Look(alpha=0.5))
    assert f"{SEEN_PX:.0f}" not in re.findall(r"\d+", str(refused.value))  # it is not that too little is seen to move
    with raises(Rejected, "scenes.variants.variations._sheer", " 0 ", f"{SEEN_PX:.0f}"):
        variations._sheer(1.0)(bounce)


@pytest.mark.slow
def test_frames_that_are_shown_later_show_the_outcome():
    of = scenario("plinko-0001")
    take = variations.VARIATIONS["frames_later"].film(of)
    late = take.evidence["late_frames"]
    assert take.frames == [] and of.control.open_frames < 50
    assert of.control.outcome.commit_frame <= min(late) and max(late) < of.control.open_frames
    assert np.isfinite(take.evidence["least_visible_px"])
