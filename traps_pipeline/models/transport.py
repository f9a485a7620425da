"""What really went over the wire in one attempt, seen below the client libraries: they turn odd answers into errors
that look as if nothing had been billed, and follow redirects with the keys in the headers.

Every connection that litellm makes is watched from `watch` on. An attempt sets WATCHED, and finds there afterwards
whether its call was sent, with what status it was answered, and the answer's bytes. A redirect is never followed, an
answer is read up to a bound, and nothing compressed is asked for.
"""

from __future__ import annotations

import zlib
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

MOST_BYTES = 16 * 2**20  # of an answer; 8,000 tokens with their reasoning take less than a hundredth of it
# Statuses by which a server says that it did not take the call. 408 and 499 tell of a call that it gave up.
_TAKEN = (408, 499)
_NOT_TAKEN = (503, 529)


@dataclass
class Exchange:
    """One attempt: whether no connection was made, the status, the decoded body (None: not read to its end)."""

    unsent: bool = False
    status: int | None = None
    content: bytes | None = None

    @property
    def answered(self) -> bool:
        """Whether a server said that it did what it was asked to."""
        return self.status is not None and 200 <= self.status < 300

    def may_be_billed(self, status: int | None = None) -> bool:
        """Whether the provider may charge for it. status: what a library says where nothing was seen."""
        status = self.status if self.status is not None else status
        if self.unsent:
            return False
        refused = status is not None and 400 <= status < 500 and status not in _TAKEN
        return not (refused or status in _NOT_TAKEN)


WATCHED: ContextVar[Exchange | None] = ContextVar("watched", default=None)


def watch(handler: Any) -> None:
    """Put a watch around every connection that litellm makes from now on. handler: its class AsyncHTTPHandler, which
    both its own client and the one that it hands to OpenAI's library get their transport from."""
    import aiohttp
    import httpx

    never_sent = (aiohttp.ClientConnectorError, aiohttp.ConnectionTimeoutError)

    class Watched(httpx.AsyncBaseTransport):
        def __init__(self, inner: httpx.AsyncBaseTransport) -> None:
            self._inner = inner

        async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
            exchange = WATCHED.get() or Exchange()
            exchange.unsent, exchange.status, exchange.content = False, None, None
            request.headers["accept-encoding"] = "identity"
            try:
                response = await self._inner.handle_async_request(request)
            except (httpx.ConnectError, httpx.ConnectTimeout) as error:
                exchange.unsent = isinstance(error.__cause__, never_sent) or error.__cause__ is None
                raise
            exchange.status = response.status_code
            try:
                exchange.content = await self._read(response)
            finally:
                await response.aclose()
            dropped = ("content-encoding", "content-length", "transfer-encoding", "location")
            headers = [(name, value) for name, value in response.headers.multi_items() if name not in dropped]
            return httpx.Response(response.status_code, headers=headers, content=exchange.content)

        @staticmethod
        async def _read(response: httpx.Response) -> bytes:
            chunks, size = [], 0
            assert isinstance(response.stream, httpx.AsyncByteStream)
            async for chunk in response.stream:
                size += len(chunk)
                if size > MOST_BYTES:
                    raise httpx.ReadError(f"the answer is larger than {MOST_BYTES} bytes")
                chunks.append(chunk)
            return _decoded(b"".join(chunks), response.headers.get("content-encoding", "identity"))

        async def aclose(self) -> None:
            await self._inner.aclose()

    def _decoded(content: bytes, encoding: str) -> bytes:
        if encoding.lower() == "identity":
            return content
        if encoding.lower() not in ("gzip", "deflate"):
            raise httpx.DecodingError(f"the answer is encoded as {encoding[:40]!r}, which was not asked for")
        unpacking = zlib.decompressobj(47 if encoding.lower() == "gzip" else 15)
        try:
            unpacked = unpacking.decompress(content, MOST_BYTES)
        except zlib.error as error:
            raise httpx.DecodingError(str(error)) from error
        if unpacking.unconsumed_tail:
            raise httpx.DecodingError(f"the answer is larger than {MOST_BYTES} bytes")
        return unpacked

    make = handler.create_async_transport

    def create(*args: Any, **named: Any) -> httpx.AsyncBaseTransport:
        return Watched(make(*args, **named) or httpx.AsyncHTTPTransport())

    handler.create_async_transport = staticmethod(create)
