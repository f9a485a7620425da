"""One strict door for files: any bytes give plain values or one sentence that names the file."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import yaml
from pydantic import BaseModel, ValidationError

from tests.build.errors import raises
from tests.conftest import ROOT
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.yamlfile import faults_of, read_lines, read_yaml
from traps_pipeline.models.registry.accounts import Account, Prices
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.models.registry.user_registry import UserRegistry
from traps_pipeline.pipeline.experiment import Experiment, load_experiment
from traps_pipeline.storage.study import MechanismSettings, Study
from traps_pipeline.storage.workspace import Workspace


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "file.yaml"


def test_what_is_shipped_reads_as_any_reader_reads_it() -> None:
    files = [*(ROOT / "assets").rglob("*.yaml"), *(ROOT / "scene_specs").rglob("*.yaml")]
    files += [*(ROOT / "tests" / "experiments").glob("*.yaml")]
    assert len(files) > 10
    for path in files:
        plain = yaml.safe_load(path.read_text())
        assert json.dumps(read_yaml(path)) == json.dumps(plain, default=str), path


@pytest.mark.parametrize(
    "text",
    [
        "a: 1\nb: 2\na: 3",
        "a: {b: 1, b: 2}",
        "a: &x [1]\nb: &y [*x, *x]",
        "a: &x [1]\nb: [" + "*x, " * 300 + "]",
        "a: !!python/object/apply:os.system [ls]",
        "a: !!float .inf",
        "!!int a: 5",
        "a: !!map [1]",
        "a: !own {b: 1}",
        "a: ! 5",
        "%TAG !e! tag:yaml.org,2002:\n---\na: !e!bool abc",
        "a: !<tag:evil.example,2026:x> 1",
        "a: 1e999",
        "? [1, 2]\n: 3",
        "[" * 100,
        'a: "\\ud800"',
        "a: \x00",
    ],
)
def test_what_two_readers_could_take_for_two_things_is_refused(file: Path, text: str) -> None:
    file.write_text(text)
    with raises(TrapsError, "base.yamlfile.read_yaml", "file.yaml"):
        read_yaml(file)


def test_words_that_early_yaml_takes_for_something_else_are_words(file: Path) -> None:
    said = "a: yes\nb: 1:30\nc: 010\nd: 2026-11-21\ne: .inf\nf: 0x10\ng: 1_000\nh: off\ni: ~\nj: true\nk: 1.5e-3\nl: -7"
    file.write_text(said)
    assert read_yaml(file) == {
        **{"a": "yes", "b": "1:30", "c": "010", "d": "2026-11-21", "e": ".inf", "f": "0x10", "g": "1_000"},
        **{"h": "off", "i": None, "j": True, "k": 0.0015, "l": -7},
    }


@pytest.mark.parametrize("said", ["yes", "true", "1:30", ".inf", ".nan", "010", '"20"', "2_0", "1e999", "-1", "[20]"])
def test_a_budget_is_a_number_and_nothing_that_looks_like_one(tmp_path: Path, said: str) -> None:
    (tmp_path / "study.yaml").write_text(f"format: 1\nbudget_usd: {said}\n")
    with raises(TrapsError, "base.yamlfile", "study.yaml"):
        Workspace.open(tmp_path)


@pytest.mark.parametrize(
    "line",
    [
        '{"a": 1, "a": 2}',
        '{"b": [{"a": 1, "a": 2}]}',
        '{"a": NaN}',
        '{"a": -Infinity}',
        '{"a": 1e999}',
        '{"a": "\\ud83d"}',
        '{"a": ' + "9" * 5000 + "}",
        "[" * 5000,
    ],
)
def test_an_ambiguous_line_is_named(file: Path, line: str) -> None:
    file.write_text(f'{{"a": "\\ud83d\\ude00 [[[["}}\n{line}\n')
    lines = read_lines(file)
    assert next(lines)[0] == 1
    with raises(TrapsError, "base.yamlfile.check_line", "file.yaml:2") as raised:
        next(lines)
    assert len(str(raised.value)) < 400 + len(str(file))


MODEL = """models:
  - id: my-model
    base_url: http://127.0.0.1:9/v1
    media: images
"""


@pytest.mark.parametrize(
    ("text", "line", "near"),
    [
        (f"name: a\npanel: rules\nscenarios: []\n{MODEL}", 3, ""),
        (f"name: a\npanel: rules\nscenarios: [plinko-0001, plinko_0002]\n{MODEL}", 3, "plinko-0002"),
        (f"name: a\npanel: rulez\n{MODEL}", 2, "rules"),
        (f"name: a\n{MODEL}    serverd_name: x\n", 6, "served_name"),
        (f"name: a\n{MODEL}    limits:\n      concurency: 3\n", 7, "concurrency"),
        (f"name: a\n{MODEL}  - orcale\n", 6, "oracle"),
        (f"name: a\nruns: 3\n{MODEL}", 2, ""),
        (f"name: a\n{MODEL}  - 5\n", 6, ""),
        ("name: a\npanel: rules\n", 1, ""),
        ("[]", 1, ""),
    ],
)
def test_a_fault_is_blamed_on_its_file_and_line_with_the_word_that_was_meant(
    text: str, line: int, near: str, file: Path
) -> None:
    file.write_text(text)
    with raises(TrapsError, "", f"{file}:{line}: ") as refused:
        load_experiment(str(file))
    assert re.findall(r"did you mean ([\w-]+)\?", str(refused.value)) == ([near] if near else [])
    file.write_text("")
    with raises(TrapsError, "", f"{file}: "):
        load_experiment(str(file))


@pytest.mark.parametrize("kind", [Experiment, Study, ModelEntry, Account, MechanismSettings, UserRegistry, Prices])
def test_no_sentence_of_the_validator_reaches_a_person(kind: type[BaseModel]) -> None:
    wrong = (None, "", "x y", 3, -1, -1.5, True, [], [5], {}, {"a": 1}, [[]], [{}])
    n_refused = 0
    for fields in [None, [], *({name: value} for name in kind.model_fields for value in wrong)]:
        try:
            kind.model_validate(fields, context={"accounts": {}})
        except ValidationError as error:
            text, n_refused = faults_of(error, kind), n_refused + 1
            own = [details["msg"] for details in error.errors() if details["type"] != "value_error"]
            assert text and not any(sentence in text for sentence in own), f"{fields}: {text}"
            assert "{" not in re.sub(r"not [\[{'].*", "", text), text  # a gap that nothing fills
    assert n_refused > len(kind.model_fields)


@pytest.mark.parametrize(
    ("line", "field", "near"),
    [
        ("modls: [oracle]", "modls", "models"),
        ("mechanism: {promts: [guided]}", "mechanism.promts", "prompts"),
        ("weather: fine", "weather", ""),
    ],
)
def test_an_unknown_key_is_told_with_the_known_one_that_it_resembles(
    line: str, field: str, near: str, file: Path
) -> None:
    file.write_text(line)
    with raises(TrapsError, "base.yamlfile.parse_yaml_model", field) as refused:
        load_experiment(str(file))
    assert re.findall(r"(\w+)\?", str(refused.value)) == ([near] if near else [])
