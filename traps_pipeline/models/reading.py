"""What an answer in the ledger amounts to: an answer, or a text that is none (docs/models.md, "Broken is not modest").

The ledger keeps what a provider sent; this reading of it makes the responses table, so that a better reading asks
nothing again. A text that is no answer is an outcome of its own and reaches no judge, who would take it for modesty.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from traps_pipeline.models.prompts import fields_of
from traps_pipeline.models.request import JUDGED, WITH_TEXT

THINKS = re.compile(r"<(/?)think(?:ing)?>", re.IGNORECASE)
READING = "2"  # version of this module's rules; the answers' tables are stale when it is raised
FINAL = re.compile(r"\banswer\W*?(?:\bis\b\s*:?|[:=])\s*", re.IGNORECASE)  # what announces the final answer
_WORD = re.compile(r"\w+")
_LONGEST_UNIT, _LEAST_REPEATS, _LEAST_SHARE = 40, 6, 0.5  # words, times, of the text's words
_LEAST_WORDS, _FEW_CHARACTERS = 12, 30


@dataclass(frozen=True)
class Reading:
    """outcome: as the ledger has it, or `degenerate`; text: what a judge is shown, None where it is shown nothing;
    reasoning: the trace; is_json: where the prompt asks for an object, whether the text is that;
    why: what is wrong with a text that is no answer."""

    outcome: str
    text: str | None
    reasoning: str | None
    is_json: bool | None = None
    why: str | None = None


def read_answer(
    row: Mapping[str, Any], reasoning: str | None, regime: str, *, inline_thinking: bool, dataset: str = ""
) -> Reading:
    """The reading of an answer's row in the ledger. inline_thinking: whether the model's entry says that it thinks
    between `<think>` tags in its visible text, which are then split off. dataset: of the item; it may ask for another
    object than the regime."""
    fields = fields_of(regime, dataset)
    outcome, text = str(row["outcome"]), row["text"]
    if outcome not in WITH_TEXT or not isinstance(text, str):
        return Reading(outcome, text, reasoning)
    is_json = _is_json(text, fields) if fields else None
    if THINKS.search(text):
        if not inline_thinking:
            why = "thinks between tags in its text; say `inline_thinking: true` in its entry"
            return Reading("degenerate", None, reasoning, is_json, why)
        thought, text = split_thinking(text)
        reasoning = "\n\n".join(part for part in (reasoning, thought) if part) or None
        is_json = _is_json(text, fields) if fields else None
        if not text:
            return Reading("truncated" if outcome == "truncated" else "empty", None, reasoning, is_json, "only thinks")
    if why := degenerate(text):
        return Reading("degenerate", None, reasoning, is_json, why)
    if outcome == "truncated" and not (_says_its_answer(text) or _is_json(text, fields or ())):
        return Reading("truncated", None, reasoning, is_json, "cut off at the limit of tokens before a final answer")
    return Reading(JUDGED[0], text, reasoning, is_json)


def _says_its_answer(text: str) -> bool:
    """Whether a word follows what announces the final answer."""
    return any(_WORD.search(piece) for piece in FINAL.split(text)[1:])


def split_thinking(text: str) -> tuple[str, str]:
    """The thoughts in a text and its answer. A closing tag without an opening one ends thoughts that began with the
    text, as chat templates have it that open the tag themselves; an opening one that is never closed leaves no
    answer."""
    tags = list(THINKS.finditer(text))
    last = tags[-1]
    answer = text[last.end() :] if last.group(1) else text[: tags[0].start()]
    thoughts = text[: last.start()] if last.group(1) else text[tags[0].end() :]
    return THINKS.sub(" ", thoughts).strip(), answer.strip()


def degenerate(text: str) -> str | None:
    """Why a text says nothing: it holds no letter and no digit, or repeats itself; None if it says something.

    A text repeats itself where a unit of at most 40 words stands at least six times in a row at its end and makes up
    at least half of its words, or where 30 characters or more are of at most two kinds.
    """
    words = _WORD.findall(text.lower())
    if not words:
        return "holds no word"
    letters = "".join(words)
    if len(letters) >= _FEW_CHARACTERS and len(set(letters)) <= 2:
        return "repeats a character"
    if len(words) >= _LEAST_WORDS:
        for unit in range(1, _LONGEST_UNIT + 1):
            same = 0
            while same < len(words) - unit and words[-1 - same] == words[-1 - same - unit]:
                same += 1
            repeats, share = same // unit + 1, (same + unit) / len(words)
            if repeats >= _LEAST_REPEATS and share >= _LEAST_SHARE:
                return "repeats itself"
    return None


def _is_json(text: str, fields: Sequence[str]) -> bool:
    """Whether a text is an object with the fields that decide, `final_answer` and `abstain` if asked for, in a fence or
    not. What reasons it gives is left to it."""
    stripped = text.strip()
    if stripped.startswith("```") and stripped.endswith("```"):
        stripped = stripped[3:-3].removeprefix("json")
    try:
        parsed = json.loads(stripped)
    except (ValueError, RecursionError):
        return False
    return isinstance(parsed, dict) and {"final_answer", *({*fields} - {"reason"})} <= parsed.keys()
