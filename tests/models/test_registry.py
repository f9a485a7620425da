"""A model is one entry of a YAML file; a wrong one is named with its field."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.registry.entries import get_model, load_models
from traps_pipeline.models.registry.judges import load_panel
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.protocol.cells import Evaluation
from traps_pipeline.protocol.regimes import REGIMES

GROUPS = "groups: {family: f, access: none, input: none, group: g}"


def registry(tmp_path: Path, *entries: str) -> Path:
    path = tmp_path / "models.yaml"
    path.write_text("models:\n" + "".join(f"  - {{{entry}}}\n" for entry in entries))
    return path


def entry(model_id: str, more: str = "") -> str:
    return f"id: {model_id}, backend: reference, params: {{strategy: oracle}}, {GROUPS}{more}"


def test_entries_keep_their_order_and_defaults(tmp_path: Path) -> None:
    models = load_models(registry(tmp_path, entry("z-2.5"), entry("a", ", runs: 1, limits: {retries: 0}")))
    assert list(models) == ["z-2.5", "a"]
    assert (models["z-2.5"].runs, models["a"].runs) == (3, 1)
    assert (models["z-2.5"].limits.concurrency, models["z-2.5"].limits.retries) == (24, 5)  # docs/spec.md 3.1
    assert models["a"].limits.retries == 0


@pytest.mark.parametrize(
    ("wrong", "names"),
    [
        (entry("Bad_Id"), ["2 (Bad_Id): id: ", "'Bad_Id'"]),
        (entry("a", ", colour: red"), ["2 (a): colour: "]),
        (entry("a", ", limits: {retrys: 3}"), ["2 (a): limits.retrys: "]),
        (entry("a", ", runs: 0"), ["2 (a): runs: "]),
        (f"id: a, backend: telepathy, {GROUPS}", ["2 (a): backend: ", "'telepathy'", "reference"]),
        (f"id: a, backend: reference, params: {{strategy: psychic}}, {GROUPS}", ["2 (a): ", "'psychic'", "oracle"]),
        (f"id: a, backend: rule, params: {{rule: thumb}}, {GROUPS}", ["2 (a): ", "'thumb'", "occluder, length"]),
        (f"id: a, backend: reference, {GROUPS}", ["2 (a): ", "strategy"]),
        (f"backend: reference, {GROUPS}", ["2 (?): id: "]),
    ],
)
def test_a_wrong_entry_is_named_with_its_field(tmp_path: Path, wrong: str, names: list[str]) -> None:
    with raises(TrapsError, "base.yamlfile.parse_yaml_model", "models.yaml:", *names):
        load_models(registry(tmp_path, entry("ok"), wrong))


def test_the_second_entry_of_a_name_is_named(tmp_path: Path) -> None:
    with raises(TrapsError, "models.registry.entries._add", "models.yaml: ", " 3: ", "'a'"):
        load_models(registry(tmp_path, entry("a"), entry("b"), entry("a")))


def test_a_file_without_models_says_what_it_must_hold(tmp_path: Path) -> None:
    path = tmp_path / "models.yaml"
    for text in ("", "[]", "judges: []", "models: 3"):
        path.write_text(text)
        load_models.cache_clear()
        with raises(TrapsError, "models.registry.entries.read_entries", "models.yaml", "models"):
            load_models(path)


def test_an_unknown_model_is_answered_with_the_known_ones() -> None:
    with raises(TrapsError, "models.registry.entries.get_model", "gpt-6", "gpt-5-nr"):
        get_model("gpt-6")


def test_every_model_regime_and_run_is_one_evaluation_model_outermost() -> None:
    expected = [
        (m.id, regime, run) for m in load_models().values() for regime in REGIMES for run in range(1, m.runs + 1)
    ]
    found = StudyPartitions(None).evaluations
    assert [(e.model, e.regime, e.run) for e in found] == expected
    assert Evaluation("oracle", "json", 2) not in found  # one run: no run2 key
    assert Evaluation("random-50", "json", 3) in found


def test_every_departure_of_an_entry_of_the_paper_is_a_waiver() -> None:
    refused, preview = {"temperature", "top_p"}, {"identifier"}
    departing = {
        "gemini-3.1-pro": preview,
        "gemini-3.1-pro-r-low": preview,
        "qwen3-vl-think": {"json_schema"},
        **dict.fromkeys(("gpt-5-pro", "gpt-5-high", "gpt-5-medium", "gpt-5-mini"), refused),
        "gpt-5-nr": refused | {"reasoning"},  # the paper has an effort of none
        "gemma-4-e4b": {"media"},  # 10 frames for 32
        "llava-next-video-7b": {"media"},
    }
    of_the_paper = [one for one in load_models().values() if one.groups.group in ("main", "replication")]
    assert len(of_the_paper) == 16
    assert {one.id: set(one.waivers) for one in of_the_paper if one.waivers} == departing
    # The paper retries no judge; a judge whose name differs says so.
    judges = {one.id: set(one.waivers) for one in load_panel("paper")}
    assert judges == {
        "judge-gemini-3-flash": {"identifier", "retries"},
        "judge-qwen3-vl-instruct": {"retries"},
        "judge-claude-opus-4.6": {"retries"},
    }
