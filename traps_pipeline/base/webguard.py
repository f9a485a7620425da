"""Guard a local web server so that only its owner can use it.

A server accepts any request that reaches its port: a page of another site, opened in the same browser, could act in the
user's name. The guard admits a request that carries the token of the printed address or comes from a page of this very
server, and lets it change something only by a POST of JSON.
"""

import hmac
import ipaddress
import secrets
from base64 import urlsafe_b64encode
from collections.abc import Mapping, Sequence
from urllib.parse import quote, urlencode, urlsplit

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

from traps_pipeline.base.errors import TrapsError

MIN_TOKEN = 16  # characters
TOKEN_OWNER = "traps.who"  # key of a request's scope: the owner of its token
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
_SAFE_METHODS = ("GET", "HEAD")
# Added to every answer, beside the app's own policy: it is in no frame, and nothing, its address included, leaves.
_HEADERS = {
    "x-frame-options": "DENY",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}
_POLICY = "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; form-action 'self'; frame-ancestors 'none'"


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

    token: the only token, or several tokens with the person of each; the app finds the person in the scope under
    TOKEN_OWNER. command: the command that printed the address, for the message to visitors without a token. behind: the
    address of an HTTPS proxy in front, if there is one.
    """

    def __init__(
        self,
        app: ASGIApp,
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
        request = HTTPConnection(scope)
        refusal, owner = self._refusal(request), self._header_owner(request)
        if refusal is None and self._has_token(request):
            await self._entry(request)(scope, receive, _with_headers(send))
        elif refusal is None and owner is not None:
            scope[TOKEN_OWNER] = owner
            await self._app(scope, receive, _with_headers(send))
        else:
            no_token = f"open the address that `{self._command}` printed: the token in it lets this browser in"
            await _refuse(*(refusal or (403, no_token)), scope, receive, send)

    def _refusal(self, request: HTTPConnection) -> tuple[int, str] | None:
        websocket = request.scope["type"] == "websocket"
        hosts = [host.lower() for host in request.headers.getlist("host")]
        if len(hosts) != 1 or (self._names is not None and hosts[0] not in self._names):
            return 421, f"this is not the name of this server: open the address that `{self._command}` printed"
        origin = request.headers.get("origin", "" if websocket else None)
        if origin is not None:
            url = urlsplit(origin.lower())
            if url.scheme not in ("http", "https") or url.netloc != hosts[0]:
                return 403, "a page of another site asked for this"
        own_site = request.headers.get("sec-fetch-site", "none") in ("same-origin", "none")
        if not own_site and not self._has_token(request):
            return 403, "a page of another site asked for this"
        if websocket:
            return None
        if request.scope["method"] in _SAFE_METHODS:
            if request.scope["path"].rstrip("/").endswith("/graphql") and request.scope.get("query_string"):
                return 405, "GraphQL is asked by POST"
            return None
        if request.scope["method"] != "POST":
            return 405, "POST changes something here, GET reads, and nothing else does anything"
        kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
        return None if kind == "application/json" else (415, "a POST holds JSON here")

    def _has_token(self, request: HTTPConnection) -> bool:
        """Return whether a request that changes nothing has a token in its address."""
        reads = request.scope["type"] == "http" and request.scope["method"] in _SAFE_METHODS
        return reads and self._owner(request.query_params.get("token")) is not None

    def _owner(self, token_given: str | None) -> str | None:
        """Return the token's owner, if any, in constant time."""
        owner = None
        for token, person in self._tokens.items():
            if token_given is not None and hmac.compare_digest(token_given.encode(), token.encode()):
                owner = person
        return owner

    def _header_owner(self, request: HTTPConnection) -> str | None:
        """Return the owner of a request's bearer token (`Authorization: Bearer TOKEN`) or cookie, if any."""
        scheme, _, token = request.headers.get("authorization", "").partition(" ")
        return self._owner(token.strip() if scheme.lower() == "bearer" else request.cookies.get(self._cookie))

    def _entry(self, request: HTTPConnection) -> RedirectResponse:
        """Return what sets the token as a cookie and redirects, so that no address shows the token."""
        parameters = [pair for pair in request.query_params.multi_items() if pair[0] != "token"]
        place = "/" + quote(request.scope["path"].lstrip("/\\")) + (f"?{urlencode(parameters)}" if parameters else "")
        token = request.query_params["token"]
        cookie = f"{self._cookie}={token}; HttpOnly; SameSite=Strict; Path=/{self._secure}"
        return RedirectResponse(place, 303, {"set-cookie": cookie})


async def _refuse(status: int, why: str, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await WebSocketClose(1008, why[:120])(scope, receive, send)
    else:
        await PlainTextResponse(f"{why}\n", status)(scope, receive, _with_headers(send))


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            headers.update(_HEADERS)
            headers.append("content-security-policy", _POLICY)
            headers.setdefault("cache-control", "no-store")
        await send(message)

    return sending
