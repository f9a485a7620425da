"""Interpret a ledger row: an answer, or a text that is none (docs/models.md).

The ledger keeps what a provider sent; the responses table comes from this interpretation, so that improving it asks
nothing again. A text that is no answer has an outcome of its own and reaches no judge, who would take it for an
abstention.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from traps_pipeline.models.reading.endings import ending_of
from traps_pipeline.models.reading.thinking import (
    Marks,
    declaration_line,
    split_thinking,
    strip_fence,
    strip_tokens,
    undeclared_mark,
)
from traps_pipeline.models.request import JUDGED_OUTCOMES, UNFINISHED, WITH_TEXT
from traps_pipeline.protocol.regimes import fields_of

READING = "5"  # version of this module's rules; raising it makes the answers' tables stale
# An announced final answer: what stands before it, its first character, and an end after that one.
_MAX_BEFORE = 60  # characters
# own text: _MAX_BEFORE characters of one
_BEFORE = re.compile(r"(?:^|[.!?:\n]|\b(?:the|my|final|correct|best)\s)[\W_]*\Z", re.IGNORECASE)
_STATED = re.compile(r"answer[\W_]*?(?:\bis\b(?:\s*:)?|[:=])[\s*_\"'`]*(?=\w)", re.IGNORECASE)
_END = re.compile(r"\n|[.!?][\"'`)*_\]]*(?:\s|(?<!\d.)$)")
_OBJECT = re.compile(r'\{\s*"')
_DECODER = json.JSONDecoder(strict=False)
_WORD, _SPACE = re.compile(r"\w+"), re.compile(r"\s*")
_LONGEST_UNIT, _MIN_REPEATS, _MIN_SHARE = 40, 6, 0.5  # words, times, of the text's words
_MIN_WORDS, _FEW_CHARACTERS = 12, 30
_MAX_REASON, _MAX_FRAGMENT = 60, 4_000  # characters of a finish reason in a sentence, and of a text that is no answer
_TOKEN_CHARACTERS = 128  # of the longest token in any usual vocabulary


@dataclass(frozen=True)
class Reading:
    """The interpretation of an answer's raw text.

    outcome: as in the ledger, or `degenerate`; text: for judges, None if they are shown nothing; reasoning: the trace;
    is_json: whether the text is the requested object, if one was requested; why: what is wrong with a text that is no
    answer; fragment: that text's beginning.
    """

    outcome: str
    text: str | None
    reasoning: str | None
    is_json: bool | None = None
    why: str | None = None
    fragment: str | None = None


def read_answer(
    row: Mapping[str, Any],
    reasoning: str | None,
    regime: str,
    *,
    thinking: Marks | None = None,
    dataset: str = "",
    max_tokens: int = 0,
) -> Reading:
    """Return the interpretation of an answer's ledger row.

    thinking: the marks, declared by the model's entry, around thinking in the visible text, which is split off.
    dataset: of the item; it may ask for another object than the regime. max_tokens: the request's limit; a longer text
    is not the model's alone, and no answer. 0 if there is none.
    """
    fields = fields_of(regime, dataset)
    outcome, text = str(row["outcome"]), row["text"]
    fragment = text[:_MAX_FRAGMENT] if isinstance(text, str) else None
    if outcome == UNFINISHED:  # this version may know the reason
        finish_reason = row.get("finish_reason")
        outcome = {"complete": JUDGED_OUTCOMES[0], "truncated": "truncated"}.get(ending_of(finish_reason), UNFINISHED)
        if outcome == UNFINISHED:
            why = f"ended for the unknown reason {str(finish_reason)[:_MAX_REASON]!r}"
            return Reading(outcome, None, reasoning, why=why, fragment=fragment)
    if outcome == "empty" and ending_of(row.get("finish_reason")) == "truncated":
        return Reading("truncated", None, reasoning, False if fields else None, "cut off before its answer began")
    if outcome not in WITH_TEXT or not isinstance(text, str):
        return Reading(outcome, text, reasoning)
    if max_tokens and len(text) > _TOKEN_CHARACTERS * max_tokens:
        why = f"is longer than its {max_tokens:,} tokens can be: {len(text):,} characters"
        return Reading(UNFINISHED, None, reasoning, False if fields else None, why, fragment)
    text, is_cut_off = strip_tokens(text), outcome == "truncated"
    if thinking:
        split = split_thinking(text, thinking)
        text, is_cut_off = split.answer, is_cut_off or split.is_open
        reasoning = "\n\n".join(part for part in (reasoning, split.thinking) if part) or None
        if is_cut_off and (split.is_open or not text):
            return Reading("truncated", None, reasoning, False if fields else None, "cut off inside its thinking")
        if not text:
            return Reading("empty", None, reasoning, False if fields else None, "only thinks")
    is_json, fragment = _is_json(text, fields) if fields else None, text[:_MAX_FRAGMENT]
    if mark := undeclared_mark(text):
        reason = f"thinks between marks in its text; say `{declaration_line(mark)}` in its entry"
        return Reading("degenerate", None, reasoning, is_json, reason, fragment)
    if reason := degenerate(text):
        return Reading("degenerate", None, reasoning, is_json, reason, fragment)
    if is_cut_off and not _has_final_answer(text):
        why = "cut off at the limit of tokens before a final answer"
        return Reading("truncated", None, reasoning, is_json, why, fragment)
    return Reading(JUDGED_OUTCOMES[0], text, reasoning, is_json)


def _has_final_answer(text: str) -> bool:
    """Return whether a truncated text has a final answer, before its object or as a complete field of it."""
    brace = _OBJECT.search(text)
    start = brace.start() if brace else len(text)
    return _states_answer(text[:start]) or "final_answer" in _complete_fields(text[start:])


def _states_answer(text: str) -> bool:
    """Return whether a text announces an answer that ends before the text does; one at the cut may be incomplete."""
    for stated in _STATED.finditer(text):
        start = max(0, stated.start() - _MAX_BEFORE)
        if _BEFORE.search(f"{'x' if start else ''}{text[start : stated.start()]}"):
            return _END.search(text, stated.end() + 1) is not None
    return False


def _complete_fields(text: str) -> dict[str, Any]:
    """Return a possibly truncated object's fields up to the first incomplete one."""
    fields, place = dict[str, Any](), 1
    try:
        while True:
            place = _skip(text, place)
            name, place = _DECODER.raw_decode(text, place)
            place = _skip(text, place, ":")
            value, place = _DECODER.raw_decode(text, place)
            if not isinstance(value, str) and text[_skip(text, place)] not in ",}":  # a number may continue
                return fields
            fields[str(name)] = value
            place = _skip(text, place, ",")
    except (ValueError, IndexError, RecursionError):
        return fields


