"""The guard with several people, and behind a server with HTTPS: who is let in, by which name, as whom."""

from __future__ import annotations

import asyncio
from typing import Any

from traps_pipeline.base.webguard import TOKEN_OWNER, Guard, personal_tokens

PEOPLE = {who: token for token, who in personal_tokens("one secret of sixteen", ["jd", "ab"]).items()}


async def who_asks(scope: Any, receive: Any, send: Any) -> None:
    """An app that says whose request it got."""
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": scope[TOKEN_OWNER].encode()})


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


NAME = "labels.example.org"


def test_each_token_is_one_persons() -> None:
    for who, token in PEOPLE.items():
        assert ask(authorization=f"Bearer {token}")[:2] == (200, who)
        status, _, headers = ask(f"token={token}")
        assert (status, headers["location"]) == (303, "/")
        assert "Secure" not in headers["set-cookie"]
        assert ask(cookie=headers["set-cookie"].partition(";")[0])[:2] == (200, who)
    for nobody in ("", "x" * 24, PEOPLE["jd"][:-1], "one secret of sixteen"):
        assert ask(authorization=f"Bearer {nobody}")[0] == 403
        assert ask(f"token={nobody}")[0] == 403


def test_behind_a_server_with_https_its_name_is_known_and_no_other() -> None:
    own: dict[str, str] = {"authorization": f"Bearer {PEOPLE['ab']}", "host": NAME, "content_type": "application/json"}
    assert ask(**own)[0] == 421
    behind = f"https://{NAME}"
    assert ask(behind=behind, method="POST", origin=behind, **own)[:2] == (200, "ab")
    assert ask(behind=behind, method="POST", origin="https://evil.example", **own)[0] == 403
    assert ask(behind=behind, **own | {"host": "evil.example"})[0] == 421
    assert ask(behind=behind, **own | {"host": "127.0.0.1:3200"})[0] == 200  # a program of this machine
    cookie = ask(f"token={PEOPLE['jd']}", behind=behind, host=NAME)[2]["set-cookie"]
    assert cookie.endswith("; HttpOnly; SameSite=Strict; Path=/; Secure")
