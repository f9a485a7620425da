"""Errors of databases as sentences: what real databases raise, without the libraries' own text."""

from __future__ import annotations

import re
import sqlite3
from pathlib import Path

import pytest
import sqlalchemy
from sqlalchemy.exc import OperationalError

from tests.build.errors import raises
from traps_pipeline.base.databases import NO_SPACE, reason_and_remedy
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.people.human_label_rows import LABELS_FILE
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.servers.labelstore import LabelStore
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

LIBRARIES = re.compile("sqlalche|sqlite3|SQL|parameters|Background|Error")


def test_a_full_disk_is_named_without_the_statement(tmp_path: Path) -> None:
    engine = sqlalchemy.create_engine(f"sqlite:///{tmp_path / 'a.db'}")
    with pytest.raises(OperationalError) as raised, engine.begin() as connection:
        connection.exec_driver_sql("PRAGMA max_page_count = 2")
        connection.exec_driver_sql("CREATE TABLE a (b)")
        connection.exec_driver_sql("INSERT INTO a VALUES (?)", ("x" * 10_000,))
    assert "[SQL: INSERT" in str(raised.value) and "sqlalche.me" in str(raised.value)
    of_postgres = Exception('could not extend file "base/1": No space left on device\nHINT: Check free disk space.')
    reason, _, is_unwritable = told = reason_and_remedy(raised.value)
    assert (reason, is_unwritable) == (NO_SPACE, True) and reason_and_remedy(of_postgres) == told


def test_a_damaged_file_is_moved_away_and_any_other_error_keeps_the_words_of_the_database(tmp_path: Path) -> None:
    (tmp_path / "a.db").write_bytes(b"no database at all" * 100)
    with pytest.raises(sqlite3.DatabaseError) as raised:
        sqlite3.connect(tmp_path / "a.db").execute("select * from a")
    damaged, remedy, _ = reason_and_remedy(raised.value)
    assert str(raised.value) not in damaged
    engine = sqlalchemy.create_engine(f"sqlite:///{tmp_path / 'b.db'}")
    with pytest.raises(OperationalError) as failed, engine.begin() as connection:
        connection.exec_driver_sql("select * from a where b = ?", ("secret",))
    words, another_remedy, _ = reason_and_remedy(failed.value)
    assert words == "no such table: a" and another_remedy != remedy


def test_a_history_on_a_full_disk_is_one_sentence(
    tiny_disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    workspace = Workspace.create(tmp_path / "study", Study(scenarios=["plinko-0001"]))
    monkeypatch.setenv("DAGSTER_HOME", str(tiny_disk / "home"))
    home = str(tiny_disk / "home")
    with raises(TrapsError, "pipeline.run.dagster_history", home, NO_SPACE) as raised, dagster_history(workspace):
        pass
    assert not LIBRARIES.search(str(raised.value))


def test_labels_on_a_full_disk_are_one_sentence(tiny_disk: Path) -> None:
    (tiny_disk / "filler").write_bytes(b"0" * 60_000)
    with raises(TrapsError, "servers.labelstore", str(tiny_disk / "labels"), NO_SPACE) as raised:
        LabelStore(tiny_disk / "labels")
    assert LABELS_FILE not in str(raised.value)  # it is only full: a damaged database is made again from that file
