"""Dagster's web server behind a guard, so that only the person who started it can use it: `traps ui`.

Dagster's own server takes any request that reaches its port: a page of another site, opened in the same browser, could
launch runs, which spend money, and wipe history. The guard lets through what carries the token of the address that was
printed, comes from a page of this very server, and changes something by a POST of JSON only.
"""

from __future__ import annotations

import hmac
import ipaddress
import os
import secrets
import sys
from collections.abc import Awaitable, Callable, Iterable, Mapping, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qsl, quote, urlencode, urlsplit

from traps_pipeline.errors import TrapsError

TOKEN_VARIABLE = "TRAPS_UI_TOKEN"
LEAST_TOKEN = 16  # characters
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
_SAFE_METHODS = ("GET", "HEAD")
_OWN_SITE = (b"same-origin", b"none")
# Added to every answer: it is not shown in a frame, its address (which may hold the token) goes to no other site.
_HEADERS = (
    (b"x-frame-options", b"DENY"),
    (b"content-security-policy", b"frame-ancestors 'none'"),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cache-control", b"no-store"),
)

Message = MutableMapping[str, Any]
Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]


def is_loopback(host: str) -> bool:
    """Whether only programs of this machine reach what listens there."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def token_for(host: str, given: str | None) -> str:
    """The token of a server that listens there: the given one, or a fresh one. Raises TrapsError beyond this machine
    without one, and for one that can be guessed."""
    if given is None and not is_loopback(host):
        raise TrapsError(
            f"--host {host}: everybody who reaches that address could launch runs, which spend this study's budget; "
            f"give a token of your own (--token, or {TOKEN_VARIABLE}), and put a server that speaks HTTPS before it, "
            "since the token crosses the network; or leave --host out and use an SSH tunnel"
        )
    if given is not None and (len(given) < LEAST_TOKEN or not given.isascii() or not given.isprintable()):
        raise TrapsError(f"--token: {LEAST_TOKEN} or more printable ASCII characters, so that it cannot be guessed")
    return given or secrets.token_urlsafe(24)


class Guard:
    """An ASGI app before another one."""

    def __init__(self, app: App, token: str, host: str, port: int) -> None:
        self._app, self._token, self._cookie = app, token, f"traps-ui-{port}"
        self._names = {f"{name}:{port}" for name in (*LOOPBACK, host)} if is_loopback(host) else None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through, or say in a sentence why not."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] not in ("http", "websocket"):
            return
        headers = {name.lower(): value for name, value in scope["headers"]}
        refused = self._refusal(scope, headers)
        if refused is None and scope["type"] == "http" and self._token_in(scope):
            await self._enter(scope, send)
        elif refused is None and not self._is_known(headers):
            refused = 403, "open the address that `make ui` printed: the token in it lets this browser in"
        if refused is not None:
            await _refuse(scope, receive, send, *refused)
        elif not (scope["type"] == "http" and self._token_in(scope)):
            await self._app(scope, receive, _with_headers(send))

    def _refusal(self, scope: Scope, headers: Mapping[bytes, bytes]) -> tuple[int, str] | None:
        host = headers.get(b"host", b"").decode("latin-1").lower()
        if sum(name.lower() == b"host" for name, _ in scope["headers"]) != 1 or (
            self._names is not None and host not in self._names
        ):
            return 421, "this is not the name of this server: open the address that `make ui` printed"
        origin, websocket = headers.get(b"origin"), scope["type"] == "websocket"
        if origin is not None or websocket:
            of_origin = urlsplit((origin or b"").decode("latin-1").lower())
            if of_origin.scheme not in ("http", "https") or of_origin.netloc != host:
                return 403, "a page of another site asked for this"
        reads = not websocket and scope["method"] in _SAFE_METHODS
        if headers.get(b"sec-fetch-site", b"none") not in _OWN_SITE and not (reads and self._token_in(scope)):
            return 403, "a page of another site asked for this"
        if websocket:
            return None
        path = scope["path"].rstrip("/")
        if reads:
            if path.endswith("/graphql") and scope.get("query_string"):
                return 405, "GraphQL is asked by POST"
            return None
        if scope["method"] != "POST":
            return 405, "POST changes something here, GET reads, and nothing else does anything"
        kind = headers.get(b"content-type", b"").split(b";")[0].strip().lower()
        return None if kind == b"application/json" else (415, "a POST holds JSON here")

    def _token_in(self, scope: Scope) -> bool:
        if scope["method"] not in _SAFE_METHODS:
            return False
        given = dict(parse_qsl(scope.get("query_string", b"").decode("latin-1"))).get("token")
        return given is not None and self._is_token(given)

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self._token.encode())

    def _is_known(self, headers: Mapping[bytes, bytes]) -> bool:
        """Whether the browser was let in before, or a program brings the token as `Authorization: Bearer TOKEN`."""
        scheme, _, given = headers.get(b"authorization", b"").decode("latin-1").partition(" ")
        if scheme.lower() == "bearer":
            return self._is_token(given.strip())
        try:
            cookies = SimpleCookie(headers.get(b"cookie", b"").decode("latin-1"))
        except CookieError:
            return False
        return self._cookie in cookies and self._is_token(cookies[self._cookie].value)

    async def _enter(self, scope: Scope, send: Send) -> None:
        """Give the browser the token as a cookie and show the page without it: an address is seen and kept."""
        left = [pair for pair in parse_qsl(scope["query_string"].decode("latin-1")) if pair[0] != "token"]
        place = "/" + quote(scope["path"].lstrip("/\\")) + (f"?{urlencode(left)}" if left else "")
        cookie = f"{self._cookie}={self._token}; HttpOnly; SameSite=Strict; Path=/"
        headers = [(b"location", place.encode()), (b"set-cookie", cookie.encode("latin-1"))]
        await _answer(send, 303, b"", headers)


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int, why: str) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008, "reason": why[:120]})
        return
    await _answer(send, status, f"{why}\n".encode(), [(b"content-type", b"text/plain; charset=utf-8")])


async def _answer(send: Send, status: int, body: bytes, headers: Iterable[tuple[bytes, bytes]]) -> None:
    length = (b"content-length", str(len(body)).encode())
    await send({"type": "http.response.start", "status": status, "headers": [*headers, length, *_HEADERS]})
    await send({"type": "http.response.body", "body": body})


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            own = {name for name, _ in _HEADERS if name != b"cache-control"}
            sent = [(name, value) for name, value in message.get("headers", ()) if name.lower() not in own]
            cached = any(name.lower() == b"cache-control" for name, _ in sent)
            message["headers"] = [*sent, *(each for each in _HEADERS if not cached or each[0] != b"cache-control")]
        await send(message)

    return sending


def serve_with_dagster(host: str, port: int, token: str) -> None:
    """`dagster dev` with this web server in the place of Dagster's own, until Ctrl-C."""
    from dagster._cli import dev

    start = vars(dev)["open_ipc_subprocess"]

    def start_ours(command: list[str], **named: Any) -> Any:
        ours = [command[0], "-m", __name__, *command[3:]] if command[1:3] == ["-m", "dagster_webserver"] else command
        return start(ours, **named)

    dev.__dict__["open_ipc_subprocess"] = start_ours  # the one place that starts it
    os.environ[TOKEN_VARIABLE] = token
    dev.dev_command.main(
        ["-h", host, "-p", str(port), "-m", "traps_pipeline.definitions"], prog_name="traps ui", standalone_mode=False
    )


def main() -> None:
    """Dagster's own command of its web server, with the guard before its app."""
    import uvicorn
    from dagster_webserver import cli

    run, token = uvicorn.run, os.environ[TOKEN_VARIABLE]

    def serve(app: Any, *, host: str, port: int, **named: Any) -> None:
        shown = f"[{host}]" if ":" in host else host
        print(f"\n  open http://{shown}:{port}/?token={token}\n", file=sys.stderr, flush=True)
        run(Guard(app, token, host, port), host=host, port=port, access_log=False, **named)

    uvicorn.__dict__["run"] = serve  # Dagster calls it by this name, with the app and its address
    cli.main()


if __name__ == "__main__":
    main()
