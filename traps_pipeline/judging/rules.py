"""The rule judge, which reads answers by rules, for reference models and for studies that say so.

Like any judge it reads the rendered user message and answers with the JSON that the prompts ask for. docs/judging.md,
"The rule judge" says how many plain sentences it misreads, and which.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import cache

from traps_pipeline.judging.answers import NUMBER_WORDS, normalise, strip_fence
from traps_pipeline.models.reading import FINAL
from traps_pipeline.models.request import Outcome, Request

COLOURS = (
    *("red", "green", "blue", "yellow", "orange", "cyan", "purple", "white", "black", "grey", "gray", "brown", "pink"),
    *("magenta", "teal", "turquoise", "violet", "navy"),
)
SIDES = ("left", "right", "elsewhere", "somewhere else", "balanced", "level")

# --- words that decline -----------------------------------------------------------------------------------------------

_CANNOT = r"(?:cannot|can not|can'?t|could not|couldn'?t)"
_NOT = (
    rf"(?:{_CANNOT}|do not|don'?t|does not|doesn'?t|did not|didn'?t|will not|won'?t|not able to|unable to|rather not)"
)
_CHOICE = r"\b(?:left|right|\d|" + "|".join(COLOURS) + r")\b"
_ADVERBS = r"(?:\w+ly |even |yet |be )*"
_KNOW = (
    r"(?:know|tell|say|determine|see|answer|identify|infer|judge|conclude|decide|estimate|establish|count|confirm|give|"
    r"discern|observe|measure|guess|predict|provide|speculate|make out|sure|certain|100 ?%)"
)
_KNOWN = (
    r"(?:determined|answered|known|inferred|established|seen|counted|confirmed|identified|predicted|estimated|"
    r"measured|observed|discerned|made out|read off|deduced|judged|told|verified)"
)
_SHOW = (
    r"(?:show|reveal|contain|say|tell|provide|give|indicate|include|capture|state|depict|allow|specify|mention|have)\w*"
)
_FOOTAGE = r"(?:video|clip|footage|recording|frames?|sequence|scene|view)"
_INFORMATION = r"(?:information|evidence|data|details?|indication|context|hint|clues?)"
# Statements about what can be known.
DECLINES = (
    rf"{_NOT} {_ADVERBS}{_KNOW}\b",
    rf"{_CANNOT} be (?:\w+ )?{_KNOWN}",
    rf"(?:impossible|not possible|isn'?t possible|too early|too short|no way) (?:to|of) {_ADVERBS}\w+",
    r"\b(?:unanswerable|undeterminable|indeterminate|undetermined|indeterminable|unknowable|uncertain|inconclusive)\b",
    r"\bunknown\b(?! (?:side|face|force|object|ball))",
    r"\b(?:unclear|not clear|no idea|not sure|not certain|unsure)\b",
    rf"(?:not|n't|no|in|without)[ -]?(?:enough |sufficient )(?:\w+ ){{0,2}}{_INFORMATION}",
    rf"\b(?:no|lack of|lacks|nor any) (?:\w+ )?{_INFORMATION}\b",
    r"\bno (?:\w+ )?(?:answer|conclusion) (?:can|could|is|exists)\b",
    r"\bneither\b",
    r"\bnone of the\b",
    r"\bnot applicable\b|\bn/a\b",
    r"\b(?:any|either|all|each|both) (?:of .*)?(?:is|are) (?:equally )?(?:possible|plausible)\b",
    r"\b(?:could|can|may|might|lands? in|is|goes) (?:\w+ )*(?:either )?.*"
    rf"{_CHOICE}[^,]*\bor\b.*{_CHOICE}",
    r"\bmay or may not\b",
    r"^\W*(?:maybe|perhaps|possibly)\W*$",
    r"\b(?:has|have|is|are|does|do|can)(?: no|n'?t| not)\b.*\banswer\b",
    r"\bquestion (?:does not|doesn'?t|can ?not|can'?t|is not|isn'?t|has no|makes no|asks about something)",
    r"\bpremise\b.*\b(?:wrong|false|incorrect|flawed)\b",
    r"(?:is not|isn'?t) (?:something|a property|a quantity)",
    r"\brefuse\b|\bdecline to\b",
)
# Statements about what can be seen: they decline where the answer commits to nothing.
UNSEEN = (
    rf"\b(?:{_FOOTAGE}|it|there) {_NOT} (?:\w+ )?{_SHOW}",
    rf"\b{_FOOTAGE}\b.* (?:does not|doesn'?t|do not|don'?t) (?:\w+ )?{_SHOW}",
    r"\b(?:is|are|was|were|has been|have been|remains?|be)(?:n't| not)? (?:still |completely |fully |partly |all )*"
    r"(?:hidden|occluded|obscured|covered|blocked|concealed|out of (?:view|sight|frame))",
    r"(?:not|n't) (?:be )?(?:\w+ly )?(?:shown|visible|seen|given|stated|known|provided|specified|indicated|mentioned|"
    r"depicted|discernible|in (?:view|sight|frame))",
    rf"\b{_FOOTAGE} (?:ends?|stops?|cuts? off|is cut|finishes) (?:\w+ ){{0,2}}(?:before|too early|while|when)",
    rf"\bno (?:\w+ )+(?:appears?|is shown|are shown|is visible|are visible|is present|are present|in the {_FOOTAGE})",
    rf"\bthere (?:is|are) no (?:\w+ )+(?:in|on|visible|shown)\b.*{_FOOTAGE}",
    rf"\bnothing (?:in the {_FOOTAGE} )?(?:\w+ )?{_SHOW}",
    rf"\b(?:there is|there's) nothing in the {_FOOTAGE}",
    rf"\b(?:alone|itself) (?:does not|doesn'?t) {_SHOW}",
    r"\bhas(?:n't| not) (?:\w+ )*(?:come to rest|landed|settled|stopped|finished|ended)\b",
    r"\bis still (?:moving|falling|rolling|tumbling|bouncing|spinning|in the air)\b",
)
_DECLINE = re.compile("|".join(DECLINES))
_NONE_OF = re.compile(r"\bnone of the\b")  # where 0 is a choice, this is a number
_UNSEEN = re.compile("|".join(UNSEEN))

# --- words that commit ------------------------------------------------------------------------------------------------

_COMMITMENT = re.compile(
    r"\b(?:appears?|seems?|looks?|likely|probably|presumably|apparently|(?:my )?(?:best )?guess|suggests?|points? to|"
    r"i (?:think|believe|expect|estimate)|i(?:'d| would) (?:\w+ )?(?:say|guess|go with|pick|choose|estimate|expect)|"
    r"heading for|inferred)\b"
)
_TURN = re.compile(r"\W*(?:but|however|so|therefore|thus|hence|still|yet|nevertheless|nonetheless)\b")
_REASON = re.compile(r"^\W*(?:because|since|as|given|due to|without|if|whether|which)\b")
# A clause ends at punctuation, at a line's end, and at a comma before a conjunction.
_CLAUSE = re.compile(
    r"(?<=[^\d\s])[.:](?=\s|$|\*)|(?<=\d)[.:](?=\s|$)|[;!?\n]+"
    r"|,?\s+(?=(?:but|however|nevertheless|nonetheless|still,|yet|although|though|because)\b)"
    r"|,\s*(?=(?:and|so|as|since|while|therefore|hence|thus|given)\b)"
)
# What follows these words is compared with the answer and is no answer.
_BESIDE = re.compile(r",?\s+(?:ahead of|before|followed by|in front of|after|instead of|rather than|not|than|unlike)\s")
_LATER = re.compile(r"\b(?:second|third|last|later)\b")
_NEGATIVE = re.compile(
    r"\b(?:not|never|no|stays?|remains?|stands?|stops?|misses|stuck|fails?|short|upright)\b|n't\b|n’t\b"
)
_RESPONSE = re.compile(r"^(RESPONSE-[0-9a-f]{12})\n(.*)\n\1\Z", re.DOTALL | re.MULTILINE)
_TRUTH = re.compile(r"^Ground truth: (.*)$", re.MULTILINE)
_QUESTION = re.compile(r"\AQuestion: (.*)$", re.MULTILINE)
_YES_NO = re.compile(r"(?:^\W*|\b)(yes|no)\b(?=\W*$|\s*[.,;:!)*\"'–—])|^\W*(yes|no)\b")
_RANGE, _NUMBER = r"\d+-\d+", r"[-+]?\d+(?:\.\d+)?"


class RuleJudge:
    """The backend of a rule judge, for any seat of the panel (see `Backend`)."""

    async def ask(self, request: Request) -> Outcome:
        """The vote as JSON text."""
        found = _RESPONSE.search(request.user)
        if found is None:
            return Outcome("error", error="no response between markers")
        answer, before = found.group(2), request.user[: found.start()]
        asked, truth = _QUESTION.search(before), _TRUTH.search(before)
        question = asked.group(1) if asked else ""
        if request.about["task"] == "abstention":
            vote = judge_abstention(answer, question)
        else:
            vote = judge_correctness(answer, truth.group(1) if truth else "", question)
        return Outcome("answer", json.dumps(vote), finish_reason="stop", served_model=request.participant, cost_usd=0.0)


def final_statement(answer: str) -> str:
    """The final statement of an answer: the JSON's `final_answer`, else the text after the last 'answer is', or all. An
    object that says of itself that it abstains states nothing."""
    try:
        parsed = json.loads(strip_fence(answer))
    except (ValueError, RecursionError):
        parsed = None
    if isinstance(parsed, dict) and "final_answer" in parsed:
        abstains = parsed["final_answer"] is None or parsed.get("abstain") is True
        return "" if abstains else str(parsed["final_answer"])
    pieces = FINAL.split(answer)
    return pieces[-1] if len(pieces) > 1 and normalise(pieces[-1]) else answer


def judge_abstention(answer: str, question: str = "") -> dict[str, object]:
    """The vote on abstention: yes if the final statement declines. A hedge before an answer is no abstention."""
    final = _lower(final_statement(answer))
    declined, _ = _read(final, _asked(question))
    abstained = declined is not None or not normalise(final)
    reason = f"The response says '{declined}'." if declined else "The response commits to an answer."
    return {"abstained": abstained, "confidence": "high" if declined else "medium", "reasoning": reason}


def judge_correctness(answer: str, ground_truth: str, question: str = "") -> dict[str, object]:
    """The vote on correctness: it extracts a value of the ground truth's kind; code decides whether it is correct."""
    final = final_statement(answer)
    declined, committed = _read(_lower(final), _asked(question))
    # What a statement amounts to is read where it commits; one that declines has the value that it names, if any.
    value = extract(committed or final, ground_truth, "" if declined else question)
    return {
        "correct": value is not None and normalise(value) == normalise(ground_truth),
        "extracted_value": value,
        "reasoning": f"The response names {value!r}." if value is not None else "The response names no such value.",
    }


