"""Log-probabilities of an answer's first token: what may have stood in its place, in a provider's own bytes
(docs/arms.md, "Graded cuts")."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from traps_pipeline.protocol.regimes import BY_NAME

MOST = 20  # alternatives that are kept; providers give no more
ROUNDING = 1e-3  # above 0, which some providers round a certain token to


def of_chat(logprobs: Any) -> dict[str, float]:
    """Return the alternatives at the first token that holds a letter or a digit (quotes, stars and white space begin no
    answer). logprobs: of a choice of OpenAI's chat API; empty without."""
    for place in _objects(logprobs.get("content")) if isinstance(logprobs, dict) else []:
        if any(character.isalnum() for character in str(place.get("token"))):
            return dict(filter(None, map(_alternative, [*_objects(place.get("top_logprobs")), place])))
    return {}


def stored(alternatives: Mapping[str, float], regime: object) -> str | None:
    """Return alternatives as they are stored, the likeliest first; None where there are none or the regime has no use
    for them."""
    if not alternatives or regime not in BY_NAME or not BY_NAME[str(regime)].first_token:
        return None
    likeliest = sorted(alternatives.items(), key=lambda one: -one[1])[: MOST + 1]  # what was sampled may be unlikely
    return json.dumps({token: round(logprob, 6) for token, logprob in likeliest}, ensure_ascii=False)


def _alternative(entry: Mapping[str, Any]) -> tuple[str, float] | None:
    token, logprob = entry.get("token"), entry.get("logprob")
    if not isinstance(token, str) or not isinstance(logprob, int | float) or isinstance(logprob, bool):
        return None
    if not math.isfinite(logprob) or logprob > ROUNDING:
        return None
    return token.encode("utf-8", "replace").decode(), min(float(logprob), 0.0)


def _objects(values: Any) -> list[dict[str, Any]]:
    return [value for value in values if isinstance(value, dict)] if isinstance(values, list) else []
