"""What errors about a study's history, pages and comparisons say to do lets them be opened or made."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.build.entries import nobodys_own
from tests.remedies.remedied import refused, remedied
from traps_pipeline.explorer import site
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

__all__ = ["nobodys_own"]  # the fixture


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
    assert remedied(lambda: site.script.__wrapped__(), "explorer.site.script", lambda: shutil.copy(kept, copy))
