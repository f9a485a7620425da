"""A call is billed from the moment that bytes of it were handed to a server, and its true cause is told before that."""

from __future__ import annotations

import asyncio
import gzip
import json
import os
import threading
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from socketserver import StreamRequestHandler, ThreadingTCPServer

import httpx
import pytest

from tests.build.calls import CHOICE, allowed_by, body, entry_of, request
from tests.build.errors import raises
from tests.build.ledger import budget as budget_of
from tests.conftest import KEY, SECRET
from tests.providers.servers import answering, closed_port, self_signed, silent
from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.asking.participants import Participants, ask_once
from traps_pipeline.models.money.budget import Budget, worst_case_usd
from traps_pipeline.models.registry.accounts import Account
from traps_pipeline.models.request import Outcome, TransientError
from traps_pipeline.models.wire.api import ApiBackend
from traps_pipeline.models.wire.httpx_transport import Wire, get_url
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
    attempted = await ask_once(asked["m"], request(), allowed_by(budget))
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
        assert get_url(f"http://{host}:{provider.port}/v1/models", {}, 20.0).status_code == 200
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
        assert get_url(f"https://localhost:{provider.port}/v1/models", {}, 20.0).status_code == 200


def test_a_certificate_that_is_named_or_renewed_in_mid_run_is_trusted_by_the_same_transport(
    environment: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "two").mkdir()
    one, two = self_signed(tmp_path / "one"), self_signed(tmp_path / "two")
    trusted = tmp_path / "trusted.pem"
    environment.setenv("SSL_CERT_FILE", str(trusted))
    trusted.write_bytes(two[1].read_bytes())
    transport = Wire()

    async def statuses() -> list[int]:
        async with httpx.AsyncClient(transport=transport, timeout=20.0) as client:
            found = list[int]()
            for _ in range(2):
                try:
                    found.append((await client.get(f"https://localhost:{provider.port}/v1/models")).status_code)
                except httpx.HTTPError:
                    found.append(0)
                trusted.write_bytes(one[1].read_bytes())
                os.utime(trusted, ns=(1, 1))  # the same name, renewed
            environment.setenv("SSL_CERT_FILE", str(two[1]))
            with pytest.raises(httpx.HTTPError):
                await client.get(f"https://localhost:{provider.port}/v1/models")
            return found

    with answering(200, b"{}", tls=one[0]) as provider:
        assert asyncio.run(statuses()) == [0, 200]


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


def failed(status: int, content: object, **headers: str) -> tuple[Outcome | None, float]:
    """What one answer of a provider becomes."""
    with answering(status, json.dumps(content).encode(), headers) as provider:
        return call(f"http://127.0.0.1:{provider.port}/v1", retries=0)


def retry_info(delay: str) -> dict[str, object]:
    """Gemini's way to ask for a pause."""
    details = [{"@type": "type.googleapis.com/google.rpc.RetryInfo", "retryDelay": delay}]
    return {"error": {"code": 429, "status": "RESOURCE_EXHAUSTED", "message": "quota", "details": details}}


def openrouter(headers: dict[str, object]) -> dict[str, object]:
    """OpenRouter's way, which hands on the headers of the provider behind it."""
    return {"error": {"message": "slow down", "code": 429, "metadata": {"headers": headers}}}


