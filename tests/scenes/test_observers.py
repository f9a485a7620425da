"""Observers see the answer in the control and nothing in the void, whatever the occluder looks like and however long
the clip is. One scenario of every family, on its sampled frames."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes.observed import frozen, observed
from tests.scenes.released import SAMPLED, SIX, Released, first_of_each, load
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.observe import family_asking
from traps_pipeline.scenes.parts.vision import after_occluder, blobs, colour_mask
from traps_pipeline.scenes.parts.wording import match_slots
from traps_pipeline.scenes.physics.kit import COLOURS
from traps_pipeline.scenes.physics.simulate import swept_points
from traps_pipeline.scenes.picture.camera import HEIGHT, WIDTH
from traps_pipeline.scenes.variants.arms import ARMS, Scenario
from traps_pipeline.scenes.worlds.outcome import compile_scene

OTHER_OCCLUDER = (0.75, 0.10, 0.50), (0.42, 0.42, 0.10)  # magenta and olive, in turn: the occluder is navy
PATCH = 56  # pixels of an occluder that hides nothing
ALL = [*first_of_each("occluder"), *first_of_each("truncation")]


# One test, not three: what takes the time is drawing the frames, which are drawn once here.
@pytest.mark.slow
@pytest.mark.parametrize(
    "scenario_id",
    [pytest.param(name, marks=[pytest.mark.promise] * (name.removesuffix("-0001") in SIX)) for name in ALL],
)
def test_the_observer_answers_the_control_and_abstains_on_every_void_as_frozen(scenario_id: str) -> None:
    case = load(scenario_id)
    observe, question, void = case.family.observe, case.spec.question, case.void
    assert observe is not None
    assert observe(case.control_frames, question) == case.spec.ground_truth
    assert observe(void, question) is None
    assert observe(case.control_frames, case.spec.ill_posed_question) is None
    elsewhere = _with_occluder_elsewhere(case, case.control_frames)
    assert observe(elsewhere, question) == case.spec.ground_truth
    if case.occluder is None:
        padded = np.concatenate([void, np.repeat(void[-1:], len(case.control_frames) - len(void), axis=0)])
        assert observe(padded, question) is None
    else:  # the colour of the occluder tells it nothing
        assert observe(case.void_behind(OTHER_OCCLUDER[ALL.index(scenario_id) % 2]), question) is None
    assert observed(case) == frozen()[case.family.name]


# --- arms -------------------------------------------------------------------------------------------------------------


def _reads(arm: str, scenario_id: str) -> tuple[str | None, str]:
    """What the observer says of an arm's clip, and the right answer."""
    case = load(scenario_id)
    take = ARMS[arm].film(Scenario.of_record(case.spec, case.qpos, case.twin))
    observe, question = case.family.observe, ARMS[arm].ask(case.spec)[0]
    assert observe is not None
    return observe(np.stack(take.frames[SAMPLED]), question.text), str(question.answer)


@pytest.mark.slow
@pytest.mark.parametrize("scenario_id", ["catch-0001", "tower-0001", "bounce-0001", "slide-0001"])
def test_the_observer_answers_after_a_late_occluder_from_what_was_seen_before(scenario_id: str) -> None:
    said, answer = _reads("late_occluder", scenario_id)
    assert said == answer


@pytest.mark.slow
def test_the_observer_foretells_a_cut_that_is_predictable_and_no_die_whose_slow_tumbling_tells_nothing() -> None:
    said, answer = _reads("predictable_cut", "seesaw_sorter-0001")
    assert said == answer
    # A face that a slowed die shows was wrong twice as often as right.
    assert _reads("predictable_cut", "tumbling_dice-0001")[0] is None


def _with_occluder_elsewhere(case: Released, frames: np.ndarray) -> np.ndarray:
    """A navy patch in a corner where nothing moves and no outcome is; no change if all corners are taken."""
    model, scene = compile_scene(case.family, case.params, case.physics)
    points = np.concatenate([swept_points(model, case.qpos[::5]), *(box.corners() for box in scene.framed)])
    x, y = case.camera.project(points).T
    for left in (4, WIDTH - PATCH - 4):
        for top in (4, HEIGHT - PATCH - 4):
            if not ((x > left - 6) & (x < left + PATCH + 6) & (y > top - 6) & (y < top + PATCH + 6)).any():
                changed = frames.copy()
                changed[:, top : top + PATCH, left : left + PATCH] = np.array(COLOURS["navy"]) * 255
                return changed
    return frames


def test_an_observer_abstains_where_an_occluder_goes_for_a_last_frame_alone() -> None:
    frames = np.full((6, HEIGHT, WIDTH, 3), 200, np.uint8)
    frames[:5, 100:240, 120:360] = np.array(COLOURS["navy"]) * 255
    assert len(after_occluder(frames)) == 1
    asked = {spec.family: spec.question for spec in load_released().values()}
    answers = {name: get_family(name).observe for name in asked}
    for shown in (frames, frames[-1:]):
        said = {name: observe(shown, asked[name]) for name, observe in answers.items() if observe}
        assert said == dict.fromkeys(asked)


def test_every_released_question_belongs_to_its_own_family_alone() -> None:
    for spec in load_released().values():
        family = family_asking(spec.question)
        assert family is not None
        assert family.name == spec.family, spec.question


def test_an_ill_posed_question_belongs_to_no_family_or_asks_for_what_its_observer_does_not_find() -> None:
    asked_of = {id_: family_asking(spec.ill_posed_question) for id_, spec in load_released().items()}
    found = {id_: family for id_, family in asked_of.items() if family is not None}
    assert len(found) <= 5  # one that offers no choices may be worded as a family words its own
    for id_, family in found.items():
        case = load(id_)
        assert family.observe is not None
        assert family.observe(case.control_frames, case.spec.ill_posed_question) is None


def test_a_question_gives_its_template_and_values_back() -> None:
    templates = ("Does the {ball} ball pass the {line} line, yes or no?", "Where is the {ball} ball: left or right?")
    assert match_slots(templates, "Does the red ball pass the blue line, yes or no?") == {"ball": "red", "line": "blue"}
    assert match_slots(templates, "Where is the red ball: left or right?") == {"ball": "red"}
    assert match_slots(templates, "Where is the red ball?") is None
    assert match_slots(("Which ball is first: {choices}?",), "Which ball is first: red or blue?") == {
        "choices": "red or blue"
    }
    assert match_slots(templates, "Where is the red ball: up or down?") is None
    assert match_slots(("{a} or {a}?",), "x or y?") is None  # the same placeholder, two values


@pytest.mark.parametrize("colour", [c for c in COLOURS if c not in ("white", "grey", "wood", "black")])
def test_a_lit_and_a_shaded_patch_are_of_their_colour_and_of_no_other(colour: str) -> None:
    frame = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)  # the warm-grey floor
    frame[..., 2] = 188
    rgb = np.array(COLOURS[colour]) * 255
    frame[100:120, 50:80] = rgb
    frame[200:220, 300:330] = rgb * 0.75
    found = blobs(colour_mask(frame, colour))
    assert [(blob.box, blob.area, blob.fill) for blob in sorted(found, key=lambda b: b.y)] == [
        ((50, 100, 30, 20), 600, 1.0),
        ((300, 200, 30, 20), 600, 1.0),
    ]
    others = [c for c in COLOURS if c not in (colour, "grey", "black")]
    assert all(not colour_mask(frame, other)[105:115, 55:75].any() for other in others)
