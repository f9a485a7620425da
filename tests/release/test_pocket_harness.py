"""The pocket model, served to the real harnesses and to a study: the same answers to the same frames, the same PECS."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.build.harness import ours
from tests.conftest import ROOT, Checkout
from tests.release.environments import python_of, run_in
from tests.serving import transformers_serve
from traps_pipeline.exchange.harness_logs import log_reader
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.release.harness.scoring import RUN_METRICS
from traps_pipeline.release.harness.write import media_settings, write_harness
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
WEIGHTS = ROOT / "assets" / "pocket" / "weights"
DEMO = (ROOT / "assets" / "experiments" / "demo.yaml").read_text()
# Greedy, so that an answer is the same whoever asks.
EXPERIMENT = """name: served
models:
  - id: served
    base_url: {url}
    served_name: {weights}
    media: {{profile: images, uniform: 8}}
    params: {{temperature: 0.0, max_tokens: 32}}
    waivers: {{media: trained with eight frames, temperature: greedy, max_tokens: its answers are short}}
    runs: 1
panel: rules
judged_by_rules: true
regimes: [standard]
"""


@dataclass(frozen=True)
class Served:
    """A server of the pocket model, the harness of the demo's release, and a study that asked the same server."""

    url: str
    harness: Path
    workspace: Workspace

    @property
    def answers(self) -> dict[str, tuple[str, str]]:
        """The study's outcomes and texts by item."""
        rows = self.workspace.tables.read_all(RESPONSES).to_dict("records")
        return {row["item_id"]: (row["outcome"], row["text"]) for row in rows}


def logged(path: Path) -> dict[str, tuple[str, str]]:
    """Outcomes and texts by item as `traps study import-answers` reads them from a harness's log."""
    read = log_reader(path)
    assert read is not None
    return {one.item: (one.answer["outcome"], one.answer["text"]) for one in read(path)}


@pytest.fixture(scope="module")
def served(demo: Checkout, released: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("served")
    shutil.copytree(demo.workspace / "clips", folder / "study" / "clips")
    study = Checkout(ROOT, folder / "study")
    write_harness(released, folder / "harness", media_settings("images", 8))
    with transformers_serve(WEIGHTS, folder) as url:
        experiment = EXPERIMENT.format(url=url, weights=WEIGHTS) + DEMO[DEMO.index("scenarios:") :]
        (folder / "served.yaml").write_text(experiment)
        finished = study.traps("run", folder / "served.yaml", "--no-preflight", "--until", "leaderboard")
        assert finished.code == 0, finished.out + finished.err
        yield Served(url, folder / "harness", Workspace.open(study.workspace))


def test_inspect_ai_gets_the_same_answers_and_metrics(request: pytest.FixtureRequest, tmp_path: Path) -> None:
    python_of("inspect")
    served: Served = request.getfixturevalue("served")
    # As docs/release.md says it, but into a folder of the test (by its name inspect knows it for installed), offline.
    site = tmp_path / "site-packages"
    options = ("--no-index", "--no-deps", "--no-build-isolation", "--quiet", "--target", site)
    run_in("inspect", "-m", "pip", "install", *options, served.harness)
    model = ("--model", f"openai-api/pocket/{WEIGHTS}", "--model-base-url", served.url)
    as_asked = ("--temperature", "0", "--max-tokens", "32", "--no-log-images", "--display", "plain")
    command = ("-m", "inspect_ai", "eval", "traps_harness/traps", "-T", "regime=standard", *model, *as_asked)
    log = ("--log-dir", tmp_path / "logs", "--log-format", "json")
    run_in("inspect", *command, *log, folder=tmp_path, PYTHONPATH=str(site), POCKET_API_KEY="none")
    (path,) = (tmp_path / "logs").iterdir()
    assert logged(path) == served.answers and len(served.answers) == 136
    scores = json.loads(path.read_text())["results"]["scores"]
    values = {name: one["value"] for score in scores for name, one in score["metrics"].items()}
    expected = ours(served.workspace, "served", "standard")
    assert {name: values[name] for name in expected} == expected


def test_lmms_eval_gets_the_same_answers_and_metrics(request: pytest.FixtureRequest, tmp_path: Path) -> None:
    python_of("lmms")
    served: Served = request.getfixturevalue("served")
    model = ("--model", "openai", "--model_args", f"model_version={WEIGHTS},base_url={served.url},api_key=none")
    task = ("--include_path", served.harness / "lmms", "--tasks", "traps_standard")
    as_asked = ("--gen_kwargs", "temperature=0,max_new_tokens=32", "--log_samples", "--output_path", tmp_path / "logs")
    run_in("lmms", "-m", "lmms_eval", *model, *task, *as_asked, folder=tmp_path, HF_HOME=str(tmp_path / "cache"))
    (samples,) = (tmp_path / "logs").rglob("*samples*.jsonl")
    assert logged(samples) == served.answers and len(served.answers) == 136
    (results,) = (tmp_path / "logs").rglob("*results*.json")
    values = json.loads(results.read_text())["results"]["traps_standard"]
    expected = ours(served.workspace, "served", "standard")
    assert {name: values[f"traps_{name},none"] for name in RUN_METRICS} == {
        name: expected[name] for name in RUN_METRICS
    }