AT_EIGHT = 1795593600  # 2026-11-25T08:00:00Z
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
        ({"date": DATES["date"], "Retry-After": str(AT_EIGHT + 7)}, {}, 7.0),
        (
            {"date": DATES["date"], "X-RateLimit-Remaining": "0", "X-RateLimit-Reset": str(1000 * AT_EIGHT + 7000)},
            {},
            7.0,
        ),
        ({"date": DATES["date"], "X-RateLimit-Reset": str(AT_EIGHT + 7)}, {}, 7.0),
        (
            {"date": DATES["date"]},
            openrouter({"X-RateLimit-Remaining": "0", "X-RateLimit-Reset": 1000 * AT_EIGHT + 7000}),
            7.0,
        ),
        ({"ratelimitbysize-remaining": "0", "ratelimitbysize-reset": "7"}, {}, 7.0),
        ({"x-tokenlimit-remaining": "0", "x-tokenlimit-reset": "7"}, {}, 7.0),
        ({"RateLimit": '"a";r=3;t=90, "b";r=0;t=7'}, {}, 7.0),
        (
            {},
            {"error": {"message": "Rate limit reached (TPM). Please try again in 1m2.5s. Visit x", "code": 429}},
            62.5,
        ),
        ({}, {"error": {"message": "Please retry after 20 seconds.", "code": "429"}}, 20.0),
        ({}, {"error": {"message": "slow down", "code": 429, "metadata": {"retry_after_seconds": 7}}}, 7.0),
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
        assert failed(400, AZURE)[0] == refused
        assert failed(403, FLAGGED)[0] == refused
        assert failed(403, REGION)[0] == Outcome("error", error="http_403_denied", cost_usd=0.0)
        assert failed(403, NO_ACCESS)[0] == Outcome("error", error="http_403", cost_usd=0.0)
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
    assert outcome and (outcome.kind, outcome.text) == ("malformed", None) and booked_usd > 0.0
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


LENGTH = b"Content-Length: %d\r\n" % len(WHOLE)
BODY = b"\r\n" + WHOLE
CODED = gzip.compress(WHOLE)
STREAM = b"".join(
    b"data: %s\n\n"
    % json.dumps({"model": "m", "choices": [{"index": 0, "delta": delta, "finish_reason": finish}]}).encode()
    for delta, finish in (({"content": "The answer"}, None), ({"content": " is: left."}, None), ({}, "stop"))
)
STREAM += b'data: {"choices": [], "usage": {"prompt_tokens": 20, "completion_tokens": 21}}\n\ndata: [DONE]\n\n'


def counted(content: bytes, headers: bytes = b"") -> bytes:
    return HEAD + headers + b"Content-Length: %d\r\n\r\n" % len(content) + content


READ = {
    "long header": HEAD + LENGTH + b"X-Trace: " + b"a" * 60_000 + b"\r\n" + BODY,
    "many headers": HEAD + LENGTH + b"".join(b"X-%d: a\r\n" % number for number in range(3000)) + BODY,
    "long reason": b"HTTP/1.1 200 " + b"a" * 9000 + b"\r\n" + LENGTH + BODY,
    "no reason": b"HTTP/1.1 200\r\n" + LENGTH + BODY,
    "version 2": b"HTTP/2 200\r\n" + LENGTH + BODY,
    "version 1.0 without a length": b"HTTP/1.0 200 OK\r\n" + BODY,
    "hints first": b"HTTP/1.1 103 Early Hints\r\nLink: a\r\n\r\n" + HEAD + LENGTH + BODY,
    "line feeds alone": (HEAD + LENGTH).replace(b"\r\n", b"\n") + b"\n" + WHOLE,
    "folded header": HEAD + LENGTH + b"X: a\r\n b\r\n" + BODY,
    "zero byte in a header": HEAD + LENGTH + b"X: a\0b\r\n" + BODY,
    "space in a name": HEAD + LENGTH + b"X Y: a\r\n" + BODY,
    "name that is none": HEAD + LENGTH + "X-\u00e9: \u4e2d\r\n: b\r\nwords\r\n".encode() + BODY,
    "length twice": HEAD + LENGTH + LENGTH + BODY,
    "length as a list": HEAD + b"Content-Length: %d, %d\r\n" % (len(WHOLE), len(WHOLE)) + BODY,
    "length that is no number": HEAD + b"Content-Length: all\r\n" + BODY,
    "length beside chunks": HEAD
    + b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n"
    + chunk(WHOLE)
    + chunk(b""),
    "transfer encoding identity": HEAD + LENGTH + b"Transfer-Encoding: identity\r\n" + BODY,
    "compressed chunks": HEAD + b"Transfer-Encoding: gzip, chunked\r\n\r\n" + chunk(CODED) + chunk(b""),
    "trailer": CHUNKED + chunk(WHOLE) + b"0\r\nX-Sum: 1\r\n\r\n",
    "more than its length": HEAD + LENGTH + BODY + b"HTTP/1.1 200 OK\r\n",
    "empty encoding": counted(WHOLE, b"Content-Encoding: \r\n"),
    "encoding that is a character set": counted(WHOLE, b"Content-Encoding: utf-8\r\n"),
    "gzip that is none": counted(WHOLE, b"Content-Encoding: gzip\r\n"),
    "gzip without a label": counted(CODED),
    "bytes after gzip": counted(CODED + b"junk", b"Content-Encoding: gzip\r\n"),
    "raw deflate": counted(zlib.compress(WHOLE)[2:-4], b"Content-Encoding: deflate\r\n"),
    "byte order mark": counted(b"\xef\xbb\xbf" + WHOLE),
    "UTF-16": counted(WHOLE.decode().encode("utf-16")),
    "a character set that lies": counted(WHOLE).replace(b"json", b"json; charset=utf-16"),
    "zero byte at the end": counted(WHOLE + b"\0"),
    "list of one": counted(b"[" + WHOLE + b"]"),
    "event of one": counted(b": wait\n\ndata: " + WHOLE + b"\n\ndata: [DONE]\n\n"),
    "stream": counted(STREAM),
    "lines of JSON": counted(STREAM.replace(b"data: ", b"").replace(b"[DONE]", b"").replace(b"\n\n", b"\n")),
}


