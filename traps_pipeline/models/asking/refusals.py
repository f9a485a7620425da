"""Tell a provider's refusal of one item from a failure, by its behaviour.

Content filters have words of their own, which no list holds. So a call that ends in a final HTTP error is asked again
once its cell is done, and then one that was answered. If the former is refused as before and the latter answered, the
item is refused: credit, key and server were well (docs/models.md, "Calls").
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from traps_pipeline.models.request import WITH_TEXT, Outcome, Request

Row = Mapping[str, Any]
CONTROL = "control"  # the error of a call that was asked again to see that its model still answers
# Final HTTP errors that are about a call; others are about key, credit, address or time.
_OF_A_CALL = re.compile(r"http_(?!401$|402$|403$|404$|405$|407$)4\d\d(_denied)?")


@dataclass
class RefusedCalls:
    """Calls of one form that a provider refused, and one (`control`) that it answered."""

    refused: list[Request] = field(default_factory=list)
    control: Request | None = None


def refused_calls(requests: Iterable[Request], rows: Mapping[str, Row]) -> Iterator[RefusedCalls]:
    """Yield a cell's refused calls, by participant, parameters, system prompt, and whether a clip is sent."""
    forms: dict[str, RefusedCalls] = {}
    for request in requests:
        parts = [request.participant, dict(request.params), request.system, request.sent is None]
        calls, row = forms.setdefault(json.dumps(parts, sort_keys=True), RefusedCalls()), rows[request.key]
        if row["outcome"] == "error" and _OF_A_CALL.fullmatch(row["error"] or ""):
            calls.refused.append(request)
        elif row["outcome"] in WITH_TEXT:
            calls.control = calls.control or request
    yield from (calls for calls in forms.values() if calls.refused and calls.control)


def control_outcome(outcome: Outcome) -> Outcome:
    """Return the outcome of the repeated answered call as a failure, which never replaces its answer."""
    if outcome.kind not in WITH_TEXT:
        return outcome
    return replace(outcome, kind="error", error=CONTROL, text=None, reasoning=None, first_token=None)


def refusal(row: Row) -> Outcome:
    """Return a failed call's row as the outcome of a refusal; its cost is in that row."""
    return Outcome("refused", error=row["error"], client=row.get("client"), cost_usd=0.0)
