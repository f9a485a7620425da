"""One folder holds one study, and says so when it holds another."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.storage.study import FORMAT, MechanismSettings, Study
from traps_pipeline.storage.workspace import Workspace


def edit(root: Path, **changes: Any) -> None:
    path = root / "study.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | changes))


def test_a_created_workspace_opens_with_its_study(tmp_path: Path) -> None:
    study = Study(per_family=2, epoch="2026-11", budget_usd=12.5)
    Workspace.create(tmp_path / "w", study)
    opened = Workspace.open(tmp_path / "w").study
    assert re.fullmatch(r"w-[0-9a-f]{8}", opened.name)  # the folder's name, and where it was made
    assert opened.model_copy(update={"name": ""}) == study
    assert yaml.safe_load((tmp_path / "w" / "study.yaml").read_text()) == {
        "name": opened.name,
        "experiments": {},
        "account_budgets": {},
        "format": FORMAT,
        "benchmark": "released",
        "per_family": 2,
        "panel": "",  # an experiment or the command names it
        "judged_by_rules": False,
        "epoch": "2026-11",
        "budget_usd": 12.5,
        "model_budgets_usd": {},
        "allow_unknown_prices": False,
    }
    assert [path.name for path in (tmp_path / "w").glob(".*")] == []


def test_creating_it_again_opens_it_and_keeps_what_was_edited(tmp_path: Path) -> None:
    Workspace.create(tmp_path, Study(scenarios=["plinko-0001"]))
    edit(tmp_path, epoch="2", budget_usd=5.0)
    again = Workspace.create(tmp_path, Study(scenarios=["plinko-0001"]))
    assert (again.study.epoch, again.study.budget_usd) == ("2", 5.0)


@pytest.mark.parametrize(
    ("wanted", "field"),
    [(Study(per_family=3), "per_family"), (Study(benchmark="sampled-1"), "benchmark"), (Study(), "per_family")],
)
def test_another_benchmark_or_subset_is_refused_with_the_remedy(tmp_path: Path, wanted: Study, field: str) -> None:
    Workspace.create(tmp_path, Study(per_family=2))
    named = field, repr(getattr(wanted, field)), "TRAPS_WORKSPACE"
    with raises(TrapsError, "storage.workspace.Workspace.create", *named):
        Workspace.create(tmp_path, wanted)


@pytest.mark.parametrize("other", [FORMAT + 1, 0, None])
def test_a_workspace_of_another_format_is_refused_with_the_remedy(tmp_path: Path, other: int | None) -> None:
    Workspace.create(tmp_path, Study())
    edit(tmp_path, format=other)
    with raises(TrapsError, "storage.workspace.Workspace.open", "study.yaml"):
        Workspace.open(tmp_path)


@pytest.mark.parametrize(
    ("text", "by", "named"),
    [
        (b"format: [1", "base.yamlfile.read_yaml", []),
        (b"\xff\xfe\x00", "base.yamlfile.read_yaml", []),
        (b"just words", "storage.workspace.Workspace.open", ["'just words'", str(FORMAT)]),
        (b"format: 1\nbudget: 3", "base.yamlfile.parse_yaml_model", ["budget", "budget_usd"]),
        (b"format: 1\nbudget_usd: -3", "base.yamlfile.parse_yaml_model", ["budget_usd"]),
        (b"format: 1\nper_family: 2\nscenarios: [a-1]", "base.yamlfile.parse_yaml_model", ["scenarios", "per_family"]),
    ],
)
def test_a_malformed_study_names_its_file_and_the_field(tmp_path: Path, text: bytes, by: str, named: list[str]) -> None:
    (tmp_path / "study.yaml").write_bytes(text)
    with raises(TrapsError, by, "study.yaml", *named):
        Workspace.open(tmp_path)


def test_a_clip_of_another_scene_has_another_path_and_tables_store_it_relative(tmp_path: Path) -> None:
    workspace = Workspace.create(tmp_path, Study())
    one, two = (workspace.clip("plinko-0001", "void", digit * 64) for digit in "ab")
    assert one != two
    assert workspace.relative(one) == f"clips/plinko-0001/void-{'a' * 16}.mp4"
    assert workspace.resolve(workspace.relative(one)) == one


def test_a_study_that_steers_nothing_still_does_so_when_it_is_opened(tmp_path: Path) -> None:
    settings = {"models": {"qwen3-vl-8b": {"steering": 16, "centroid": 3}}, "steering": None}
    study = Study(mechanism=MechanismSettings.model_validate(settings))
    Workspace.create(tmp_path, study)
    assert Workspace.open(tmp_path).mechanism.steering is None
    assert Workspace.open(tmp_path).mechanism == study.mechanism


@pytest.mark.parametrize(("name", "sign"), [("a?b", "'?'"), ("a%41b", "'%41'")])
@pytest.mark.parametrize("is_home", [False, True])
def test_a_folder_that_dagsters_history_cannot_lie_in_is_refused_before_anything_is_written(
    name: str, sign: str, is_home: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if is_home:
        monkeypatch.setenv("DAGSTER_HOME", str(tmp_path / name))
    else:
        monkeypatch.delenv("DAGSTER_HOME", raising=False)
    with raises(TrapsError, "base.paths.require_history_path", sign, "DAGSTER_HOME"):
        Workspace.create(tmp_path / ("study" if is_home else name), Study(name="study"))
    assert not list(tmp_path.iterdir())


@pytest.mark.promise
@pytest.mark.parametrize("name", ["a#b", "a%b", "a b"])
def test_a_folder_with_other_signs_keeps_a_history(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRAPS_WORKSPACE", str(tmp_path / name))
    monkeypatch.setenv("DAGSTER_HOME", str(tmp_path / name / "dagster"))
    workspace = Workspace.create(tmp_path / name, Study(name="study"))
    with dagster_history(workspace) as history:
        assert history.get_runs() == []
    assert (tmp_path / name / "dagster" / "dagster.yaml").is_file()


def test_a_history_whose_settings_name_the_storage_of_0_3_0_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DAGSTER_HOME", str(tmp_path / "dagster"))
    workspace = Workspace.create(tmp_path, Study(name="study"))
    custom = {"module": "traps_pipeline.pipeline.event_storage", "class": "SqliteStorage"}
    custom["config"] = {"base_dir": {"env": "DAGSTER_HOME"}}
    (tmp_path / "dagster" / "dagster.yaml").write_text(yaml.safe_dump({"storage": {"custom": custom}}))
    with dagster_history(workspace) as history:
        assert history.get_runs() == []
