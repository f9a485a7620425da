"""The guard before Dagster's web server: who was given the address uses it, and no page of another site does."""

from __future__ import annotations

import asyncio
import functools
import http.client
import json
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiohttp
import pytest
import uvicorn
from starlette.applications import Starlette
from starlette.testclient import TestClient

from tests.build.errors import raises
from tests.foreign_page import attack
from tests.pages import CHROMIUM
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.webguard import Guard, token_for
from traps_pipeline.cli import main
from traps_pipeline.pipeline.previews import StudyFile
from traps_pipeline.pipeline.webserver import DANGER, TOKEN_VARIABLE, study_route
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

TOKEN = "a-token-of-a-test-0123"
JSON = {"Content-Type": "application/json"}
BEARER = {"Authorization": f"Bearer {TOKEN}"}
token_of = functools.partial(token_for, danger=DANGER, variable=TOKEN_VARIABLE)


OWN_HEADERS = [(b"content-type", b"text/html"), (b"content-security-policy", b"script-src 'nonce-1'")]


@dataclass
class Guarded:
    """A guarded server, and the requests that got through to what is behind."""

    port: int = 0
    reached: list[str] = field(default_factory=list)

    async def behind(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "lifespan":
            return
        self.reached.append(f"{scope.get('method', 'WS')} {scope['path']}")
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.accept"})
            await send({"type": "websocket.close"})
            return
        await send({"type": "http.response.start", "status": 200, "headers": OWN_HEADERS})
        await send({"type": "http.response.body", "body": b"<h1>behind</h1>"})

    def ask(
        self, method: str = "GET", path: str = "/", headers: dict[str, str] | None = None, body: str = ""
    ) -> tuple[int, dict[str, str]]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=10)
        connection.request(method, path, body=body or None, headers=headers or {})
        answer = connection.getresponse()
        answer.read()
        connection.close()
        names = {name.lower() for name, _ in answer.getheaders()}
        return answer.status, {name: answer.getheader(name) or "" for name in names}  # of several: all, with commas


@pytest.fixture(scope="module")
def running() -> Iterator[Guarded]:
    guarded = Guarded()
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        guarded.port = listening.getsockname()[1]
        guard = Guard(guarded.behind, TOKEN, "127.0.0.1", guarded.port)
        server = uvicorn.Server(uvicorn.Config(guard, log_level="error", lifespan="off"))
        thread = threading.Thread(target=lambda: asyncio.run(server.serve([listening])), daemon=True)
        thread.start()
        while not server.started:
            time.sleep(0.01)
        yield guarded
        server.should_exit = True
        thread.join(10)


@pytest.fixture
def guarded(running: Guarded) -> Guarded:
    running.reached.clear()
    return running


def test_the_printed_address_lets_a_browser_in_and_leaves_no_token_in_its_bar(guarded: Guarded) -> None:
    assert guarded.ask()[0] == 403
    assert guarded.ask(path="/?token=another-token-of-a-test")[0] == 403
    status, headers = guarded.ask(path=f"/assets?token={TOKEN}&view=list")
    assert (status, headers["location"]) == (303, "/assets?view=list")
    assert "HttpOnly" in headers["set-cookie"] and "SameSite=Strict" in headers["set-cookie"]
    assert guarded.reached == []
    cookie = {"Cookie": headers["set-cookie"].split(";")[0]}
    status, headers = guarded.ask(headers=cookie)
    assert status == 200 and guarded.reached == ["GET /"]
    assert headers["x-frame-options"] == "DENY"
    policies = headers["content-security-policy"]  # the page's own stays beside the guard's
    assert "script-src 'nonce-1'" in policies and "default-src 'self'" in policies and "frame-ancestors" in policies
    assert guarded.ask(path=f"//attacker.test/?token={TOKEN}")[1]["location"].startswith("/attacker.test")


