"""Suggest the known word nearest to an unknown one, for error messages."""

from collections.abc import Iterable

_LIKENESS = 0.6


def nearest_name(word: str, candidates: Iterable[str]) -> str | None:
    """Return the known word most similar to this one, or None if none is similar."""
    from difflib import get_close_matches

    names = {name.lower(): name for name in candidates}
    matches = get_close_matches(word.lower()[:100], names, n=1, cutoff=_LIKENESS)
    return names[matches[0]] if matches else None


def did_you_mean(word: str, candidates: Iterable[str]) -> str:
    """Return a clause that suggests the nearest known word; empty if none is near."""
    suggestion = nearest_name(word, candidates)
    return f"; did you mean {suggestion}?" if suggestion else ""
