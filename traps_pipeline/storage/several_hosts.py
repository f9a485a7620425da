"""The one door to what only several hosts need: the room `traps_pipeline.cluster`, which no other room imports.

It is found by its name, and only where a study has a database that hosts share.
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
    """What other rooms ask for. workspace: a `Workspace`, which itself asks here."""

    def open_store(self, place: Place, root: Path, study: Study | None = None) -> Store | None:
        """Return the files of a study with a database, in a folder that several hosts see or at an address in an object
        store; they lie below `root` while they are used.

        study: what `study.yaml` says or will say, where that is known; else the address tells, and None is returned
        where no study lies there. Raises TrapsError where the store or its database cannot be used.
        """
        ...

    def dagster_yaml(self, workspace: Any) -> dict[str, Any]:
        """Return the `dagster.yaml` of a study whose runs go to Ray, and export the variables that it names."""
        ...

    def runs(self, workspace: Any, instance: dg.DagsterInstance, options: Any) -> Any:
        """Return the `Runs` that hosts of a cluster make (`pipeline/runs.py`), once those of earlier commands have
        ended. options: of `traps run`. Raises TrapsError where no run can be submitted from this host."""
        ...

    def sensors(self) -> Sequence[dg.SensorDefinition]:
        """Return the sensors with which Dagster's daemon starts such runs and ends those that cannot begin."""
        ...


def several_hosts() -> SeveralHosts:
    """Return the room for several hosts."""
    return cast(SeveralHosts, import_module(_ROOM))
