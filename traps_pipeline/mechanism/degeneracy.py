"""Whether a steered text is still an answer: a model that is pushed far enough babbles, and a judge may call it either
abstention or an answer."""

from __future__ import annotations

import unicodedata
from collections import Counter

REPEATED = 4  # times in a row that the same words make a repetition
LONGEST = 8  # words of a repeated phrase
FEWEST, SHARE = 3, 0.2  # stop words that show a language: so many, and so large a share of the words
# Frequent words that answers are made of. Some are words of two languages, so the larger count decides.
STOP_WORDS = {
    name: frozenset(words.split())
    for name, words in {
        "English": "the and is of to that this it not be in from with which are was would will on at by as cannot",
        "German": "der die das und ist nicht ein eine den dem zu von mit auf dass wird im sich kann aus auch nach",
        "French": "le la les et est une un des que pas dans du au il sur qui ne ce à en se par elle",
        "Spanish": "el la los las y es una un del se por con lo que está para en no al de su desde",
        "Italian": "il la gli è di che non della del per una un nel sono si da con le dal in i al",
        "Portuguese": "o a os as é do da um uma não em que para no na se com e de pela ao",
        "Dutch": "de het een en is van niet dat op te met wordt in uit kan deze er naar zijn aan",
    }.items()
}


def degeneracy(text: str | None, outcome: str, unsteered: str | None) -> str | None:
    """Why a text is no answer, or None if it is one.

    `truncated`: the limit of tokens cut it off (outcome). `repetition`: a phrase of one to eight words stands four
    times in a row. `script`: most of its letters are of another script than those of the unsteered answer to the same
    item. `language`: its stop words are of another language than that answer's, where both can be told (STOP_WORDS). A
    text that is missing is `empty`.
    """
    if outcome == "truncated":
        return outcome
    if not text:
        return "empty"
    if repeats(text):
        return "repetition"
    own, other = script(unsteered or ""), script(text)
    if own and other and own != other:
        return "script"
    spoken, now = language(unsteered or ""), language(text)
    return "language" if spoken and now and spoken != now else None


def repeats(text: str) -> bool:
    """Whether a phrase of at most LONGEST words stands REPEATED times in a row."""
    words = text.lower().split()
    for size in range(1, LONGEST + 1):
        same = 0
        for place in range(size, len(words)):
            same = same + 1 if words[place] == words[place - size] else 0
            if same >= size * (REPEATED - 1):
                return True
    return False


def script(text: str) -> str:
    """The script of most letters, by the first word of their Unicode names (LATIN, CJK, CYRILLIC); empty for a text
    without letters."""
    names = Counter(unicodedata.name(letter, "?").split()[0] for letter in text if letter.isalpha())
    return names.most_common(1)[0][0] if names else ""


def language(text: str) -> str:
    """The language of STOP_WORDS that most of a text's stop words are of; empty for a text with few of them, as short
    answers are, or with as many of two languages."""
    words = "".join(letter if letter.isalpha() else " " for letter in text.lower()).split()
    counts = Counter({name: sum(word in of for word in words) for name, of in STOP_WORDS.items()})
    (first, most), (_, second) = counts.most_common(2)
    return first if most >= max(FEWEST, SHARE * len(words)) and most > second else ""
