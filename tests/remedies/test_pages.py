"""What errors about a study's history, pages and comparisons say to do lets them be opened or made."""

from __future__ import annotations

import shutil
from pathlib import Path

import pandas as pd
import pytest

from tests.build.canary import asked
from tests.build.entries import nobodys_own
from tests.conftest import Checkout
from tests.remedies.remedied import refused, remedied
from traps_pipeline.checks.canary import CANARY, changes_text
from traps_pipeline.explorer import site
from traps_pipeline.explorer.site import write_site
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.scoring.epochs import EpochMismatch, require_one_epoch
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
    found = remedied(
        opened,
        "pipeline.run.dagster_history",
        lambda: home.rename(tmp_path / "away"),
    )
    assert found == 0


def test_a_site_goes_to_a_folder_that_is_empty_or_does_not_exist(small: Checkout, tmp_path: Path) -> None:
    workspace = Workspace.open(small.workspace)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "letter.txt").write_text("mine")
    (tmp_path / "empty").mkdir()
    for other in ("empty", "new"):
        remedied(
            lambda: write_site(workspace, tmp_path / "taken", clips=False),
            "explorer.site._former_files",
            again=lambda other=other: write_site(workspace, tmp_path / other, clips=False),
        )


def test_the_sites_libraries_are_used_once_they_are_restored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = Path(shutil.copytree(site.LIBRARY.parent, tmp_path / "vendor")) / site.LIBRARY.name
    kept = site.LIBRARY
    monkeypatch.setattr(site, "LIBRARY", copy)
    copy.write_bytes(copy.read_bytes() + b"//")
    assert remedied(
        lambda: site.script.__wrapped__(),
        "explorer.site.script",
        lambda: shutil.copy(kept, copy),
    )


def test_a_comparison_within_one_epoch_is_made() -> None:
    mixed = pd.DataFrame({"standard": ["e1", "e1"], "guided": ["e2", "e1"]}, index=pd.Index(["m", "n"]))
    for right in (mixed.assign(guided="e1"), mixed.drop(index="m")):
        remedied(
            lambda: require_one_epoch(mixed, "uplift"),
            "scoring.epochs.require_one_epoch",
            again=lambda right=right: require_one_epoch(right, "uplift"),
            error=EpochMismatch,
        )


def test_a_canary_of_another_epoch_shows_what_changed() -> None:
    one = pd.DataFrame([vars(asked("nov", "a", 1))], columns=pd.Index(CANARY.names))
    assert changes_text(one).startswith("canary: asked in this epoch; name another epoch in study.yaml to ask again")
    both = pd.concat([one, pd.DataFrame([vars(asked("dec", "a", 9, value="right", text="right"))])])
    assert changes_text(both).startswith("canary: items that changed")
