"""The harnesses put the same items, prompts and frames and score to the last digit as a study does; logs come back."""

from __future__ import annotations

import ast
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.build.harness import ours
from tests.conftest import EXPERIMENT, Checkout, forget_rows, once
from tests.release.environments import run_in
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.benchmark.held_out import opaque
from traps_pipeline.exchange.answer_exchange import Whose, import_answers
from traps_pipeline.models.answer_rows import RESPONSES
from traps_pipeline.models.prompts import system_prompt
from traps_pipeline.pipeline.experiment import load_experiment
from traps_pipeline.release.harness.scoring import RUN_FIGURES, figures, judge
from traps_pipeline.release.harness.write import SHOWN, copied, shown, write_harness
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.media import payload
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
MODELS = ("oracle", "always-abstain", "observer", "random-50")


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
            found = figures(judge(item, "answer", texts[item["item_id"]], regime) for item in items)
            assert {name: found[name] for name in ours(workspace, model, regime)} == ours(workspace, model, regime)
            seen += 1
    assert seen == 27


def test_what_is_no_answer_is_missing_and_decides_nothing(workspace: Workspace) -> None:
    item = next(row for row in workspace.tables.read_all(ITEMS).to_dict("records") if row["side"] == "control")
    for outcome, text, read in (
        ("answer", "", "empty"), ("refused", None, "refused"), ("truncated", "First I look", "truncated"),
        ("answer", "...", "degenerate"), ("answer", "<think>left", "degenerate"),
        ("answer", "Das lässt sich nicht bestimmen.", "unread"),
    ):  # fmt: skip
        judged = judge(item, outcome, text, "standard")
        assert (judged.outcome, judged.abstained, judged.correct, judged.right) == (read, None, None, False)
    shrugs = figures([judge(item, "answer", text, "standard") for text in ("", "IDK")])
    assert (shrugs["missing"], shrugs["unread"]) == (2, 1)


def test_its_items_prompts_and_frames_are_those_that_a_model_is_sent(
    harness: Path, workspace: Workspace, tmp_path: Path
) -> None:
    package = harness / "traps_harness"
    about = json.loads((package / "about.json").read_text())
    assert about["prompts"] == {regime: system_prompt(regime) for regime in ("guided", "json", "standard")}
    assert about["parameters"] == {"temperature": 0.8, "top_p": 0.95, "max_tokens": 8000}
    items = {row["item_id"]: row for row in map(json.loads, (package / "items.jsonl").read_text().splitlines())}
    asked = workspace.tables.read_all(ITEMS).to_dict("records")
    assert {*items} == {row["item_id"] for row in asked}
    for row in asked[::16]:
        sent = workspace.media.prepare(workspace.resolve(row["clip"]), row["media_digest"], SHOWN["images"])
        assert [(package / name).read_bytes() for name in items[row["item_id"]]["media"]] == payload(sent)
        assert items[row["item_id"]]["question"] == row["question"]


def test_its_code_is_the_pipelines_own_and_needs_nothing_of_it(harness: Path) -> None:
    paths = [*(harness / "traps_harness").glob("*.py")]
    for path in paths:
        names = [
            name
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Import | ast.ImportFrom)
            for name in ([node.module or ""] if isinstance(node, ast.ImportFrom) else [one.name for one in node.names])
        ]
        assert [name for name in names if name.startswith("traps_pipeline")] == []
        neighbours = [name.partition(".")[2] for name in names if name.startswith("traps_harness.")]
        assert {*neighbours} <= {each.stem for each in paths}
        allowed = {*sys.stdlib_module_names, "traps_harness", "inspect_ai"}
        assert [name for name in names if name.partition(".")[0] not in allowed] == []
    assert copied("from traps_pipeline.judging.rules import x\n") == "from traps_harness.rules import x\n"


def test_a_harness_is_made_of_a_whole_open_release_alone(released: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(released, tmp_path / "copy"))
    (copy / "prompts.jsonl").write_text("{}")
    with pytest.raises(TrapsError, match=r"is not what was released: prompts\.jsonl"):
        write_harness(copy, tmp_path / "out")
    with pytest.raises(TrapsError, match="holds other files"):
        write_harness(released, copy)
    with pytest.raises(TrapsError, match="--uniform: goes with --media images"):
        shown("video", 2)


# --- the real harnesses, in environments of their own -----------------------------------------------------------------

