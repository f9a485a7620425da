"""What errors about a study's file say to do lets the study be opened."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.build.entries import nobodys_own
from tests.build.ledger import answer, write
from tests.remedies.remedied import command, remedied
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import VARIABLE, Workspace

__all__ = ["nobodys_own"]  # fixtures


def test_a_workspace_is_there_once_it_is_made_or_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "study"
    made = remedied(
        lambda: Workspace.open(root),
        "storage.workspace.Workspace.open",
        lambda: command("init", "demo", "--workspace", root),
    )
    assert made.study.panel == "rules"
    monkeypatch.setenv(VARIABLE, str(tmp_path / "other"))
    remedied(Workspace.open, "storage.workspace.Workspace.open", lambda: monkeypatch.setenv(VARIABLE, str(root)))


def test_a_study_of_another_format_goes_on_in_a_new_workspace_with_its_ledger(tmp_path: Path) -> None:
    old = Workspace.create(tmp_path / "old", Study())
    write(old.answers, answer("k", "left"), evaluation="m__standard__run1")
    file = old.root / "study.yaml"
    file.write_text(file.read_text().replace("format: ", "format: 9"))

    def anew() -> Workspace:
        new = Workspace.create(tmp_path / "new", Study())
        shutil.copytree(old.root / "ledger", new.root / "ledger", dirs_exist_ok=True)
        return Workspace.open(new.root)

    new = remedied(lambda: Workspace.open(old.root), "storage.workspace.Workspace.open", again=anew)
    assert list(new.answers.read("m__standard__run1").rows) == ["k"]