@pytest.mark.parametrize("name", READ)
def test_a_whole_answer_that_browsers_read_is_read_once_at_its_price(name: str) -> None:
    with raw(READ[name]) as address:
        outcome, booked_usd = call(address)
    assert outcome and (outcome.kind, outcome.text) == ("answer", "The answer is: left.")
    assert booked_usd == pytest.approx(20e-6 + 21e-5)


def test_words_in_the_character_set_of_their_label_are_read() -> None:
    content = (
        body(choices=[CHOICE | {"message": {"content": "caf\u00e9"}}])
        .encode()
        .decode("unicode_escape")
        .encode("latin-1")
    )
    with raw(counted(content).replace(b"json", b"json; charset=iso-8859-1")) as address:
        outcome, _ = call(address)
    assert outcome and outcome.text == "caf\u00e9"


def test_a_head_that_comes_byte_by_byte_is_read(environment: pytest.MonkeyPatch) -> None:
    async def drip(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        for byte in READ["length twice"]:
            writer.write(bytes([byte]))
            await writer.drain()
        writer.close()

    async def run() -> Outcome | None:
        async with await asyncio.start_server(drip, "127.0.0.1", 0) as server:
            return await asking(f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/v1", budget_of(10.0))

    outcome = asyncio.run(run())
    assert outcome and outcome.text == "The answer is: left."


UNREADABLE = {
    "no chunks where chunks are said": CHUNKED + WHOLE,
    "chunk of another size": CHUNKED + b"5\r\n" + WHOLE + b"\r\n0\r\n\r\n",
    "status of four digits": b"HTTP/1.1 2000 OK\r\n" + LENGTH + BODY,
    "length too small": HEAD + b"Content-Length: 20\r\n" + BODY,
    "endless head": HEAD + b"X: a\r\n" * 2**18,
}


@pytest.mark.parametrize("name", UNREADABLE)
def test_an_answer_that_nobody_can_read_is_malformed_and_tried_twice(name: str) -> None:
    started = time.monotonic()
    with raw(UNREADABLE[name]) as address:
        outcome, booked_usd = call(address, retries=5)
    assert outcome and outcome.kind == "malformed" and time.monotonic() - started < 30
    assert booked_usd == pytest.approx(2 * WORST_USD)
