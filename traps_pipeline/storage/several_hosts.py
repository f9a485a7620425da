"""Reach the room `traps_pipeline.cluster` by its one entry point.

Only several hosts need that room, and no other room imports it.

It is imported by name, and only if a study has a database that hosts share.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

if TYPE_CHECKING:
    import dagster as dg

    from traps_pipeline.storage.place import Place
    from traps_pipeline.storage.store import Store
    from traps_pipeline.storage.study import Study

_ROOM = "traps_pipeline.cluster.entry"


class SeveralHosts(Protocol):
    """The interface that other rooms use.

    workspace: a `Workspace`, which itself asks here.
    """

    def open_store(self, place: Place, root: Path, study: Study | None = None) -> Store | None:
        """Return the files of a study with a database.

        They lie in a shared folder or an object store.

        They lie below `root` while they are used. study: the contents of `study.yaml`, if known; else they are read
        from the address, and None is returned if there is no study. Raises TrapsError if the store or its database
        cannot be used.
        """
        ...

    def dagster_yaml(self, workspace: Any) -> dict[str, Any]:
        """Return the `dagster.yaml` of a study whose runs go to Ray.

        The variables that it names are exported.
        """
        ...

    def runs(self, workspace: Any, instance: dg.DagsterInstance, options: Any) -> Any:
        """Return the `Runs` of a cluster (`pipeline/runs.py`).

        Those of earlier commands have ended by then.

        options: of `traps run`. Raises TrapsError if no run can be submitted from this host.
        """
        ...

    def sensors(self) -> Sequence[dg.SensorDefinition]:
        """Return the sensors that start such runs and end those that cannot begin.

        Dagster's daemon evaluates them.
        """
        ...


def several_hosts() -> SeveralHosts:
    """Return the module for several hosts."""
    return cast(SeveralHosts, import_module(_ROOM))
