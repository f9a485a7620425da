"""What errors about entries, experiments and money say to do lets the same file be read, or the same call be made."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from tests.build.entries import nobodys_own
from tests.build.ledger import answer, write
from tests.remedies.remedied import command, remedied
from traps_pipeline.models import prompts
from traps_pipeline.models.local.settings import LocalParams
from traps_pipeline.models.reading import read_answer
from traps_pipeline.models.registry import Account
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
LOCAL = {"checkpoint": "x", "dtype": "float32", "quantisation": "none", "do_sample": False, "max_new_tokens": 9}


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


@pytest.mark.parametrize(
    ("wrong", "by", "right"),
    [
        (MINE.replace("    media: images\n", ""), "base.yamlfile.within", MINE),
        (
            MINE.replace("    media: images\n", ""),
            "base.yamlfile.within",
            MINE.replace("images", "video"),
        ),
        (
            PUBLIC.replace("media: images", "media: images\n    params: {temperature: 0}"),
            "base.yamlfile.within",
            PUBLIC.replace("media: images", "media: images\n    params: {temperature: 0.8}"),
        ),
        (
            PUBLIC.replace("media: images", "media: images\n    params: {temperature: 0}"),
            "base.yamlfile.within",
            PUBLIC.replace("media: images", "media: images\n    params: {temperature: 0}")
            + "    waivers: {temperature: the server has no other}\n",
        ),
        (
            PUBLIC + "    waivers: {temperature: none}\n",
            "base.yamlfile.within",
            PUBLIC,
        ),
        (
            PUBLIC.replace("media: images", "media: {profile: images, fps: 2, most: 10}"),
            "base.yamlfile.within",
            PUBLIC.replace("media: images", "media: {profile: images, fps: 5, most: 25}"),
        ),
        (
            WHOLE,
            "base.yamlfile.within",
            WHOLE + "accounts: {mine: {base_url: 'https://example.org/v1'}}\n",
        ),
        (
            MINE + "scenarios: [plinko-0001]\nper_family: 2\n",
            "base.yamlfile.parse_yaml_model",
            MINE + "per_family: 2\n",
        ),
        (
            MINE + "datasets: [schema_answer]\nregimes: [json]\n",
            "base.yamlfile.parse_yaml_model",
            MINE + "datasets: [schema_answer]\nregimes: [standard]\n",
        ),
        (MINE + "regimes: [polite]\n", "base.yamlfile.parse_yaml_model", MINE + "regimes: [guided]\n"),
    ],
)
def test_an_experiment_is_read_once_it_is_as_told(tmp_path: Path, wrong: str, by: str, right: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(wrong)
    assert remedied(lambda: load_experiment(str(path)), by, lambda: path.write_text(right)).models == ["my-model"]


def test_an_experiment_that_is_not_there_is_named_by_its_path_or_a_known_name(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(MINE)
    for known in ("demo", str(path)):
        remedied(
            lambda: load_experiment("mine"),
            "pipeline.experiment.load_experiment",
            again=lambda known=known: load_experiment(known),
        )


def experiment(tmp_path: Path, **fields: Any) -> Experiment:
    return Experiment.model_validate({"name": "one", "models": ["oracle"], **fields})


def test_a_panel_is_named_in_one_place(tmp_path: Path) -> None:
    one = experiment(tmp_path, panel="paper")
    remedied(
        lambda: one.judged(None, "rules"),
        "pipeline.experiment.Experiment.judged",
        again=lambda: experiment(tmp_path, panel="rules").judged(None, "rules"),
    )
    judged = Study(panel="rules")
    remedied(
        lambda: one.judged(judged, None),
        "pipeline.experiment.Experiment.judged",
        again=lambda: one.judged(Study(panel="paper"), None),
    )
    remedied(
        lambda: one.check_study(judged, tmp_path),
        "pipeline.experiment.Experiment.check_study",
        again=lambda: one.check_study(Study(panel="paper"), tmp_path),
    )
    remedied(
        lambda: experiment(tmp_path).judged(None, None),
        "models.judges.load_panel",
        again=lambda: experiment(tmp_path).judged(None, "rules"),
    )


def test_rules_judge_other_models_where_somebody_says_so() -> None:
    asks = Experiment.model_validate({"name": "one", "models": ["gpt-5-mini"], "panel": "rules"})
    remedied(
        lambda: asks.judged(None, None),
        "models.judges.require_panel",
        again=lambda: asks.judged(None, None, judged_by_rules=True),
    )
    other = asks.model_copy(update={"panel": "paper"})
    assert other.judged(None, None).panel == "paper"


def test_two_mechanism_sections_are_made_one(tmp_path: Path) -> None:
    paper = load_experiment("paper")
    assert paper.mechanism is not None
    other = paper.mechanism.model_copy(update={"steering": None})
    for right in (paper.mechanism, None):
        remedied(
            lambda: paper.check_study(paper.study.model_copy(update={"mechanism": other}), tmp_path),
            "pipeline.experiment.Experiment.check_study",
            again=lambda right=right: paper.check_study(paper.study.model_copy(update={"mechanism": right}), tmp_path),
        )


def test_a_greedy_model_has_no_temperature() -> None:
    remedied(
        lambda: LocalParams.model_validate(LOCAL | {"temperature": 0.8}),
        "LocalParams",
        again=lambda: LocalParams.model_validate(LOCAL),
        error=ValidationError,
    )


def test_a_key_that_is_exported_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    account = Account(key="TRAPS_TEST_SOME_KEY")
    monkeypatch.delenv("TRAPS_TEST_SOME_KEY", raising=False)
    found = remedied(
        account.secret,
        "base.keys.read_key",
        lambda: monkeypatch.setenv("TRAPS_TEST_SOME_KEY", "sk"),
    )
    assert found == "sk"


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

    if (copy / "json_suffix.txt").exists():
        assert remedied(lambda: read("json_suffix"), "models.prompts.prompt", restored)
    else:
        assert remedied(lambda: read("json_suffix"), "models.prompts.prompt", restored)


def test_a_model_that_thinks_in_its_answer_is_read_once_its_entry_says_so() -> None:
    row = {"outcome": "answer", "text": "<think>red, then blue</think>The blue one."}
    told = read_answer(row, None, "standard").why
    assert told == 'thinks between marks in its text; say `thinking: "<think>"` in its entry'
    assert read_answer(row, None, "standard", thinking=("<think>", "</think>")).text == "The blue one."


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
    remedied(
        Workspace.open,
        "storage.workspace.Workspace.open",
        lambda: monkeypatch.setenv(VARIABLE, str(root)),
    )


def test_another_benchmark_gets_another_folder(tmp_path: Path) -> None:
    Workspace.create(tmp_path / "one", Study())
    remedied(
        lambda: Workspace.create(tmp_path / "one", Study(per_family=2)),
        "storage.workspace.Workspace.create",
        again=lambda: Workspace.create(tmp_path / "two", Study(per_family=2)),
    )


def test_a_study_of_another_format_goes_on_in_a_new_workspace_with_its_ledger(tmp_path: Path) -> None:
    old = Workspace.create(tmp_path / "old", Study())
    write(old.answers, answer("k", "left"), evaluation="m__standard__run1")
    file = old.root / "study.yaml"
    file.write_text(file.read_text().replace("format: ", "format: 9"))

    def anew() -> Workspace:
        new = Workspace.create(tmp_path / "new", Study())
        shutil.copytree(old.root / "ledger", new.root / "ledger", dirs_exist_ok=True)
        return Workspace.open(new.root)

    new = remedied(
        lambda: Workspace.open(old.root),
        "storage.workspace.Workspace.open",
        again=anew,
    )
    assert list(new.answers.read("m__standard__run1").rows) == ["k"]


def test_a_study_asks_inside_models_once_an_experiment_does(tmp_path: Path) -> None:
    root = Workspace.create(tmp_path / "study", Study()).root
    paper = load_experiment("mechanism")
    remedied(
        lambda: Workspace.open(root).mechanism,
        "storage.workspace.Workspace.mechanism",
        lambda: Workspace.open(root).allow(mechanism=paper.mechanism),
    )
