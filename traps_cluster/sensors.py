"""Define the sensors of Dagster's daemon on the head: one starts runs, one ends lost ones.

Any host requests a run by an observation in the shared history, which outlives the command, the daemon and the head. A
sensor turns each request into a run in Dagster's queue, once: its `run_key` is the request's name.

A run that has left the queue is STARTING until its process reports that it has begun, for as long as all hosts are
busy: Dagster's own limit (`start_timeout_seconds`) would end healthy runs. Ray knows whether a run waits for a host;
Dagster asks Ray only about runs that have begun, and a sensor about the others.
"""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Mapping, Sequence

import dagster as dg

from traps_cluster.bucket import Bucket
from traps_cluster.history import fetch, logs_folder
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.pipeline.translation import asset_key
from traps_pipeline.storage.workspace import Workspace

REQUEST_TAG = "traps/request"
REQUESTS_S, LOST_RUNS_S = 1, 15  # intervals of the sensors; Dagster's daemon evaluates sensors every 5 s
AT_ONCE = 100  # requests turned into runs per tick
LOST_S = 90  # a run unknown to Ray for so long was never submitted, or Ray's head lost it
_UNSTARTED = [dg.DagsterRunStatus.STARTING, dg.DagsterRunStatus.NOT_STARTED]


def submit(instance: dg.DagsterInstance, study: str, stages: Sequence[str], tags: Mapping[str, str]) -> str:
    """Request a run of stages; return the request's name, the run's `REQUEST_TAG`."""
    name = secrets.token_hex(8)
    body = {"name": name, "stages": [*stages], "tags": dict(tags)}
    instance.report_runless_asset_event(dg.AssetObservation(_key(study), metadata={"run": json.dumps(body)}))
    return name


def _key(study: str) -> dg.AssetKey:
    return dg.AssetKey([study, "requested_runs"])


@dg.sensor(
    asset_selection=dg.AssetSelection.all(),
    minimum_interval_seconds=REQUESTS_S,
    default_status=dg.DefaultSensorStatus.RUNNING,
    description="Puts the runs into the queue that `traps run --cluster` asks for.",
)
def start_requested_runs(context: dg.SensorEvaluationContext) -> dg.SensorResult:
    """Create requested runs; the cursor holds a place per study of a shared history."""
    study, cursors, requests = Workspace.open().study.name, json.loads(context.cursor or "{}"), list[dg.RunRequest]()
    result = context.instance.fetch_observations(_key(study), AT_ONCE, cursors.get(study), ascending=True)
    for record in result.records:
        assert record.asset_observation is not None, "only observations are fetched"
        body = json.loads(str(record.asset_observation.metadata["run"].value))
        name, selection = body["name"], [asset_key(stage) for stage in body["stages"]]
        requests.append(dg.RunRequest(name, asset_selection=selection, tags={**body["tags"], REQUEST_TAG: name}))
    return dg.SensorResult(requests, cursor=json.dumps(cursors | {study: result.cursor}))


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
    minimum_interval_seconds=LOST_RUNS_S,
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
