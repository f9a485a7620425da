"""Dagster's UI in a real browser: the whole graph, no request off the machine, and a correction driven by clicks."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect, sync_playwright

from tests.conftest import EXPERIMENT, Checkout
from traps_pipeline.definitions import defs
from traps_pipeline.lineage import partition_of
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.tables import TABLES

pytestmark = pytest.mark.slow
CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
QUIET = (
    "--no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking --disable-sync "
    "--disable-component-update"
)
RUN_SECONDS = 90


def wait_until(condition: Callable[[], bool], seconds: float, what: str) -> None:
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, f"not within {seconds} s: {what}"
        time.sleep(0.3)


@pytest.fixture
def server(study: Checkout) -> Iterator[str]:
    """`make ui`'s command on a free port: web server and daemon."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = (
        sys.executable,
        "-m",
        "dagster",
        "dev",
        "-h",
        "127.0.0.1",
        "-p",
        str(port),
        "-m",
        "traps_pipeline.definitions",
    )
    process = study.start(*command)
    url = f"http://127.0.0.1:{port}"
    try:
        wait_until(lambda: _answers(f"{url}/server_info"), 60, "the web server answers")
        yield url
    finally:
        os.killpg(process.pid, signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):  # on a busy machine Dagster's own processes may take longer
            process.communicate(timeout=30)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def _answers(url: str) -> bool:
    try:
        return urllib.request.urlopen(url, timeout=2).status == 200
    except OSError:
        return False


@pytest.fixture
def page(server: str) -> Iterator[Page]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=QUIET.split())
        page = browser.new_page(viewport={"width": 1600, "height": 1000})
        page.set_default_timeout(30_000)
        yield page
        browser.close()


def materialize(page: Page, server: str, asset: str, *choices: str) -> None:
    """Open the asset, press Materialize, choose partitions in the dialog, launch."""
    page.goto(f"{server}/assets/{asset}")
    page.get_by_role("button", name="Materialize").first.click()
    if not choices:
        expect(page.get_by_text("Launched run")).to_be_visible()
        return
    for choice in choices:
        page.get_by_text("Select a partition or create one").first.click()
        box = page.get_by_placeholder("Filter partitions")
        box.fill(choice)
        # Of what lies over the page: the page behind names partitions, too, and is there before the list is.
        page.locator(".bp5-portal").get_by_text(choice, exact=True).locator("visible=true").last.click()
        page.keyboard.press("Escape")
        expect(box).to_have_count(0)  # the next box opens only once this one is gone
    page.get_by_role("button", name="Launch").last.click()
    expect(page.get_by_role("button", name="Launch")).to_have_count(0)


def materialize_and_wait(study: Checkout, page: Page, server: str, stage: str, key: str | None = None) -> None:
    """Materialize by clicks and wait until the table (or report) is written anew."""
    if stage in TABLES:
        file = Workspace.open(study.workspace).tables.path(TABLES[stage], partition_of(stage, key))
    else:
        file = study.workspace / "reports" / ".state" / f"{stage}.json"
    before = file.stat().st_mtime_ns
    materialize(page, server, stage, *(key.split("|") if key else ()))
    wait_until(lambda: file.stat().st_mtime_ns > before, RUN_SECONDS, f"{stage} {key} is made from the UI")


def test_a_correction_is_driven_from_the_ui_and_nothing_leaves_the_machine(
    study: Checkout, server: str, page: Page, tmp_path: Path
) -> None:
    hosts = set[str]()
    page.on("request", lambda request: hosts.add(request.url.split("/")[2]))
    page.goto(f"{server}/asset-groups")
    shown = ("report", "scoring", "evaluation", "benchmark")
    for group in shown:  # opens its list of assets
        page.get_by_text(group, exact=True).first.dblclick()
    page.screenshot(path=tmp_path / "graph.png")
    graph = defs.resolve_asset_graph()
    for key in graph.get_all_asset_keys():
        if graph.get(key).group_name in shown:
            expect(page.get_by_text(key.to_user_string(), exact=True).first).to_be_attached()

    study.correct("plinko-0003", ill_posed_question="Why is the little triangle beside the board singing?")
    rows = len(study.ledger_rows("answers"))

    for stage, key in (("scene_specs", "plinko"), ("videos", "plinko"), ("items", "chaotic_ill_posed")):
        assert f"    {key}: " in study.traps("status", EXPERIMENT).out  # stale, with the reason
        materialize_and_wait(study, page, server, stage, key)
    cell = "chaotic_ill_posed|prior__json__run1"
    materialize_and_wait(study, page, server, "responses", cell)
    assert len(study.ledger_rows("answers")) == rows + 1  # one item touched, one cell materialized
    materialize_and_wait(study, page, server, "contact_sheet")
    materialize_and_wait(study, page, server, "items", "chaotic")  # the other dataset of the category: nothing changes
    status = study.traps("status", EXPERIMENT).out
    for stage, fresh in (("scene_specs", 4), ("videos", 4), ("items", 4), ("responses", 24 - 5), ("contact_sheet", 1)):
        assert re.search(rf"^{stage} +{fresh} ", status, re.MULTILINE), status
    assert hosts == {server.removeprefix("http://")}
