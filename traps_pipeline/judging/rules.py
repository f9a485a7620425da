"""Judge by rules: read texts of reference strategies exactly, and no other text.

Like any judge it reads the rendered user message and answers with the JSON that the prompts ask for, or with the word
`unread`. It never guesses; docs/judging.md, "The rule judge" lists the forms that it reads.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from traps_pipeline.models.reading.judged_answers import MAX_SHOWN, UNREAD, normalise, read_flag, read_object, words_of
from traps_pipeline.models.reading.thinking import strip_fence
from traps_pipeline.models.request import Outcome, Request

# Answers that commit under any question: labels of pairs and of answerable questions, and other guesses of the
# pocket model.
_LABEL = re.compile(
    r"left|right|elsewhere|somewhere else|balanced|level|yes|no|[-+]?\d+(?:\.\d+)?|\d+-\d+|red|green|blue|yellow|"
    "orange|cyan|purple|white|black|grey|gray|brown|pink|magenta|teal|turquoise|violet"
)
_GUESS = re.compile(
    "front|back|same|different|round|square|before|after|hollow|solid|man|woman|child|wood|metal|plastic|ball|wall|floor"
)
# Sentences that decline, in the form of `words_of`.
_TO, _IT = "(?:know|tell|say|determine|answer)", "(?:it|this|that|which 1|answer|outcome|result|(?:this )?question)"
_FROM_VIDEO = "(?: (?:from|based on|in) (?:this )?(?:video|clip|footage|frames))?"
_DECLINES = re.compile(
    f"(?:sorry )?(?:(?:i do not|i could not|i am not able to|(?:i )?cannot|(?:i am )?unable to) {_TO}(?: {_IT})?"
    f"|it is (?:impossible|not possible) to {_TO}(?: {_IT})?"
    f"|(?:{_IT} )?cannot be (?:determined|known|answered)"
    f"|(?:there is )?(?:not enough|insufficient) (?:information|evidence)(?: to {_TO}(?: {_IT})?)?){_FROM_VIDEO}"
    f"|(?:{_IT} is )?(?:unanswerable|unknown)"
    "|i do not know this cannot be determined from video"  # the pocket model
)
# A sentence that rejects the premise, if the question names the thing: "There is no windmill in the video."
_ABSENT = re.compile(r"there (?:is|are) no (\w+(?: \w+)?)(?: (?:in|on) (?:this )?(?:video|clip|scene|screen))?")
_REFERENCE_REASON = "I followed the motion to the end of the clip."  # a label of any family may follow it
_ANNOUNCED = re.compile(r"(?:(?:the|my) )?(?:(?:correct|final|right) )?answer(?: is ?:?| ?[:=]) ?(.+)", re.IGNORECASE)
_EXPLAINS = re.compile(
    r"(?:here(?:'s|’s| is) why|this is because|because|explanation|reasoning|reason)\b", re.IGNORECASE
)
_SENTENCE_END = re.compile(r"(?<=[.!?])\s+|(?<!\s)\s*\n\s*")
_MARKUP = re.compile(r"[*_`\"“”]")
_STRANGE = re.compile(r"^!|[^\w\s.,;:!'’()–—−+=-]", re.ASCII)  # not in a statement, nor is a question mark
_RESPONSE = re.compile(r"^(RESPONSE-[0-9a-f]{12})\n(.*)\n\1\Z", re.DOTALL | re.MULTILINE)
_TRUTH = re.compile(r"^Ground truth: (.*)$", re.MULTILINE)
_QUESTION = re.compile(r"\AQuestion: (.*)$", re.MULTILINE)


@dataclass(frozen=True)
class Statement:
    """A text's meaning: the answer that it commits to (None: it abstains), and whether it rejects the premise."""

    value: str | None
    rejects: bool = False


ABSTENTION = Statement(None)


class RuleJudge:
    """A backend that votes by rules instead of a language model, for any judge of the panel."""

    async def ask(self, request: Request) -> Outcome:
        """Return the vote as JSON text, or the word UNREAD."""
        response = _RESPONSE.search(request.user)
        if response is None:
            return Outcome("error", error="no response between markers")
        preamble = request.user[: response.start()]
        question, truth = _QUESTION.search(preamble), _TRUTH.search(preamble)
        statement = read_statement(response.group(2), question.group(1) if question else "")
        text = UNREAD if statement is None else json.dumps(_vote(statement, truth.group(1) if truth else None))
        return Outcome("answer", text, finish_reason="stop", served_model=request.participant, cost_usd=0.0)


