"""Ill-posed questions: drawn from the inventory, refuted by it or beyond any video; well-posed ones are neither."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from tests.build.errors import raises
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.parts.wording import (
    BEYOND_VIDEO,
    beyond_video,
    choices_in,
    colour_distance,
    draw_ill_posed,
    false_premise,
    false_premises,
    none_as_answer,
)
from traps_pipeline.scenes.physics.kit import Inventory

SCENE = Inventory(
    colours=("red", "wood", "black"), objects=("ball", "ramp", "line"), things=("red ball", "wooden ramp", "black line")
)


@pytest.mark.parametrize(
    ("question", "property_"),
    [
        ("How many grams does the red ball weigh?", "mass"),
        ("What is the temperature of the ramp in degrees Celsius?", "temperature"),
        ("Where will the ball be one hour after the clip ends?", "later"),
        ("In which year was the ramp made?", "age"),
        ("Does the red ball pass the black line, yes or no?", None),
        ("What colour is the ramp?", None),
        ("What colour is the inside of the red block?", "inside"),
        ("What colour is the inside of the red tray?", None),  # it is open
        ("Is the tray of the red block hollow or solid?", None),
    ],
)
def test_a_question_beyond_the_video_names_a_listed_property(question: str, property_: str | None) -> None:
    assert beyond_video(question) == property_


def test_every_template_asks_for_its_own_property() -> None:
    for name, (_, templates) in BEYOND_VIDEO.items():
        for template in templates:
            assert beyond_video(template.format(thing="red ball")) == name, template


@pytest.mark.parametrize(
    ("question", "refuted"),
    [
        ("What material are the triangles made of?", ["triangle"]),  # the paper's own
        ("What is the weight of the red color?", ["weight"]),  # and this one
        ("What is the weight of the colour red?", ["weight"]),
        ("Where does the blue ball end up?", ["blue"]),
        ("Where does the red ball end up?", []),
        ("How often does the ball hit the magnet?", ["magnet"]),
    ],
)
def test_a_false_premise_is_refuted_by_the_inventory(question: str, refuted: list[str]) -> None:
    assert presumed(question, SCENE) == refuted
    assert (false_premise(question, SCENE) is None) == (refuted == [])


def presumed(question: str, inventory: Inventory) -> list[str]:
    """What a question presumes falsely, as its reasons name it."""
    named = "triangle", "magnet", "arrow", "weight", "blue", "green", "gold"
    return [word for reason in false_premises(question, inventory) for word in reason.split() if word in named]


@pytest.mark.parametrize("taxonomy", ["occlusion", "chaotic"])
def test_drawn_questions_are_refuted_and_plenty(taxonomy: str) -> None:
    texts = Counter[str]()
    most = 1 if taxonomy == "occlusion" else 10
    for draw in range(40 if taxonomy == "occlusion" else 200):
        question = draw_ill_posed(
            taxonomy,  # type: ignore[arg-type]
            SCENE,
            np.random.default_rng(draw),
            lambda text: texts[text] < most,
        )
        assert (beyond_video(question) if taxonomy == "occlusion" else false_premise(question, SCENE)) is not None
        if taxonomy == "chaotic":
            assert len(false_premises(question, SCENE, near=True)) == 1, question
            assert none_as_answer(question) is None, question
        texts[question] += 1
    assert max(texts.values()) <= most


@pytest.mark.parametrize(
    ("question", "answer"),
    [
        ("How many windmills does the peg touch?", "zero"),
        ("How often does the wall hit the domino?", "zero"),
        ("How many black stripes does the peg have?", "zero"),
        ("How far does the rope travel?", "zero"),
        ("How loud is the colour green, in decibels?", "zero"),
        ("When does the ball pass the magnet?", "never"),
        ("Does the rope move before or after the zone?", "never"),
        ("What does the blue ball hit first?", "nothing"),
        ("What is written on the bell?", "nothing"),
        ("What does the colour red cost?", "nothing"),
        ("Does the ball touch the magnet?", "nothing"),
        ("Is there a windmill?", "no"),
        ("What colour is the windmill?", None),
        ("Is the windmill larger or smaller than the ball?", None),
        ("Where does the blue ball end up?", None),
        ("What is the weight of the colour red?", None),
    ],
)
def test_a_question_that_none_answers_truly_is_known_by_its_words(question: str, answer: str | None) -> None:
    assert none_as_answer(question) == answer


def test_a_colour_that_is_nearly_there_refutes_nothing() -> None:
    # By hand in CIELAB: yellow (0.98, 0.82, 0.08) and gold (1.00, 0.84, 0.00) differ by a few units only.
    assert colour_distance("gold", "yellow") < 10
    assert colour_distance("black", "white") > 60
    yellow = Inventory(colours=("yellow", "wood"), objects=("ball",))
    assert presumed("Where does the gold ball end up?", yellow) == []
    assert presumed("Where does the green ball end up?", yellow) == ["green"]
    assert presumed("Which way does the gold arrow point?", yellow) == ["arrow"]
    assert len(false_premises("Which way does the gold arrow point?", yellow, near=True)) == 2
    assert presumed("Which way does the green arrow point?", yellow) == ["arrow", "green"]


def test_a_scene_with_every_question_taken_is_refused() -> None:
    with raises(ValueError, "scenes.parts.wording.draw_ill_posed"):
        draw_ill_posed("occlusion", SCENE, np.random.default_rng(0), lambda _: False)


def test_choices_are_read_as_they_are_listed() -> None:
    assert choices_in("red, blue or green") == ("red", "blue", "green")
    assert choices_in("0-2, 3-4 or 5-6") == ("0-2", "3-4", "5-6")


def test_no_released_false_premise_has_a_true_answer() -> None:
    asked = {id_: spec.ill_posed_question for id_, spec in load_released().items() if spec.taxonomy == "chaotic"}
    assert len(asked) == 500
    assert {id_: question for id_, question in asked.items() if none_as_answer(question) is not None} == {}
