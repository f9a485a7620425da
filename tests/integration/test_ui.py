"""Dagster's UI in a real browser: everything from one button, ranges, corrections that are followed, damage shown."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.build.network import entry, experiment
from tests.conftest import CLIP_CACHE, EXPERIMENT, SMALL, Checkout, make_checkout
from tests.pages import a_browser, patient
from tests.providers.server import Provider
from tests.providers.servers import closed_port
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.pipeline.automation import INTERVAL_S
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.tables import Table
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
TOKEN = "token-of-the-user-interface"
NOWHERE = "about:blank"  # while a test waits: a page of Dagster's polls, and draws its graph, for as long as it is open
RUN_SECONDS = 600  # nine times what a busy machine of two cores takes
PAUSE_S = 3


def wait_until(condition: Callable[[], bool], seconds: float, what: str, *, pause_s: float = 0.3) -> None:
    """pause_s: between two looks; one that starts a command would keep a core from what is waited for."""
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, f"not within {seconds} s: {what}"
        time.sleep(pause_s)


@contextmanager
def serving(study: Checkout) -> Iterator[str]:
    """`make ui`'s command on a free port: web server and daemon of a study."""
    port = closed_port()
    command = (sys.executable, "-m", "traps_pipeline.cli", "ui", "--port", str(port), "--token", TOKEN)
    url, log = f"http://127.0.0.1:{port}", (study.workspace / "dagster-dev.log").open("w")
    # Its runs write to the same stream: a pipe that nobody reads would stop them.
    process = subprocess.Popen(
        command, cwd=study.root, env=study.environment, stdout=log, stderr=log, start_new_session=True
    )
    try:
        wait_until(lambda: _answers(f"{url}/server_info"), RUN_SECONDS, "the web server answers")
        yield url
    finally:
        os.killpg(process.pid, signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):  # on a busy machine Dagster's own processes may take longer
            process.wait(timeout=30)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        log.close()


def _answers(url: str) -> bool:
    try:
        asked = urllib.request.Request(url, headers={"Authorization": f"Bearer {TOKEN}"})
        return urllib.request.urlopen(asked, timeout=2).status == 200
    except OSError:
        return False


@contextmanager
def browsing(server: str) -> Iterator[Page]:
    with a_browser() as browser:
        page = patient(browser.new_page(viewport={"width": 1600, "height": 1000}))
        page.goto(f"{server}/?token={TOKEN}")
        page.goto(NOWHERE)
        expect.set_options(timeout=60_000)
        yield page


def launch_all(page: Page, address: str) -> None:
    """Press "Materialize all" on a page of the graph, choose all partitions, launch, and leave the page."""
    page.goto(address)
    page.get_by_role("button", name="Materialize all").first.click()
    page.get_by_role("button", name="All", exact=True).first.click()
    launch = page.get_by_role("button", name=re.compile(r"^Launch"))
    every, pressed = page.get_by_role("button", name="All", exact=True), 1

    def chosen() -> bool:  # a dimension's button may come later than the first one's
        nonlocal pressed
        while pressed < every.count():
            every.nth(pressed).click()
            pressed += 1
        return launch.last.is_enabled()

    wait_until(chosen, RUN_SECONDS, "all partitions are chosen")
    launch.last.click()
    expect(launch).to_have_count(0)
    page.goto(NOWHERE)


def launch_job(page: Page, server: str, job: str) -> None:
    """One click: a job, launched as it is."""
    page.goto(f"{server}/locations/traps_pipeline.definitions/jobs/{job}/playground")
    page.get_by_role("button", name="Launch Run").click()
    expect(page.get_by_role("button", name="Launch Run")).to_have_count(0)


def written(study: Checkout, name: str) -> dict[Path, int]:
    """When each file of a table, or the state of a report, was written."""
    tables = [*(study.workspace / "tables" / name).rglob("*.parquet")]
    files = tables or [study.workspace / "reports" / ".state" / f"{name}.json"]
    return {file: file.stat().st_mtime_ns for file in files if file.exists()}


@pytest.fixture
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Checkout:
    """A study of four scenarios with an empty history. Two fifths of one model's calls fail, whichever they are: that
    depends on the bytes of the clips, which may be those of this machine's cache."""
    monkeypatch.setenv("TRAPS_CLIP_CACHE", CLIP_CACHE)
    study = Checkout(make_checkout(tmp_path / "checkout"), tmp_path / "study")
    shutil.copytree(SMALL.parent, study.root / "tests" / "experiments")
    registry = study.root / "assets" / "models.yaml"
    registry.write_text(registry.read_text().replace("failing: 0.05", "failing: 0.4"))
    study.traps("init", "tests/experiments/four.yaml").ok()
    return study


@pytest.mark.promise
def test_materialize_all_goes_from_an_empty_history_to_the_report(fresh: Checkout) -> None:
    hosts = set[str]()
    with serving(fresh) as server, browsing(server) as page:
        page.on("request", lambda request: hosts.add(request.url.split("/")[2]))
        launch_all(page, f"{server}/asset-groups")
        wait_until(lambda: bool(written(fresh, "report_page")), 3 * RUN_SECONDS, "the report is made from one click")
        assert hosts == {server.removeprefix("http://")}
    cells = Workspace.open(fresh.workspace).tables.read_all(RESPONSES, ["dataset", "model"])
    assert set(cells["model"]) == {"oracle", "flaky"}  # all of the study's, and of the registry no other
    assert len(written(fresh, "responses")) == 4 * 2  # datasets x models
    # The unreliable model's failed calls are told; all the rest is made.
    assert re.search(r"'failed': .*\d", failures(fresh, RESPONSES))


