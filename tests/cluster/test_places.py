"""A study in a folder that several hosts see, with its ledger in PostgreSQL."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from tests.build.errors import raises
from tests.postgres import Postgres
from tests.remedies.remedied import command
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.storage.store import LEASES
from traps_pipeline.storage.workspace import RAY, Workspace

pytestmark = pytest.mark.slow


@pytest.fixture
def folder(tmp_path: Path, postgres: Postgres, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where a study may be made, with what a host of it exports."""
    monkeypatch.setenv("LAB_DATABASE", postgres.address())
    monkeypatch.setenv("TRAPS_SCRATCH", str(tmp_path / "scratch"))
    for name in ("DAGSTER_HOME", "TRAPS_WORKSPACE", RAY):
        monkeypatch.delenv(name, raising=False)
    return tmp_path / "study"


def test_a_study_that_is_made_with_a_database_is_shared_by_all_hosts_of_its_folder(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command("init", "demo", "--workspace", folder, "--database", "LAB_DATABASE")
    workspace = Workspace.open(folder)
    assert yaml.safe_load((folder / "study.yaml").read_text())["database"] == "LAB_DATABASE"
    lease = workspace.store.lease("work")
    assert lease is not None and not (folder / LEASES).exists()  # some file systems lock files for one host alone
    lease.close()
    # SQLite on a network file system loses what two hosts write: each has a history of its own, or all have PostgreSQL.
    assert not workspace.dagster_home.is_relative_to(folder)
    monkeypatch.setenv(RAY, "http://head:8265")
    assert workspace.is_on_cluster and workspace.dagster_home == folder / "cluster"


def test_a_study_whose_ledger_lies_elsewhere_is_not_shared_by_a_word(folder: Path) -> None:
    command("init", "demo", "--workspace", folder)
    with raises(TrapsError, "cli.init_commands.create", f"{folder}/study.yaml", "--database LAB_DATABASE"):
        command("init", "demo", "--workspace", folder, "--database", "LAB_DATABASE")
    assert Workspace.open(folder).study.database is None


def test_a_database_that_cannot_be_used_leaves_no_study(
    folder: Path, postgres: Postgres, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LAB_DATABASE", postgres.address(password="wrong"))
    with raises(
        TrapsError, "traps_cluster.postgres.PostgresDatabase", "LAB_DATABASE: ", "password authentication failed"
    ):
        command("init", "demo", "--workspace", folder, "--database", "LAB_DATABASE")
    assert not Workspace.is_there(folder)
