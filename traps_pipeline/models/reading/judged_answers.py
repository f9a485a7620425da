"""Decide correctness: compare a value with the ground truth (docs/spec.md 4.3)."""

import json
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

from traps_pipeline.models.reading.thinking import strip_fence

UNREAD = "unread"  # a rule judge's vote, and an answer's outcome, if no rule can read the text
MAX_SHOWN = 40_000  # characters of an answer that a judge is shown, more than 8,000 tokens of prose
NUMERIC_TOLERANCE = 0.5
_WORDS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
_ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth")
NUMBER_WORDS = {word: str(n) for n, word in enumerate(_WORDS)}
_ORDINAL_WORDS = {word: str(n) for n, word in enumerate(_ORDINALS, 1)}
_CONTRACTIONS = {"can't": "cannot", "can not": "cannot", "n't": " not", "i'm": "i am", "it's": "it is"}
_DENIALS = {"not", "never", "neither", "nor", "without", "except", "cannot"}
_SAYS_YES = dict.fromkeys(("true", "does", "do", "is", "will"), "yes") | {"false": "no"}
_PRONOUN = re.compile(r"\b((?:the|this|that)\s+\w+\s+)ones?\b", re.IGNORECASE)  # "the middle one" is no number
_FENCE = re.compile(r"(?:```|~~~)?\s*(?:json)?", re.IGNORECASE)
_NUMBER = re.compile(r"(?:(?<![\w.])-)?(?:\d+(?:\.\d+)?|\.\d+)")
_THOUSANDS = re.compile(r"(?<=\d),(?=\d{3}(?!\d))")
# Kept punctuation: a hyphen or point inside a number or range, a minus or point before a number.
_PUNCTUATION = re.compile(r"(?<=\d)[.\-](?=\d)|(?<![\w.])-(?=\.?\d)|(?<![\w.])\.(?=\d)|([^\w\s])")


def normalise(text: str) -> str:
    """Return the text in lower case, without articles and non-numeric punctuation."""
    text = _THOUSANDS.sub("", re.sub("[–—−]", "-", text.lower()))
    text = re.sub(r"(?<=\d)\s*(?:-|to)\s*(?=\d)", "-", text)
    text = _PUNCTUATION.sub(lambda match: " " if match[1] else match[0], text)
    return " ".join(word for word in text.split() if word not in ("a", "an", "the"))


def read_object(text: str) -> dict[str, Any] | None:
    """Return a text's JSON object, fenced or not; None if it is none or repeats a key."""
    try:
        value = json.loads(strip_fence(text), object_pairs_hook=_unique)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def leading_object(text: str) -> str:
    """Return the JSON object, fenced or not, at a text's start, without later prose.

    The text is returned unchanged if it begins with no complete object, or if another brace follows: of two verdicts
    neither is the judge's.
    """
    start = text.find("{")
    if start < 0 or _FENCE.fullmatch(text[:start].strip()) is None:
        return text
    try:
        _, end = json.JSONDecoder().raw_decode(text, start)
    except (ValueError, RecursionError):
        return text
    return text if "{" in text[end:] else text[start:end]


def _unique(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) < len(pairs):
        raise ValueError("a key stands twice")
    return fields


def read_flag(value: object) -> object:
    """Return a truth value from a word (`"true"`); anything else unchanged."""
    return {"true": True, "false": False}.get(value.strip().lower(), value) if isinstance(value, str) else value


def words_of(text: str) -> str:
    """Return a text's normal form without contractions, and with numbers in digits."""
    text = text.lower().replace("’", "'")
    for contraction, full in _CONTRACTIONS.items():
        text = text.replace(contraction, full)
    return " ".join(NUMBER_WORDS.get(word, word) for word in normalise(text).split())


def named_choices(text: str, answer_type: str, labels: Sequence[str], aliases: Mapping[str, str]) -> set[str]:
    """Return the choices that a value names; a value that names several cannot be read.

    The longest names count, wherever they stand; a numeric value also names each number in it, and "2 of 3" names 2
    alone. Where a word outside of a name denies something, or a number counts from the right, every choice is returned.
    """
    names, longest = _names(tuple(labels), tuple(aliases.items()))
    text = _PRONOUN.sub(lambda match: match[0] if tuple(_value_words(match[0])) in names else match[1], text)
    words, is_binary, named = _value_words(text), {*labels} == {"yes", "no"}, set[str]()
    if exact := names.get(tuple(words)) or (is_binary and _SAYS_YES.get(" ".join(words))):
        return {exact}
    if is_binary and words[-1:] == ["not"]:  # "no, it does not"
        words, named = words[:-2], {"no"}
    is_denied, place = False, 0
    while place < len(words):
        word, ends = words[place], range(min(place + longest, len(words)), place, -1)
        end = next((end for end in ends if tuple(words[place:end]) in names), place)
        if named and words[place - 1] == "of" and word[0].isdigit():
            end = place + 1
        elif end > place:
            named.add(names[tuple(words[place:end])])
        elif answer_type == "numeric":
            numbers = [f"{float(number):g}" for number in _NUMBER.findall(_ORDINAL_WORDS.get(word, word))]
            named |= {names.get((number,), number) for number in numbers}
        elif all((part,) in names for part in word.split("-")):
            named |= {names[part,] for part in word.split("-")}
        is_other_end = answer_type == "numeric" and words[max(0, place - 1) : place + 1] == ["from", "right"]
        is_denial = word in _DENIALS or is_other_end or (word == "no" and answer_type != "numeric")
        is_denied |= is_denial and end == place and named != {"no"}  # "no, it does not fall"
        place = max(end, place + 1)
    return {*labels} if is_denied and (named or is_binary) else named


@lru_cache(1024)  # every vote on an item needs them
def _names(labels: tuple[str, ...], aliases: tuple[tuple[str, str], ...]) -> tuple[dict[tuple[str, ...], str], int]:
    """Return the label of each name, by the name's words, and the words of the longest."""
    names = {tuple(_value_words(name)): label for name, label in (*aliases, *zip(labels, labels, strict=True)) if name}
    return names, max(map(len, names), default=0)


def _value_words(text: str) -> list[str]:
    return [word for word in words_of(text).split() if word not in ("it", "they")]


def to_label(text: str, labels: Sequence[str], aliases: Mapping[str, str]) -> str | None:
    """Return the label that a value names; None if it names none or several."""
    named = named_choices(text, "", labels, aliases)
    return named.pop() if len(named) == 1 else None


def is_correct(
    extracted: str | None, ground_truth: str, answer_type: str, labels: Sequence[str], aliases: Mapping[str, str]
) -> bool | None:
    """Return whether the choice that a value names is the truth, or within 0.5 of it; None if it names several."""
    named = [] if extracted is None else [*named_choices(extracted, answer_type, labels, aliases)]
    if len(named) > 1:
        return None
    if not named or answer_type != "numeric":
        return named == [ground_truth]
    return abs(float(named[0]) - float(ground_truth)) <= NUMERIC_TOLERANCE
