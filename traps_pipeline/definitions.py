"""The code location: `dagster ... -m traps_pipeline.definitions`."""

import os

import dagster as dg

import traps_pipeline.defs  # noqa: F401 - declares the graph
from traps_pipeline.base.paths import require_root
from traps_pipeline.base.redaction import redact_tracebacks
from traps_pipeline.orchestration.assets import WorkspaceResource, assets_of
from traps_pipeline.orchestration.automation import jobs, sensors
from traps_pipeline.orchestration.graph import the_graph
from traps_pipeline.orchestration.lost_runs import lost_runs
from traps_pipeline.storage.workspace import RAY, Workspace

redact_tracebacks()
require_root()


def _sensors() -> list[dg.SensorDefinition]:
    is_on_cluster = isinstance(Workspace.default_place(), str) and bool(os.environ.get(RAY))
    return [*sensors(), *([lost_runs] if is_on_cluster else [])]


# Runs are in process: a run costs 2 s instead of 5, and rendering and calls use their own processes and connections.
defs = dg.Definitions(
    assets=assets_of(the_graph()),
    jobs=jobs(),
    sensors=_sensors(),
    executor=dg.in_process_executor,
    resources={"workspace": WorkspaceResource(root=str(Workspace.default_place()))},
)
