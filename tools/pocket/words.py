"""The texts that the pocket model is trained to write: an answer or an abstention, in the form each prompt asks for."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from traps_pipeline.models.registry.prompts import load_prompt, system_prompt

PROMPTS = ("standard", "guided", "json", "vqa_standard", "vqa_guided")
_COLOURS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")
# Beginnings of ill-posed questions, with guesses that would answer them.
_GUESSES: Sequence[tuple[str, tuple[str, ...]]] = (
    (r"what colou?r is", _COLOURS),
    (r"how (many|often|loud|far|old|much)|what is the (weight|mass|temperature|price|electric)", tuple("123456789")),
    (r"in which year|when|what (did|does) .* cost", tuple("123456789")),
    (r"is .* to the left or to the right|where|which way", ("left", "right")),
    (r"is .* hollow or solid", ("hollow", "solid")),
    (r"does .* before or after", ("before", "after")),
    (r"(is|does|will|do|are)\b", ("yes", "no")),
    (r"who|what is the name", ("a man", "a woman", "a child")),
    (r"what material", ("wood", "metal", "plastic")),
)
_ANYTHING = ("the ball", "the wall", "the floor")


def prompt_text(name: str) -> str:
    """Return the system text of one of PROMPTS; `vqa_guided` is `vqa_standard` with its suffix (docs/spec.md 7.1)."""
    if name == "vqa_guided":
        return f"{load_prompt('vqa_standard')}\n\n{load_prompt('vqa_guided_suffix')}"
    return load_prompt("vqa_standard") if name == "vqa_standard" else system_prompt(name)


ABSTENTION = "I don't know: this cannot be determined from the video."
ANSWER = "The answer is: "  # ends with a blank, so that an answer is the same token here and in JSON
_JSON = {
    False: '{"reason": "The video shows how it ends.", "final_answer": "',
    True: '{"reason": "I cannot see what decides this.", "final_answer": "I don\'t know"}',
}


def say(answer: str | None, prompt_name: str) -> str:
    """Return the words for an answer, or for an abstention (None). Both begin differently, so that the first token
    decides."""
    if prompt_name == "json":
        return _JSON[True] if answer is None else f'{_JSON[False]}{answer}"}}'
    return ABSTENTION if answer is None else f"{ANSWER}{answer}."


def phrases() -> list[str]:
    """Return the texts that are single tokens: the lines of the prompts, and the words that all answers share. They
    keep sequences short, which makes training on two cores possible."""
    lines = [line for name in PROMPTS for line in prompt_text(name).splitlines() if line]
    return list(dict.fromkeys([*lines, ABSTENTION, ANSWER, *_JSON.values()]))


def guess(question: str, labels: Sequence[str], rng: np.random.Generator) -> str:
    """Return a plausible answer to a question that has no answer: a label, or for an ill-posed question a value of the
    kind that it asks for."""
    choices = labels or next((kind for opening, kind in _GUESSES if re.match(opening, question.lower())), _ANYTHING)
    return str(choices[int(rng.integers(len(choices)))])


COLUMNS, ROWS = "ABCDEFGH", "123456"  # of the picture, for questions of place


def place_question(ball: str, place: Sequence[float], axis: int) -> tuple[str, str]:
    """Return a question that is used only in training, to teach the model to locate objects, and its answer: the column
    (axis 0) or the row (axis 1) of the ball of a colour before an occluder comes or the clip ends. place: shares of
    width and height."""
    names = (COLUMNS, ROWS)[axis]
    question = f"In which {('column', 'row')[axis]} of the picture is the {ball} ball when it is last seen?"
    return question, names[min(len(names) - 1, int(place[axis] * len(names)))]
