"""The files of a study that several hosts see: in a folder, or at an address in an object store."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import yaml

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cluster.bucket import Bucket
from traps_pipeline.cluster.cluster_database import Database, database_of, lease
from traps_pipeline.cluster.objects import ObjectStore
from traps_pipeline.storage.place import STUDY, Place
from traps_pipeline.storage.store import FolderStore, Lease, Store
from traps_pipeline.storage.study import FORMAT, Study

_HEAD = "# A study of TRAPSBench. Its own study.yaml, and the names of its files, lie in the database.\n"


class SharedFolder(FolderStore):
    """A folder that all hosts of a study see. Which of them has a piece of work, the database says: locks on files are
    those of one machine on some file systems."""

    def __init__(self, root: Path, database: Database) -> None:
        super().__init__(root)
        self._database = database

    def lease(self, name: str) -> Lease | None:
        """See `Store`."""
        return lease(self._database, name)


def open_store(place: Place, root: Path, study: Study | None = None) -> Store | None:
    """See `SeveralHosts`. In an object store the one object with a name says which study lies there, and the variable
    that holds the address of its database."""
    if study is not None:
        name, variable = study.name, str(study.database)
        if isinstance(place, Path):
            return SharedFolder(root, database_of(variable, name))
    else:
        content = _bucket(str(place)).get(STUDY)
        if content is None:
            return None
        try:
            parsed = yaml.safe_load(content)
            name, variable = str(parsed["name"]), str(parsed["database"])
        except (yaml.YAMLError, KeyError, TypeError) as error:
            raise TrapsError(f"{place}/{STUDY}: is not what `traps init` wrote ({error})") from None
    return _store(root, str(place), database_of(variable, name), name, variable)


@cache
def _bucket(address: str) -> Bucket:
    return Bucket(address)


@cache
def _store(root: Path, address: str, database: Database, name: str, variable: str) -> ObjectStore:
    """Return the store of a process: what it has seen is not looked at again when the workspace is opened once more."""
    anchor = _HEAD + yaml.safe_dump({"format": FORMAT, "name": name, "database": variable}, sort_keys=False)
    return ObjectStore(root, _bucket(address), database, name, anchor.encode())
