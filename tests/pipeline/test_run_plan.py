"""What is stale is told from tables' footers: Dagster is neither imported nor asked where nothing is to be made."""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path

import pytest
from dagster import AssetMaterialization

from tests.conftest import EXPERIMENT, Checkout
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.storage.workspace import Workspace

# What takes longest to import, and what a command that reads footers and one item needs none of.
HEAVY = {"dagster", "litellm", "matplotlib", "pandas", "rich.console", "scipy", "traps_pipeline.scenes.physics.kit"}
PROGRAM = "import sys; from traps_pipeline.cli import main; code = main(sys.argv[1:]); "
pytestmark = pytest.mark.slow


def loaded(study: Checkout, *command: str, besides: Collection[str] = ()) -> str:
    """The last line of a command's output: which of the heavy libraries, but for those besides, it has imported."""
    program = f"{PROGRAM}print('loaded', sorted({HEAVY - {*besides}} & {{*sys.modules}})); sys.exit(code)"
    finished = study.python("-c", program, *command).ok()
    return finished.out.splitlines()[-1]


def test_status_why_and_plan_load_no_dagster(study: Checkout) -> None:
    assert loaded(study, "status") == "loaded []"
    assert loaded(study, "why", "occlusion:domino_chain-0001:void") == "loaded []"
    assert loaded(study, "plan", EXPERIMENT, besides=("pandas", "traps_pipeline.scenes.physics.kit")) == "loaded []"


def test_a_run_with_nothing_to_do_opens_no_history_until_something_changes_in_it(
    study: Checkout, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DAGSTER_HOME", str(study.workspace / "dagster"))
    command = ("run", EXPERIMENT, "--until", "leaderboard")
    assert study.traps(*command).code == 0
    assert loaded(study, *command) == "loaded []"
    # Dagster's history then holds another version than the table: the partition is made once more.
    workspace = Workspace.open(Path(study.workspace))
    with dagster_history(workspace) as history:
        tags = {"dagster/data_version": "0" * 16, "dagster/data_version_is_user_provided": "true"}
        history.report_runless_asset_event(AssetMaterialization("leaderboard", tags=tags))
    again = study.traps(*command)
    assert again.code == 0 and re.search(r"^1 [^,]+, \d+ s$", again.err, re.MULTILINE), again.err
    assert loaded(study, *command) == "loaded []"
