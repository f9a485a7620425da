"""Guard a local web server so that only its owner can use it.

A server accepts any request that reaches its port: a page of another site, opened in the same browser, could act in the
user's name. The guard admits a request that carries the token of the printed address or comes from a page of this very
server, and lets it change something only by a POST of JSON.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from base64 import urlsafe_b64encode
from collections.abc import Awaitable, Callable, Iterable, Mapping, MutableMapping, Sequence
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qsl, quote, urlencode, urlsplit

from traps_pipeline.base.errors import TrapsError

MIN_TOKEN = 16  # characters
TOKEN_OWNER = "traps.who"  # key of a request's scope: the owner of its token
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
    """Return whether a host is reachable only from this machine."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def token_for(host: str, token: str | None, *, danger: str, variable: str) -> str:
    """Return the token of a server on this host: the given one, or a fresh one.

    Raises TrapsError for a server that others can reach without a token, and for a token that can be guessed. danger:
    what everybody who reaches the address could do; variable: the environment variable that may hold a token.
    """
    if token is None and not is_loopback(host):
        raise TrapsError(
            f"--host {host}: everybody who reaches that address could {danger}; "
            f"give a token of your own (--token, or {variable}), and put a server that speaks HTTPS before it, "
            "since the token crosses the network; or leave --host out and use an SSH tunnel"
        )
    if token is not None and (len(token) < MIN_TOKEN or not token.isascii() or not token.isprintable()):
        raise TrapsError(f"--token: {MIN_TOKEN} or more printable ASCII characters, so that it cannot be guessed")
    return token or secrets.token_urlsafe(24)


def public_name(address: str) -> str:
    """Return the HTTPS proxy's NAME[:PORT]; raise TrapsError for another address."""
    parts = urlsplit(address)
    if parts.scheme != "https" or not parts.hostname or address.rstrip("/") != f"https://{parts.netloc}":
        raise TrapsError(
            f"--behind {address}: give the address of the server with HTTPS, as https://labels.example.org"
        )
    return parts.netloc.lower()


def personal_tokens(token: str, people: Sequence[str]) -> dict[str, str]:
    """Derive a token per person from a secret: stable, and none reveals another."""

    def token_of(who: str) -> str:
        return urlsafe_b64encode(hmac.digest(token.encode(), who.encode(), "sha256")[:18]).decode()

    return {token_of(who): who for who in people}


class Guard:
    """An ASGI app that guards another one.

    token: the only token, or several tokens with the person of each; the app finds the person in the scope under WHO.
    command: the command that printed the address, for the message to visitors without a token. behind: the address of
    an HTTPS proxy in front, if there is one.
    """

    def __init__(
        self,
        app: App,
        token: str | Mapping[str, str],
        host: str,
        port: int,
        *,
        command: str = "make ui",
        behind: str = "",
    ) -> None:
        self._app, self._cookie, self._command = app, f"traps-ui-{port}", command
        self._tokens = {token: ""} if isinstance(token, str) else dict(token)
        self._names = {f"{name}:{port}" for name in (*LOOPBACK, host)} if is_loopback(host) else None
        self._secure = "; Secure" if behind else ""
        if behind and self._names is not None:
            self._names.add(public_name(behind))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Admit a request, or answer with a sentence that says why not."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] not in ("http", "websocket"):
            return
        headers = {name.lower(): value for name, value in scope["headers"]}
        refusal = self._refusal(scope, headers)
        if refusal is None and scope["type"] == "http" and self._has_token(scope):
            await self._enter(scope, send)
        elif refusal is None and (person := self._header_owner(headers)) is not None:
            scope[TOKEN_OWNER] = person
        elif refusal is None:
            refusal = 403, f"open the address that `{self._command}` printed: the token in it lets this browser in"
        if refusal is not None:
            await _refuse(scope, receive, send, *refusal)
        elif not (scope["type"] == "http" and self._has_token(scope)):
            await self._app(scope, receive, _with_headers(send))

    def _refusal(self, scope: Scope, headers: Mapping[bytes, bytes]) -> tuple[int, str] | None:
        host = headers.get(b"host", b"").decode("latin-1").lower()
        if sum(name.lower() == b"host" for name, _ in scope["headers"]) != 1 or (
            self._names is not None and host not in self._names
        ):
            return 421, f"this is not the name of this server: open the address that `{self._command}` printed"
        origin, websocket = headers.get(b"origin"), scope["type"] == "websocket"
        if origin is not None or websocket:
            origin_url = urlsplit((origin or b"").decode("latin-1").lower())
            if origin_url.scheme not in ("http", "https") or origin_url.netloc != host:
                return 403, "a page of another site asked for this"
        reads = not websocket and scope["method"] in _SAFE_METHODS
        if headers.get(b"sec-fetch-site", b"none") not in _OWN_SITE and not (reads and self._has_token(scope)):
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

    def _has_token(self, scope: Scope) -> bool:
        if scope["method"] not in _SAFE_METHODS:
            return False
        return self._owner(_token_of_address(scope)) is not None

    def _owner(self, token_given: str | None) -> str | None:
        """Return the token's owner, if any, in constant time."""
        owner = None
        for token, person in self._tokens.items():
            if token_given is not None and hmac.compare_digest(token_given.encode(), token.encode()):
                owner = person
        return owner

    def _header_owner(self, headers: Mapping[bytes, bytes]) -> str | None:
        """Return the owner of a request's cookie or bearer token, if any.

        The header is `Authorization: Bearer TOKEN`.
        """
        scheme, _, token = headers.get(b"authorization", b"").decode("latin-1").partition(" ")
        if scheme.lower() == "bearer":
            return self._owner(token.strip())
        try:
            cookies = SimpleCookie(headers.get(b"cookie", b"").decode("latin-1"))
        except CookieError:
            return None
        return self._owner(cookies[self._cookie].value) if self._cookie in cookies else None

    async def _enter(self, scope: Scope, send: Send) -> None:
        """Set the token as a cookie and redirect, so that no address shows the token."""
        parameters = [pair for pair in parse_qsl(scope["query_string"].decode("latin-1")) if pair[0] != "token"]
        place = "/" + quote(scope["path"].lstrip("/\\")) + (f"?{urlencode(parameters)}" if parameters else "")
        cookie = f"{self._cookie}={_token_of_address(scope)}; HttpOnly; SameSite=Strict; Path=/{self._secure}"
        headers = [(b"location", place.encode()), (b"set-cookie", cookie.encode("latin-1"))]
        await _answer(send, 303, b"", headers)


def _token_of_address(scope: Scope) -> str | None:
    """Return the token in the address of a request."""
    return dict(parse_qsl(scope.get("query_string", b"").decode("latin-1"))).get("token")


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
            token_of = {name for name, _ in _HEADERS if name != b"cache-control"}
            headers = [(name, value) for name, value in message.get("headers", ()) if name.lower() not in token_of]
            has_cache_control = any(name.lower() == b"cache-control" for name, _ in headers)
            message["headers"] = [
                *headers,
                *(header for header in _HEADERS if not has_cache_control or header[0] != b"cache-control"),
            ]
        await send(message)

    return sending
