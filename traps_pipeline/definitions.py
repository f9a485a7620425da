"""The code location: `dagster ... -m traps_pipeline.definitions`."""

import dagster as dg

from traps_pipeline import defs as declared
from traps_pipeline.base.paths import require_root
from traps_pipeline.base.redaction import redact_tracebacks
from traps_pipeline.orchestration.automation import jobs, sensors
from traps_pipeline.orchestration.graph import DECLARED
from traps_pipeline.orchestration.schemes import study_here
from traps_pipeline.orchestration.stage import WorkspaceResource
from traps_pipeline.storage.several_hosts import several_hosts
from traps_pipeline.storage.workspace import Workspace

redact_tracebacks()


def _assets() -> list[dg.AssetsDefinition | dg.SourceAsset]:
    """The assets that `defs/` declares, from Dagster's loader, without the groups that the study does not use."""
    require_root()
    found = dg.load_definitions_from_package_module(declared).assets or ()
    shown = {one.spec.key for one in DECLARED.values()}
    assets = [one for one in found if isinstance(one, dg.AssetsDefinition | dg.SourceAsset)]
    return [one for one in assets if one.key in shown]


def _sensors() -> list[dg.SensorDefinition]:
    workspace = study_here()
    return [*sensors(), *(several_hosts().sensors() if workspace is not None and workspace.is_on_cluster else ())]


# Runs are in process: a run costs 2 s instead of 5, and rendering and calls use their own processes and connections.
defs = dg.Definitions(
    assets=_assets(),
    jobs=jobs(),
    sensors=_sensors(),
    executor=dg.in_process_executor,
    resources={"workspace": WorkspaceResource(root=str(Workspace.default_place()))},
)
