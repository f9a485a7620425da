"""What errors about a study's history, pages and comparisons say to do lets them be opened or made."""

from __future__ import annotations

import shutil
from pathlib import Path

import pandas as pd
import pytest

from tests.conftest import EXPERIMENT, ROOT, Checkout
from tests.remedies.remedied import carries_out, refused, remedied
from tests.remedies.test_models import nobodys_own
from tests.study.test_canary import asked
from traps_pipeline.explorer import site
from traps_pipeline.explorer.site import write_site
from traps_pipeline.orchestration.graph import the_graph
from traps_pipeline.orchestration.lineage import State, read_report_state, write_report_state
from traps_pipeline.orchestration.run import dagster_history
from traps_pipeline.report.contact_sheet import MOST_PAIRS, chosen_pairs
from traps_pipeline.scoring.epochs import EpochMismatch, require_one_epoch
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.study.canary import CANARY, changes_text

__all__ = ["nobodys_own"]  # the fixture
SMALL = ROOT / EXPERIMENT


def test_a_note_of_what_files_were_made_from_is_deleted_and_written_again(tmp_path: Path) -> None:
    workspace = Workspace.create(tmp_path, Study())
    stage = the_graph()["gallery"]
    write_report_state(workspace, stage, State("v", {}, 0, 0))
    note = next(workspace.reports.rglob("gallery.json"))
    note.write_text("{")

    def run_again() -> None:
        note.unlink()
        write_report_state(workspace, stage, State("v", {}, 0, 0))

    found = remedied(
        lambda: read_report_state(workspace, stage),
        "orchestration/lineage.py | {}: is not what was written ({}); delete it and run again",
        run_again,
    )
    assert found is not None and found.version == "v"


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

    refused(opened, "base/databases.py | free some space, or move that folder away")
    found = remedied(
        opened,
        "Dagster's history cannot be read or written ({}); {} and run the same command again: tables are whole",
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
            "holds something that is no site; name a folder that is empty, or does not exist yet",
            again=lambda other=other: write_site(workspace, tmp_path / other, clips=False),
        )


def test_the_sites_libraries_are_used_once_they_are_restored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = Path(shutil.copytree(site.LIBRARY.parent, tmp_path / "vendor")) / site.LIBRARY.name
    kept = site.LIBRARY
    monkeypatch.setattr(site, "LIBRARY", copy)
    copy.write_bytes(copy.read_bytes() + b"//")
    assert remedied(
        lambda: site.script.__wrapped__(),
        "is not what was checked in; restore it from git, or run `make explorer-vendor`",
        lambda: shutil.copy(kept, copy),
    )


def test_a_contact_sheet_shows_fewer_pairs_of_each_family() -> None:
    rows = pd.DataFrame(
        [
            {"pair_id": f"p{n:03d}", "dataset": "occlusion", "sub_scenario": f"f{n % 4}", "side": side}
            for n in range(MOST_PAIRS + 4)
            for side in ("control", "void")
        ]
    )
    for items, per_family in ((rows, 3), (rows[: 2 * MOST_PAIRS], None)):
        assert remedied(
            lambda: chosen_pairs(rows, None),
            "a contact sheet shows 1 to {} pairs, not {}: pass other items or a smaller per_family",
            again=lambda items=items, per_family=per_family: chosen_pairs(items, per_family),
            error=ValueError,
        )


def test_a_comparison_within_one_epoch_is_made() -> None:
    mixed = pd.DataFrame({"standard": ["e1", "e1"], "guided": ["e2", "e1"]}, index=pd.Index(["m", "n"]))
    for right in (mixed.assign(guided="e1"), mixed.drop(index="m")):
        remedied(
            lambda: require_one_epoch(mixed, "uplift"),
            "ratio, contrast or gap: evaluate both sides in one epoch, or leave this one out",
            again=lambda right=right: require_one_epoch(right, "uplift"),
            error=EpochMismatch,
        )


@carries_out("canary: asked in this epoch; name another epoch in study.yaml to ask again, and what changed is shown")
def test_a_canary_of_another_epoch_shows_what_changed() -> None:
    one = pd.DataFrame([vars(asked("nov", "a", 1))], columns=pd.Index(CANARY.names))
    assert changes_text(one).startswith("canary: asked in this epoch; name another epoch in study.yaml to ask again")
    both = pd.concat([one, pd.DataFrame([vars(asked("dec", "a", 9, value="right", text="right"))])])
    assert changes_text(both).startswith("canary: items that changed")