# --- reading a statement ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Asked:
    """What a question offers: its choices among colours, sides, numbers and yes or no, and the stems of its words."""

    choices: tuple[str, ...] = ()
    yes_no: bool = False
    zero: bool = False
    first: bool = False
    stems: frozenset[str] = frozenset()

    def named(self, clause: str) -> bool:
        """Whether a clause names one of the choices."""
        if self.yes_no and _YES_NO.search(clause):
            return True
        return bool({*self.choices} & {*_words(clause)} or (self.choices and "somewhere else" in clause))


@cache
def _asked(question: str) -> _Asked:
    lower = _lower(question)
    colours = "|".join(COLOURS)
    choices = re.findall(rf"\b({colours})\b(?=,|\)|\?| or\b)|\bor (?:the )?({colours})\b", lower)
    found = [one or other for one, other in choices]
    found += [side for side in SIDES if re.search(rf"\b{side}\b", lower)]
    numbers = re.findall(r"\d+", lower)
    if numbers or "how many" in lower:
        found += [str(n) for n in range(max(map(int, numbers), default=20) + 1)]
    stems = frozenset(word[:4] for word in _words(lower) if len(word) > 3)
    return _Asked(tuple(found), "yes or no" in lower, "0" in numbers, " first" in lower, stems)


def _lower(text: str) -> str:
    return text.lower().replace("’", "'")


