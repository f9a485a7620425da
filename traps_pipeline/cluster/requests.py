"""Request runs on any host; Dagster's daemon on the head creates them.

A request is an observation in the shared history, so it outlives the command, the daemon and the head. A sensor turns
each into a run in Dagster's queue, once: its `run_key` is the request's name.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Mapping, Sequence
from functools import cache

import dagster as dg

from traps_pipeline.pipeline.translation import asset_key
from traps_pipeline.storage.workspace import Workspace

REQUEST_TAG = "traps/request"
INTERVAL_S = 1  # Dagster's daemon evaluates sensors every 5 s
AT_ONCE = 100  # requests turned into runs per tick
_BODY = "run"


def submit(instance: dg.DagsterInstance, study: str, stages: Sequence[str], tags: Mapping[str, str]) -> str:
    """Request a run of stages; return the request's name, the run's `REQUEST_TAG`."""
    name = secrets.token_hex(8)
    body = {"name": name, "stages": [*stages], "tags": dict(tags)}
    instance.report_runless_asset_event(dg.AssetObservation(_key(study), metadata={_BODY: json.dumps(body)}))
    return name


def _key(study: str) -> dg.AssetKey:
    return dg.AssetKey([study, "requested_runs"])


@cache
def _study_here() -> str:
    return Workspace.open().study.name


def _run_request(record: dg.EventLogRecord) -> dg.RunRequest:
    assert record.asset_observation is not None, "only observations are fetched"
    body = json.loads(str(record.asset_observation.metadata[_BODY].value))
    selection = [asset_key(name) for name in body["stages"]]
    return dg.RunRequest(body["name"], asset_selection=selection, tags={**body["tags"], REQUEST_TAG: body["name"]})


@dg.sensor(
    asset_selection=dg.AssetSelection.all(),
    minimum_interval_seconds=INTERVAL_S,
    default_status=dg.DefaultSensorStatus.RUNNING,
    description="Puts the runs into the queue that `traps run --cluster` asks for.",
)
def start_requested_runs(context: dg.SensorEvaluationContext) -> dg.SensorResult:
    """Create requested runs; the cursor holds a place per study of a shared history."""
    study, cursors = _study_here(), json.loads(context.cursor or "{}")
    result = context.instance.fetch_observations(_key(study), AT_ONCE, cursors.get(study), ascending=True)
    cursors[study] = result.cursor
    return dg.SensorResult([*map(_run_request, result.records)], cursor=json.dumps(cursors))
