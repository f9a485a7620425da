"""Dagster's history is written without waiting for the disk, and nothing else is."""

from pathlib import Path

import dagster as dg
import pytest
import sqlalchemy as sa

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import ROOT
from traps_pipeline.ledger.sqlite import SqliteDatabase
from traps_pipeline.pipeline import history_files  # noqa: F401 - its listeners

OFF, FULL = 0, 2  # as SQLite numbers the values of `PRAGMA synchronous`


def synchronous(engine: sa.Engine) -> int:
    with engine.begin() as connection:
        return connection.exec_driver_sql("PRAGMA synchronous").scalar_one()


@pytest.mark.parametrize(
    ("name", "value"),
    [("history/runs.db", OFF), ("history/runs/index.db", OFF), ("ledger/ledger.sqlite", FULL), ("runs.db", FULL)],
)
def test_only_files_of_the_history_are_written_without_a_sync(tmp_path: Path, name: str, value: int) -> None:
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    assert synchronous(sa.create_engine(f"sqlite:///{tmp_path / name}")) == value


def test_a_ledger_in_a_folder_of_that_name_is_synced(tmp_path: Path) -> None:
    folder = tmp_path / "history" / "runs"
    folder.mkdir(parents=True)
    assert synchronous(SqliteDatabase(folder, file="index.db")._engine) != OFF


def test_a_disk_that_takes_no_event_is_named_with_the_file(tmp_path: Path) -> None:
    (tmp_path / "history").mkdir()
    file = tmp_path / "history" / "runs.db"
    engine = sa.create_engine(f"sqlite:///{file}")
    with engine.begin() as connection:
        connection.exec_driver_sql("CREATE TABLE events (number)")
        connection.exec_driver_sql(
            "CREATE TRIGGER full BEFORE INSERT ON events BEGIN SELECT RAISE(ABORT, 'database or disk is full'); END"
        )
    with pytest.raises(TrapsError) as raised, engine.begin() as connection:
        connection.exec_driver_sql("INSERT INTO events VALUES (1)")
    assert str(file) in str(raised.value) and "INSERT" not in str(raised.value)


@pytest.mark.promise
def test_the_settings_of_a_checkout_need_no_study_and_send_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`dagster dev` reads them where DAGSTER_HOME is not set."""
    monkeypatch.delenv("DAGSTER_HOME", raising=False)
    (tmp_path / "dagster.yaml").write_text((ROOT / "dagster.yaml").read_text())
    with dg.DagsterInstance.from_config(str(tmp_path)) as instance:
        assert instance.get_runs() == [] and not instance.telemetry_enabled
