"""Send all calls out of this machine by an httpx transport that records them.

`use_transport_in` makes litellm's clients use it on every route. Each attempt's `Exchange` records whether its request
was sent, the status of the answer, and the answer's bytes. Loopback addresses bypass proxies, redirects are not
followed, an attempt sends one request at most, an answer is read up to a bound, and no compression is requested.
"""

import asyncio
import os
import ssl
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import aiohttp
import httpx
from aiohttp.abc import AbstractStreamWriter
from aiohttp.http_exceptions import HttpProcessingError
from yarl import URL

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.network import TLS_VARIABLES, certificate_problem, proxy_of
from traps_pipeline.models.wire.exchange import Exchange, record_exchange
from traps_pipeline.models.wire.lenient_http import LenientConnector

MAX_BYTES = 16 * 2**20  # maximum bytes of an answer; 8,000 tokens with reasoning take less than a hundredth of it
CONNECT_S = 60.0  # time-out of a connection with its TLS handshake
KEEPALIVE_S, NAMES_KEPT_S = 120.0, 300  # an idle connection; an address of a name
_GZIP = b"\x1f\x8b"
_ASKED_ANEW = ("content-encoding", "content-length", "transfer-encoding", "location")


class _Body(aiohttp.BytesPayload):
    """A request's body, which records when its first byte is written.

    aiohttp holds the headers back until the body is written, on a connection whose handshakes (of a proxy's tunnel, of
    TLS) are done: so the first byte of a request is written here and nowhere else.
    """

    def __init__(self, content: bytes, exchange: Exchange) -> None:
        super().__init__(content, content_type="application/json")
        self._exchange = exchange

    async def write_with_length(self, writer: AbstractStreamWriter, content_length: int | None) -> None:
        """Write headers and body, and record them as sent if the connection is open."""
        transport = getattr(writer, "transport", None)
        if transport is None or transport.is_closing():
            raise aiohttp.ClientConnectionResetError("the connection was closed before the request was written")
        self._exchange.sent = True
        await super().write_with_length(writer, content_length)


class Wire(httpx.AsyncBaseTransport):
    """A transport that sends requests with aiohttp, one session per event loop.

    is_verified: whether certificates must be signed by an authority of SSL_CERT_FILE, SSL_CERT_DIR or certifi.
    """

    def __init__(self, *, is_verified: bool = True) -> None:
        self._is_verified = is_verified
        self._tls: ssl.SSLContext | bool = is_verified
        self._certificates: list[tuple[str | None, int | None]] = []  # of which `_tls` was made
        self._sessions: dict[asyncio.AbstractEventLoop, aiohttp.ClientSession] = {}

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        """Send a request and read the answer to its end.

        Raises httpx.ReadTimeout, and NetworkError for anything else: neither makes a client library retry.
        `Exchange.problem` says what happened.
        """
        with record_exchange() as exchange:
            if exchange.sent:
                raise httpx.NetworkError("a client library wanted to send a second request in one attempt")
            exchange.sent = False
            try:
                response = await self._send(request, exchange)
                exchange.status = response.status
                exchange.headers = {name.lower(): value for name, value in response.headers.items()}
                exchange.content = await _read(response)
            except Exception as error:
                exchange.problem = _explain(error, request.url, exchange)
                exchange.is_unreadable = bool(exchange.sent) and _is_unreadable(error)
                kind = httpx.ReadTimeout if isinstance(error, TimeoutError) and exchange.sent else httpx.NetworkError
                raise kind(exchange.problem) from error
        headers = [(name, value) for name, value in response.headers.items() if name.lower() not in _ASKED_ANEW]
        return httpx.Response(response.status, headers=headers, content=exchange.content)

    async def _send(self, request: httpx.Request, exchange: Exchange) -> aiohttp.ClientResponse:
        request.headers["accept-encoding"] = "identity"
        content, url, times = await request.aread(), str(request.url), request.extensions.get("timeout", {})
        if request.url.scheme not in ("http", "https"):
            raise TrapsError(f"{url}: {request.url.scheme}:// is no scheme of HTTP; write http:// or https://")
        proxy = proxy_of(url)
        if proxy is not None:
            exchange.proxy = proxy.variable
            if proxy.problem:
                raise TrapsError(proxy.problem)
        if request.url.scheme == "https" and self._is_verified:
            self._renew_tls()
        return await self._session().request(
            request.method,
            URL(url, encoded=True),
            headers=request.headers,
            data=_Body(content, exchange) if content else None,
            allow_redirects=False,
            timeout=aiohttp.ClientTimeout(
                total=None, sock_connect=min(times.get("connect") or CONNECT_S, CONNECT_S), sock_read=times.get("read")
            ),
            proxy=proxy and proxy.url,
            ssl=self._tls,
        )

    def _renew_tls(self) -> None:
        """Read the certificates anew if a variable, or a file that one names, has changed."""
        certificates = [(place := os.environ.get(name), _changed_at(place)) for name in TLS_VARIABLES]
        if certificates != self._certificates:
            if problem := certificate_problem(TLS_VARIABLES):
                raise TrapsError(problem)
            self._tls, self._certificates = httpx.create_ssl_context(), certificates

    def _session(self) -> aiohttp.ClientSession:
        loop = asyncio.get_running_loop()
        self._dispose_closed()
        if loop not in self._sessions:
            connector = LenientConnector(limit=0, keepalive_timeout=KEEPALIVE_S, ttl_dns_cache=NAMES_KEPT_S)
            cookies = aiohttp.DummyCookieJar()
            self._sessions[loop] = aiohttp.ClientSession(
                connector=connector, cookie_jar=cookies, auto_decompress=False, trust_env=False
            )
        return self._sessions[loop]

    async def aclose(self) -> None:
        """Close the connections of the running loop, and of closed loops."""
        own_session = self._sessions.pop(asyncio.get_running_loop(), None)
        if own_session is not None:
            await own_session.close()
        self._dispose_closed()

    def _dispose_closed(self) -> None:
        for closed_loop in [loop for loop in self._sessions if loop.is_closed()]:
            _dispose(self._sessions.pop(closed_loop))

    def __del__(self) -> None:
        self._dispose_closed()


