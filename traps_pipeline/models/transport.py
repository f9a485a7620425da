"""What went over the wire in one attempt. The transport (`models/wire.py`) writes it down below the client libraries,
which turn odd answers into errors that look as if nothing had been billed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

_GIVEN_UP = (408, 499, 504, 524)  # statuses of a call that a server took and gave up, so that its work may be billed
_NOT_TAKEN = (503, 529)


@dataclass
class Exchange:
    """One attempt as the wire saw it.

    sent: whether bytes of the request were handed to a connected server; None where nobody looks (a backend without a
    network). status, headers: of the answer. content: its decoded body, None if it was not read to its end. proxy: the
    variable that named the proxy. problem: why nothing was sent, or why no answer came.
    """

    sent: bool | None = None
    status: int | None = None
    headers: Mapping[str, str] = field(default_factory=dict)
    content: bytes | None = None
    proxy: str | None = None
    problem: str | None = None

    @property
    def never_left(self) -> bool:
        """Whether it is certain that no byte of the request reached a server."""
        return self.sent is False

    @property
    def is_answered(self) -> bool:
        """Whether a server said that it did what it was asked to."""
        return self.status is not None and 200 <= self.status < 300

    def may_be_billed(self, status: int, *, is_explained: bool) -> bool:
        """Return whether the provider may charge for an answer with a status.

        status: the one on the wire, or the one in the body, where that counts in its place. is_explained: whether an
        error object of the provider's stands in the place of an answer; a page of a proxy on the way tells nothing of
        what the provider did.
        """
        if self.never_left:
            return False
        if status in _GIVEN_UP:
            return True
        return not (400 <= status < 500 or status in _NOT_TAKEN or (is_explained and status >= 500))


WATCHED: ContextVar[Exchange | None] = ContextVar("watched", default=None)


@contextmanager
def watching() -> Iterator[Exchange]:
    """Let the wire write into this exchange within the block: the one that a caller watches already, or a new one."""
    if (outer := WATCHED.get()) is not None:
        yield outer
        return
    token = WATCHED.set(exchange := Exchange())
    try:
        yield exchange
    finally:
        WATCHED.reset(token)
