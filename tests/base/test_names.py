"""A name is refused before it becomes a key, a file, an option or a value that says something else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import dagster as dg
import pytest
import yaml

from tests.build.entries import nobodys_own
from tests.build.errors import raises
from traps_pipeline.base.names import MAX_NAME_LENGTH, check_name
from traps_pipeline.cli import main
from traps_pipeline.protocol.cells import Cell, Evaluation

__all__ = ["nobodys_own"]  # a fixture
KEYS = ["", "a_b", "a__b", "A", "a|b", "a/b", "a b", "a,b", "a\n", "ä", "a\u0663"]
PATHS = [".", "..", "a..b", "a...b", ".a", "a.", "-a", "a-", "a" * (MAX_NAME_LENGTH + 1)]
VALUES = ["1", "1.5", "1e3", "0x1f", "0b1", "2026-11-01", "2026-13-45", "20261101", "nan", "inf", "infinity"]
VALUES += ["true", "false", "yes", "no", "on", "off", "null"]


@pytest.mark.parametrize("name", [*KEYS, *PATHS, *VALUES])
def test_a_name_that_becomes_something_else_is_refused(name: str) -> None:
    with raises(ValueError, "base.names.check_name"):
        check_name(name)


@pytest.mark.parametrize("name", ["m", "gpt-5", "qwen3-vl-8b.2", "4o", "7b-1e3", "a--b", "a" * MAX_NAME_LENGTH])
def test_any_other_name_is_a_key_a_file_and_a_text(name: str, tmp_path: Path) -> None:
    assert check_name(name) == name
    key = Cell("occlusion_ill_posed", Evaluation(name, "standard", 1)).evaluation.key
    assert dg.StaticPartitionsDefinition([key]).get_partition_keys() == [key]
    (tmp_path / f"{name}@{name}__standard__run1.lock").touch()
    assert yaml.safe_load(f"[{name}]") == [name]


@pytest.mark.parametrize("field", ["models", "judges", "panels", "accounts", "name"])
def test_a_wrong_name_in_an_experiment_is_one_sentence_and_leaves_no_workspace(
    field: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    described = {"id": "a...b", "base_url": "http://127.0.0.1:9/v1", "media": "images"}
    wrong = {
        "models": {"models": [described]},
        "judges": {"judges": [{"id": "a...b", "base_url": described["base_url"]}]},
        "panels": {"panels": {"a...b": ["judge"]}},
        "accounts": {"accounts": {"a...b": {}}},
        "name": {"name": "2026"},
    }
    experiment = {"name": "x", "models": ["oracle"], "panel": "rules", "datasets": ["occlusion"]} | wrong[field]
    (tmp_path / "x.yaml").write_text(yaml.safe_dump(experiment))
    code = main(["run", str(tmp_path / "x.yaml"), "--workspace", str(tmp_path / "study")])
    (sentence,) = capsys.readouterr().err.splitlines()
    assert code == 1
    assert "[a-z0-9.-]+" in sentence and sentence.count("x.yaml:") == 1
    assert not (tmp_path / "study").exists()


@pytest.mark.parametrize("wrong", [{"scenarios": ["domino_chian-0001"]}, {"benchmark": "other"}], ids=str)
def test_a_name_that_nothing_has_leaves_no_workspace_and_the_corrected_one_makes_it(
    wrong: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    right = {"name": "x", "models": ["oracle"], "panel": "rules", "scenarios": ["domino_chain-0001"]}
    codes = []
    for experiment in (right | wrong, right):
        (tmp_path / "x.yaml").write_text(yaml.safe_dump(experiment))
        codes.append(main(["init", str(tmp_path / "x.yaml"), "--workspace", str(tmp_path / "study")]))
        codes.append((tmp_path / "study").exists())
    assert codes == [1, False, 0, True]
    assert str(next(iter(wrong.values()))) in capsys.readouterr().err
