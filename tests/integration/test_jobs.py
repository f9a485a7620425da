"""Jobs from an empty study: each makes its part, shows the runs that it starts, and is stopped as a whole."""

from __future__ import annotations

import signal
import sys
import time
from pathlib import Path

import dagster as dg
import pytest

from tests.conftest import ROOT, Checkout
from traps_pipeline.definitions import defs
from traps_pipeline.pipeline.graph import JOB_GROUPS, the_graph
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.pipeline.runs import JOB_RUN_TAG, JOB_TAG, LocalRuns
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
EXECUTE = ("job", "execute", "-m", "traps_pipeline.definitions", "-j")


@pytest.fixture
def empty(tmp_path: Path) -> Checkout:
    """A study with an arm of which nothing is made."""
    study = Checkout(ROOT, tmp_path / "study")
    study.traps("init", "tests/experiments/with_arm.yaml").ok()
    return study


def runs_of(study: Checkout, monkeypatch: pytest.MonkeyPatch) -> list[dg.DagsterRun]:
    monkeypatch.setenv("DAGSTER_HOME", str(study.workspace / "dagster"))
    with dagster_history(Workspace.open(study.workspace)) as instance:
        return [*instance.get_runs()]


def test_every_job_succeeds_in_its_turn_from_an_empty_study(empty: Checkout, monkeypatch: pytest.MonkeyPatch) -> None:
    for job in [*(name for name in JOB_GROUPS if name != "mechanism"), "everything"]:
        executed = empty.dagster(*EXECUTE, job)
        assert executed.code == 0, f"{job}: {executed.out}{executed.err}"
    assert (empty.workspace / "reports" / "report.html").exists()
    runs = {run.run_id: run for run in runs_of(empty, monkeypatch)}
    assert {run.status for run in runs.values()} == {dg.DagsterRunStatus.SUCCESS}
    started = [run for run in runs.values() if JOB_TAG in run.tags]
    # Specs, clips and arms are one run, items another; then answers to verdicts; metrics, and what hangs on them.
    assert [runs[run.tags[JOB_RUN_TAG]].job_name for run in started[::-1]] == [
        *("benchmark", "benchmark", "evaluation", "scoring", "scoring"),
    ]
    assert all(run.parent_run_id is None for run in started)  # a run with a parent is a re-execution in the pages
    assert all(run.tags[JOB_TAG] == runs[run.tags[JOB_RUN_TAG]].job_name for run in started)


def test_a_job_that_is_stopped_leaves_no_failed_run_behind(empty: Checkout, monkeypatch: pytest.MonkeyPatch) -> None:
    process = empty.start(sys.executable, "-m", "dagster", *EXECUTE, "benchmark")
    while not [*(empty.workspace / "clips").rglob("*.mp4")]:
        assert process.poll() is None, process.communicate()
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    process.communicate()
    [started] = [run for run in runs_of(empty, monkeypatch) if JOB_TAG in run.tags]
    assert started.status == dg.DagsterRunStatus.CANCELED


def test_below_a_job_that_is_being_terminated_no_run_begins(tmp_path: Path) -> None:
    everything = defs.resolve_implicit_global_asset_job_def()
    with dg.DagsterInstance.local_temp(str(tmp_path)) as instance:
        parent = instance.add_run(dg.DagsterRun(job_name="everything", status=dg.DagsterRunStatus.CANCELING))
        runs = LocalRuns(instance, everything, parent=parent)
        with pytest.raises(KeyboardInterrupt):
            next(iter(runs.make([the_graph()["items"]], [("chaotic", "chaotic")], {})))
        assert [run.run_id for run in instance.get_runs()] == [parent.run_id]
