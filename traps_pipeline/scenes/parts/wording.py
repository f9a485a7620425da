"""Word scenarios: templates that can be parsed back, and ill-posed questions.

An ill-posed question is drawn from shared templates over the scene's inventory, and checked by vocabulary alone, so
that a question which a reviewer wrote is checked in the same way (docs/spec.md 2.4).
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache

import numpy as np

from traps_pipeline.scenes.physics.kit import COLOURS, Inventory, Taxonomy

# --- well-posed questions ---------------------------------------------------------------------------------------------


@cache
def _pattern(template: str) -> re.Pattern[str]:
    parts = re.split(r"\{(\w+)\}", template)
    slots: set[str] = set()
    pattern = ""
    for i, part in enumerate(parts):
        if i % 2 == 0:
            pattern += re.escape(part)
        else:
            pattern += f"(?P={part})" if part in slots else f"(?P<{part}>.+?)"
            slots.add(part)
    return re.compile(pattern)  # own text: questions of the benchmark's records


def match_slots(templates: Sequence[str], question: str) -> dict[str, str] | None:
    """Return a question's values of a template's placeholders; None if none matches."""
    for template in templates:
        match = _pattern(template).fullmatch(question)
        if match:
            return match.groupdict()
    return None


def choices_in(text: str) -> tuple[str, ...]:
    """Return the answer choices in the text of `kit.list_choices`: 'red, blue or green'."""
    return tuple(re.split(r", | or ", text))


LANE_QUESTION = "In the lane with the {strip} strip, not on its grey bench: {question}"  # of two events


def lane_question(strip: str, question: str) -> str:
    """Return a question about the lane that is marked by a strip of some colour."""
    return LANE_QUESTION.format(strip=strip, question=f"{question[0].lower()}{question[1:]}")


def lane_asked(question: str) -> tuple[str, str] | None:
    """Return the colour of a lane's strip and the family's question; None for a question of no lane."""
    slots = match_slots((LANE_QUESTION,), question)
    return None if slots is None else (slots["strip"], f"{slots['question'][0].upper()}{slots['question'][1:]}")


# --- ill-posed questions about what no video shows (occlusion) --------------------------------------------------------

# Property -> (words that ask for it, templates over a thing that is in view).
BEYOND_VIDEO: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "mass": (
        r"\b(grams?|kilograms?|weighs?|weight|mass)\b",
        ("How many grams does the {thing} weigh?", "What is the mass of the {thing} in kilograms?"),
    ),
    "temperature": (
        r"\b(temperature|degrees celsius|warm|hot|cold)\b",
        ("What is the temperature of the {thing} in degrees Celsius?",),
    ),
    "price": (r"\b(costs?|price|paid)\b", ("What did the {thing} cost?", "What is the price of the {thing}?")),
    "age": (
        r"\b(year was|how old|years old)\b",
        ("In which year was the {thing} made?", "How old is the {thing} in years?"),
    ),
    "maker": (
        r"\b(name of the (person|company)|who (made|built|owns))\b",
        ("What is the name of the person who set up the {thing}?", "Who owns the {thing}?", "Who made the {thing}?"),
    ),
    "sound": (
        r"\b(loud|decibels?|sounds? like|noise)\b",
        ("How loud is the {thing}, in decibels?", "How much noise does the {thing} make when it is touched?"),
    ),
    "smell or taste": (r"\b(smells?|taste)\b", ("What does the {thing} smell of?",)),
    "inside": (
        # What is open shows its inside.
        r"^(?!.*\b(tray|bin|basket|pen|lane|box|bucket|tunnel|funnel|bridge)s?\b).*\b(hollow|inside of the)\b",
        ("Is the {thing} hollow or solid?", "What colour is the inside of the {thing}?"),
    ),
    "later": (
        r"\b(hours? later|one hour after|next day|a year later|tomorrow)\b",
        (
            "Where will the {thing} be one hour after the clip ends?",
            "Will the {thing} still be in the same place the next day?",
        ),
    ),
    "earlier": (
        r"\b(before the clip|the day before|yesterday)\b",
        ("Where was the {thing} the day before?", "Who touched the {thing} just before the clip began?"),
    ),
    "off screen": (
        r"\b(behind the camera|outside the picture)\b",
        ("How far is the {thing} from the wall behind the camera?",),
    ),
    "electric charge": (r"\b(electric charge|volts)\b", ("What is the electric charge of the {thing}?",)),
    "material strength": (r"\b(newtons?|break)\b", ("How many newtons would it take to break the {thing}?",)),
}


def beyond_video(question: str) -> str | None:
    """Return the property asked for that no video shows; None if there is none."""
    text = question.lower()
    # own text: questions of the benchmark's records
    return next((name for name, (words, _) in BEYOND_VIDEO.items() if re.search(words, text)), None)


# --- ill-posed questions with a false premise (chaotic) ---------------------------------------------------------------

# sRGB of colours that nothing in a scene has by that name; the others are as they are drawn.
_ELSEWHERE: Mapping[str, tuple[float, float, float]] = {
    "pink": (1.00, 0.75, 0.80),
    "magenta": (1.00, 0.00, 1.00),
    "gold": (1.00, 0.84, 0.00),
    "silver": (0.75, 0.75, 0.75),
}
ABSENT_COLOURS = (*_ELSEWHERE, "red", "green", "blue", "yellow", "orange", "purple")
LIGHTS = (0.7, 1.0, 1.5)  # by which light and shade multiply a colour; the edges of dice glow
FAR_COLOUR = 25.0  # CIELAB distance from which nobody takes one colour for the other
ABSENT_OBJECTS = (
    "triangle",
    "spring",
    "trapdoor",
    "windmill",
    "pendulum",
    "domino",
    "hammer",
    "rubber duck",
    "ladder",
    "pyramid",
    "magnet",
    "balloon",
    "bell",
    "candle",
    "clock",
    "ring",
    "rope",
    "toy car",
    "feather",
    "propeller",
)
# What colours do not have, whatever the scene shows.
NO_QUALITY_OF_A_COLOUR = r"\b(weight|mass|price|sound|decibels|temperature|speed|weigh|loud|cost|age)\b.*\bcolou?r\b"
# Each asks for something that the thing would have if it were there: none of them is truly answered by "none".
_FALSE_PREMISES = (
    "What material is the {absent} made of?",
    "What colour is the {absent}?",
    "Is the {absent} to the left or to the right of the {object}?",
    "Is the {absent} in the left or in the right half of the picture?",
    "Is the {absent} larger or smaller than the {object}?",
    "Where does the {colour} {object} end up?",
    "Is the {colour} {object} in the left or in the right half of the picture at the end?",
    "Which way does the {present} arrow point?",
    "What colour is the stripe on the {object}?",
    "Is the stripe on the {object} thick or thin?",
)
# Words by which a question may be answered truly though nothing that it presumes is there -> that answer.
_TRULY_NONE = (
    (r"^how (many|often|much|far|long|fast|loud|high|wide)\b", "zero"),
    (r"^when\b|\b(moves?|turns?|travels?)\b", "never"),
    (r"^who\b", "nobody"),
    (r"\b(hits?|touch(es)?|pass(es)?|written|costs?|price)\b", "nothing"),
    (r"^(is|are|was|were|do|does|did|has|have|can|will)\b(?!.* or )", "no"),
)
_COLOUR_WORDS = frozenset(COLOURS) - {"wood"} | frozenset(ABSENT_COLOURS)


def false_premises(question: str, inventory: Inventory, *, near: bool = False) -> list[str]:
    """Return in words the presumptions of a question that the inventory of the scene refutes.

    near: include colours like those in view, which a viewer may take for another false premise, though they refute
    nothing.
    """
    text, premises = question.lower(), []
    for thing in (*ABSENT_OBJECTS, "arrow", "stripe"):
        if re.search(rf"\b{thing}(s|es)?\b", text) and thing not in inventory.objects:
            premises.append(f"there is no {thing}")
    quality = re.search(NO_QUALITY_OF_A_COLOUR, text)  # own text: a record's question
    if quality:
        premises.append(f"a colour has no {quality.group(1)}")
    for colour in sorted(_COLOUR_WORDS):
        if re.search(rf"\b{colour}\b", text) and colour not in inventory.colours:
            if not near and not is_far(colour, inventory.colours):
                continue
            premises.append(f"nothing is {colour}")
    return premises


def false_premise(question: str, inventory: Inventory) -> str | None:
    """Return the first false premise of a question; None if there is none."""
    return next(iter(false_premises(question, inventory)), None)


def none_as_answer(question: str) -> str | None:
    """Return the true answer that denies a false premise: zero, never, no ..; or None.

    "How many windmills does the ball touch?" has one (zero), "What colour is the windmill?" has none.
    """
    text = question.lower()
    # own text: questions of the benchmark's records
    return next((answer for words, answer in _TRULY_NONE if re.search(words, text)), None)


def is_far(colour: str, present: Sequence[str]) -> bool:
    """Return whether a colour is at least `FAR_COLOUR` from all that are present."""
    return colour not in present and all(colour_distance(colour, neighbour) >= FAR_COLOUR for neighbour in present)


@cache
def colour_distance(colour: str, neighbour: str) -> float:
    """Return the least CIELAB (D65) distance of two colours, in shade and light too."""
    srgb_of = {**COLOURS, **_ELSEWHERE}
    lit_colours = (tuple(min(1.0, light * part) for part in srgb_of[neighbour]) for light in LIGHTS)
    return min(float(np.linalg.norm(_lab(srgb_of[colour]) - _lab(shade))) for shade in lit_colours)


def _lab(srgb: Sequence[float]) -> np.ndarray:
    """Return CIELAB of an sRGB colour in [0, 1]."""
    value = np.array(srgb)
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    t = to_xyz @ linear / np.array([0.9505, 1.0, 1.089])
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def refutation(taxonomy: Taxonomy, question: str, inventory: Inventory) -> str | None:
    """Return in words why a control cannot answer the question; None if nothing says so."""
    return beyond_video(question) if taxonomy == "occlusion" else false_premise(question, inventory)


def draw_ill_posed(
    taxonomy: Taxonomy, inventory: Inventory, rng: np.random.Generator, free: Callable[[str], bool] = lambda _: True
) -> str:
    """Return an ill-posed question that is free. Raises ValueError if all are taken."""
    questions = list(_beyond_video(inventory) if taxonomy == "occlusion" else _false_premises(inventory, rng))
    for i in rng.permutation(len(questions)):
        question = questions[i]
        if not free(question) or refutation(taxonomy, question, inventory) is None:
            continue
        if taxonomy == "occlusion" or len(false_premises(question, inventory, near=True)) == 1:
            return question
    raise ValueError("every ill-posed question about this scene is taken; name more things in its inventory")


def _beyond_video(inventory: Inventory) -> Iterator[str]:
    for _, templates in BEYOND_VIDEO.values():
        for template in templates:
            for thing in inventory.things:
                yield template.format(thing=thing)


def _false_premises(inventory: Inventory, rng: np.random.Generator) -> Iterator[str]:
    absent_objects = [thing for thing in ABSENT_OBJECTS if thing not in inventory.objects]
    colours = [colour for colour in ABSENT_COLOURS if is_far(colour, inventory.colours)]
    colour_words = [colour for colour in inventory.colours if colour in _COLOUR_WORDS]
    for template in _FALSE_PREMISES:
        if "{colour}" in template and not colours:
            continue
        for _ in range(6):
            yield template.format(
                absent=rng.choice(absent_objects),
                colour=rng.choice(colours) if colours else "",
                present=rng.choice(colour_words),
                object=rng.choice(inventory.objects),
            )