def _changed_at(place: str | None) -> int | None:
    """Return when a file or folder was changed, in nanoseconds; None if it is not there."""
    try:
        return Path(place).stat().st_mtime_ns if place else None
    except OSError:
        return None


def _dispose(session: aiohttp.ClientSession) -> None:
    """Close the session of a closed loop without waiting, lest aiohttp report it."""
    with suppress(StopIteration):
        session.close().send(None)


async def _read(response: aiohttp.ClientResponse) -> bytes:
    chunks, size = list[bytes](), 0
    async with response:
        async for chunk in response.content.iter_chunked(2**16):
            size += len(chunk)
            if size > MAX_BYTES:
                raise ValueError(f"the answer is larger than {MAX_BYTES} bytes")
            chunks.append(chunk)
    content = _decompress(b"".join(chunks), response.headers.get("content-encoding", "").lower())
    try:
        content.decode()
    except UnicodeDecodeError:
        with suppress(LookupError, UnicodeDecodeError, RuntimeError):  # an unknown character set, or not its bytes
            content = content.decode(response.get_encoding()).encode() if response.charset else content
    return content


def _decompress(content: bytes, label: str) -> bytes:
    """Decompress a body by what it is, whatever its label; raise ValueError if truncated or too large."""
    is_gzip, is_text = content.startswith(_GZIP), content.lstrip()[:1] in (b"{", b"[", b"")
    if not is_gzip and ("deflate" not in label or is_text):
        return content
    has_header = content[0] & 15 == 8 and int.from_bytes(content[:2], "big") % 31 == 0  # some send "deflate" without
    plain_bytes = b""
    while True:  # gzip may have several members
        unpacking = zlib.decompressobj(31 if is_gzip else 15 if has_header else -15)
        plain_bytes += unpacking.decompress(content, MAX_BYTES + 1 - len(plain_bytes))
        if len(plain_bytes) > MAX_BYTES:
            raise ValueError(f"the answer is larger than {MAX_BYTES} bytes")
        if not unpacking.eof:
            raise ValueError("the compressed answer breaks off")
        content = unpacking.unused_data.lstrip(b"\0")
        if not content.startswith(_GZIP):
            return plain_bytes


def _is_unreadable(error: BaseException | None) -> bool:
    """Return whether an answer came that breaks HTTP's rules, and no connection that broke."""
    while error is not None:
        if isinstance(error, HttpProcessingError | ValueError | zlib.error):
            return "Not enough data" not in str(error)
        error = error.__cause__ or error.__context__
    return False


def _explain(error: BaseException, url: httpx.URL, exchange: Exchange) -> str:
    """Return in words why a request or its answer did not arrive."""
    if isinstance(error, TrapsError):
        return str(error)
    location = f"{url.host}:{url.port or {'http': 80, 'https': 443}.get(url.scheme, '?')}"
    text = cause_of(error)
    if exchange.sent:
        return f"the connection to {location} broke after the request was sent: {text}"
    if exchange.proxy:
        proxy = proxy_of(str(url))
        return f"nothing was sent to {location} through the proxy {proxy and proxy.address} of {exchange.proxy}: {text}"
    return f"nothing was sent to {location}: {text}"


def cause_of(error: BaseException) -> str:
    """Return the message of an error's root cause, with advice about common ones."""
    while (inner_error := error.__cause__ or (None if error.__suppress_context__ else error.__context__)) is not None:
        error = inner_error
    if isinstance(error, ssl.SSLCertVerificationError):
        return (
            f"its certificate is not trusted ({error.verify_message}): have SSL_CERT_FILE name the file of the "
            "authority that signed it"
        )
    if isinstance(error, ssl.SSLError):
        return f"TLS failed ({error.reason or error}): if the server speaks plain HTTP, write http:// in its address"
    if isinstance(error, aiohttp.ClientHttpProxyError):
        return f"the proxy answered {error.status} {error.message}"
    if isinstance(error, HttpProcessingError):
        return error.message.strip().rstrip(".")  # str(error) begins with a status that no server sent
    if isinstance(error, OSError) and error.errno and error.errno > 0:
        return os.strerror(error.errno)
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


def use_transport_in(handler: Any) -> None:
    """Make every client that litellm creates from now on send through a `Wire`.

    handler: its class AsyncHTTPHandler, from which both its own client and the one for OpenAI's library get their
    transport.
    """

    def create(ssl_verify: bool | None = None, **_: Any) -> Wire:
        return Wire(is_verified=ssl_verify is not False)  # litellm's own context is never renewed

    handler.create_async_transport = staticmethod(create)


def get_url(url: str, headers: Mapping[str, str], timeout_s: float) -> httpx.Response:
    """Return the answer to a GET, outside of event loops. Raises TrapsError if none."""

    async def answer() -> httpx.Response:
        async with httpx.AsyncClient(transport=Wire(), timeout=timeout_s, follow_redirects=False) as client:
            return await client.get(url, headers=headers)

    with record_exchange() as exchange:
        try:
            return asyncio.run(answer())
        except Exception as error:
            raise TrapsError(exchange.problem or cause_of(error)) from error