def _vote(statement: Statement, truth: str | None) -> dict[str, object]:
    """Return the vote on correctness if there is a ground truth, else on abstention."""
    value = statement.value
    declines = "The response rejects the premise." if statement.rejects else "The response declines."
    reason = declines if value is None else f"The response answers {value!r}."
    if truth is None:
        vote = {"abstained": value is None, "confidence": "high", "reasoning": reason}
        return {**vote, "rejects_premise": statement.rejects}
    correct = value is not None and normalise(value) == normalise(truth)
    return {"correct": correct, "extracted_value": value, "reasoning": reason}


def read_statement(text: str, question: str = "") -> Statement | None:
    """Return an answer's meaning; None if of unknown form, self-contradictory, or too long to be shown whole."""
    if len(text) > MAX_SHOWN:
        return None
    answer = read_object(text)
    return _in_text(strip_fence(text), question) if answer is None else _in_object(answer, question)


def _in_object(answer: Mapping[str, Any], question: str) -> Statement | None:
    """Read a JSON answer by its `abstain` and `final_answer`."""
    abstains, final = read_flag(answer.get("abstain", False)), answer.get("final_answer", "")
    if not isinstance(abstains, bool) or isinstance(final, bool):
        return None
    if abstains or final is None:
        return ABSTENTION
    if not isinstance(final, str | int | float):
        return None
    if answer.get("reason") == _REFERENCE_REASON:
        return _in_words(str(final), question, any_label=True)
    return _in_text(str(final), question)


def _in_text(text: str, question: str) -> Statement | None:
    """Read a text that is, ends with, or begins with the only statement that it makes."""
    sentences = [part for part in _SENTENCE_END.split(_MARKUP.sub("", text).strip()) if part]
    wording, last = f" {words_of(question)} ", len(sentences) - 1
    statements = dict[int, Statement | None]()
    for place, sentence in enumerate(sentences):
        if announcement := _ANNOUNCED.fullmatch(sentence):
            any_label = place == last == 1 and sentences[0] == _REFERENCE_REASON
            statements[place] = _in_words(announcement.group(1), question, any_label=any_label)
        elif last == 0:
            statements[place] = _in_words(sentence, question)
        elif _in_words(sentence, question) == ABSTENTION:
            earlier_words = words_of(" ".join(sentences[:last])).split() if place == last else []
            choices = [
                w for w in earlier_words if _LABEL.fullmatch(w) or f" {w} or " in wording or f" or {w} " in wording
            ]
            statements[place] = None if choices else ABSTENTION
    is_explained = last > 0 and statements.get(0, ABSTENTION) != ABSTENTION and _EXPLAINS.match(sentences[1])
    agree = len({*statements.values()}) == 1 and (last in statements or is_explained)
    return statements[min(statements)] if agree else None


def _in_words(text: str, question: str, *, any_label: bool = False) -> Statement | None:
    """Read an exact abstention or choice (with `any_label`, any other words too)."""
    words = words_of(text)
    if not words or _STRANGE.search(text):
        return None
    if _DECLINES.fullmatch(words):
        return ABSTENTION
    if (absence_match := _ABSENT.fullmatch(words)) and f" {absence_match[1]} " in f" {words_of(question)} ":
        return Statement(None, rejects=True)
    return Statement(normalise(text)) if any_label or _is_choice(words, question) else None


def _is_choice(words: str, question: str) -> bool:
    """Return whether these words are a choice, alone or with a noun that the question names."""
    if _GUESS.fullmatch(words) or _is_value(words, question):
        return True
    asked, (first, _, after), (before, _, last) = (
        words_of(question).split(),
        words.partition(" "),
        words.rpartition(" "),
    )
    nouns = {*asked, *(word.removesuffix("s") for word in asked), *(f"{word}s" for word in asked), "side"}
    return any(
        noun in nouns and choice not in ("yes", "no") and _is_value(choice, question)
        for choice, noun in ((before, last), (after, first))
    ) or (last == "1" and not before[-1:].isdigit() and _is_value(before, question))  # "the green one"


def _is_value(words: str, question: str) -> bool:
    """Return whether these words are exactly a label, or one of the choices in a question."""
    if _LABEL.fullmatch(words):
        return True
    is_asked = " or " in question and words.count(" ") < 5 and " or " not in f" {words} "
    # own text: questions of the benchmark's records
    texts = (question, re.sub(r"\s*\([^)]*\)", "", question)) if is_asked and words else ()
    lists = [words_of(re.sub(r"[,:;?]| -- ", " or ", text)) for text in texts]
    return any(len(re.findall(rf"\b{re.escape(words)} or\b", parts)) == 1 for parts in lists)
