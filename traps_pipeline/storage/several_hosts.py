"""Reach the package `traps_cluster`, which only several hosts need.

It is imported by name, and only if a study has a database that hosts share. Nothing else here imports it.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

from traps_pipeline.base.extras import require_extra

if TYPE_CHECKING:
    import dagster as dg

    from traps_pipeline.ledger.database import Database
    from traps_pipeline.storage.place import Place
    from traps_pipeline.storage.store import Store
    from traps_pipeline.storage.study import Study

_PACKAGE = "traps_cluster.entry"


class SeveralHosts(Protocol):
    """The interface of `traps_cluster`; `workspace` is always a `Workspace`."""

    def open_store(self, place: Place, root: Path, study: Study | None = None) -> Store | None:
        """Open a study with a database, in a shared folder or an object store.

        Files lie below `root` while they are used. study: the contents of `study.yaml`, if known; else they are read
        from the address, and None is returned if there is no study. Raises TrapsError if the store or its database
        cannot be used.
        """
        ...

    def open_ledger(self, variable: str, study: str) -> Database:
        """Return this process's ledger in the database at a variable's address. Raises TrapsError."""
        ...

    def dagster_yaml(self, workspace: Any) -> dict[str, Any]:
        """Return `dagster.yaml` for runs on Ray, and export the variables that it names."""
        ...

    def runs(self, workspace: Any, instance: dg.DagsterInstance, options: Any) -> Any:
        """Return a cluster's `Runs`, after those of earlier commands have ended.

        options: of `traps run`. Raises TrapsError if no run can be submitted from this host.
        """
        ...

    def move(self, workspace: Any, address: Place) -> int:
        """Move a study to s3://BUCKET/STUDY; return its ledger's row count. Raises TrapsError."""
        ...

    def sensors(self) -> Sequence[dg.SensorDefinition]:
        """Return the daemon's sensors that start cluster runs and end unstartable ones."""
        ...


def several_hosts() -> SeveralHosts:
    """Return the module for several hosts. Raises TrapsError if its package is not installed."""
    require_extra("cluster", "traps_cluster")
    return cast(SeveralHosts, import_module(_PACKAGE))