@pytest.mark.parametrize(
    ("status", "method", "path", "headers"),
    [
        (200, "POST", "/graphql", JSON),
        (200, "POST", "/graphql", JSON | {"Origin": "http://127.0.0.1:{port}", "Sec-Fetch-Site": "same-origin"}),
        (200, "POST", "/graphql", {"Content-Type": "application/json; charset=utf-8"}),
        (200, "GET", "/graphql", {}),
        (405, "GET", "/graphql?query=mutation", {}),
        (405, "HEAD", "/graphql/?query=mutation", {}),
        (415, "POST", "/graphql", {"Content-Type": "text/plain"}),
        (415, "POST", "/graphql", {"Content-Type": "application/x-www-form-urlencoded"}),
        (415, "POST", "/graphql", {"Content-Type": "multipart/form-data; boundary=application/json"}),
        (415, "POST", "/report_asset_materialization/items", {}),
        (405, "DELETE", "/assets", JSON),
        (405, "OPTIONS", "/graphql", {"Origin": "http://127.0.0.1:{port}"}),
        (403, "POST", "/graphql", JSON | {"Origin": "http://attacker.test"}),
        (403, "POST", "/graphql", JSON | {"Origin": "null"}),
        (403, "POST", "/graphql", JSON | {"Origin": "http://127.0.0.1:1"}),
        (403, "GET", "/", {"Origin": "http://127.0.0.1.attacker.test:{port}"}),
        (403, "GET", "/", {"Sec-Fetch-Site": "cross-site"}),
        (403, "GET", "/", {"Sec-Fetch-Site": "same-site"}),
        (421, "GET", "/", {"Host": "rebound.test:{port}"}),
        (421, "GET", "/", {"Host": "127.0.0.1"}),
    ],
)
def test_only_what_this_servers_own_page_asks_gets_through(
    guarded: Guarded, status: int, method: str, path: str, headers: dict[str, str]
) -> None:
    sent = {name: value.replace("{port}", str(guarded.port)) for name, value in headers.items()}
    got, _ = guarded.ask(method, path, sent | BEARER, "{}" if method == "POST" else "")
    assert got == status
    assert bool(guarded.reached) == (status == 200)
    guarded.reached.clear()
    assert guarded.ask(method, path, sent, "{}" if method == "POST" else "")[0] in (403, 405, 415, 421)
    assert guarded.reached == []  # and nothing at all without the token


def test_a_websocket_is_for_this_servers_own_page_that_was_let_in(guarded: Guarded) -> None:
    own = f"http://127.0.0.1:{guarded.port}"

    async def opens(headers: dict[str, str]) -> bool:
        async with aiohttp.ClientSession() as session:
            try:
                async with session.ws_connect(f"{own}/graphql", headers=headers):
                    return True
            except aiohttp.WSServerHandshakeError:
                return False

    assert asyncio.run(opens(BEARER | {"Origin": own}))
    for headers in ({"Origin": own}, BEARER, BEARER | {"Origin": "http://attacker.test"}, BEARER | {"Origin": "null"}):
        assert not asyncio.run(opens(headers))
    assert guarded.reached == ["WS /graphql"]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which(CHROMIUM) is None, reason="chromium is not installed")
def test_a_foreign_page_in_a_browser_that_was_let_in_reaches_nothing(guarded: Guarded) -> None:
    seen = attack(guarded.port, ["mutation { wipe }"], [(f"traps-ui-{guarded.port}", TOKEN)])
    assert len(seen) > 15 and set(seen) <= {"refused", "opaque"}
    assert guarded.reached == []


def test_beyond_this_machine_a_token_of_ones_own_is_wanted(
    tmp_path: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("TRAPS_UI_TOKEN", raising=False)
    assert main(["ui", "--host", "0.0.0.0", "--workspace", str(tmp_path)]) == 1
    told = capsys.readouterr().err
    assert [name for name in ("--host 0.0.0.0", "--token", "TRAPS_UI_TOKEN") if name not in told] == []
    with raises(TrapsError, "base.webguard.token_for", "--token", "16"):
        token_of("0.0.0.0", "short")
    assert token_of("192.0.2.1", TOKEN) == TOKEN
    assert token_of("127.0.0.1", None) != token_of("127.0.0.1", None)
    assert len(json.dumps(token_of("::1", None))) > 30


def test_the_report_and_clips_of_a_study_are_served_and_nothing_else_of_it(tmp_path: Path) -> None:
    workspace = Workspace.create(tmp_path / "study", Study())
    for name in ("reports/report.html", "reports/.state/site.json", "clips/a-1/void.mp4", "outside.txt"):
        (workspace.root / name).parent.mkdir(parents=True, exist_ok=True)
        (workspace.root / name).write_bytes(b"0123456789")
    (workspace.root / "reports" / "link.html").symlink_to(workspace.root / "study.yaml")
    client = TestClient(Starlette(routes=[study_route(workspace)]))
    assert client.get(StudyFile("reports/report.html").url).text == "0123456789"
    part = client.get("/study/clips/a-1/void.mp4", headers={"Range": "bytes=2-4"})  # as a browser seeks in a clip
    assert (part.status_code, part.text) == (206, "234")
    outside = ("study.yaml", "outside.txt", "ledger/answers", "reports/../study.yaml", "reports/%2e%2e/study.yaml")
    for path in (*outside, "reports/.state/site.json", "reports/link.html", "reports", "clips//etc/passwd"):
        assert client.get(f"/study/{path}").status_code == 404, path
