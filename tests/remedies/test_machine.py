"""What errors about a machine, a study's history, pages and ledger say to do lets the same call succeed."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.build.ledger import answer, local, paid, write
from tests.ledger.conftest import VARIABLE
from tests.postgres import Postgres
from tests.remedies.remedied import command, refused, remedied
from traps_cluster.postgres import PostgresDatabase
from traps_pipeline.ledger.money import Money
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.report.explorer import site
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


def test_a_history_is_opened_once_what_lies_in_its_way_is_moved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    workspace = Workspace.create(tmp_path / "study", Study())
    home = tmp_path / "dagster"
    monkeypatch.setenv("DAGSTER_HOME", str(home))
    (home / "history" / "runs.db").mkdir(parents=True)

    def opened() -> int:
        with dagster_history(workspace) as instance:
            return len(instance.get_runs())

    refused(opened, "pipeline.run.dagster_history")
    found = remedied(opened, "pipeline.run.dagster_history", lambda: home.rename(tmp_path / "away"))
    assert found == 0


def test_the_sites_libraries_are_used_once_they_are_restored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = Path(shutil.copytree(site.LIBRARY.parent, tmp_path / "vendor")) / site.LIBRARY.name
    kept = site.LIBRARY
    monkeypatch.setattr(site, "LIBRARY", copy)
    copy.write_bytes(copy.read_bytes() + b"//")
    assert remedied(lambda: site.script.__wrapped__(), "report.explorer.site.script", lambda: shutil.copy(kept, copy))


def test_a_ledger_on_a_full_disk_goes_on_once_there_is_space(tiny_disk: Path) -> None:
    subprocess.run(["mount", "-o", "remount,size=1m", str(tiny_disk)], check=True)  # tables and log take some 300 KiB
    filler = tiny_disk / "filler"
    write(local(tiny_disk), answer("k", "left"))
    filler.write_bytes(b"0" * os.statvfs(tiny_disk).f_bavail * os.statvfs(tiny_disk).f_bsize)
    rows = [answer(f"k{n}", "x" * 300) for n in range(20)]
    remedied(lambda: write(local(tiny_disk), *rows), "ledger.sqlite", filler.unlink)
    assert set(local(tiny_disk).read("m").rows) == {"k", *(row["key"] for row in rows)}


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])


def lower_total(file: Path) -> None:
    with sqlite3.connect(file) as connection:
        connection.execute("update traps_totals set dollars = 0")


def add_trigger(file: Path) -> None:
    with sqlite3.connect(file) as connection:
        connection.execute("create trigger t after insert on traps_rows begin delete from traps_totals; end")


@pytest.mark.parametrize("damage", [cut, lower_total, add_trigger])
def test_a_damaged_ledger_goes_on_once_what_is_whole_is_exported_and_imported(
    tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    workspace = Workspace.create(tmp_path / "study", Study())
    write(workspace.answers, *(paid(f"k{number}", 0.25) | {"text": "x" * 2000} for number in range(100)))
    file, saved = workspace.ledger_folder / "ledger.sqlite", tmp_path / "whole.sqlite"
    damage(file)

    def follow() -> None:
        command("study", "export-ledger", saved, "--workspace", workspace.root)
        (tmp_path / "away").mkdir()
        for part in file.parent.glob(f"{file.name}*"):
            part.rename(tmp_path / "away" / part.name)
        command("study", "import-ledger", saved, "--workspace", workspace.root)

    remedied(lambda: write(Workspace.open(workspace.root).answers, answer("later", "left")), "ledger", follow)
    answers = Workspace.open(workspace.root).answers
    assert len(answers.read("m").settled) == 101 if damage is not cut else 30 < len(answers.read("m").settled) < 101
    with answers.database.writing():
        assert sum(Money(answers.database).spent().values()) == 25.0  # of rows that were lost, too
    assert [*answers.damage()] == []


def test_a_host_whose_clock_is_an_hour_off_works_once_it_is_set(postgres: Postgres) -> None:
    """The database's clock is altered: nobody may set this machine's."""
    psycopg = pytest.importorskip("psycopg")
    with psycopg.connect(postgres.address(), autocommit=True) as connection:
        connection.execute("create database late")
        connection.execute("alter database late set search_path = altered, pg_catalog")
    late = postgres.address(database="late")
    with psycopg.connect(late, autocommit=True) as connection:
        connection.execute("create schema altered")
        connection.execute(
            """create function altered.clock_timestamp() returns timestamptz language sql
               as $$ select pg_catalog.clock_timestamp() + interval '1 hour' $$"""
        )

    def set_clock() -> None:
        with psycopg.connect(late, autocommit=True) as connection:
            connection.execute("drop function altered.clock_timestamp()")

    session = remedied(lambda: PostgresDatabase(late, VARIABLE, "clocks"), "traps_cluster.postgres", set_clock)
    assert session.exists()
