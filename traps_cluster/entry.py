"""Offer this room to others by one name; see `storage/several_hosts.py`.

Modules above the storage are imported in functions: importing them opens the study.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from traps_cluster.history import dagster_yaml
from traps_cluster.objects import open_store
from traps_cluster.postgres import open_ledger
from traps_pipeline.storage.place import Place
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    import dagster as dg

    from traps_pipeline.pipeline.runs import Runs

__all__ = ["dagster_yaml", "move", "open_ledger", "open_store", "runs", "sensors"]


def runs(workspace: Workspace, instance: dg.DagsterInstance, options: Any) -> Runs:
    """See `SeveralHosts`."""
    from traps_cluster.ray_runs import RayRuns, require_cluster

    require_cluster(workspace, instance)
    runs = RayRuns(instance, workspace, options.runs, options.gpus, options.on_interrupt, options.cpus)
    runs.wait_for_earlier()
    return runs


def move(workspace: Workspace, address: Place) -> int:
    """See `SeveralHosts`."""
    from traps_cluster.store_move import move_to_store

    return move_to_store(workspace, address)


def sensors() -> Sequence[dg.SensorDefinition]:
    """See `SeveralHosts`."""
    from traps_cluster.sensors import end_lost_runs, start_requested_runs

    return [start_requested_runs, end_lost_runs]