def _skip(text: str, place: int, sign: str = "") -> int:
    """Return the place after white space (and a sign). Raises ValueError."""
    place = _SPACE.match(text, place).end()  # pyright: ignore[reportOptionalMemberAccess] - it matches everywhere
    if not text.startswith(sign, place):
        raise ValueError(f"{sign!r} is not there")
    return place if not sign else _skip(text, place + len(sign))


def degenerate(text: str) -> str | None:
    """Return in words why a text says nothing (no letter or digit, or repetition), else None.

    A text repeats itself if a unit of at most 40 words occurs at least six times in a row at its end and makes up at
    least half of its words, or if 30 characters or more are of at most two kinds.
    """
    words = _WORD.findall(text.lower())
    if not words:
        return "holds no word"
    letters = "".join(words)
    if len(letters) >= _FEW_CHARACTERS and len(set(letters)) <= 2:
        return "repeats a character"
    if len(words) >= _MIN_WORDS:
        for unit in range(1, _LONGEST_UNIT + 1):
            n_repeats = 0
            while n_repeats < len(words) - unit and words[-1 - n_repeats] == words[-1 - n_repeats - unit]:
                n_repeats += 1
            repeats, share = n_repeats // unit + 1, (n_repeats + unit) / len(words)
            if repeats >= _MIN_REPEATS and share >= _MIN_SHARE:
                return "repeats itself"
    return None


def _is_json(text: str, fields: Sequence[str]) -> bool:
    """Return whether a text is an object, in a fence or not, with `final_answer`, and `abstain` if requested."""
    try:
        value = json.loads(strip_fence(text))
    except (ValueError, RecursionError):
        return False
    return isinstance(value, dict) and {"final_answer", *({*fields} - {"reason"})} <= value.keys()
