"""Detect degenerate steered texts, which judges could call abstention or answer."""

import re
import unicodedata
from collections import Counter

MIN_REPEATS = 4  # consecutive occurrences that make a repetition
MAX_PHRASE_WORDS = 8  # maximum words of a repeated phrase


def degeneracy(text: str | None, outcome: str, unsteered: str | None) -> str | None:
    """Return in words why a text is no answer, or None if it is one.

    `truncated`: the limit of tokens cut it off (outcome). `empty`: the text is missing. `letters`: it has no letter and
    no digit. `repetition`: a phrase of one to eight words stands four times in a row, or up to twelve characters six
    times. `script`: most of its letters are of another script than those of the unsteered answer to the same item.
    """
    if outcome == "truncated":
        return outcome
    if not text:
        return "empty"
    if not any(character.isalnum() for character in text):
        return "letters"
    if repeats(text) or re.search(r"(\S{1,12}?)\1{5}", text):
        return "repetition"
    unsteered_script, steered_script = script(unsteered or ""), script(text)
    return "script" if unsteered_script and steered_script and unsteered_script != steered_script else None


def repeats(text: str) -> bool:
    """Return whether a phrase of at most MAX_PHRASE_WORDS words stands MIN_REPEATS times in a row."""
    words = text.lower().split()
    for size in range(1, MAX_PHRASE_WORDS + 1):
        n_repeats = 0
        for place in range(size, len(words)):
            n_repeats = n_repeats + 1 if words[place] == words[place - size] else 0
            if n_repeats >= size * (MIN_REPEATS - 1):
                return True
    return False


def script(text: str) -> str:
    """Return the name of the writing system of most letters (LATIN, CJK), or empty."""
    names = Counter(unicodedata.name(letter, "?").split()[0] for letter in text if letter.isalpha())
    return names.most_common(1)[0][0] if names else ""
