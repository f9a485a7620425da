"""Record one attempt on the wire.

The transport (`models/wire/httpx_transport.py`) writes it below the client libraries, which turn malformed answers into
errors that look unbilled.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

_GIVEN_UP = (408, 499, 504, 524)  # the server accepted the call and abandoned it, so its work may be billed
_NOT_TAKEN = (503, 529)


@dataclass
class Exchange:
    """One attempt to send a call, as seen on the wire: status, headers, body.

    sent: whether bytes of the request were handed to a connected server; None if unknown (a backend without a network).
    status, headers (by name in lower case): of the answer. content: its decoded body, None if it was not read to its
    end. proxy: the variable that named the proxy. problem: why nothing was sent, or why no answer came; is_unreadable:
    whether one came that breaks the rules of HTTP.
    """

    sent: bool | None = None
    status: int | None = None
    headers: Mapping[str, str] = field(default_factory=dict)
    content: bytes | None = None
    proxy: str | None = None
    problem: str | None = None
    is_unreadable: bool = False

    @property
    def is_unsent(self) -> bool:
        """Whether certainly no byte of the request reached a server."""
        return self.sent is False

    @property
    def is_answered(self) -> bool:
        """Whether a server reported success."""
        return self.status is not None and 200 <= self.status < 300

    def is_billable(self, status: int, *, is_explained: bool) -> bool:
        """Return whether the provider may charge for an answer with a status.

        status: the one on the wire, or the one in the body that overrides it. is_explained: whether the answer is a
        provider's error object; a page of a proxy on the way says nothing about the provider.
        """
        if self.is_unsent:
            return False
        if status in _GIVEN_UP:
            return True
        return not (300 <= status < 500 or status in _NOT_TAKEN or (is_explained and status >= 500))


CURRENT_EXCHANGE: ContextVar[Exchange | None] = ContextVar("watched", default=None)


@contextmanager
def record_exchange() -> Iterator[Exchange]:
    """Yield a record of the wire's traffic in the block: the caller's exchange or a new one."""
    if (outer := CURRENT_EXCHANGE.get()) is not None:
        yield outer
        return
    token = CURRENT_EXCHANGE.set(exchange := Exchange())
    try:
        yield exchange
    finally:
        CURRENT_EXCHANGE.reset(token)
