"""What errors about entries, experiments and money say to do lets the same file be read, or the same call be made."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.build.entries import nobodys_own
from tests.build.ledger import answer, write
from tests.remedies.remedied import command, remedied
from traps_pipeline.models import prompts
from traps_pipeline.pipeline.experiment import Experiment, load_experiment
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import VARIABLE, Workspace

__all__ = ["nobodys_own"]  # fixtures

MINE = """
name: mine
panel: rules
judged_by_rules: true
models:
  - id: my-model
    base_url: http://127.0.0.1:8000
    served_name: org/Model-7B
    media: images
"""
PUBLIC = MINE.replace("http://127.0.0.1:8000", "https://example.org")
WHOLE = """
name: mine
panel: rules
judged_by_rules: true
models:
  - {id: my-model, backend: api, account: mine, provider_id: openai/m, media: {profile: images, fps: 5, most: 25},
     params: {temperature: 0.8, top_p: 0.95, max_tokens: 8000},
     groups: {family: f, access: none, input: none, group: g}}
"""


ZERO = PUBLIC.replace("media: images", "media: images\n    params: {temperature: 0}")


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        (MINE.replace("    media: images\n", ""), MINE.replace("images", "video")),
        (ZERO, PUBLIC.replace("media: images", "media: images\n    params: {temperature: 0.8}")),
        (ZERO, ZERO + "    waivers: {temperature: the server has no other}\n"),
        (PUBLIC + "    waivers: {temperature: none}\n", PUBLIC),
        (WHOLE, WHOLE + "accounts: {mine: {base_url: 'https://example.org/v1'}}\n"),
        (MINE + "scenarios: [plinko-0001]\nper_family: 2\n", MINE + "per_family: 2\n"),
    ],
)
def test_an_experiment_is_read_once_it_is_as_told(tmp_path: Path, wrong: str, right: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(wrong)
    read = remedied(lambda: load_experiment(str(path)), "base.yamlfile", lambda: path.write_text(right))
    assert read.models == ["my-model"]


def experiment(tmp_path: Path, **fields: Any) -> Experiment:
    return Experiment.model_validate({"name": "one", "models": ["oracle"], **fields})


@pytest.mark.parametrize("damage", [lambda path: path.unlink(), lambda path: path.write_text(" \n")])
def test_a_prompt_is_read_once_it_is_restored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: Callable[[Path], object]
) -> None:
    copy = Path(shutil.copytree(prompts.PROMPTS, tmp_path / "prompts"))
    monkeypatch.setattr(prompts, "PROMPTS", copy)
    damage(copy / "json_suffix.txt")
    read = prompts.prompt.__wrapped__

    def restored() -> None:
        shutil.copy(prompts.ASSETS / "prompts" / "json_suffix.txt", copy)

    assert remedied(lambda: read("json_suffix"), "models.prompts", restored)


# --- a study's file ---------------------------------------------------------------------------------------------------


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