def _words(text: str) -> list[str]:
    """The words of a text; numbers in digits, ranges also as their ends."""
    words = [NUMBER_WORDS.get(word, word) for word in normalise(text).split()]
    return [*words, *(end for word in words if re.fullmatch(_RANGE, word) for end in word.split("-"))]


def _read(final: str, asked: _Asked) -> tuple[str | None, str | None]:
    """The words with which a statement declines, or else the clause with which it commits; (None, None) if it does
    neither, which is an answer too.

    Clauses are read from the last to the first. A clause that says what cannot be known declines; one that names a
    choice, or says what is likely, commits. What cannot be seen declines where no clause commits.
    """
    clauses = [clause for clause in _CLAUSE.split(final) if clause and normalise(clause)]
    later = [c for c in clauses if asked.first and _LATER.search(c) and "first" not in c]
    unseen = None
    for clause in reversed(clauses):
        declined = _DECLINE.search(clause)
        if declined and asked.zero and _NONE_OF.search(declined.group()):
            return None, clause
        if declined:
            return declined.group(), None
        hidden = _UNSEEN.search(clause)
        if hidden:
            unseen = unseen or hidden
            continue
        if clause in later or _REASON.match(clause):
            continue
        if (
            asked.named(clause)
            or _COMMITMENT.search(clause)
            or (_TURN.match(clause) and len(asked.stems & _stems(clause)) > 1)
        ):
            return None, clause
    return (unseen.group(), None) if unseen else (None, None)


