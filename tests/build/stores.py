"""Files of a study in a folder or in a bucket, as its hosts see them: `where` is a fixture to import."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from pathlib import Path

import pytest

from traps_cluster.objects import Bucket, ObjectStore
from traps_cluster.postgres import PostgresDatabase
from traps_pipeline.storage.store import FolderStore, Store


@pytest.fixture(params=["folder", pytest.param("objects", marks=pytest.mark.slow)])
def where(request: pytest.FixtureRequest, tmp_path: Path) -> Sequence[str]:
    """What `opened` is told of a study."""
    if request.param == "folder":
        return [str(tmp_path)]
    request.getfixturevalue("s3")
    return [str(tmp_path), request.getfixturevalue("postgres").address(), f"study-{secrets.token_hex(4)}"]


def opened(folder: str, *of_database: str) -> Store:
    """A study's files below a folder, as the host of the last name sees them; with the address of a database and the
    study's name before that, in a bucket."""
    *where, host = of_database
    if not where:
        return FolderStore(Path(folder) / "study")
    address, study = where
    return ObjectStore(Path(folder) / host, Bucket(f"s3://lab/{study}"), database(address, study))


def database(address: str, study: str) -> PostgresDatabase:
    """The database of a study, as a process of its own has it."""
    return PostgresDatabase(address, "TRAPS_TEST_DATABASE", study)
