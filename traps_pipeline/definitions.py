"""The code location: `dagster ... -m traps_pipeline.definitions`."""

from pathlib import Path

import dagster as dg

from traps_pipeline.orchestration.automation import JOBS, SENSORS
from traps_pipeline.orchestration.stage import WorkspaceResource
from traps_pipeline.paths import require_checkout
from traps_pipeline.storage.workspace import Workspace

# In process: a run costs 2 s instead of 5, and rendering and asking bring their own processes and connections.
defs = dg.Definitions.merge(
    dg.load_from_defs_folder(project_root=require_checkout()),
    dg.Definitions(
        jobs=JOBS,
        sensors=SENSORS,
        executor=dg.in_process_executor,
        resources={"workspace": WorkspaceResource(root=str(Workspace.default_root()))},
    ),
)
