"""Two hosts with folders of their own ask for one study: its answers, votes and money lie in one database."""

from __future__ import annotations

import os
import re
import secrets
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bench.equality import main as compare
from tests.build.network import ITEMS, ask, entry, experiment, responses, settled
from tests.conftest import Checkout, copy_workspace
from tests.ledger.conftest import VARIABLE
from tests.postgres import Postgres
from tests.providers.server import Provider

pytestmark = pytest.mark.slow


WANTED = 2 * ITEMS


@pytest.fixture
def hosts(
    unasked: Checkout,
    provider: Provider,
    postgres: Postgres,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> tuple[Checkout, Checkout]:
    """Two checkouts of one study, whose clips and items each has made, and whose ledger lies in the database."""
    monkeypatch.setenv(VARIABLE, postgres.address())
    file = unasked.workspace / "study.yaml"
    text = re.sub(r"(?m)^name: .*$", f"name: study-{secrets.token_hex(4)}", file.read_text())
    file.write_text(f"{text}database: {VARIABLE}\n")
    copy_workspace(unasked.workspace, tmp_path / "other")
    return unasked, Checkout(unasked.root, tmp_path / "other")


def start(host: Checkout, path: Path, budget_usd: str) -> subprocess.Popen[str]:
    command = ("run", str(path), "--no-preflight", "--until", "responses", "--budget-usd", budget_usd)
    return host.start(sys.executable, "-m", "traps_pipeline.cli", *command)


def test_hosts_ask_each_call_once_and_one_goes_on_where_another_is_killed(
    hosts: tuple[Checkout, Checkout], provider: Provider
) -> None:
    one, two = hosts
    provider.configure(latency_s=0.2)
    path = experiment(one, provider, [entry("image-model", "images")])
    killed, other = start(one, path, "100"), start(two, path, "100")
    while provider.stats()["answered_in_full"] < WANTED // 4:
        assert killed.poll() is None and other.poll() is None
        time.sleep(0.05)
    os.killpg(killed.pid, signal.SIGKILL)
    killed.communicate()
    out, err = other.communicate(timeout=600)
    assert other.returncode == 0, out + err
    assert len(responses(two)) == WANTED
    sent = provider.stats()["answered_in_full"]
    assert WANTED <= sent <= WANTED + 24  # those in flight at the kill
    again = ask(one, path)
    assert (again.code, again.counts()["answers"]) == (0, 0), again.err
    assert provider.stats()["answered_in_full"] == sent
    assert compare(one.workspace, two.workspace) == 0
    assert one.ledger_rows("answers") == []  # nothing of it lies in a folder
    one.traps("study", "export-ledger", str(one.workspace / "ledger" / "ledger.sqlite")).ok()
    rows = settled(one)
    assert len(rows) == len({row["key"] for row in rows}) == WANTED
    assert one.in_flight_usd() >= (sent - WANTED) * min(row["cost_usd"] for row in rows)  # what nobody has is spent too


def test_one_budget_holds_for_both_and_the_next_run_goes_on(
    hosts: tuple[Checkout, Checkout], provider: Provider
) -> None:
    one, two = hosts
    provider.configure(latency_s=0.05, usd_a_token=[1e-6, 1e-5])  # as the entry says
    path = experiment(one, provider, [entry("image-model", "images")])
    running = [start(host, path, "0.4") for host in (one, two)]  # all answers cost about $0.70
    said = [process.communicate(timeout=600) for process in running]
    assert [process.returncode for process in running] == [4, 4], said
    assert all("$0.40" in err and "--budget-usd" in err for _, err in said), said
    assert 0 < provider.stats()["billed_usd"] <= 0.4
    ask(two, path, "--budget-usd", "5").ok()
    assert len(responses(two)) == WANTED == provider.stats()["answered_in_full"]