INSPECT = """
import json, sys
from importlib.metadata import version
from inspect_ai import eval
from inspect_ai.model import ModelOutput, ModelUsage, get_model
folder, answers, logs, regime, *models = sys.argv[1:]
sys.path.insert(0, folder)
from traps_task import traps
from traps_harness.harness_items import items
given, found = json.load(open(answers))[regime], {"version": version("inspect_ai")}
for model in models:
    outputs = [ModelOutput.from_content("mockllm/model", given[model][item["item_id"]]) for item in items()]
    for output in outputs:
        output.usage = ModelUsage(input_tokens=1, output_tokens=1, total_tokens=2)  # else it loads a tokenizer
    replay = get_model("mockllm/model", custom_outputs=outputs)
    (log,) = eval(traps(regime), model=replay, display="none", max_samples=1, log_dir=f"{logs}/{model}",
                  log_images=False, log_format="json" if model == "oracle" else "eval")
    assert log.status == "success", str(log.error)[:2000]
    for sample, item in zip(log.samples, items()):
        system, user = sample.messages[:2]
        kinds = [part.type for part in user.content]
        assert kinds == ["image"] * len(item["media"]) + ["text"], kinds
        assert (sample.id, user.content[-1].text) == (item["item_id"], item["question"])
        assert system.role == "system" and system.text.startswith("You are"), system.text[:80]
    found[model] = {name: one.value for score in log.results.scores for name, one in score.metrics.items()}
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def inspected(harness: Path, answers: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """Figures by model of the real inspect_ai, and the folder of its logs."""
    logs = tmp_path_factory.mktemp("logs")
    printed = run_in("inspect", "-c", INSPECT, harness, answers, logs, "standard", *MODELS, INSPECT_DISABLE_TRACE="1")
    return json.loads(printed.splitlines()[-1]), logs


@pytest.mark.parametrize("model", MODELS)
def test_inspect_ai_gives_the_same_figures_to_the_last_digit(
    inspected: tuple[dict[str, Any], Path], workspace: Workspace, model: str
) -> None:
    found = inspected[0][model]
    assert {name: found[name] for name in found if name not in ("missing", "unread")} == ours(
        workspace, model, "standard"
    )
    assert (found["missing"], found["unread"]) == (0, 0)


def test_inspect_ai_finds_the_task_in_its_file(harness: Path) -> None:
    listed = run_in("inspect", "-m", "inspect_ai", "list", "tasks", "traps_task.py", folder=harness)
    assert listed.split() == ["traps_task.py@traps"]


LMMS = """
import json, sys
from importlib.metadata import version
from lmms_eval import evaluator
from lmms_eval.api.model import lmms
from lmms_eval.loggers import EvaluationTracker
from lmms_eval.tasks import TaskManager
folder, answers, logs, regime, *models = sys.argv[1:]
given, found = json.load(open(answers))[regime], {"version": version("lmms_eval")}

class Replay(lmms):
    is_simple = True

    def __init__(self, name):
        super().__init__()
        self.name = name

    def generate_until(self, requests):
        said = []
        for context, _, visual, doc_id, task, split in (request.args for request in requests):
            doc = self.task_dict[task][split][doc_id]
            assert len(visual(doc)) == len(doc["media"]) and context.endswith("\\n\\n" + doc["question"])
            said.append(given[self.name][doc["item_id"]])
        return said

    def loglikelihood(self, requests):
        raise NotImplementedError

    generate_until_multi_round = loglikelihood

