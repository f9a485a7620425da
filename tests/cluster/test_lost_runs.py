"""Which runs Ray will never begin, and which only wait for a host: asked of a real head that has no CPUs."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import dagster as dg
import pytest
import yaml
from dagster._core.events import EngineEventData
from dagster._core.launcher import LaunchRunContext
from dagster._utils.error import serializable_error_info_from_exc_info

from tests.remedies.remedied import remedied
from traps_cluster.history import dagster_yaml
from traps_cluster.ray_runs import RESOURCES_TAG, STUDY_TAG, RayRuns
from traps_cluster.sensors import fail_lost_runs
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import RAY, Workspace

CAN_END_S = 300


@dg.op
def nothing() -> None: ...


@dg.job
def study() -> None:
    nothing()


@contextmanager
def history(folder: Path, ray: str) -> Iterator[dg.DagsterInstance]:
    """A history whose runs go to that head."""
    folder.mkdir()
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv(RAY, ray)
        patched.setenv("LAB_DATABASE", "postgresql://user:secret@host/db")
        settings = dagster_yaml(Workspace(folder, Study(name="lab", database="LAB_DATABASE")))
        said = {"run_launcher": settings["run_launcher"], "telemetry": {"enabled": False}}
    (folder / "dagster.yaml").write_text(yaml.safe_dump(said))
    with dg.DagsterInstance.from_config(str(folder)) as instance:
        yield instance


def launched(instance: dg.DagsterInstance) -> dg.DagsterRun:
    """A run that has left the queue, as Dagster's daemon tells it before it is submitted."""
    origin = dg.reconstructable(study).get_python_origin()
    run = instance.create_run_for_job(study, tags={STUDY_TAG: "lab", RESOURCES_TAG: "{}"}, job_code_origin=origin)
    starting = dg.DagsterEvent(event_type_value=dg.DagsterEventType.PIPELINE_STARTING.value, job_name="study")
    instance.report_dagster_event(starting, run.run_id)
    return run


def state(instance: dg.DagsterInstance, run: dg.DagsterRun) -> str:
    """What Dagster knows of it."""
    found = instance.get_run_by_id(run.run_id)
    assert found is not None
    return found.status.value


def told(instance: dg.DagsterInstance, run: dg.DagsterRun) -> str:
    """What the command that waits for it says when it has ended."""
    watching = RayRuns(instance, Workspace(Path("/"), Study(name="lab")), 1, 0.0, "leave")
    ((problem,),) = (ran.problems for ran in watching._watch([], [run.run_id]))
    return problem


@pytest.mark.slow
def test_a_run_that_waits_for_a_host_goes_on_waiting_and_one_that_waits_for_nothing_fails(tmp_path: Path) -> None:
    pytest.importorskip("dagster_ray", reason="the extra `cluster` is not installed")
    from bench.cluster_launcher import Cluster

    plain = {key: value for key, value in os.environ.items() if not key.startswith(("RAY_", "DAGSTER_", "TRAPS_"))}
    with ExitStack() as opened:
        # Not below tmp_path: the name of a Unix socket holds 107 characters.
        folder = opened.enter_context(TemporaryDirectory(prefix="ray-", ignore_cleanup_errors=True))
        cluster = Cluster(Path(folder), plain)
        opened.callback(lambda: cluster.signal("head", signal.SIGKILL))
        instance = opened.enter_context(history(tmp_path / "history", f"http://127.0.0.1:{cluster.dashboard}"))
        launcher: Any = instance.run_launcher
        waiting, ended, unknown, left = (launched(instance) for _ in range(4))
        never_queued = instance.create_run_for_job(study)

        def launch() -> None:
            launcher.launch_run(LaunchRunContext(waiting, workspace=None))

        remedied(launch, "traps_cluster.launcher", cluster.start_head)
        from ray.job_submission import JobSubmissionClient  # pyright: ignore[reportMissingImports]

        client = JobSubmissionClient(launcher.address)
        client.submit_job(submission_id=f"dagster-run-{ended.run_id}", entrypoint="false")  # takes no CPU
        until = time.monotonic() + CAN_END_S
        while not client.get_job_status(f"dagster-run-{ended.run_id}").is_terminal():
            assert time.monotonic() < until
            time.sleep(0.5)
        instance.report_run_canceled(left)
        assert fail_lost_runs(instance, lost_s=3600) == [ended.run_id]  # the others may be submitted yet
        assert {*fail_lost_runs(instance, lost_s=0)} == {unknown.run_id, never_queued.run_id}
        assert [state(instance, run) for run in (waiting, left)] == ["STARTING", "CANCELED"]
        assert all(name in told(instance, unknown) for name in (unknown.run_id[:8], "404"))  # Ray has no such job
        cluster.signal("head", signal.SIGKILL)
        with pytest.raises(OSError, match=r"Max retries|Connection"):
            fail_lost_runs(instance, lost_s=0)
        assert state(instance, waiting) == "STARTING"


@pytest.mark.promise
def test_a_command_says_why_a_run_could_not_be_started() -> None:
    why = "Ray's head does not answer the host here"
    with dg.DagsterInstance.ephemeral() as instance:
        run = instance.create_run_for_job(study)
        try:
            raise TrapsError(why)
        except TrapsError:
            error = serializable_error_info_from_exc_info(sys.exc_info())
        instance.report_engine_event("Caught an unrecoverable error", run, EngineEventData.engine_error(error))
        instance.report_run_failed(run)  # as Dagster's daemon does when a launcher raises
        assert all(name in told(instance, run) for name in (run.run_id[:8], f"({why})", "`traps ui`"))
