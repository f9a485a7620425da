"""Thinking that stands in a visible text, between marks that the entry of a model or a judge declares."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass

Marks = tuple[str, str]  # what opens the thinking, and what closes it
USUAL: tuple[Marks, ...] = (
    ("<think>", "</think>"),  # DeepSeek-R1, Qwen3, GLM and most others
    ("<thinking>", "</thinking>"),
    ("<thought>", "</thought>"),
    ("<reasoning>", "</reasoning>"),
    ("[THINK]", "[/THINK]"),  # Magistral
    ("◁think▷", "◁/think▷"),  # Kimi-VL
    ("<seed:think>", "</seed:think>"),  # Seed-OSS
    ("<|START_THINKING|>", "<|END_THINKING|>"),  # Command A
    ("<|channel|>analysis<|message|>", "<|channel|>final<|message|>"),  # gpt-oss
)
_TURN = re.compile(r"<\|start\|>assistant|<\|(?:start|end|return)\|>")  # gpt-oss writes these around its messages


@dataclass(frozen=True)
class Split:
    """A text in two. is_open: whether it ends inside its thinking."""

    thinking: str
    answer: str
    is_open: bool


def marks_of(declared: str | Sequence[str]) -> Marks:
    """Return the marks that an entry declares by both, or by the opening one if it is usual. Raises ValueError."""
    usual = dict(USUAL)
    if isinstance(declared, str) and declared in usual:
        return declared, usual[declared]
    both = [] if isinstance(declared, str) else [mark for mark in declared if isinstance(mark, str) and mark.strip()]
    if len(both) != 2 or both[0] == both[1]:
        known = ", ".join(usual)
        raise ValueError(f"give what opens and what closes the thinking, [OPEN, CLOSE], or one of {known}")
    return both[0], both[1]


def split_thinking(text: str, marks: Marks | None) -> Split:
    """Split the thinking off a text; without marks all of it is the answer.

    A closing mark without an opening one ends thinking that began with the text: some chat templates open it
    themselves.
    """
    if marks is None:
        return Split("", text, is_open=False)
    opens, closes = (re.escape(mark) for mark in marks)
    thinking, answer, is_open = "", "", False
    for piece in re.split(rf"({opens}|{closes})", text, flags=re.IGNORECASE):
        if piece.lower() == marks[0].lower():
            is_open = True
        elif piece.lower() == marks[1].lower():
            if not is_open:
                thinking, answer = f"{thinking}\n{answer}", ""
            is_open = False
        elif is_open:
            thinking += piece
        else:
            answer += piece
    return Split(_TURN.sub("", thinking).strip(), _TURN.sub("", answer).strip(), is_open)


def undeclared_mark(text: str) -> str | None:
    """Return the opening one of the first usual marks that a text holds; None if it holds none."""
    lower = text.lower()
    return next((opens for opens, closes in USUAL if opens.lower() in lower or closes.lower() in lower), None)


def how_to_declare(mark: str) -> str:
    """Return the line of an entry that declares a usual mark."""
    return f"thinking: {json.dumps(mark, ensure_ascii=False)}"
