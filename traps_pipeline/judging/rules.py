"""The rule judge, which looks for phrases and words, for studies without a key. Like any judge it reads the rendered
user message and answers with the JSON that the prompts ask for."""

from __future__ import annotations

import json
import re

from traps_pipeline.judging.answers import NUMBER_WORDS, normalise, strip_fence
from traps_pipeline.models.request import Outcome, Request

COLOURS = (
    *("red", "green", "blue", "yellow", "orange", "cyan", "purple", "white", "black", "grey", "gray", "brown", "pink"),
    *("magenta", "teal", "turquoise", "violet", "navy"),
)
SIDES = ("left", "right", "elsewhere", "somewhere else", "balanced", "level")
ABSTENTIONS = (
    r"i (?:do not|don'?t|cannot|can'?t) (?:really )?(?:know|tell|say|determine|answer|see)",
    r"(?:cannot|can'?t|can not|could not|couldn'?t) be (?:\w+ )?"
    r"(?:determined|answered|known|inferred|established|seen)",
    r"(?:impossible|not possible|unable) to (?:tell|determine|know|say|answer|conclude|see)",
    r"\b(?:unanswerable|undeterminable|indeterminate|undetermined|unknowable|unknown)\b",
    r"(?:insufficient|not enough|no sufficient|lack of) (?:\w+ )?(?:information|evidence|data)",
    r"\bneither\b",
    r"\bnone of the (?:above|options|choices)\b",
    r"\bnot applicable\b|\bn/a\b",
    r"\bno way to (?:tell|know|determine)\b",
)
_ABSTENTION = re.compile("|".join(ABSTENTIONS))
_FINAL = re.compile(r"\banswer\W*?(?:\bis\b\s*:?|[:=])\s*", re.IGNORECASE)
# "I can't tell exactly, but it seems to go left" is an answer: after the hedge and the "but", it names an outcome.
_TURN = re.compile(r"\b(?:but|however|nevertheless|nonetheless|still|yet)\b")
_COMMITMENT = re.compile(
    r"\b(?:appears?|seems?|looks?|likely|probably|i(?:'d| would) (?:say|guess|go with|pick|choose)"
    r"|(?:my )?(?:best )?guess|i (?:think|believe))\b"
)
_RESPONSE = re.compile(r"^(RESPONSE-[0-9a-f]{12})\n(.*)\n\1\Z", re.DOTALL | re.MULTILINE)
_TRUTH = re.compile(r"^Ground truth: (.*)$", re.MULTILINE)


class RuleJudge:
    """The backend of a rule judge, for any seat of the panel (see `Backend`)."""

    async def ask(self, request: Request) -> Outcome:
        """The vote as JSON text."""
        found = _RESPONSE.search(request.user)
        if found is None:
            return Outcome("error", error="no response between markers")
        answer = found.group(2)
        if request.about["task"] == "abstention":
            vote = judge_abstention(answer)
        else:
            truth = _TRUTH.search(request.user[: found.start()])
            vote = judge_correctness(answer, truth.group(1) if truth else "")
        return Outcome("answer", json.dumps(vote), finish_reason="stop", served_model=request.participant, cost_usd=0.0)


def final_statement(answer: str) -> str:
    """The final statement of an answer: the JSON's `final_answer`, else the text after the last 'answer is', or all."""
    try:
        parsed = json.loads(strip_fence(answer))
    except (ValueError, RecursionError):
        parsed = None
    if isinstance(parsed, dict) and "final_answer" in parsed:
        return "" if parsed["final_answer"] is None else str(parsed["final_answer"])
    pieces = _FINAL.split(answer)
    return pieces[-1] if len(pieces) > 1 and pieces[-1].strip() else answer


def judge_abstention(answer: str) -> dict[str, object]:
    """The vote on abstention: yes if the final statement declines. A hedge before an answer is no abstention."""
    final = final_statement(answer).lower().replace("’", "'")
    last = _TURN.split(final)[-1]
    found = None if _COMMITMENT.search(last) and not _ABSTENTION.search(last) else _ABSTENTION.search(final)
    abstained = found is not None or not normalise(final)
    reason = f"The response says '{found.group()}'." if found else "The response commits to an answer."
    return {"abstained": abstained, "confidence": "high" if found else "medium", "reasoning": reason}


def judge_correctness(answer: str, ground_truth: str) -> dict[str, object]:
    """The vote on correctness: it extracts a value of the ground truth's kind; code decides whether it is correct."""
    value = extract(final_statement(answer), ground_truth)
    return {
        "correct": value is not None and normalise(value) == normalise(ground_truth),
        "extracted_value": value,
        "reasoning": f"The response names {value!r}." if value is not None else "The response names no such value.",
    }


def extract(text: str, like: str) -> str | None:
    """The last word of the kind of `like` (range, number, yes/no, side or colour) in a text; else the whole text."""
    words = normalise(text)
    kind = normalise(like)
    if re.fullmatch(r"\d+-\d+", kind):
        pattern = r"\d+-\d+"
    elif re.fullmatch(r"[\d.]+", kind):
        words = " ".join(NUMBER_WORDS.get(word, word) for word in words.split())
        pattern = r"[-+]?\d+(?:\.\d+)?"
    elif kind in ("yes", "no"):
        pattern = r"yes|no"
    elif kind in SIDES:
        pattern = "|".join(SIDES)
    elif kind in COLOURS:
        pattern = "|".join(COLOURS)
    else:
        return words or None
    found = re.findall(rf"(?<![\w.-])(?:{pattern})(?![\w])", words)
    return found[-1] if found else None
