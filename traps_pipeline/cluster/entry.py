"""Offer this room to others by one name; see `storage/several_hosts.py`.

Modules above the storage are imported in functions: importing them opens the study.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from traps_pipeline.cluster.places import open_store
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    import dagster as dg

    from traps_pipeline.pipeline.runs import Runs

__all__ = ["dagster_yaml", "open_store", "runs", "sensors"]


def dagster_yaml(workspace: Workspace) -> dict[str, Any]:
    """See `SeveralHosts`."""
    from traps_pipeline.cluster import shared_history

    return shared_history.dagster_yaml(workspace)


def runs(workspace: Workspace, instance: dg.DagsterInstance, options: argparse.Namespace) -> Runs:
    """See `SeveralHosts`."""
    from traps_pipeline.cluster.ray_runs import RayRuns, require_cluster

    require_cluster(workspace, instance)
    runs = RayRuns(instance, workspace, options.runs, options.gpus, options.on_interrupt, options.cpus)
    runs.wait_for_earlier()
    return runs


def sensors() -> Sequence[dg.SensorDefinition]:
    """See `SeveralHosts`."""
    from traps_pipeline.cluster.lost_runs import end_lost_runs
    from traps_pipeline.cluster.requests import start_requested_runs

    return [start_requested_runs, end_lost_runs]
