"""Models and judges of one's own in four lines of an experiment, kept in its workspace."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.build.entries import nobodys_own
from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.registry.entries import account_of, get_model, load_models, user_registry
from traps_pipeline.models.registry.judges import load_panel, panel_id, thinking_of
from traps_pipeline.pipeline.experiment import load_experiment
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import VARIABLE, Workspace

__all__ = ["nobodys_own"]  # a fixture
MINE = """\
name: mine
models:
  - id: my-model
    base_url: http://127.0.0.1:8000/v1
    served_name: org/Model-7B
    media: images
regimes: [standard]
"""
JUDGES = """\
judges:
  - {id: judge-a, base_url: "http://127.0.0.1:8001/v1", served_name: a}
panels: {one: [judge-a]}
panel: one
"""


@pytest.fixture(autouse=True)
def _no_workspace(nobodys_own: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)


def written(tmp_path: Path, text: str) -> str:
    (tmp_path / "mine.yaml").write_text(text)
    return str(tmp_path / "mine.yaml")


def test_a_model_is_four_lines_and_the_protocol_fills_in_the_rest(tmp_path: Path) -> None:
    assert load_experiment(written(tmp_path, MINE)).models == ["my-model"]
    entry = get_model("my-model")
    assert entry.provider_id == "openai/org/Model-7B"
    assert entry.params == {"temperature": 0.8, "top_p": 0.95, "max_tokens": 8000}
    assert entry.media is not None and (entry.media.profile, entry.media.fps, entry.media.most) == ("images", 5, 25)
    assert entry.prices is not None and entry.prices.cost(10**6, 10**6) == 0  # a server on this machine sends no bill
    assert (account_of(entry).base_url, account_of(entry).key) == ("http://127.0.0.1:8000/v1", None)
    assert list(load_models())[-1] == "my-model"  # behind the registry's, so that partition keys keep their order


def test_elsewhere_the_price_is_unknown_until_it_is_given_and_a_departure_from_the_protocol_needs_its_reason(
    tmp_path: Path,
) -> None:
    text = MINE.replace("http://127.0.0.1:8000", "https://example.org")
    load_experiment(written(tmp_path, text))
    assert get_model("my-model").prices is None
    with raises(TrapsError, "base.yamlfile.parse_yaml_model", "mine.yaml", "params.temperature"):
        load_experiment(written(tmp_path, text.replace("media: images", "media: images\n    params: {temperature: 0}")))


def test_a_parameter_that_a_server_refuses_is_left_out_by_null(tmp_path: Path) -> None:
    lines = "media: images\n    params: {temperature: null, top_p: null, max_completion_tokens: 8000}\n"
    load = MINE.replace("media: images\n", lines)
    with raises(TrapsError, "base.yamlfile.parse_yaml_model", "mine.yaml", "params.temperature"):
        load_experiment(written(tmp_path, load))
    waived = lines + "    waivers: {temperature: refused, top_p: refused}\n"
    load_experiment(written(tmp_path, MINE.replace("media: images\n", waived)))
    assert get_model("my-model").params == {"max_completion_tokens": 8000}


def test_a_judge_declares_its_thinking_and_the_panel_is_another(tmp_path: Path) -> None:
    load_experiment(written(tmp_path, MINE + JUDGES))
    plain = panel_id("one")
    load_experiment(written(tmp_path, MINE + JUDGES.replace("served_name: a}", 'served_name: a, thinking: "[THINK]"}')))
    (judge,) = load_panel("one")
    assert judge.thinking == thinking_of("judge-a") == ("[THINK]", "[/THINK]") and panel_id("one") != plain


def test_a_panel_of_one_judge_of_ones_own_has_a_version(tmp_path: Path) -> None:
    assert load_experiment(written(tmp_path, MINE + JUDGES)).panel == "one"
    (judge,) = load_panel("one")
    assert judge.params == {"temperature": 0.8, "max_tokens": 512}
    first = panel_id("one")
    assert first.startswith("one@")
    load_experiment(written(tmp_path, MINE + JUDGES.replace("served_name: a}", "served_name: b}")))
    assert panel_id("one") != first


def test_the_workspace_keeps_what_an_experiment_brought(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    load_experiment(written(tmp_path, MINE))
    user_registry.save_entries(Workspace(tmp_path, Study(name="lab")))
    user_registry.add_entries(user_registry.UserRegistry(), Path("none"))
    with raises(TrapsError, "models.registry.entries.get_model", "my-model"):
        get_model("my-model")
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    user_registry.clear_caches()
    assert get_model("my-model").provider_id == "openai/org/Model-7B"
    newer = MINE.replace("Model-7B", "Model-8B") + JUDGES
    load_experiment(written(tmp_path, newer))
    user_registry.save_entries(Workspace(tmp_path, Study(name="lab")))
    user_registry.add_entries(user_registry.UserRegistry(), Path("none"))
    assert get_model("my-model").provider_id == "openai/org/Model-8B" and len(load_panel("one")) == 1


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("    media: images\n", "", "media: "),
        ("media: images", "media: pictures", "media.profile: "),
        ("id: my-model", "id: oracle", "'oracle'"),
        ("id: my-model", "id: My Model", "'My Model'"),
        ("served_name", "served", "served: "),
        ("  - id: my-model\n    base_url", "  - base_url", "`id`"),
    ],
)
def test_a_wrong_entry_of_ones_own_is_named_with_its_field(tmp_path: Path, old: str, new: str, field: str) -> None:
    with raises(TrapsError, "", "mine.yaml:", field):
        load_experiment(written(tmp_path, MINE.replace(old, new)))


TWO_JUDGES = """judges:
  - {id: judge-a, base_url: "http://127.0.0.1:9/v1"}
  - {id: judge-b, base_url: "http://127.0.0.1:9/v1"}
