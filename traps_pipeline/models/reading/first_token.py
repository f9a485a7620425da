"""Read the log-probabilities of an answer's first token (docs/arms.md)."""

import json
import math
from collections.abc import Mapping
from typing import Any

from traps_pipeline.protocol.regimes import BY_NAME

MAX_ALTERNATIVES = 20  # alternatives kept; providers give no more
ROUNDING = 1e-3  # above 0, which some providers round a certain token to


def first_token_logprobs(logprobs: Any) -> dict[str, float]:
    """Return log-probabilities by token, at an answer's first token with a letter or a digit.

    Quotes, stars and white space begin no answer. logprobs: the field of a choice in OpenAI's chat API; the result is
    empty without it.
    """
    for place in _objects(logprobs.get("content")) if isinstance(logprobs, dict) else []:
        if any(character.isalnum() for character in str(place.get("token"))):
            return dict(filter(None, map(_alternative, [*_objects(place.get("top_logprobs")), place])))
    return {}


def stored_alternatives(alternatives: Mapping[str, float], regime: object) -> str | None:
    """Return first tokens' log-probabilities as stored text, likeliest first; None if the regime uses none."""
    if not alternatives or regime not in BY_NAME or not BY_NAME[str(regime)].first_token:
        return None
    top_alternatives = sorted(alternatives.items(), key=lambda one: -one[1])[
        : MAX_ALTERNATIVES + 1
    ]  # the sampled token may be unlikely
    return json.dumps({token: round(logprob, 6) for token, logprob in top_alternatives}, ensure_ascii=False)


def _alternative(entry: Mapping[str, Any]) -> tuple[str, float] | None:
    token, logprob = entry.get("token"), entry.get("logprob")
    if not isinstance(token, str) or not isinstance(logprob, int | float) or isinstance(logprob, bool):
        return None
    if not math.isfinite(logprob) or logprob > ROUNDING:
        return None
    return token.encode("utf-8", "replace").decode(), min(float(logprob), 0.0)


def _objects(values: Any) -> list[dict[str, Any]]:
    return [value for value in values if isinstance(value, dict)] if isinstance(values, list) else []
