"""A call is billed from the moment that bytes of it were handed to a server, and its true cause is told before that."""

from __future__ import annotations

import asyncio
import gzip
import json
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from socketserver import StreamRequestHandler, ThreadingTCPServer

import pytest

from tests.build.calls import allowed_by, body, entry_of, request
from tests.build.errors import raises
from tests.build.ledger import budget as budget_of
from tests.conftest import KEY, SECRET
from tests.providers.servers import answering, closed_port, self_signed, silent
from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.asking.participants import Participants, attempt
from traps_pipeline.models.money.budget import Budget, worst_case_usd
from traps_pipeline.models.registry.entries import Account
from traps_pipeline.models.request import Outcome, TransientError
from traps_pipeline.models.wire.api import ApiBackend
from traps_pipeline.models.wire.httpx_transport import get
from traps_pipeline.storage.study import Study

pytestmark = pytest.mark.promise  # the client library alone takes seconds to import
PROXIES = ("http_proxy", "https_proxy", "all_proxy", "no_proxy")
MODEL = "m"
LONG_S = 300.0


@pytest.fixture(autouse=True)
def environment(client_library: None, monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """A key and no word about proxies and certificates."""
    for name in (*PROXIES, *(name.upper() for name in PROXIES), "SSL_CERT_FILE", "SSL_CERT_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(KEY, SECRET)
    return monkeypatch


async def asking(base_url: str, budget: Budget, timeout_s: float = LONG_S, **limits: int) -> Outcome | None:
    """One call to an address with its retries."""
    account, entry = Account(key=KEY, base_url=base_url), entry_of(MODEL)
    entry = entry.model_copy(update={"limits": entry.limits.model_copy(update={"timeout_s": timeout_s, **limits})})
    asked = Participants({"m": entry}, lambda e: ApiBackend(e, account), Study(budget_usd=10.0), {"a": Account()})
    attempted = await attempt(asked["m"], request(), allowed_by(budget))
    return attempted and attempted[0]


def call(base_url: str, timeout_s: float = LONG_S, **limits: int) -> tuple[Outcome | None, float]:
    """What came of one call, and what the budget says that it cost."""
    budget = budget_of(10.0)
    return asyncio.run(asking(base_url, budget, timeout_s, **limits)), budget.spent_usd


def unsent(capsys: pytest.CaptureFixture[str], base_url: str, *names: str, timeout_s: float = LONG_S) -> str:
    """A call that never left cost nothing, its row says no cost, and what is said of it holds these names."""
    with progress.use_progress(progress.Progress()):
        outcome, booked_usd = call(base_url, timeout_s)
    assert (outcome, booked_usd) == (Outcome("error", error="unreachable"), 0.0)
    said = capsys.readouterr().err
    assert SECRET not in said and all(name in said for name in names), said
    return said


WORST_USD = worst_case_usd(entry_of(MODEL), request())


@pytest.mark.slow
@pytest.mark.promise
def test_a_refused_connection_a_name_that_is_none_and_a_scheme_that_is_none_cost_nothing(
    capsys: pytest.CaptureFixture[str],
) -> None:
    port = closed_port()
    unsent(capsys, f"http://127.0.0.1:{port}/v1", f"127.0.0.1:{port}", "Connection refused")
    unsent(capsys, "http://no-such-host.invalid/v1", "no-such-host.invalid:80")
    unsent(capsys, f"htp://127.0.0.1:{port}/v1", "htp://", "http://", "https://")


@pytest.mark.parametrize("variable", ["http_proxy", "ALL_PROXY"])
def test_a_dead_proxy_costs_nothing_and_is_named_by_its_variable_without_its_password(
    environment: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], variable: str
) -> None:
    proxy = f"127.0.0.1:{closed_port()}"
    environment.setenv(variable, f"http://me:passw0rd@{proxy}")
    names = "provider.invalid:80", f"http://{proxy}", variable, "Connection refused"
    assert "passw0rd" not in unsent(capsys, "http://provider.invalid/v1", *names)


def test_what_reached_only_a_proxy_that_makes_no_tunnel_costs_nothing(
    environment: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with answering(407) as proxy:
        environment.setenv("HTTPS_PROXY", f"http://127.0.0.1:{proxy.port}")
        unsent(capsys, "https://provider.invalid/v1", "HTTPS_PROXY", " 407 ")
    assert {*proxy.requests} == {"CONNECT provider.invalid:443"}


def test_a_plain_request_that_a_proxy_took_may_have_been_passed_on(environment: pytest.MonkeyPatch) -> None:
    with answering(502) as proxy:
        environment.setenv("HTTP_PROXY", f"http://127.0.0.1:{proxy.port}")
        outcome, booked_usd = call("http://provider.invalid/v1")
        assert outcome and outcome.error == "server_error" and booked_usd == pytest.approx(2 * WORST_USD)
    assert proxy.requests == ["POST http://provider.invalid/v1/chat/completions"] * 2


def test_a_socks_proxy_costs_nothing_and_is_named(
    environment: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    environment.setenv("ALL_PROXY", "socks5://127.0.0.1:9")
    unsent(capsys, "http://provider.invalid/v1", "ALL_PROXY", "socks5://127.0.0.1:9", "NO_PROXY")


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_loopback_addresses_are_asked_directly_whatever_the_environment_says(
    environment: pytest.MonkeyPatch, host: str
) -> None:
    environment.setenv("HTTP_PROXY", f"http://127.0.0.1:{closed_port()}")
    environment.setenv("ALL_PROXY", "socks5://127.0.0.1:9")
    environment.setenv("NO_PROXY", "example.org")
    with answering(200, body().encode()) as provider:
        outcome, _ = call(f"http://{host}:{provider.port}/v1")
        assert outcome and outcome.kind == "answer"
        assert get(f"http://{host}:{provider.port}/v1/models", {}, 20.0).status_code == 200
    assert provider.requests == ["POST /v1/chat/completions", "GET /v1/models"]


def test_a_certificate_that_nobody_trusts_and_one_that_is_gone_cost_nothing(
    environment: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    tls, _ = self_signed(tmp_path)
    with answering(200, body().encode(), tls=tls) as provider:
        address = f"https://localhost:{provider.port}/v1"
        unsent(capsys, address, "(self-signed certificate)", "SSL_CERT_FILE")
        environment.setenv("SSL_CERT_FILE", "/nonexistent.pem")
        unsent(capsys, address, "SSL_CERT_FILE", "/nonexistent.pem")
    assert provider.requests == []


def test_a_certificate_that_a_variable_names_is_trusted(environment: pytest.MonkeyPatch, tmp_path: Path) -> None:
    tls, certificate = self_signed(tmp_path)
    environment.setenv("SSL_CERT_FILE", str(certificate))
    with answering(200, b"{}", tls=tls) as provider:
        assert get(f"https://localhost:{provider.port}/v1/models", {}, 20.0).status_code == 200


def test_https_to_a_plain_port_costs_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with answering(200, body().encode()) as provider:
        unsent(capsys, f"https://127.0.0.1:{provider.port}/v1", "http://")
    assert provider.requests == []


@pytest.mark.parametrize("key", [SECRET + "\nX-Evil: 1", SECRET + "é"])
def test_a_key_that_no_header_takes_is_refused_before_anything_is_sent(
    environment: pytest.MonkeyPatch, key: str
) -> None:
    environment.setenv(KEY, key)
    with answering(200, body().encode()) as provider, raises(TrapsError, "base.keys.check_key"):
        call(f"http://127.0.0.1:{provider.port}/v1", 20.0)
    assert provider.requests == []


async def cancelled(base_url: str, reached: asyncio.Event) -> float:
    """What is booked for a call that is cancelled once a server was reached."""
    budget = budget_of(10.0)
    task = asyncio.create_task(asking(base_url, budget))
    await reached.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    return budget.spent_usd


@pytest.mark.parametrize(("scheme", "worst_cases"), [("https", 0), ("http", 1)])
def test_a_call_that_is_cancelled_is_billed_once_it_was_sent_and_not_in_a_handshake(
    scheme: str, worst_cases: int
) -> None:
    async def run() -> float:
        reached = asyncio.Event()

        async def take(reader: asyncio.StreamReader, _: asyncio.StreamWriter) -> None:
            await reader.readexactly(64)  # of a request, or of the first message of TLS
            reached.set()

        async with await asyncio.start_server(take, "127.0.0.1", 0) as server:
            port = server.sockets[0].getsockname()[1]
            return await cancelled(f"{scheme}://127.0.0.1:{port}/v1", reached)

    assert asyncio.run(run()) == pytest.approx(worst_cases * WORST_USD)


@pytest.mark.slow
@pytest.mark.promise
def test_a_time_out_is_billed_where_the_call_was_sent_and_not_where_no_connection_was_made(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with silent() as port:
        unsent(capsys, f"https://127.0.0.1:{port}/v1", timeout_s=0.5)
        outcome, booked_usd = call(f"http://127.0.0.1:{port}/v1", timeout_s=0.5)
    assert outcome and outcome.error == "timeout" and booked_usd == pytest.approx(2 * WORST_USD)


def error(status: int, content: object, **headers: str) -> tuple[Outcome | None, float]:
    """What one answer of a provider becomes."""
    with answering(status, json.dumps(content).encode(), headers) as provider:
        return call(f"http://127.0.0.1:{provider.port}/v1", retries=0)


def retry_info(delay: str) -> dict[str, object]:
    """Gemini's way to ask for a pause."""
    details = [{"@type": "type.googleapis.com/google.rpc.RetryInfo", "retryDelay": delay}]
    return {"error": {"code": 429, "status": "RESOURCE_EXHAUSTED", "message": "quota", "details": details}}


DATES = {"date": "Wed, 25 Nov 2026 08:00:00 GMT", "retry-after": "Wed, 25 Nov 2026 08:00:07 GMT"}
SPENT = {"x-ratelimit-remaining-requests": "0", "x-ratelimit-reset-requests": "1m7s"}
NOT_SPENT = {"x-ratelimit-remaining-tokens": "9", "x-ratelimit-reset-tokens": "6m0s"}
ANTHROPIC = {"anthropic-ratelimit-tokens-remaining": "0", "anthropic-ratelimit-tokens-reset": "2026-11-25T08:00:07Z"}


@pytest.mark.parametrize(
    ("headers", "content", "seconds"),
    [
        ({"Retry-After": "7"}, {}, 7.0),
        ({"Retry-After": "7s"}, {}, 7.0),
        (DATES, {}, 7.0),
        ({"retry-after-ms": "1500", "Retry-After": "2"}, {}, 1.5),
        ({}, retry_info("7s"), 7.0),
        (SPENT | NOT_SPENT, {}, 67.0),
        ({"date": DATES["date"]} | ANTHROPIC, {}, 7.0),
        ({"Retry-After": "nan"}, {}, None),
        ({"Retry-After": "soon"}, {}, None),
        (NOT_SPENT, {}, None),
    ],
)
def test_a_pause_that_a_provider_asks_for_is_read_in_all_its_forms(
    headers: dict[str, str], content: dict[str, object], seconds: float | None
) -> None:
    content = content or {"error": {"code": "rate_limit_exceeded", "message": "slow down"}}
    with answering(429, json.dumps(content).encode(), headers) as provider:
        backend = ApiBackend(entry_of(MODEL), Account(key=KEY, base_url=f"http://127.0.0.1:{provider.port}/v1"))
        with pytest.raises(TransientError) as raised:
            asyncio.run(backend.ask(request()))
    assert (raised.value.kind, raised.value.billed) == ("rate_limited", False)
    assert raised.value.retry_after_s == pytest.approx(seconds)


AZURE = {
    "error": {
        "message": "The response was filtered due to the prompt triggering content management policy.",
        "param": "prompt",
        "code": "content_filter",
        "status": 400,
        "innererror": {"code": "ResponsibleAIPolicyViolation"},
    }
}
FLAGGED = {"error": {"message": "Your input was flagged", "code": 403, "metadata": {"flagged_input": "x"}}}
REGION = {"error": {"message": "Country, region, or territory not supported", "code": "unsupported_country"}}
NO_ACCESS = {"error": {"message": "You have no access to this model", "type": "permission_error"}}


def test_a_content_filter_is_a_refusal_and_other_403s_are_told_from_those_about_a_key(
    capsys: pytest.CaptureFixture[str],
) -> None:
    refused = Outcome("refused", error="content_policy", cost_usd=0.0)
    with progress.use_progress(progress.Progress()):
        assert error(400, AZURE)[0] == refused
        assert error(403, FLAGGED)[0] == refused
        assert error(403, REGION)[0] == Outcome("error", error="http_403_denied", cost_usd=0.0)
        assert error(403, NO_ACCESS)[0] == Outcome("error", error="http_403", cost_usd=0.0)
    said = capsys.readouterr().err
    assert "Your input was flagged" in said and "Country, region, or territory not supported" in said


ONE, TWO = body()[:200].encode(), body()[200:].encode()


@pytest.mark.parametrize(
    ("encoding", "content"),
    [
        ("gzip", gzip.compress(ONE) + gzip.compress(TWO)),
        ("gzip", gzip.compress(ONE + TWO) + bytes(8)),
        ("X-GZIP", gzip.compress(ONE + TWO)),
        ("deflate", zlib.compress(ONE + TWO)),
    ],
)
def test_a_compressed_answer_is_read_with_all_its_members(encoding: str, content: bytes) -> None:
    with answering(200, content, {"content-encoding": encoding}) as server:
        outcome, _ = call(f"http://127.0.0.1:{server.port}/v1")
    assert outcome and (outcome.kind, outcome.text) == ("answer", "The answer is: left.")


@pytest.mark.parametrize(
    ("content", "is_bomb"), [(gzip.compress(ONE + TWO)[:-8], False), (gzip.compress(ONE + TWO + b" " * 2**24), True)]
)
def test_a_compressed_answer_that_breaks_off_or_is_a_bomb_is_no_answer(
    content: bytes, is_bomb: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    with answering(200, content, {"content-encoding": "gzip"}) as server, progress.use_progress(progress.Progress()):
        outcome, booked_usd = call(f"http://127.0.0.1:{server.port}/v1")
    assert outcome and (outcome.kind, outcome.text) == ("error", None) and booked_usd > 0.0
    assert ("16777216" in capsys.readouterr().err) == is_bomb


@contextmanager
def raw(answer: bytes) -> Iterator[str]:
    """Serve these very bytes to every request and close; the address."""

    class Handler(StreamRequestHandler):
        def handle(self) -> None:
            length = 0
            while (line := self.rfile.readline()).strip():
                name, _, value = line.partition(b":")
                length = int(value) if name.lower() == b"content-length" else length
            self.rfile.read(length)
            self.wfile.write(answer)

    with ThreadingTCPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/v1"
        server.shutdown()


WHOLE = ONE + TWO
HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n"
CHUNKED = HEAD + b"Transfer-Encoding: chunked\r\n\r\n"
PADDING = b" " * 16 + b"\n"  # what OpenRouter sends while it waits


def chunk(content: bytes) -> bytes:
    return b"%x\r\n" % len(content) + content + b"\r\n"


@pytest.mark.parametrize(
    "answer",
    [
        CHUNKED + chunk(WHOLE),  # and no last chunk: more may have been to come
        CHUNKED + chunk(PADDING) + chunk(b""),
        HEAD + b"\r\n" + ONE,
        HEAD + b"Content-Length: %d\r\n\r\n" % (len(WHOLE) + 50) + WHOLE,
    ],
)
def test_half_an_answer_is_none_and_may_be_billed(answer: bytes) -> None:
    with raw(answer) as address:
        outcome, booked_usd = call(address)
    assert outcome and outcome.kind in ("error", "malformed") and outcome.text is None and booked_usd > 0.1
