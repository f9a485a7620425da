"""Read HTTP answers that aiohttp's parser refuses and browsers and curl accept.

Gateways add long headers, count a body twice, or write names that are none. The head of each answer is rewritten before
the parser sees it: what it would refuse is left out, and what says where the body ends is written once.
"""

import re
from functools import partial
from typing import Any

import aiohttp
from aiohttp.client_proto import ResponseHandler

MAX_HEAD = 2**20  # bytes; a longer head is handed on as it is, which the parser refuses
MAX_FIELD = 8000  # bytes of a header that is handed on; aiohttp's limit is 8,190
MAX_FIELDS = 100  # aiohttp's limit is 128
_END = re.compile(rb"\r?\n\r?\n")
_STATUS = re.compile(rb"(?:HTTP|ICY)(?:/(\d)(?:\.(\d))?)? {1,8}(\d{3})(?!\d)", re.I)
_NAME = re.compile(rb"[!#$%&'*+.^_`|~0-9A-Za-z-]{1,200}")
_LENGTH = re.compile(rb"\+?(\d{1,15})(?: ?, ?\+?(?:\d{1,15}))*")
_NEEDED = re.compile(rb"content|limit|retry|date|location|connection", re.I)  # kept where there are too many
_FRAMING = (b"content-length", b"transfer-encoding")


class LenientConnector(aiohttp.TCPConnector):
    """A connector for aiohttp whose connections read answers by `LenientHandler`."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self._factory = partial(LenientHandler, loop=self._loop)


class LenientHandler(ResponseHandler):
    """A handler that reads the answers of one connection, each with its head rewritten."""

    is_asked = False  # whether a request was sent; what comes before is kept

    def set_response_params(self, **settings: Any) -> None:
        """Expect the answer to a request that was just sent."""
        self.is_asked, self._head = True, bytearray()
        self._is_head, self._body = True, aiohttp.EMPTY_PAYLOAD
        self._left: int | None = None  # bytes of the body to come; None if chunks or the end of the connection say it
        super().set_response_params(**settings)

    def feed_data(self, data: tuple[Any, aiohttp.StreamReader], size: int = 0) -> None:
        """Pass on an answer, and remember the reader of its body."""
        self._body = data[1]
        super().feed_data(data, size)

    def data_received(self, data: bytes) -> None:
        """Pass a response's bytes to the HTTP parser, its head made readable."""
        if self.is_asked and data and self._is_head:
            self._head += data if self._head else data.lstrip(b"\r\n")
            end = _END.search(self._head, max(0, len(self._head) - len(data) - 3))  # what came before holds no end
            if end is None and len(self._head) < MAX_HEAD:
                return
            head, data = bytes(self._head[: end and end.end()]), bytes(self._head[end.end() :]) if end else b""
            self._is_head, self._head = re.match(rb"HTTP/\d\.\d 1(?!01)", head) is not None, bytearray()
            rewritten, self._left = rewrite_head(head)
            super().data_received(rewritten)
            if data:
                self.data_received(data)
            return
        if self.is_asked and data and self._left is not None:
            if len(data) > self._left:
                self.force_close()  # nothing was asked for beside this answer
            data = data[: self._left]
            self._left -= len(data)
            if not data:
                return
        super().data_received(data)
        if (error := self.exception()) is not None and self._body.exception() is None:
            self._body.set_exception(error)  # wakes the reader of a body that breaks HTTP's rules


def rewrite_head(head: bytes) -> tuple[bytes, int | None]:
    """Return a head that the parser accepts, if any client reads it, and the body's length if the head gives it."""
    lines = re.split(rb"\r?\n", re.sub(rb"\r?\n[ \t]+", b" ", head.rstrip(b"\r\n")))
    status = _STATUS.match(lines[0])
    if status is None:
        return head, None
    fields = list[tuple[bytes, bytes]]()
    for line in lines[1:]:
        name, colon, value = line.partition(b":")
        name, value = name.rstrip(), re.sub(rb"[\r\0]", b" ", value).strip()
        if colon and _NAME.fullmatch(name) and len(name + value) <= MAX_FIELD:
            fields.append((name, value))
    minor = b"0" if status[1] == b"1" and status[2] == b"0" else b"1"
    framing, length = _framing([(name.lower(), value) for name, value in fields], int(status[3]))
    others = [(name, value) for name, value in fields if name.lower() not in _FRAMING]
    kept = sorted(others, key=lambda field: _NEEDED.search(field[0]) is None)[:MAX_FIELDS] + framing
    reason = re.sub(rb"[\r\0]", b" ", lines[0][status.end() :]).strip()[:200]
    rewritten = b"HTTP/1.%s %s %s\r\n" % (minor, status[3], reason) + b"".join(b"%s: %s\r\n" % field for field in kept)
    return rewritten + b"\r\n", length


def _framing(fields: list[tuple[bytes, bytes]], status: int) -> tuple[list[tuple[bytes, bytes]], int | None]:
    """Return the headers that say where the body ends: chunks, else its first length, else the connection's end."""
    if b"chunked" in b",".join(value for name, value in fields if name == b"transfer-encoding").lower():
        return [(b"Transfer-Encoding", b"chunked")], None
    lengths = [match[1] for name, value in fields if name == b"content-length" and (match := _LENGTH.fullmatch(value))]
    if status < 200 or status in (204, 304):
        return [], 0
    return ([(b"Content-Length", lengths[0])], int(lengths[0])) if lengths else ([], None)