def _stems(clause: str) -> set[str]:
    return {word[:4] for word in _words(clause) if len(word) > 3}


# --- extracting a value -----------------------------------------------------------------------------------------------


def extract(text: str, like: str, question: str = "") -> str | None:
    """The last word of the kind of `like` (range, number, yes/no, side or colour) in a text; else the whole text.

    What a text compares its answer with ("ahead of the green one") is left out where something remains. A yes or no
    that is not said is read off the statement, where it speaks of what the question asks.
    """
    kind = normalise(like)
    if kind in ("yes", "no"):
        return _yes_or_no(_lower(text), _asked(question))
    whole = re.sub(r"\bbetween (\S+) and (\S+)", r"\1-\2", _lower(text))
    parts = [whole[: found.start()] for found in _BESIDE.finditer(whole)]
    for part in [*parts[:1], whole]:
        value = _last(part, kind)
        if value is not None:
            return value
    return None


def _last(text: str, kind: str) -> str | None:
    words = " ".join(NUMBER_WORDS.get(word, word) for word in normalise(text).split())
    if re.fullmatch(_RANGE, kind):
        patterns = (_RANGE, _NUMBER)
    elif re.fullmatch(r"[\d.]+", kind):
        patterns = (_NUMBER,)
    elif kind in SIDES:
        patterns = ("|".join(SIDES), "|".join(COLOURS))
    elif kind in COLOURS:
        patterns = ("|".join(COLOURS),)
    else:
        return normalise(text) or None
    for pattern in patterns:
        found = re.findall(rf"(?<![\w.-])(?:{pattern})(?![\w])", words)
        if found:
            return found[-1]
    return None


def _yes_or_no(text: str, asked: _Asked) -> str | None:
    """A yes or no that a text says, or that its statement amounts to."""
    said = [one or other for one, other in _YES_NO.findall(text)]
    if said:
        return said[-1]
    if not asked.stems & _stems(text):
        return None
    return "no" if _NEGATIVE.search(text) else "yes"