"""


@pytest.mark.parametrize(
    ("judges", "line", "twice"),
    [
        (TWO_JUDGES.replace("judge-b", "judge-a"), 1, "'judge-a'"),  # two entries of one id
        (f"{TWO_JUDGES}panels:\n  none-asks-it: [judge-a, judge-a, judge-b]\n", 5, "'judge-a', 'judge-a', 'judge-b'"),
    ],
)
def test_a_judge_twice_is_refused_in_its_line(tmp_path: Path, judges: str, line: int, twice: str) -> None:
    path = written(tmp_path, f"{judges}name: mine\nmodels: [oracle]\npanel: rules\n")
    with raises(TrapsError, "", f"mine.yaml:{line}: ", twice):
        load_experiment(path)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("media: images", "media: images\n    key: sk-0123456789abcdef"),
        ("media: images", "media: images\n    api_key: sk-0123456789abcdef"),
        ("media: images", "media: images\n    params: {api_key: sk-0123456789abcdef}"),
        ("media: images", "media: images\n    params: {extra_headers: {x-gate: sk-0123456789abcdef}}"),
        ("media: images", "media: images\n    params: {extra_body: {7: [{auth_token: sk-0123456789abcdef}]}}"),
        ("http://", "http://sk-0123456789abcdef@"),
        ("http://", "http://me:sk-0123456789abcdef@"),
        ("8000/v1", "8000/v1?token=sk-0123456789abcdef"),
    ],
)
def test_a_key_that_stands_in_an_entry_is_refused_and_not_repeated(tmp_path: Path, old: str, new: str) -> None:
    with raises(TrapsError, "", "mine.yaml:") as raised:
        load_experiment(written(tmp_path, MINE.replace(old, new)))
    assert "0123456789" not in str(raised.value)


def test_an_address_of_a_parameter_would_take_the_key_elsewhere(tmp_path: Path) -> None:
    for name in ("api_base", "base_url"):
        text = MINE.replace("media: images", f"media: images\n    params: {{{name}: 'http://elsewhere.invalid/v1'}}")
        with raises(TrapsError, "base.yamlfile.parse_yaml_model", name):
            load_experiment(written(tmp_path, text))


@pytest.mark.parametrize("name", ["4.10", "4", "true", "null", "''", "[m]"])
def test_a_served_name_that_yaml_reads_as_something_else_is_refused_and_kept_in_quotes(
    tmp_path: Path, name: str
) -> None:
    with raises(TrapsError, "", "mine.yaml", "served_name", "my-model"):
        load_experiment(written(tmp_path, MINE.replace("org/Model-7B", name)))
    quoted = name.strip("'") or "m"
    load_experiment(written(tmp_path, MINE.replace("org/Model-7B", f'"{quoted}"')))
    assert get_model("my-model").provider_id == f"openai/{quoted}"


def test_an_address_that_is_none_is_refused_lest_the_key_go_to_the_librarys_own(tmp_path: Path) -> None:
    for address in ("null", "true", "''"):
        with raises(TrapsError, "", "mine.yaml", "base_url", "my-model"):
            load_experiment(written(tmp_path, MINE.replace("http://127.0.0.1:8000/v1", address)))


@pytest.mark.parametrize(
    "params",
    [
        *("n: 4", "N: 1", "best_of: 2", "candidateCount: 2", "num_return_sequences: 2", "stream: true"),
        *("stream_options: {include_usage: true}", "model: other", "models: [a, b]", "messages: []", "system: x"),
        *("input: x", "contents: []", "systemInstruction: x", "generationConfig: {temperature: 0}", "tools: []"),
        *("tool_choice: none", "response_format: {type: text}", "guided_json: {}", "max_output_tokens: 9"),
        *("max_new_tokens: 9", "num_retries: 3", "timeout: 5", "mock_response: left", "fallbacks: [x]"),
        *("extra_body: {n: 4}", "extra_body: {options: {num_predict: 9}}", "extra_body: {temperature: 0}"),
        *("parameters: {top_p: 1}", "allowed_openai_params: [n]", "enable_search: true"),
    ],
)
def test_a_parameter_that_the_protocol_owns_is_refused_by_its_name(tmp_path: Path, params: str) -> None:
    text = MINE.replace("media: images", f"media: images\n    params: {{{params}}}")
    with raises(TrapsError, "base.yamlfile.parse_yaml_model", "mine.yaml", f"params.{params.partition(':')[0]}"):
        load_experiment(written(tmp_path, text))


def test_parameters_of_a_server_that_change_no_protocol_are_sent(tmp_path: Path) -> None:
    params = "seed: 1, top_k: 20, logprobs: true, extra_body: {chat_template_kwargs: {thinking: false}}"
    load_experiment(written(tmp_path, MINE.replace("media: images", f"media: images\n    params: {{{params}}}")))
    assert get_model("my-model").params["extra_body"] == {"chat_template_kwargs": {"thinking": False}}
