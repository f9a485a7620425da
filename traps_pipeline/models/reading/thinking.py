"""Strip an answer's marked thinking, code fence, and leftover special tokens."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass

Marks = tuple[str, str]  # the opening and the closing mark
COMMON_MARKS: tuple[Marks, ...] = (
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
_END = (  # tokens of the usual templates that end a text
    *("</s>", "<eos>", "<|im_end|>", "<|endoftext|>", "<|end_of_text|>", "<|eot_id|>", "<|eom_id|>"),
    *("<end_of_turn>", "<|end|>", "<|return|>", "<｜end▁of▁sentence｜>"),
)
_INVISIBLE = "\ufeff\u200b\u2060"  # byte-order mark, zero-width space and word joiner
_TURN = re.compile(r"<\|start\|>assistant|<\|(?:start|end|return)\|>")  # gpt-oss writes these around its messages


@dataclass(frozen=True)
class ThinkingSplit:
    """A text split into the model's thinking and its answer; `is_open` if it ends in its thinking."""

    thinking: str
    answer: str
    is_open: bool


def marks_of(declared: str | Sequence[str]) -> Marks:
    """Return the opening and closing mark of declared thinking: both, or a common opening one. Raises ValueError."""
    closing_mark_of = dict(COMMON_MARKS)
    if isinstance(declared, str) and declared in closing_mark_of:
        return declared, closing_mark_of[declared]
    marks = [] if isinstance(declared, str) else [mark for mark in declared if isinstance(mark, str) and mark.strip()]
    if len(marks) != 2 or marks[0] == marks[1]:
        known_marks = ", ".join(closing_mark_of)
        raise ValueError(f"give what opens and what closes the thinking, [OPEN, CLOSE], or one of {known_marks}")
    return marks[0], marks[1]


def split_thinking(text: str, marks: Marks | None) -> ThinkingSplit:
    """Return a text split into thinking and answer; without marks all of it is the answer.

    A closing mark without an opening one ends thinking that began with the text: some chat templates open it
    themselves.
    """
    if marks is None:
        return ThinkingSplit("", text, is_open=False)
    opening_mark, closing_mark = (re.escape(mark) for mark in marks)
    thinking, answer, is_open = list[str](), list[str](), False
    for piece in re.split(rf"({opening_mark}|{closing_mark})", text, flags=re.IGNORECASE):
        if piece.lower() == marks[0].lower():
            is_open = True
        elif piece.lower() == marks[1].lower():
            if not is_open:
                thinking += ["\n", *answer]
                answer = []
            is_open = False
        else:
            (thinking if is_open else answer).append(piece)
    thinking_text, answer_text = (_TURN.sub("", "".join(parts)).strip() for parts in (thinking, answer))
    return ThinkingSplit(thinking_text, answer_text, is_open)


def strip_tokens(text: str) -> str:
    """Return a text without trailing end-of-sequence tokens, and without invisible characters around it."""
    text = text.strip(_INVISIBLE)
    end, has_token = len(text), False
    while True:
        while end and text[end - 1].isspace():
            end -= 1
        token = next((token for token in _END if text.endswith(token, 0, end)), None)
        if token is None:
            return text[:end] if has_token else text
        end, has_token = end - len(token), True


def strip_fence(text: str) -> str:
    """Return the content of a code fence around the whole text, else the text."""
    text = text.strip().strip(_INVISIBLE).strip()
    if text[:3] not in ("```", "~~~") or not text[3:].endswith(text[:3]):
        return text
    content = text[3:-3]
    return (content[4:] if content[:4].lower() == "json" else content).strip()


def undeclared_mark(text: str) -> str | None:
    """Return the opening mark of the first common pair around thinking in a text; None if there is none."""
    lower = text.lower()
    return next(
        (
            opening_mark
            for opening_mark, closing_mark in COMMON_MARKS
            if opening_mark.lower() in lower or closing_mark.lower() in lower
        ),
        None,
    )


def declaration_line(mark: str) -> str:
    """Return the line of YAML that declares a common mark in an entry."""
    return f"thinking: {json.dumps(mark, ensure_ascii=False)}"
