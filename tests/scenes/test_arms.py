"""Arms: each is certified on a scenario that admits it, and refused where its certificate does not hold."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from tests.scenes import arm_table
from tests.scenes.released import load
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.protocol.datasets import ARMS, arms_of, sides_of
from traps_pipeline.scenes.parts.offers import with_choices, without_choices
from traps_pipeline.scenes.parts.wording import refutation
from traps_pipeline.scenes.picture.camera import Panel
from traps_pipeline.scenes.variants import arms
from traps_pipeline.scenes.worlds.outcome import Rejected


def scenario(scenario_id: str) -> arms.Scenario:
    case = load(scenario_id)
    return arms.Scenario.of_record(case.spec, case.qpos, case.twin)


# --- what there is ----------------------------------------------------------------------------------------------------


def test_every_arm_that_can_be_asked_can_be_filmed_and_asks_its_sides():
    assert set(arms.ARMS) == set(ARMS)
    plinko = load_released()["plinko-0001"]
    for name in arms_of("chaotic"):
        assert tuple(question.side for question in arms.ARMS[name].ask(plinko)) == sides_of(name)
    assert set(arms_of("occlusion")) & set(arms_of("chaotic")) == {"twin_control", "choices_swapped"}


def test_the_page_has_the_table_of_arms():
    assert arm_table.written() == arms.table() + "\n"


# --- words ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("question", "labels", "plain"),
    [
        ("Does the red ball fall, yes or no?", ("yes", "no"), "Does the red ball fall?"),
        ("Which ball is first: red, blue or green?", ("green", "red", "blue"), "Which ball is first?"),
        ("Where does it end: in the left bin (red) or somewhere else?", ("left", "other"), "Where does it end?"),
        (
            "In which bucket, 1, 2 or 3 from left to right, does it rest?",
            ("1", "2", "3"),
            "In which bucket does it rest?",
        ),
        ("Does it go into the red bin on the left or on the right?", ("left", "right"), None),
        ("Count the dominoes: are they 1-2, 3-4 or 5-6?", ("1-2", "3-4", "5-6"), None),
    ],
)
def test_choices_are_taken_from_a_question_or_it_is_left_alone(
    question: str, labels: tuple[str, ...], plain: str | None
):
    assert without_choices(question, labels) == plain


def test_no_released_question_offers_choices_once_they_are_swapped_and_every_ill_posed_one_does():
    refused = 0
    for spec in load_released().values():
        try:
            well_posed, ill_posed = arms.ARMS["choices_swapped"].ask(spec)
        except Rejected:
            refused += 1
            continue
        assert " or " not in well_posed.text and well_posed.text.endswith("?"), well_posed.text
        assert " or " in ill_posed.text and ill_posed.text.endswith("?"), ill_posed.text
        assert spec.question.startswith(well_posed.text[:8]) and well_posed.answer == spec.ground_truth
        assert ill_posed.answer is None
        if spec.taxonomy == "occlusion":  # what it asks for is still what no video shows
            assert refutation("occlusion", ill_posed.text, None) is not None  # type: ignore[arg-type]
    assert refused < 40  # choices that are part of their sentence: 'the bin on the left or on the right'


def test_an_ill_posed_question_that_offers_choices_keeps_them():
    assert with_choices("Is the ball hollow or solid?") == "Is the ball hollow or solid?"
    assert with_choices("How many grams does the cup weigh?") == "How many grams does the cup weigh: 20, 80 or 300?"
    assert with_choices("Why is the ball singing?") is None


# --- clips ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_panels_of_arms_come_stand_and_go_as_they_say():
    bounce = scenario("bounce-0001")
    control, void = bounce.control_frames, bounce.void_frames
    removed = arms.ARMS["removed"].film(bounce)
    assert all(np.array_equal(a, b) for a, b in zip(removed.frames, [*void[:40], *control[40:]], strict=True))
    with pytest.raises(Rejected, match="first of the two events that are asked about happens behind the panel"):
        arms.ARMS["removed"].film(scenario("hidden_race-0001"))
    late = arms.ARMS["late_panel"].film(bounce)
    at = round(late.evidence["covered_from_s"] * bounce.fps)
    assert at == bounce.control.outcome.commit_frame - 1  # never so late that the outcome was seen
    assert all(np.array_equal(a, b) for a, b in zip(late.frames, [*control[:at], *void[at:]], strict=True))
    decoy = arms.ARMS["decoy"].film(bounce)
    assert len(decoy.frames) == len(control) and decoy.evidence["panel_px"] >= arms.PANEL_PX
    assert decoy.evidence["hides_px"] == 0


@pytest.mark.slow
def test_a_panel_where_the_void_has_it_is_no_decoy(monkeypatch: pytest.MonkeyPatch):
    bounce = scenario("bounce-0001")

    def in_front(_: arms.Scenario, points: np.ndarray) -> Iterator[Panel]:
        assert bounce.control.panel is not None
        yield bounce.control.panel

    monkeypatch.setattr(arms, "_decoys", in_front)
    with pytest.raises(Rejected, match=r"no place for a panel that hides nothing \(the decoy shows \d+ pixels, hides"):
        arms.ARMS["decoy"].film(bounce)


@pytest.mark.slow
def test_a_race_whose_worlds_look_alike_until_it_is_won_has_no_late_panel():
    with pytest.raises(Rejected, match="before the panel comes the two worlds differ in 0 pixels"):
        arms.ARMS["late_panel"].film(scenario("hidden_race-0001"))


@pytest.mark.slow
def test_a_camera_that_looks_past_the_outcome_shows_the_cause_and_no_trace_of_the_rest():
    slide = scenario("slide-0001")
    take = arms.ARMS["frame_out"].film(slide)
    assert take.evidence["cause_px"] >= arms.SEEN_PX
    assert take.evidence["twin_px"] == take.evidence["ablation_px"] == 0
    assert take.evidence["hidden_from_s"] * slide.fps < slide.control.outcome.commit_frame


@pytest.mark.slow
def test_cuts_of_a_board_are_held_matched_and_predictable_and_a_settled_one_is_not():
    plinko = scenario("plinko-0001")
    cut = plinko.spec.void["cut_frame"]
    held = arms.ARMS["held_void"].film(plinko)
    assert len(held.frames) == len(plinko.control_frames)
    assert all(frame is held.frames[cut - 1] for frame in held.frames[cut:])
    matched = arms.ARMS["length_matched"].film(plinko)
    assert len(matched.frames) == cut
    assert plinko.spec.closes_frame == 45
    assert np.array_equal(matched.frames[-1], plinko.control_frames[44])  # the last one before the panel
    predictable = arms.ARMS["predictable_cut"].film(plinko)
    assert predictable.evidence["agree"] >= arms.AGREE_SHARE * arms.FUTURES
    assert cut < len(predictable.frames) < plinko.control.outcome.commit_frame
    other = replace(plinko, spec=plinko.spec.model_copy(update={"ground_truth": plinko.spec.twin.ground_truth}))
    with pytest.raises(Rejected, match="no cut before the outcome is settled"):  # another answer is never agreed on
        arms.ARMS["predictable_cut"].film(other)


@pytest.mark.slow
def test_a_twin_that_does_not_end_as_the_record_says_is_refused():
    plinko = scenario("plinko-0001")
    twin = plinko.spec.twin.model_copy(update={"ground_truth": plinko.spec.ground_truth})
    with pytest.raises(Rejected, match="the twin ends in"):
        arms.ARMS["twin_control"].film(replace(plinko, spec=plinko.spec.model_copy(update={"twin": twin})))
