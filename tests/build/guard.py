"""Requests to the guard of pages, with the tokens of two people."""

from __future__ import annotations

import asyncio
from typing import Any

from traps_pipeline.base.webguard import WHO, Guard, personal_tokens

PEOPLE = {who: token for token, who in personal_tokens("one secret of sixteen", ["jd", "ab"]).items()}


async def who_asks(scope: Any, receive: Any, send: Any) -> None:
    """An app that says whose request it got."""
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": scope[WHO].encode()})


def ask(query: str = "", behind: str = "", method: str = "GET", **headers: str) -> tuple[int, str, dict[str, str]]:
    """Status, text and headers that a request gets."""
    guard = Guard(who_asks, {token: who for who, token in PEOPLE.items()}, "127.0.0.1", 3200, behind=behind)
    named = {"host": "127.0.0.1:3200"} | {name.replace("_", "-"): value for name, value in headers.items()}
    sent: list[dict[str, Any]] = []

    async def keep(message: Any) -> None:
        sent.append(message)

    async def nothing() -> Any:
        return {"type": "http.request"}

    pairs = [(name.encode(), value.encode()) for name, value in named.items()]
    scope = {"type": "http", "method": method, "path": "/", "query_string": query.encode(), "headers": pairs}
    asyncio.run(guard(scope, nothing, keep))
    return sent[0]["status"], sent[1]["body"].decode(), {n.decode(): v.decode() for n, v in sent[0]["headers"]}
