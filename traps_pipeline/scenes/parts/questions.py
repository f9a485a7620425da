"""Represent a scene's questions as values: templates, labels and their aliases.

A template names parts in braces: '{ball}' is the value of the field `ball_colour`, and `fills` adds others. A family
has one `Question` and some answerable asides, of which each scenario has one; even the void answers those.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from traps_pipeline.scenes.parts.course import part_colours
from traps_pipeline.scenes.parts.wording import match_slots
from traps_pipeline.scenes.physics.kit import AnswerableQuestion, AnswerType, Wording, list_choices

Forms = Sequence[str]  # ways to say a label; '{}' stands for it
Aside = Callable[[Any, np.random.Generator], AnswerableQuestion]


@dataclass(frozen=True)
class Filled:
    """The answers and texts of a question in one scenario. aliases: form -> label, fills: placeholder -> text."""

    labels: tuple[str, ...]
    aliases: Mapping[str, str]
    fills: Mapping[str, str]


@dataclass(frozen=True)
class Question:
    """A question in one or more wordings. fill(p, rng): its choices and slots, drawn first."""

    answer_type: AnswerType
    templates: tuple[str, ...]
    fill: Callable[[Any, np.random.Generator], Filled]

    def word(self, p: Any, rng: np.random.Generator, asides: Sequence[Aside]) -> Wording:
        """Return the words of the question and one of the asides; a sole aside costs no draw."""
        question = self.fill(p, rng)
        text = str(rng.choice(self.templates)).format_map({**part_colours(p), **question.fills})
        return Wording(text, question.labels, question.aliases, _choose(asides, rng)(p, rng))

    def slots_in(self, question: str) -> dict[str, str] | None:
        """Return the text of each placeholder in a question; None if it is another question."""
        return match_slots(self.templates, question)


def _choose(asides: Sequence[Aside], rng: np.random.Generator) -> Aside:
    return asides[0] if len(asides) == 1 else asides[int(rng.integers(len(asides)))]


def yes_no(
    *templates: str,
    yes: Forms,
    no: Forms,
    fills: Callable[[Any, np.random.Generator], Mapping[str, str]] = lambda p, rng: {},
) -> Question:
    """Return a question answered by yes or no. fills: placeholders that are no part."""
    aliases = dict.fromkeys(yes, "yes") | dict.fromkeys(no, "no")
    return Question("binary", templates, lambda p, rng: Filled(("yes", "no"), aliases, fills(p, rng)))


def left_or_right(*templates: str, forms: Forms, colours: Callable[[Any], tuple[str, str]] | None = None) -> Question:
    """Return a question answered by a side.

    forms: other ways to say a side; '{0}' is the side and '{1}' its colour, which `colours(p)` gives for left and
    right.
    """

    def fill(p: Any, rng: np.random.Generator) -> Filled:
        side_colours = ("", "") if colours is None else colours(p)
        sides = tuple(zip(("left", "right"), side_colours, strict=True))
        return Filled(("left", "right"), {form.format(*side): side[0] for side in sides for form in forms}, {})

    return Question("direction", templates, fill)


def which_colour(
    *templates: str,
    colours: Callable[[Any], Sequence[str]],
    forms: Forms,
    also: Mapping[str, str] = MappingProxyType({}),
) -> Question:
    """Return a question answered by a colour of '{choices}', in random order.

    forms: ways to say a colour. also: other names of colours -> the colour.
    """

    def fill(p: Any, rng: np.random.Generator) -> Filled:
        choices = tuple(str(c) for c in rng.permutation(colours(p)))
        aliases = {form.format(c): c for c in choices for form in forms}
        return Filled(choices, aliases | dict(also), {"choices": list_choices(choices)})

    return Question("colour", templates, fill)


NUMBERS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")


def range_of(ranges: Sequence[Sequence[int]], count: int) -> str | None:
    """Return the choice '<lowest>-<highest>' in which a count lies; None if there is none."""
    return next((f"{low}-{high}" for low, high in ranges if low <= count <= high), None)


def how_many(
    *templates: str,
    ranges: Callable[[Any], Sequence[tuple[int, int]]],
    fills: Callable[[Any, np.random.Generator], Mapping[str, str]] = lambda p, rng: {},
) -> Question:
    """Return a question answered by a range; '{choices}' are all, lowest first."""

    def fill(p: Any, rng: np.random.Generator) -> Filled:
        aliases: dict[str, str] = {}
        for low, high in ranges(p):
            numbers = [form for n in range(low, high + 1) for form in (str(n), NUMBERS[n])]
            aliases |= dict.fromkeys([f"{low} to {high}", f"{low} or {high}", *numbers], f"{low}-{high}")
        labels = tuple(f"{low}-{high}" for low, high in ranges(p))
        return Filled(labels, aliases, {"choices": list_choices(labels), **fills(p, rng)})

    return Question("count_range", templates, fill)


def either(question: str, labels: Sequence[str], answer: Callable[[Any], str]) -> Aside:
    """Return a question that names its choices in a fixed order, and may name parts."""

    def ask(p: Any, rng: np.random.Generator) -> AnswerableQuestion:
        return AnswerableQuestion(question.format_map(part_colours(p)), tuple(labels), answer(p))

    return ask


def comes_from(question: str) -> Aside:
    """Return a question for the side, left or right, that things come from."""
    return either(question, ("left", "right"), lambda p: "left" if p.direction > 0 else "right")


def goes_to(question: str) -> Aside:
    """Return a question for the side, left or right, that things go to."""
    return either(question, ("left", "right"), lambda p: "right" if p.direction > 0 else "left")


def choice_of(question: str, choices: Callable[[Any], Sequence[str]], answer: Callable[[Any], str]) -> Aside:
    """Return a question whose '{choices}' are in random order."""

    def ask(p: Any, rng: np.random.Generator) -> AnswerableQuestion:
        order = tuple(str(c) for c in rng.permutation(choices(p)))
        return AnswerableQuestion(
            question.format_map({**part_colours(p), "choices": list_choices(order)}), order, answer(p)
        )

    return ask


def colour_of(part: str, question: str, among: Sequence[str]) -> Aside:
    """Return a question for a part's colour among those of the parts `among`."""
    return choice_of(question, lambda p: [part_colours(p)[name] for name in among], lambda p: part_colours(p)[part])


def colour_from(part: str, question: str, pool: Sequence[str], unlike: Sequence[str]) -> Aside:
    """Return a question for a part's colour, with two that no `unlike` part has."""

    def ask(p: Any, rng: np.random.Generator) -> AnswerableQuestion:
        colours = part_colours(p)
        excluded_colours = [colours[name] for name in unlike]
        other_colours = [str(c) for c in rng.permutation([c for c in pool if c not in excluded_colours])[:2]]
        return choice_of(question, lambda p: [colours[part], *other_colours], lambda p: colours[part])(p, rng)

    return ask


_IN_WORDS = {"wood": "brown", "grey": "grey", "black": "black"}


def material_of(part: str, question: str) -> Aside:
    """Return a question for the colour of a part: brown (wood), grey or black."""
    return choice_of(question, lambda p: list(_IN_WORDS.values()), lambda p: _IN_WORDS[part_colours(p)[part]])
