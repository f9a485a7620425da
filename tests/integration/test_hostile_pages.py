"""Dagster's own pages over texts that attack them, in a real browser: nothing runs, nothing leaves, nothing hides."""

from __future__ import annotations

import json
import socketserver
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.parse import quote

import pytest
from playwright.sync_api import Browser, Page

from tests.build.network import entry, experiment
from tests.conftest import Checkout
from tests.integration.test_ui import LAUNCH, LOCATION, RUN_SECONDS, TOKEN, graphql, runs_by_job, serving, wait_until
from tests.pages import until, watched
from tests.providers.server import Provider

pytestmark = pytest.mark.slow
MARK = "window.owned"  # what of a text tells that a page shows it
RAW = "\x07\x08\x1b\x9b\u202e\u202c\U000e0041"  # as few pages of Dagster have them; U+200B is in its own texts
JOB = "evaluation"
MADE = """query ($path: [String!]!, $partitions: [String!]) { assetOrError(assetKey: {path: $path}) {
  ... on Asset { assetMaterializations(partitions: $partitions, limit: 1) { runId } } } }"""


@contextmanager
def listener() -> Iterator[tuple[str, list[str]]]:
    """Host and port of a server, and the addresses that connect to it."""
    connections = list[str]()

    class Heard(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            connections.append(self.request.recv(200).decode(errors="replace"))

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Heard) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"127.0.0.1:{server.server_address[1]}", connections
        server.shutdown()


def attack(host: str) -> str:
    """A text that runs, fetches, draws and hides what it can wherever a page takes it for more than a text."""
    return (
        f"<script>{MARK} = 1; fetch('http://{host}/script')</script>"
        f'<img src="http://{host}/image" onerror="{MARK} = 2; alert(2)"><svg onload="{MARK} = 3; alert(3)"></svg>'
        f'<link rel="stylesheet" href="http://{host}/style"> ![image](http://{host}/markdown) '
        f'[link](javascript:{MARK}=4) <a href="javascript:{MARK}=5">link</a> '
        f"\x1b]8;;http://{host}/terminal\x1b\\red\x1b[31m \x9b31m \x07\x08 \u202eesrever\u202c \U000e0041 end"
    )


def answers(host: str) -> dict[str, dict[str, object]]:
    """What a server says in place of each of four models: the attack in every text that it sends."""
    text = attack(host)

    def chat(content: str, finish: str) -> dict[str, object]:
        message = {"role": "assistant", "content": content, "reasoning_content": text}
        choice = {"index": 0, "message": message, "finish_reason": finish}
        usage = {"prompt_tokens": 9, "completion_tokens": 9, "total_tokens": 18}
        body = {"id": text, "object": "chat.completion", "model": text, "choices": [choice], "usage": usage}
        return {"content": json.dumps(body)}

    error = {"message": text, "type": text, "code": text, "param": text}
    return {
        "said": chat(text, "stop"),
        "ended": chat(text, text),
        "long": chat(text * 500, "stop"),
        "refused": {"content": json.dumps({"error": error}), "status": 400},
    }


def visit(page: Page, address: str, *, shows_text: bool) -> None:
    """Open a page, which shows the attack as a text or none of it, holds no raw control, and lets nothing run."""
    page.goto(address)
    until(page, f"document.body.innerText.includes({json.dumps(MARK)})" if shows_text else "document.body.innerText")
    page.wait_for_timeout(1500)  # what a text starts needs a moment
    text = str(page.evaluate("document.body.innerText"))
    assert len(text) > 100 and not {*RAW} & {*text}, address
    assert page.evaluate(MARK) is None, address


def test_texts_of_models_and_servers_run_nothing_and_fetch_nothing_in_dagsters_pages(
    unasked: Checkout, provider: Provider, browser: Browser
) -> None:
    with listener() as (host, connections):
        models = answers(host)
        provider.configure(raw_by_model=models)
        entries = [entry(name, "images") for name in models]
        path = experiment(unasked, provider, entries, regimes=["standard"], datasets=["occlusion"])
        assert unasked.traps("run", path, "--no-preflight", "--budget-usd", "1000").code == 1  # calls were refused
        with serving(unasked) as server:
            selector = LOCATION | {"pipelineName": JOB}  # a run of the pages' own, whose output they keep
            graphql(server, LAUNCH, executionParams={"mode": "default", "selector": selector, "runConfigData": {}})
            ended = [["FAILURE"]]
            wait_until(lambda: [[s for _, s in runs_by_job(server).get(JOB, [])]] == ended, RUN_SECONDS, "it ends")
            ((run, _),) = runs_by_job(server)[JOB]
            (log,) = (unasked.workspace / "dagster" / "storage" / run / "compute_logs").glob("*.err")
            page, problems = watched(browser, 1600, (server, server.replace("http", "ws"), "data:", "blob:"))
            page.set_viewport_size({"width": 1600, "height": 3000})
            page.goto(f"{server}/?token={TOKEN}")
            for name in models:  # the table of a partition shows why a text ended, and no text
                cell = quote(f"occlusion|{name}__standard__run1")
                address = f"{server}/assets/responses?view=partitions&partition={cell}"
                visit(page, address, shows_text=name == "ended")
            made = graphql(server, MADE, path=["responses"], partitions=["occlusion|ended__standard__run1"])
            (made_by,) = made["assetOrError"]["assetMaterializations"]
            visit(page, f"{server}/runs/{made_by['runId']}?logs={MARK}", shows_text=True)
            visit(page, f"{server}/runs/{run}?logType=stderr&logFileKey={log.stem}", shows_text=True)
            explored = unasked.workspace / "reports" / "data" / "study.js"
            wait_until(lambda: "refused" in explored.read_text(), RUN_SECONDS, "the daemon makes the explorer again")
            for name in models:
                explorer = f"{server}/study/reports/index.html#/answers?model={name}"
                visit(page, explorer, shows_text=name in ("said", "long"))
            for place in ("study/reports/report.html", "assets/votes?view=overview", f"runs/{run}"):
                visit(page, f"{server}/{place}", shows_text=False)
            assert connections == []
            assert [problem for problem in problems if host in problem or problem in ("2", "3")] == []

            # A text that became markup all the same, by a fault of Dagster's or of ours, is stopped by the policy.
            page.goto(f"{server}/assets")
            until(page, "document.body.innerText.length > 100")
            page.evaluate("text => document.body.insertAdjacentHTML('beforeend', text)", attack(host))
            page.wait_for_timeout(1500)
            assert page.evaluate(MARK) is None
            assert [problem for problem in problems if problem in ("2", "3")] == []
            assert connections == []
            page.context.close()
