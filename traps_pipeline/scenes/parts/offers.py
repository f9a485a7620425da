"""Questions with and without the choices that they offer.

Well-posed questions of the benchmark offer choices and most ill-posed ones do not, so that a question's form betrays
it. The arm `choices_swapped` asks both the other way round.
"""

from __future__ import annotations

import re


def without_choices(question: str, labels: tuple[str, ...]) -> str | None:
    """A question that offers choices, without them; None if they are part of its sentence."""
    label = "|".join(re.escape(name) for name in sorted(labels, key=len, reverse=True))
    offers = (
        rf"[,:] (?:{label})(?:, (?:{label}))* or (?:{label})\?$",  # ', red, blue or green?'
        r"[,:] (?:in |the )[^,:?]+(?:, (?:in |the )?[^,:?]+)* or [^,:?]+\?$",  # ': in the left or in the right bin?'
        rf", (?:{label})(?:, (?:{label}))* or (?:{label}) from left to right(?=,)",
    )
    for offer in offers:
        shorter = re.sub(offer, "" if offer.endswith("(?=,)") else "?", question)
        if shorter != question:
            shorter = shorter.replace(", does", " does", 1) if offer.endswith("(?=,)") else shorter
            still_offers = " or " in shorter or re.search(rf"\b(?:{label})\?$", shorter)
            return None if still_offers else shorter
    return None


# What an ill-posed question may offer, by how it begins; none of it is an answer, whatever is seen.
_OFFERS: tuple[tuple[str, str], ...] = (
    (r"how many grams", "20, 80 or 300"),
    (r"what is the mass", "0.02, 0.08 or 0.3"),
    (r"what is the temperature", "15, 20 or 25"),
    (r"what did the .* cost|what is the price", "2, 5 or 10 euros"),
    (r"in which year", "2005, 2012 or 2019"),
    (r"how old|what is the age", "1, 5 or 10"),
    (r"what is the name|who ", "Anna, Ben or Clara"),
    (r"how loud", "20, 40 or 60"),
    (r"how much noise", "hardly any, some or a lot"),
    (r"what does the .* smell", "rubber, soap or paint"),
    (r"what colour", "red, white or black"),
    (r"where (will|was)", "on a shelf, in a box or on the floor"),
    (r"will the", "yes or no"),
    (r"how far is", "1, 2 or 3 metres"),
    (r"what is the electric charge", "positive, negative or zero"),
    (r"how many newtons", "10, 50 or 200"),
    (r"what material", "wood, metal or plastic"),
    (r"where does", "on the left or on the right"),
    (r"which way", "up or down"),
    (r"what is the weight", "1, 2 or 3 grams"),
)


def with_choices(question: str) -> str | None:
    """An ill-posed question with choices; the question itself if it offers some, None if none are known for it."""
    if re.search(r" or ", question):
        return question
    text = question.lower()
    offer = next((choices for begins, choices in _OFFERS if re.match(begins, text)), None)
    return None if offer is None else f"{question.removesuffix('?')}: {offer}?"
