"""Define Dagster's code location: `dagster ... -m traps_pipeline.definitions`."""

import dagster as dg

import traps_pipeline.pipeline.stages  # noqa: F401 - declares the graph
from traps_pipeline.base.paths import require_root
from traps_pipeline.base.redaction import redact_tracebacks
from traps_pipeline.pipeline.assets import WorkspaceResource, assets_of
from traps_pipeline.pipeline.automation import jobs, sensors
from traps_pipeline.pipeline.graph import the_graph
from traps_pipeline.pipeline.schemes import study_here
from traps_pipeline.storage.several_hosts import several_hosts

redact_tracebacks()
require_root()


def _sensors() -> list[dg.SensorDefinition]:
    workspace = study_here()
    return [*sensors(), *(several_hosts().sensors() if workspace is not None and workspace.is_on_cluster else ())]


# Runs execute in process: 2 s per run instead of 5, and rendering and calls have their own processes and connections.
defs = dg.Definitions(
    assets=assets_of(the_graph()),
    jobs=jobs(),
    sensors=_sensors(),
    executor=dg.in_process_executor,
    resources={"workspace": WorkspaceResource()},
)