def stale(study: Checkout) -> list[str]:
    """Stages of which something is stale or missing."""
    stages = json.loads(study.traps("status", EXPERIMENT, "--json").out)["stages"]
    return [row["stage"] for row in stages if row["stale"] or row["missing"]]


def test_a_correction_is_followed_alone_where_it_is_free_and_by_one_click_where_it_is_paid(own_study: Checkout) -> None:
    study, question = own_study, "Why is the little triangle beside the board singing?"
    tables = Workspace.open(study.workspace).tables
    rows, before = (
        len(study.ledger_rows("answers")),
        {name: written(study, name) for name in ("metrics", "report_page")},
    )

    def followed() -> bool:
        return question in [*tables.read_all(ITEMS, ["question"], dataset="chaotic_ill_posed")["question"]]

    with serving(study) as server, browsing(server) as page:
        time.sleep(INTERVAL_S / 3)  # the daemon has seen everything current
        study.correct("plinko-0003", ill_posed_question=question)
        wait_until(followed, 20 * INTERVAL_S, "free stages follow a correction")
        time.sleep(2 * INTERVAL_S)
        assert len(study.ledger_rows("answers")) == rows  # nothing is asked before the click
        launch_job(page, server, "evaluation")
        below = "what hangs on the answers follows alone"
        wait_until(lambda: all(written(study, name) != then for name, then in before.items()), RUN_SECONDS, below)
        assert len(study.ledger_rows("answers")) == rows + 3 * 2  # one item, of each model under each regime
        # Labels of confabulations are asked by the job `scoring`; all else is current again.
        current = "everything that was asked for is current"
        wait_until(lambda: {*stale(study)} <= {"confabulation"}, RUN_SECONDS, current, pause_s=PAUSE_S)


# What failed results of an asset's check `current` say, newest first.
FAILURES = """
import sys
import dagster as dg
key = dg.AssetCheckKey(dg.AssetKey(sys.argv[1]), "current")
with dg.DagsterInstance.get() as history:
    for record in history.event_log_storage.get_asset_check_execution_history(key, limit=50):
        if record.event is not None and record.status.value == "FAILED":
            print(record.event.dagster_event.asset_check_evaluation_data.metadata)
"""


def failures(study: Checkout, table: Table) -> str:
    return study.python("-c", FAILURES, table.name).out


# As Dagster's pages send them.
TERMINATE = """mutation Terminate($runIds: [String!]!, $terminatePolicy: TerminateRunPolicy) {
  terminateRuns(runIds: $runIds, terminatePolicy: $terminatePolicy) {
    ... on TerminateRunsResult { terminateRunResults { __typename } }
  }
}"""
LAUNCH = """mutation LaunchPipelineExecution($executionParams: ExecutionParams!) {
  launchPipelineExecution(executionParams: $executionParams) { __typename }
}"""
RUNS = "query { runsOrError { ... on Runs { results { runId status pipelineName } } } }"
LOCATION = {"repositoryLocationName": "traps_pipeline.definitions", "repositoryName": "__repository__"}


def graphql(server: str, query: str, **variables: object) -> dict:
    headers = {"Authorization": f"Bearer {TOKEN}", "Content-Type": "application/json"}
    body = json.dumps({"query": query, "variables": variables}).encode()
    with urllib.request.urlopen(urllib.request.Request(f"{server}/graphql", body, headers), timeout=120) as response:
        return json.load(response)["data"]


def runs_by_job(server: str) -> dict[str, list[tuple[str, str]]]:
    """Id and status of all runs, by job."""
    found: dict[str, list[tuple[str, str]]] = {}
    for run in graphql(server, RUNS)["runsOrError"]["results"]:
        found.setdefault(run["pipelineName"], []).append((run["runId"], run["status"]))
    return found


@pytest.mark.parametrize("policy", ["SAFE_TERMINATE", "MARK_AS_CANCELED_IMMEDIATELY"])
@pytest.mark.parametrize("is_job", [False, True], ids=["traps run", "job"])
def test_terminating_a_run_in_the_pages_sends_no_further_request_and_starts_no_further_run(
    unasked: Checkout, provider: Provider, is_job: bool, policy: str
) -> None:
    provider.configure(latency_s=8.0)
    model = entry("image-model", "images").replace("limits: {", "limits: {concurrency: 8, ")
    path = experiment(unasked, provider, [model])
    unasked.traps("run", path, "--no-preflight", "--until", "items", "--budget-usd", "100").ok()
    with serving(unasked) as server:
        earlier = {run for runs in runs_by_job(server).values() for run, _ in runs}

        def started(job: str) -> dict[str, str]:
            return {run: status for run, status in runs_by_job(server).get(job, []) if run not in earlier}

        command = None
        if is_job:
            selector = LOCATION | {"pipelineName": "everything"}
            graphql(server, LAUNCH, executionParams={"mode": "default", "selector": selector, "runConfigData": {}})
        else:
            command = unasked.start(sys.executable, "-m", "traps_pipeline.cli", "run", path, "--no-preflight")
        wait_until(lambda: provider.stats()["in_flight"] == 8, RUN_SECONDS, "the first requests are sent")
        [nested] = started("__ASSET_JOB")
        sent = provider.stats()["requests"]
        # Dagster's server may answer that it failed, having started no process for the run: it marks it all the same.
        graphql(server, TERMINATE, runIds=[nested], terminatePolicy=policy)
        if command is not None:
            out, err = command.communicate(timeout=RUN_SECONDS)
            assert command.returncode == 130, out + err
        else:
            ended = ["CANCELED"]
            wait_until(lambda: [*started("everything").values()] == ended, RUN_SECONDS, "the job is canceled, too")
        assert started("__ASSET_JOB") == {nested: "CANCELED"}
        assert provider.stats()["requests"] == sent
