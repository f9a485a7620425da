"""A harness holds the items, prompts and frames of a study and scores as it does; answers come back by item.

The real programs run it in `test_pocket_harness.py`."""

from __future__ import annotations

import ast
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.build.errors import raises
from tests.build.harness import ours
from tests.conftest import EXPERIMENT, Checkout, once
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.benchmark.held_out import held_out_key, opaque_name
from traps_pipeline.exchange.answer_exchange import AnswerContext, import_answers
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.registry.prompts import system_prompt
from traps_pipeline.pipeline.experiment import load_experiment
from traps_pipeline.protocol.metric_words import METRIC_WORDS
from traps_pipeline.protocol.regimes import REGIMES
from traps_pipeline.release.harness.scoring import RUN_METRICS, judge, run_metrics
from traps_pipeline.release.harness.write import MEDIA_SETTINGS, media_settings, rewritten_source, write_harness
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.media import payload
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def harness(released: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    def make(folder: Path) -> str:
        return str(write_harness(released, folder))

    return once(tmp_path_factory, "harness", make)


@pytest.fixture(scope="module")
def workspace(demo: Checkout) -> Workspace:
    return Workspace.open(demo.workspace)


@pytest.fixture(scope="module")
def answers(workspace: Workspace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's answers: regime to model to item to text."""
    found: dict[str, dict[str, dict[str, str]]] = {}
    for row in workspace.tables.read_all(RESPONSES).to_dict("records"):
        found.setdefault(row["regime"], {}).setdefault(row["model"], {})[row["item_id"]] = row["text"]
    path = tmp_path_factory.mktemp("answers") / "answers.json"
    path.write_text(json.dumps(found))
    return path


def test_the_harness_scores_every_model_and_regime_of_the_demo_as_the_demo_does(
    workspace: Workspace, answers: Path
) -> None:
    items = workspace.tables.read_all(ITEMS).to_dict("records")
    given = json.loads(answers.read_text())
    seen = 0
    for regime, models in given.items():
        for model, texts in models.items():
            found = run_metrics(judge(item, "answer", texts[item["item_id"]], regime) for item in items)
            assert {name: found[name] for name in ours(workspace, model, regime)} == ours(workspace, model, regime)
            seen += 1
    assert seen == 27


def test_the_harness_has_every_metric_of_the_leaderboard() -> None:
    assert tuple(METRIC_WORDS) == RUN_METRICS


def test_what_is_no_answer_is_missing_and_decides_nothing(workspace: Workspace) -> None:
    item = next(row for row in workspace.tables.read_all(ITEMS).to_dict("records") if row["side"] == "control")
    for outcome, text, read in (
        ("answer", "", "empty"), ("refused", None, "refused"), ("truncated", "First I look", "truncated"),
        ("answer", "...", "degenerate"), ("answer", "<think>left", "degenerate"),
        ("answer", "Das lässt sich nicht bestimmen.", "unread"),
    ):  # fmt: skip
        judged = judge(item, outcome, text, "standard")
        assert (judged.outcome, judged.abstained, judged.correct, judged.is_right) == (read, None, None, False)
    shrugs = run_metrics([judge(item, "answer", text, "standard") for text in ("", "IDK")])
    assert (shrugs["missing"], shrugs["unread"]) == (2, 1)


def test_its_items_prompts_and_frames_are_those_that_a_model_is_sent(
    harness: Path, workspace: Workspace, tmp_path: Path
) -> None:
    package = harness / "traps_harness"
    about = json.loads((package / "about.json").read_text())
    assert about["prompts"] == {regime: system_prompt(regime) for regime in REGIMES if regime != "logprobs"}
    assert about["parameters"] == {"temperature": 0.8, "top_p": 0.95, "max_tokens": 8000}
    items = {row["item_id"]: row for row in map(json.loads, (package / "items.jsonl").read_text().splitlines())}
    asked = workspace.tables.read_all(ITEMS).to_dict("records")
    assert {*items} == {row["item_id"] for row in asked}
    for row in asked[::16]:
        sent = workspace.media.prepare(workspace.resolve(row["clip"]), row["media_digest"], MEDIA_SETTINGS["images"])
        assert [(package / name).read_bytes() for name in items[row["item_id"]]["media"]] == payload(sent)
        assert items[row["item_id"]]["question"] == row["question"]


def is_for_types(node: ast.stmt) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def test_its_code_is_the_pipelines_own_and_needs_nothing_of_it(harness: Path) -> None:
    paths = [*(harness / "traps_harness").glob("*.py")]
    for path in paths:
        tree = ast.parse(path.read_text())
        for_types = {id(each) for node in tree.body if is_for_types(node) for each in ast.walk(node)}
        names = [
            name
            for node in ast.walk(tree)
            if id(node) not in for_types
            if isinstance(node, ast.Import | ast.ImportFrom)
            for name in ([node.module or ""] if isinstance(node, ast.ImportFrom) else [one.name for one in node.names])
        ]
        assert [name for name in names if name.startswith("traps_pipeline")] == []
        neighbours = [name.partition(".")[2] for name in names if name.startswith("traps_harness.")]
        assert {*neighbours} <= {each.stem for each in paths}
        allowed = {*sys.stdlib_module_names, "traps_harness", "inspect_ai"}
        assert [name for name in names if name.partition(".")[0] not in allowed] == []
    assert rewritten_source("from traps_pipeline.judging.rules import x\n") == "from traps_harness.rules import x\n"


def test_a_harness_is_made_of_a_whole_open_release_alone(released: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(released, tmp_path / "copy"))
    (copy / "prompts.jsonl").write_text("{}")
    by = "release.harness.write"
    with raises(TrapsError, f"{by}.write_harness", str(copy), "prompts.jsonl"):
        write_harness(copy, tmp_path / "out")
    with raises(TrapsError, f"{by}.write_harness", str(copy)):  # which is not empty
        write_harness(released, copy)
    with raises(TrapsError, f"{by}.media_settings", "--uniform", "--media images"):
        media_settings("video", 2)


# --- answers come back ------------------------------------------------------------------------------------------------


BY_ITEM = "exchange.answer_exchange._answers_by_item"
BY_LINE = "exchange.harness_logs._plain_lines"


def imported_texts(workspace: Workspace, model: str, regime: str) -> dict[str, str]:
    rows = workspace.answers.read(f"{model}__{regime}__run1").settled.values()
    return {row["components"]["about"]["item_id"]: row["text"] for row in rows}


def test_answers_by_opaque_name_are_imported_with_the_key_of_the_held_out_set(
    unasked: Checkout, answers: Path, tmp_path: Path
) -> None:
    given = json.loads(answers.read_text())["json"]["random-50"]
    workspace, key = Workspace.open(unasked.workspace), held_out_key(tmp_path / "key", make=True)
    ids = sorted(workspace.tables.read_all(ITEMS)["item_id"])
    lines = [{"item": opaque_name(key, id_), "regime": "json", "text": given[id_]} for id_ in ids]
    path = tmp_path / "answers.jsonl"
    command = ("study", "import-answers", unasked.root / EXPERIMENT, path, "--model", "random-50")
    plain = [line | {"item": id_} for line, id_ in zip(lines, ids, strict=True)]
    failed = [line | {"text": "Error: 429 Too Many Requests"} for line in lines]
    keyed, by = ("--key", tmp_path / "key"), "exchange.answer_exchange."
    for given_lines, with_key, raised in (
        (lines, (), "_answers_by_item"), (plain, keyed, "_answers_by_item"), (failed, keyed, "import_answers")
    ):  # fmt: skip
        path.write_text("".join(json.dumps(line) + "\n" for line in given_lines))
        refused = unasked.traps(*command, *with_key)
        assert (refused.code, refused.raised) == (1, by + raised)
        assert [name for name in (lines[0]["item"], ids[0]) if name in refused.err] == [given_lines[0]["item"]]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    scored = tmp_path / "key.scored"
    for new, known in ((48, 0), (0, 48)):
        finished = json.loads(unasked.traps(*command, *keyed, "--json").ok().out)
        assert (finished["new"], finished["known"], len(scored.read_text().splitlines())) == (new, known, 1)
    path.write_text("".join(json.dumps(lines[0] | {"regime": regime}) + "\n" for regime in ("json", "standard")))
    assert " 3 scores" in unasked.traps(*command, *keyed).ok().err  # of two files, one of them under two regimes
    assert imported_texts(workspace, "random-50", "json") == {id_: given[id_] for id_ in ids}


@pytest.mark.parametrize(
    ("lines", "by", "named"),
    [
        ([{"item": "x", "regime": "json", "text": "left"}], BY_ITEM, ["answers.jsonl:1", " x ", "json", "oracle"]),
        ([{"item": "ID", "regime": "json", "text": text} for text in "ab"], BY_ITEM, ["answers.jsonl:2"]),
        ([{"item": "ID", "regime": "json", "text": "a", "cost": 3}], BY_ITEM, ["answers.jsonl:1", "cost"]),
        ([{"item": "ID", "regime": "json", "text": "a", "run": [1]}], BY_LINE, ["answers.jsonl:1", "run"]),
        ([{"item": "ID", "regime": "json", "outcome": "error"}], BY_ITEM, ["answers.jsonl:1", "outcome"]),
    ],
)
def test_a_wrong_answer_by_item_is_named_and_nothing_is_imported(
    unasked: Checkout, tmp_path: Path, lines: list[dict[str, Any]], by: str, named: list[str]
) -> None:
    workspace, experiment = Workspace.open(unasked.workspace), load_experiment(str(unasked.root / EXPERIMENT))
    id_ = str(workspace.tables.read_all(ITEMS)["item_id"][0])
    path = tmp_path / "answers.jsonl"
    path.write_text("".join(json.dumps(line).replace('"ID"', json.dumps(id_)) + "\n" for line in lines))
    with raises(TrapsError, by, *named) as refused:
        import_answers(workspace, experiment, path, AnswerContext("oracle"))
    assert str(refused.value).count("answers.jsonl:") == 1  # no other line
    with raises(TrapsError, BY_ITEM, "--model", "oracle, prior, random-50"):
        import_answers(workspace, experiment, path)
    assert workspace.answers.read("oracle__json__run1").settled == {}