manager = TaskManager(include_path=f"{folder}/lmms", include_defaults=False)
for model in models:
    got = evaluator.simple_evaluate(model=Replay(model), tasks=[f"traps_{regime}"], task_manager=manager,
                                    log_samples=True, bootstrap_iters=0, batch_size=1)
    tracker = EvaluationTracker(output_path=f"{logs}/{model}")
    tracker.general_config_tracker.model_name_sanitized = model
    tracker.date_id = "now"
    tracker.save_results_samples(task_name=f"traps_{regime}", samples=got["samples"][f"traps_{regime}"])
    values = got["results"][f"traps_{regime}"]
    found[model] = {name.removeprefix("traps_").removesuffix(",none"): value for name, value in values.items()
                    if name.startswith("traps_") and "stderr" not in name}
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def lmms_evaluated(
    harness: Path, answers: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[dict[str, Any], Path]:
    """Figures by model of the real lmms-eval, and the folder of its samples."""
    logs = tmp_path_factory.mktemp("samples")
    printed = run_in("lmms", "-c", LMMS, harness, answers, logs, "standard", *MODELS, HF_HOME=str(logs / "cache"))
    return json.loads(printed.splitlines()[-1]), logs


@pytest.mark.parametrize("model", MODELS)
def test_lmms_eval_gives_the_same_figures_to_the_last_digit(
    lmms_evaluated: tuple[dict[str, Any], Path], workspace: Workspace, model: str
) -> None:
    expected = ours(workspace, model, "standard")
    assert lmms_evaluated[0][model] == {name: expected[name] for name in RUN_FIGURES} | {"missing": 0, "unread": 0}


# --- answers come back ------------------------------------------------------------------------------------------------


def imported_texts(workspace: Workspace, model: str, regime: str) -> dict[str, str]:
    rows = workspace.answers.read(f"{model}__{regime}__run1").settled.values()
    return {row["components"]["about"]["item_id"]: row["text"] for row in rows}


@pytest.mark.parametrize("model", ["oracle", "random-50"])
def test_an_inspect_log_is_imported_by_item(
    inspected: tuple[dict[str, Any], Path], demo_study: Checkout, answers: Path, model: str
) -> None:
    """Of oracle the log is JSON, of the other inspect's own format."""
    (log,) = (inspected[1] / model).iterdir()
    assert log.suffix == (".json" if model == "oracle" else ".eval")
    forget_rows(demo_study, "answers", f"{model}__standard__run1")
    finished = demo_study.traps("study", "import-answers", "demo", log, "--model", model)
    assert finished.code == 0 and finished.out.startswith("128 answers imported, 0 were there already"), finished.err
    given = json.loads(answers.read_text())["standard"][model]
    assert imported_texts(Workspace.open(demo_study.workspace), model, "standard") == given


def test_samples_of_lmms_eval_are_imported_by_item(
    lmms_evaluated: tuple[dict[str, Any], Path], demo_study: Checkout, answers: Path
) -> None:
    (samples,) = (lmms_evaluated[1] / "random-50").rglob("*_samples_*.jsonl")
    forget_rows(demo_study, "answers", "random-50__standard__run1")
    workspace = Workspace.open(demo_study.workspace)
    found = import_answers(workspace, load_experiment("demo"), samples, Whose("random-50"))
    assert (found.new, found.known) == (128, 0)
    given = json.loads(answers.read_text())["standard"]["random-50"]
    assert imported_texts(workspace, "random-50", "standard") == given


def test_answers_by_opaque_name_are_imported_with_the_key_of_the_held_out_set(
    unasked: Checkout, answers: Path, tmp_path: Path
) -> None:
    given = json.loads(answers.read_text())["json"]["random-50"]
    workspace, key = Workspace.open(unasked.workspace), bytes(32)
    ids = sorted(workspace.tables.read_all(ITEMS)["item_id"])
    lines = [{"item": opaque(key, id_), "regime": "json", "text": given[id_]} for id_ in ids]
    path = tmp_path / "answers.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    (tmp_path / "key").write_text("00" * 32)
    command = ("study", "import-answers", unasked.root / EXPERIMENT, path, "--model", "random-50")
    refused = unasked.traps(*command)
    assert refused.code == 1 and "under json, run 1, is not wanted of random-50" in refused.err
    finished = unasked.traps(*command, "--key", tmp_path / "key")
    assert finished.code == 0 and finished.out.startswith("48 answers imported"), finished.err
    assert imported_texts(workspace, "random-50", "json") == {id_: given[id_] for id_ in ids}


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ([{"item": "x", "regime": "json", "text": "left"}], "x under json, run 1, is not wanted of oracle"),
        ([{"item": "ID", "regime": "json", "text": text} for text in "ab"], "gives another answer"),
        ([{"item": "ID", "regime": "json", "text": "a", "cost": 3}], "cost: there is no such key"),
        ([{"item": "ID", "regime": "json", "text": "a", "run": [1]}], "gives no item, regime and text"),
        ([{"item": "ID", "regime": "json", "outcome": "error"}], "an error is no answer"),
    ],
)  # fmt: skip
def test_a_wrong_answer_by_item_is_named_and_nothing_is_imported(
    unasked: Checkout, tmp_path: Path, lines: list[dict[str, Any]], said: str
) -> None:
    workspace, experiment = Workspace.open(unasked.workspace), load_experiment(str(unasked.root / EXPERIMENT))
    id_ = str(workspace.tables.read_all(ITEMS)["item_id"][0])
    path = tmp_path / "answers.jsonl"
    path.write_text("".join(json.dumps(line).replace('"ID"', json.dumps(id_)) + "\n" for line in lines))
    with pytest.raises(TrapsError, match=said):
        import_answers(workspace, experiment, path, Whose("oracle"))
    with pytest.raises(TrapsError, match="say whose answers these are: --model, one of oracle, prior, random-50"):
        import_answers(workspace, experiment, path)
    assert workspace.answers.read("oracle__json__run1").settled == {}
