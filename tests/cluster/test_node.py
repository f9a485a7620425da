"""What a node does before a run begins: it refuses a run of a host with other code, and opens its own study."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import dagster as dg
import pytest

from tests.conftest import ROOT
from tests.postgres import Postgres
from traps_cluster.history import HISTORY, LOGS
from traps_cluster.node import CODE, REFUSED_TAG, code_here
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import RAY, VARIABLE, Workspace

pytestmark = pytest.mark.slow


@dg.job
def nothing() -> None: ...


@pytest.fixture
def workspace(tmp_path: Path, postgres: Postgres, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    """A study in a shared folder, whose history lies in PostgreSQL."""
    for name in ("dagster_ray", "dagster_postgres"):
        pytest.importorskip(name, reason="the extra `cluster` is not installed (`make cluster-setup`)")
    for name, value in ((HISTORY, ""), (LOGS, ""), (RAY, "http://127.0.0.1:1"), ("LAB_DATABASE", postgres.address())):
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("DAGSTER_HOME", raising=False)
    return Workspace.create(tmp_path / "study", Study(database="LAB_DATABASE"))


def node(run_id: str, **exported: str) -> subprocess.CompletedProcess[str]:
    """What Ray starts, with a command of Dagster's that only prints."""
    command = [sys.executable, "-P", "-m", "traps_cluster.node", run_id, "--version"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), **exported}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def test_a_run_of_other_code_fails_with_the_nodes_sentence_and_one_of_the_same_code_begins(
    workspace: Workspace, tmp_path: Path
) -> None:
    here, theirs = {VARIABLE: str(workspace.root)}, json.loads(code_here()) | {"numpy": "1.0"}
    with dagster_history(workspace) as instance:
        run = instance.create_run_for_job(nothing)
        refused = node(run.run_id, **here, **{CODE: json.dumps(theirs)})
        failed = instance.get_run_by_id(run.run_id)
        assert failed is not None and failed.status == dg.DagsterRunStatus.FAILURE and REFUSED_TAG in failed.tags
        messages = [entry.dagster_event.message for entry in instance.all_logs(run.run_id) if entry.dagster_event]
    (said,) = (message for message in messages if message and "numpy" in message)
    assert refused.returncode == 1 and said in refused.stderr and " 1.0 " in said
    begun = node(run.run_id, **here, **{CODE: code_here()})
    assert begun.returncode == 0 and dg.__version__ in begun.stdout
    lost = node(run.run_id, **{VARIABLE: str(tmp_path / "elsewhere"), CODE: code_here()})
    assert lost.returncode == 1 and lost.stderr.startswith(f"{tmp_path / 'elsewhere'}/study.yaml: ")
