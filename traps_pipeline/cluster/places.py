"""Open a study's files on several hosts: a shared folder or an object store."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import yaml

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cluster.bucket import Bucket
from traps_pipeline.cluster.objects import ObjectStore, lease
from traps_pipeline.ledger.postgres import PostgresDatabase, postgres_of
from traps_pipeline.storage.place import STUDY, Place
from traps_pipeline.storage.store import FolderStore, Lease, Store
from traps_pipeline.storage.study import FORMAT, Study

_HEAD = "# A study of TRAPSBench. Its own study.yaml, and the names of its files, lie in the database.\n"


class SharedFolder(FolderStore):
    """A folder that all hosts of a study share.

    Leases are in the database: on some file systems, file locks are local to one machine.
    """

    def __init__(self, root: Path, database: PostgresDatabase) -> None:
        super().__init__(root)
        self._database = database

    def lease(self, name: str) -> Lease | None:
        """See `Store`."""
        return lease(self._database, name)


def open_store(place: Place, root: Path, study: Study | None = None) -> Store | None:
    """See `SeveralHosts`.

    In an object store, the only object with a fixed name identifies the study, and names the variable that holds the
    address of its database.
    """
    if study is not None:
        name, variable = study.name, str(study.database)
        if isinstance(place, Path):
            return SharedFolder(root, postgres_of(variable, name))
    else:
        content = _bucket(str(place)).get(STUDY)
        if content is None:
            return None
        try:
            parsed = yaml.safe_load(content)
            name, variable = str(parsed["name"]), str(parsed["database"])
        except (yaml.YAMLError, KeyError, TypeError) as error:
            raise TrapsError(f"{place}/{STUDY}: is not what `traps init` wrote ({error})") from None
    return _store(root, str(place), postgres_of(variable, name), name, variable)


@cache
def _bucket(address: str) -> Bucket:
    return Bucket(address)


@cache
def _store(root: Path, address: str, database: PostgresDatabase, name: str, variable: str) -> ObjectStore:
    """Return the process's cached store, so that reopening does not read everything."""
    anchor = _HEAD + yaml.safe_dump({"format": FORMAT, "name": name, "database": variable}, sort_keys=False)
    return ObjectStore(root, _bucket(address), database, name, anchor.encode())
