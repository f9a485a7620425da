"""Decide correctness: compare a value with the ground truth (docs/spec.md 4.3)."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

from traps_pipeline.models.reading.thinking import strip_fence

UNREAD = "unread"  # a rule judge's vote, and an answer's outcome, if no rule can read the text
NUMERIC_TOLERANCE = 0.5
_WORDS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
NUMBER_WORDS = {word: str(n) for n, word in enumerate(_WORDS)}
_FENCE = re.compile(r"(?:```|~~~)?\s*(?:json)?", re.IGNORECASE)
_NUMBER = re.compile(r"(?:(?<![\w.])-)?(?:\d+(?:\.\d+)?|\.\d+)")
_THOUSANDS = re.compile(r"(?<=\d),(?=\d{3}(?!\d))")
# Kept punctuation: a hyphen or point inside a number or range, a minus or point before a number.
_PUNCTUATION = re.compile(r"(?<=\d)[.\-](?=\d)|(?<![\w.])-(?=\.?\d)|(?<![\w.])\.(?=\d)|([^\w\s])")


@lru_cache(4096)  # every vote on correctness normalises all labels and aliases of its item again
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
    """Return a word for a truth value (`"true"`) as a bool; anything else unchanged."""
    return {"true": True, "false": False}.get(value.strip().lower(), value) if isinstance(value, str) else value


def to_number(text: str) -> float | None:
    """Return the only number in a text, in digits or words; None if none or several."""
    words = [NUMBER_WORDS.get(word, word) for word in normalise(text).split()]
    numbers = _NUMBER.findall(" ".join(words))
    return float(numbers[0]) if len(numbers) == 1 else None


def to_label(text: str, labels: Sequence[str], aliases: Mapping[str, str]) -> str | None:
    """Return the label that a value names, exactly or by an alias; else None."""
    table = {normalise(label): label for label in labels}
    table |= {normalise(alias): label for alias, label in aliases.items()}
    return table.get(normalise(text))


def is_correct(
    extracted: str | None, ground_truth: str, answer_type: str, labels: Sequence[str], aliases: Mapping[str, str]
) -> bool:
    """Return whether a value is within 0.5 of the truth, or names its label or alias."""
    if extracted is None:
        return False
    if answer_type == "numeric":
        label = to_label(extracted, labels, aliases)
        number = to_number(label if label is not None else extracted)
        return number is not None and abs(number - float(ground_truth)) <= NUMERIC_TOLERANCE
    return to_label(extracted, labels, aliases) == ground_truth
