"""Why an answer is asked again."""

from __future__ import annotations

from pathlib import Path

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.pipeline.item_answers import explain_item
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


def test_a_study_without_items_names_the_command_that_makes_them(tmp_path: Path) -> None:
    workspace = Workspace.create(tmp_path / "study", Study())
    item = "occlusion:domino_chain-0001:void"
    with raises(TrapsError, "pipeline.item_answers.explain_item", item, "`traps run EXPERIMENT`"):
        explain_item(workspace, item)
