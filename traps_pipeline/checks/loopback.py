"""Run a fake provider on this machine that records a backend's requests."""

import asyncio
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import repeat
from threading import Thread
from typing import Any
from urllib.parse import urlsplit

from typing_extensions import override

from traps_pipeline.base.progress import Progress, use_progress
from traps_pipeline.checks.wire_body import WireBody
from traps_pipeline.models.registry.accounts import Account
from traps_pipeline.models.registry.entries import Entry, load_accounts
from traps_pipeline.models.request import Outcome, Request, TransientError
from traps_pipeline.models.wire.api import ApiBackend
from traps_pipeline.models.wire.exchange import record_exchange

PLACEHOLDER_KEY = "placeholder-of-a-key"


class _Loopback(Account):
    """An account whose provider is this machine."""

    def secret(self) -> str | None:
        """Return a placeholder for the key."""
        return PLACEHOLDER_KEY


class _Notes(Progress):
    """A collector of a backend's notes, such as why a client refused to send."""

    def __init__(self) -> None:
        super().__init__()
        self.texts = list[str]()

    @override
    def note(self, text: str) -> None:
        self.texts.append(text)


_CAUGHT = (400, b'{"error": {"message": "caught", "type": "invalid_request_error", "code": 400}}')


@contextmanager
def _serve(answers: Iterator[tuple[int, bytes]] | None = None) -> Iterator[tuple[str, list[WireBody]]]:
    """Serve here, yield address and requests; answer the next status and JSON, or 400."""
    bodies: list[WireBody] = []
    replies = repeat(_CAUGHT) if answers is None else answers

    class RequestRecorder(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            raw = self.rfile.read(int(self.headers.get("content-length") or 0))
            bodies.append(WireBody(self.command, self.path, dict(self.headers), raw))
            status, answer = next(replies, _CAUGHT)
            self.send_response(status)
            self.send_header("content-type", "application/json")
            self.send_header("content-length", str(len(answer)))
            self.end_headers()
            self.wfile.write(answer)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), RequestRecorder)
    Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", bodies
    finally:
        server.shutdown()
        server.server_close()


def replay(entry: Entry, requests: Sequence[Request], answers: Sequence[tuple[int, bytes]]) -> list[Outcome]:
    """Return each request's outcome when the provider sends the given answer. answers: status and JSON."""
    account = load_accounts()[str(entry.account)]
    with _serve(iter(answers)) as (address, _), use_progress(_Notes()):
        loopback = _Loopback(base_url=address + urlsplit(account.base_url or "").path)
        backend = ApiBackend(entry, loopback)

        async def read(request: Request) -> Outcome:
            try:
                return await backend.ask(request)
            except TransientError as error:
                return error.outcome

        async def read_all() -> list[Outcome]:
            return [await read(request) for request in requests]  # sequential, since answers come in order

        return asyncio.run(read_all())


def sent_bodies(entry: Entry, requests: Sequence[Request]) -> list[WireBody | str]:
    """Return the body of each request, or why none was sent."""
    account, notes = load_accounts()[str(entry.account)], _Notes()
    with _serve() as (address, bodies), use_progress(notes):
        loopback = _Loopback(base_url=address + urlsplit(account.base_url or "").path)

        async def ask_all() -> list[WireBody | str]:
            return [await _ask(entry, loopback, request, bodies, notes) for request in requests]

        return asyncio.run(ask_all())


async def _ask(
    entry: Entry, account: Account, request: Request, caught: list[WireBody], notes: _Notes
) -> WireBody | str:
    caught.clear()
    backend = ApiBackend(entry, account)  # a new one for each call, because it notes each kind of failure only once
    with record_exchange() as exchange, suppress(TransientError):
        await backend.ask(request)
    if caught and not exchange.sent:
        return "the request went over a connection that is not watched, so that nobody knows what is billed"
    return caught[0] if len(caught) == 1 else f"{len(caught)} requests were sent, not one ({notes.texts[-1:]})"
