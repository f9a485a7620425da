"""What errors about a machine, a study's history, pages and ledger say to do lets the same call succeed."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.build.entries import nobodys_own
from tests.build.ledger import answer, local, write
from tests.ledger.conftest import VARIABLE
from tests.postgres import Postgres
from tests.remedies.remedied import refused, remedied
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.postgres import PostgresDatabase
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.report.explorer import site
from traps_pipeline.scenes.parts.course import Course
from traps_pipeline.scenes.physics.kit import Box, Physics, View
from traps_pipeline.scenes.picture.trial import check_rendering
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

__all__ = ["nobodys_own"]  # a fixture


@pytest.mark.slow
def test_a_variable_that_chooses_an_opengl_that_does_not_draw_is_named_and_unset(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    variable = "GALLIUM_DRIVER"
    monkeypatch.setenv(variable, "nonsense")
    with pytest.raises(TrapsError, match=f"cannot render clips with .*{variable}=nonsense"):
        check_rendering()

    def unset() -> None:
        monkeypatch.delenv(variable)
        monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)

    remedied(check_rendering, "scenes.picture.trial.check_rendering", unset)


@pytest.mark.slow  # opens a renderer
def test_the_next_renderer_is_opened_once_the_first_is_closed() -> None:
    from traps_pipeline.scenes.picture.camera import fit_camera
    from traps_pipeline.scenes.picture.render import Renderer

    course = Course(Physics())
    course.block("wall", (0.2, 0.6), (0, 1), (0, 1), "red")
    model = course.spec.compile()
    camera = fit_camera(View(70.0, -25.0, 40.0), Box((-0.5, -0.5, 0.0), (0.5, 0.5, 0.8)).corners())
    first = contextlib.ExitStack()
    first.enter_context(Renderer(model, camera))

    def draw() -> np.ndarray:
        with Renderer(model, camera) as renderer:
            return next(renderer.frames(np.zeros((1, 0))))

    shown = remedied(draw, "scenes.picture.render", first.close, error=RuntimeError)
    assert shown.shape == (360, 480, 3)


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

    session = remedied(lambda: PostgresDatabase(late, VARIABLE, "clocks"), "ledger.postgres", set_clock)
    assert session.exists()
