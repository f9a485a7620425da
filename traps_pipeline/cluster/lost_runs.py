"""Detect runs that will never begin, as opposed to those that wait for a host.

A run that has left the queue is STARTING until its process reports that it has begun. On a cluster that takes as long
as all hosts are busy, or as a new one needs to start, so Dagster's own limit on it (`start_timeout_seconds`) would end
healthy runs. Ray knows whether a run waits for a host; Dagster asks Ray only about runs that have begun, and a sensor
about the others.
"""

from __future__ import annotations

import time

import dagster as dg

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cluster.bucket import Bucket
from traps_pipeline.cluster.logs import fetch
from traps_pipeline.cluster.shared_history import logs_folder
from traps_pipeline.storage.workspace import Workspace

LOST_S = 90  # a run unknown to Ray for so long was never submitted, or Ray's head lost it
INTERVAL_S = 15
_UNSTARTED = [dg.DagsterRunStatus.STARTING, dg.DagsterRunStatus.NOT_STARTED]


def fail_lost_runs(instance: dg.DagsterInstance, lost_s: float = LOST_S) -> list[str]:
    """Fail runs that will never begin; return ids. Raises OSError if Ray is silent."""
    failed = list[str]()
    for record in instance.get_run_records(dg.RunsFilter(statuses=_UNSTARTED)):
        run, is_old = record.dagster_run, time.time() - record.update_timestamp.timestamp() > lost_s
        if reason := _why_lost(instance, run, is_old=is_old):
            now = instance.get_run_by_id(run.run_id)
            if now is not None and now.status == run.status:  # it may have begun in the meantime
                instance.report_run_failed(now, f"the run will not begin: {reason}")
                failed.append(run.run_id)
    return failed


def _why_lost(instance: dg.DagsterInstance, run: dg.DagsterRun, *, is_old: bool) -> str:
    if run.status == dg.DagsterRunStatus.NOT_STARTED:
        return "what created it ended before it was in the queue" if is_old else ""
    health = instance.run_launcher.check_run_worker_health(run)
    if health.status.name in ("FAILED", "SUCCESS"):
        return f"its job on Ray has ended ({health.msg})"
    return f"Ray knows nothing of its job ({health.msg})" if health.status.name == "UNKNOWN" and is_old else ""


@dg.sensor(
    minimum_interval_seconds=INTERVAL_S,
    default_status=dg.DefaultSensorStatus.RUNNING,
    description="Marks runs as failed that wait for no host any more, since Ray's head lost them or their job ended "
    "before they began; those that wait for a host go on waiting. Fetches what runs print from the study's store.",
)
def end_lost_runs(context: dg.SensorEvaluationContext) -> dg.SkipReason:
    """Mark runs that a cluster has lost as failed."""
    workspace = Workspace.open()
    try:
        failed = fail_lost_runs(context.instance)
        if isinstance(workspace.place, str):
            fetch(Bucket(workspace.place), logs_folder(workspace))
    except (OSError, TrapsError) as error:
        return dg.SkipReason(f"Ray's head or the store does not answer: {error}")
    return dg.SkipReason(f"lost runs: {', '.join(failed)}" if failed else "no run was lost")
