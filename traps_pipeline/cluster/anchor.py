"""What lies at an address in an object store: which study, and where its rows are."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import yaml

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cluster.bucket import Bucket
from traps_pipeline.cluster.objects import ObjectStore
from traps_pipeline.storage.database import Session, session_of
from traps_pipeline.storage.place import STUDY
from traps_pipeline.storage.study import Study


def anchor_of(address: str) -> dict[str, Any] | None:
    """What the one object with a name says: the study's name, and the variable with its database's address. None where
    there is no study. Raises TrapsError."""
    content = _bucket(address).get(STUDY)
    if content is None:
        return None
    try:
        found = yaml.safe_load(content)
        return {"name": str(found["name"]), "database": str(found["database"])}
    except (yaml.YAMLError, KeyError, TypeError) as error:
        raise TrapsError(f"{address}/{STUDY}: is not what `traps init` wrote ({error})") from None


def write_anchor(address: str, study: Study) -> None:
    """Say which study lies at an address: written once, the same by whoever makes the study. Raises TrapsError."""
    head = "# A study of TRAPSBench. Its own study.yaml, and the names of its files, lie in the database.\n"
    said = {"format": study.format, "name": study.name, "database": study.database}
    _bucket(address).put(STUDY, (head + yaml.safe_dump(said, sort_keys=False)).encode())


def file_at(root: Path, address: str, name: str) -> Path | None:
    """A file of the study at an address by its name below the scratch folder `root`, as it lies on this machine; None
    where there is no study, or no such file. Raises TrapsError."""
    said = anchor_of(address)
    if said is None:
        return None
    store = store_of(root, address, session_of(said["database"], said["name"]))
    store.look()
    return store.here(root / name) if store.has(root / name) else None


@cache
def _bucket(address: str) -> Bucket:
    return Bucket(address)


@cache
def store_of(root: Path, address: str, session: Session) -> ObjectStore:
    """The store of a process: what it has seen is not looked at again by whoever opens the workspace next."""
    return ObjectStore(root, _bucket(address), session)
