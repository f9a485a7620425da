"""The file of a run in Dagster's history has what Dagster itself would put there, at a fraction of the cost."""

from __future__ import annotations

import sqlite3
import threading
from contextlib import closing
from pathlib import Path

import dagster as dg
import pytest
from dagster._core.storage.event_log.sqlite.sqlite_event_log import SqliteEventLogStorage

from tests.conftest import ROOT
from traps_pipeline.orchestration import sqlite


@dg.op
def nothing() -> None: ...


@dg.job
def job() -> None:
    nothing()


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "dagster.yaml").write_text((ROOT / "dagster.yaml").read_text())
    monkeypatch.setenv("DAGSTER_HOME", str(tmp_path))
    return tmp_path


def made(file: Path) -> tuple[list[tuple[str, ...]], list[tuple[str, ...]], tuple[str]]:
    """Tables and indices of a file, its migration, and how it is written to."""
    with closing(sqlite3.connect(file)) as connection:
        tables = connection.execute("SELECT type, name, tbl_name, sql FROM sqlite_master ORDER BY name").fetchall()
        revision = connection.execute("SELECT version_num FROM alembic_version").fetchall()
        return tables, revision, connection.execute("PRAGMA journal_mode").fetchone()


def file_of(home: Path, run_id: str) -> Path:
    return home / "history" / "runs" / f"{run_id}.db"


def test_the_file_of_a_run_is_the_one_that_dagster_makes(home: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    with dg.DagsterInstance.from_config(str(home)) as instance:
        run = job.execute_in_process(instance=instance)
    theirs = tmp_path_factory.mktemp("dagster")
    storage = SqliteEventLogStorage(str(theirs))
    with storage.run_connection("run"):
        pass
    assert made(file_of(home, run.run_id)) == made(theirs / "run.db")
    assert len(made(theirs / "run.db")[0]) > 20
    with dg.DagsterInstance.from_config(str(home)) as instance:  # another process reads all of it
        assert len(instance.all_logs(run.run_id)) >= len(run.all_events) > 5


def test_tables_of_an_older_dagster_are_not_handed_on(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with dg.DagsterInstance.from_config(str(home)) as instance:
        index = home / "history" / "runs" / "index.db"
        newest = made(index)[1]
        with closing(sqlite3.connect(index)) as connection:
            connection.execute("UPDATE alembic_version SET version_num = 'older'")
            connection.execute("CREATE TABLE of_an_older_one (x)")
            connection.commit()
        run = job.execute_in_process(instance=instance)
    tables, revision, _ = made(file_of(home, run.run_id))
    assert revision == newest and "of_an_older_one" not in [name for _, name, *_ in tables]


def test_two_that_open_the_file_of_a_run_at_once_find_it_whole(home: Path) -> None:
    with dg.DagsterInstance.from_config(str(home)) as instance:
        folder, found = instance.event_log_storage._base_dir, list[BaseException]()
    stores = [sqlite._Events(folder) for _ in range(4)]
    begin = threading.Barrier(len(stores))

    def write(store: sqlite._Events) -> None:
        try:
            for number in range(20):
                begin.wait(60)
                with store.run_connection(f"run-{number}") as connection:
                    connection.exec_driver_sql("INSERT INTO asset_keys (asset_key) VALUES (?)", (f"{id(store)}",))
        except BaseException as error:  # noqa: BLE001 - of a thread, told below
            found.append(error)
            begin.abort()

    threads = [threading.Thread(target=write, args=(store,)) for store in stores]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not found
    for number in range(20):
        with closing(sqlite3.connect(file_of(home, f"run-{number}"))) as connection:
            assert connection.execute("SELECT count(*) FROM asset_keys").fetchone() == (len(stores),)
