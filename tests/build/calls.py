"""Bodies of responses, entries and requests of one call."""

from __future__ import annotations

import asyncio
import datetime
import json
from typing import Any

from traps_pipeline.models.asking.participants import CallContext
from traps_pipeline.models.money.budget import Budget
from traps_pipeline.models.registry.entries import Account, Entry, Limits, Prices
from traps_pipeline.models.request import Request

PARAMS = {"temperature": 0.8, "top_p": 0.95, "max_tokens": 8000}
PRICES = Prices(input=1.0, output=10.0, as_of=datetime.date(2026, 11, 1))
ANSWER = "The answer is: left."
USAGE = {"prompt_tokens": 20, "completion_tokens": 21, "total_tokens": 41}
MESSAGE = {"role": "assistant", "content": ANSWER}
CHOICE = {"index": 0, "message": MESSAGE, "finish_reason": "stop"}
BODY = {"id": "x", "object": "chat.completion", "created": 1, "model": "m", "choices": [CHOICE], "usage": USAGE}


def body(**changes: Any) -> str:
    return json.dumps(BODY | changes)


def entry_of(model: str, **limits: Any) -> Entry:
    fields = {"id": "m", "backend": "api", "account": "a", "provider_id": f"openai/{model}", "params": PARAMS}
    fields |= {"limits": Limits(timeout_s=5, backoff_s=0.001, retries=1, **limits), "prices": PRICES}
    return Entry.model_validate(fields, context={"accounts": {"a": Account()}})


def request(item: int | str = "x") -> Request:
    return Request("m", "openai/m", PARAMS, "You watch a clip of two balls.", f"Which one, {item}?", {"item_id": item})


def allowed_by(budget: Budget) -> CallContext:
    async def require() -> None:
        """No other process is there."""

    return CallContext(budget, asyncio.Event(), lambda: False, require)
