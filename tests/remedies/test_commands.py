"""What a command says of its arguments, of an export or an import, and of the stages of a study lets it go on."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.build.entries import nobodys_own
from tests.conftest import EXPERIMENT, KEY, ROOT, Checkout
from tests.providers.server import Provider
from tests.remedies.remedied import command, refused, remedied
from traps_pipeline.base import paths
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.checks import doctor
from traps_pipeline.exchange import harness_logs
from traps_pipeline.exchange.answer_exchange import Whose, checked_answers, export_requests, import_answers
from traps_pipeline.exchange.batch import FOLDER, export_batches
from traps_pipeline.pipeline.experiment import load_experiment
from traps_pipeline.pipeline.graph import the_graph
from traps_pipeline.pipeline.selection import stages_until
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.workspace import Workspace

__all__ = ["nobodys_own"]  # the fixture
SMALL = ROOT / EXPERIMENT


@pytest.fixture
def unasked_copy(small: Checkout, tmp_path: Path) -> Workspace:
    """Clips and items of the small study, with nothing asked."""
    left_out = shutil.ignore_patterns("ledger", "dagster", "reports", "responses", "votes", "verdicts", "metrics")
    shutil.copytree(small.workspace, tmp_path / "study", ignore=left_out)
    return Workspace.open(tmp_path / "study")


# --- arguments --------------------------------------------------------------------------------------------------------


def test_stages_are_chosen_from_those_that_are_named() -> None:
    remedied(
        lambda: stages_until("leaderbord"),
        "pipeline.selection.stages_until",
        again=lambda: stages_until("leaderboard"),
    )
    remedied(
        lambda: the_graph()["leaderbord"],
        "pipeline.graph.Graph.__getitem__",
        again=lambda: the_graph()["leaderboard"],
    )


@pytest.mark.slow  # asks a server
def test_a_live_check_asks_a_model_with_an_address(provider: Provider, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        f"name: mine\npanel: rules\njudged_by_rules: true\nmodels:\n  - id: seer\n    base_url: {provider.url}/v1\n"
        f"    served_name: seer\n    key: {KEY}\n    media: images\n"
    )
    remedied(
        lambda: command("models", "check", "--live", "oracle"),
        "cli.models._check_live",
        again=lambda: command("models", "check", "--live", path),
    )


def test_an_export_in_batches_is_of_models_with_a_provider(unasked_copy: Workspace, tmp_path: Path) -> None:
    asks = yaml.safe_load(SMALL.read_text()) | {"datasets": ["chaotic"], "regimes": ["json"], "judged_by_rules": True}
    server = {"id": "seer", "base_url": "http://127.0.0.1:9/v1", "served_name": "seer", "media": "images"}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(asks | {"models": [server]}))
    (tmp_path / "here.yaml").write_text(yaml.safe_dump(asks | {"models": ["oracle", "prior"]}))

    def export(experiment: str, out: str, *more: str) -> Callable[[], None]:
        said = [
            "study",
            "export-requests",
            tmp_path / experiment,
            "--out",
            tmp_path / out,
            "--workspace",
            unasked_copy.root,
        ]
        return lambda: command(*said, *more)

    elsewhere = ("--media-at", "https://media.example.org")
    remedied(
        export("mine.yaml", "out", *elsewhere),
        "cli.exchange.export_calls",
        again=export("mine.yaml", "out", *elsewhere, "--batch"),
    )
    assert list((tmp_path / "out" / FOLDER).iterdir())
    for again in (export("here.yaml", "other"), export("mine.yaml", "third", "--batch")):
        remedied(
            export("here.yaml", "other", "--batch"),
            "exchange.batch.export_batches",
            again=again,
        )


@pytest.mark.slow  # runs a study
def test_a_budget_is_given_in_dollars(unasked_copy: Workspace) -> None:
    def run(*budgets: str) -> None:
        said = [part for budget in budgets for part in ("--budget-usd", budget)]
        finished = Checkout(ROOT, unasked_copy.root).traps("run", SMALL, "--until", "scene_specs", *said)
        if finished.code:
            raise TrapsError(finished.err)

    remedied(
        lambda: run("much"),
        "",
        again=lambda: run("20.50", "gpt-5-mini=3"),
    )
    study = Workspace.open(unasked_copy.root).study
    assert (study.budget_usd, study.model_budgets_usd) == (20.5, {"gpt-5-mini": 3.0})


def test_a_file_is_written_once_its_folder_is_made(unasked_copy: Workspace, tmp_path: Path) -> None:
    out = tmp_path / "gone" / "audit.csv"
    remedied(
        lambda: command("results", "audit", "--csv", out),
        "cli",
        lambda: out.parent.mkdir(),
        error=OSError,
    )


@pytest.mark.slow  # a server listens
def test_who_reviews_or_labels_is_said_once_each_in_plain_letters(small: Checkout, tmp_path: Path) -> None:
    from tests.integration.listening import listening

    root = Path(shutil.copytree(small.workspace, tmp_path / "study", ignore=shutil.ignore_patterns("dagster")))
    study = Checkout(ROOT, root)

    def listens(what: str, *people: str) -> Callable[[], None]:
        def call() -> None:
            with listening(study, what, *people) as server:
                assert server.addresses

        return call

    at = ("--workspace", root, "--token", "token-of-a-reviewer-0123")
    remedied(
        lambda: command("people", "review", *at, "--who", " "),
        "cli.review.review",
        again=listens("review", "jd"),
    )
    for wrong in (("jd", "jd"), ("j d",)):
        refused(lambda wrong=wrong: command("people", "annotate", *at, "--who", *wrong), "cli.annotate.annotate")
    remedied(
        lambda: command("people", "annotate", *at, "--who", "jd", "jd"),
        "cli.annotate.annotate",
        again=listens("annotate", "jd", "ab"),
    )


@pytest.mark.parametrize("instead", ["base.paths.require_own", "base.paths.require_own"])
def test_what_a_wheel_brought_is_left_and_a_file_of_ones_own_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, instead: str
) -> None:
    monkeypatch.setattr(paths, "IS_INSTALLED", True)
    monkeypatch.setattr(paths, "SHIPPED", tmp_path / "shipped")
    shipped, own = tmp_path / "shipped" / "a.csv", tmp_path / "a.csv"
    assert remedied(lambda: paths.require_own(shipped, instead), instead, again=lambda: paths.require_own(own, instead))


def test_another_workspace_is_chosen_where_the_disk_is_small(tiny_disk: Path, tmp_path: Path) -> None:
    remedied(
        lambda: doctor._disk(tiny_disk),
        "base.files.check_disk",
        again=lambda: doctor._disk(tmp_path),
    )


# --- exports and imports ----------------------------------------------------------------------------------------------


def test_an_export_goes_to_another_folder_or_to_one_that_was_deleted(unasked_copy: Workspace, tmp_path: Path) -> None:
    asks = load_experiment(str(SMALL)).model_copy(
        update={"models": ["prior"], "regimes": ["json"], "datasets": ["chaotic"]}
    )
    out, other = tmp_path / "out", tmp_path / "other"
    assert export_requests(unasked_copy, asks, out) > 0
    remedied(
        lambda: export_requests(unasked_copy, asks, out),
        "exchange.answer_exchange.export_requests",
        again=lambda: export_requests(unasked_copy, asks, other),
    )
    remedied(
        lambda: export_requests(unasked_copy, asks, out),
        "exchange.answer_exchange.export_requests",
        lambda: shutil.rmtree(out),
    )
    (out / FOLDER).mkdir(exist_ok=True)
    (out / FOLDER / "batch.jsonl").write_text("{}")
    remedied(
        lambda: export_batches({}, out),
        "exchange.batch.export_batches",
        again=lambda: export_batches({}, tmp_path / "third"),
    )
    remedied(
        lambda: export_batches({}, out),
        "exchange.batch.export_batches",
        lambda: shutil.rmtree(out / FOLDER),
    )


def test_answers_are_imported_once_it_is_said_whose_they_are_and_no_error_is_among_them(
    unasked_copy: Workspace, tmp_path: Path
) -> None:
    asks, path = load_experiment(str(SMALL)), tmp_path / "answers.jsonl"
    items = list(unasked_copy.tables.read_all(ITEMS)["item_id"])
    right = {"item": items[0], "regime": "json", "text": "left"}

    def written(*lines: dict[str, Any]) -> Callable[[], int]:
        return lambda: path.write_text("".join(json.dumps(line) + "\n" for line in lines))

    written(right)()
    found = remedied(
        lambda: import_answers(unasked_copy, asks, path),
        "exchange.answer_exchange._by_item",
        again=lambda: import_answers(unasked_copy, asks, path, Whose("prior")),
    )
    assert found.new == 1
    wrong = {"item": items[1], "regime": "json", "outcome": "error"}
    written(right, wrong)()
    found = remedied(
        lambda: import_answers(unasked_copy, asks, path, Whose("prior")),
        "exchange.answer_exchange._by_item",
        written(right),
    )
    assert (found.new, found.known) == (0, 1)
    given = tmp_path / "by_key.jsonl"
    given.write_text(json.dumps({"key": "k", "outcome": "error"}) + "\n")
    remedied(
        lambda: checked_answers(given, {}),
        "exchange.answer_exchange.checked_answers",
        lambda: given.write_text(""),
    )


def test_a_log_without_images_or_converted_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = tmp_path / "log.json"

    def logged(pixels: int) -> Callable[[], int]:
        sample = {"id": "x", "messages": ["i" * pixels]}
        return lambda: log.write_text(json.dumps({"samples": [], "images": sample}))

    with monkeypatch.context() as small_limits:
        small_limits.setattr(harness_logs, "MOST_LOG_BYTES", 1000)
        logged(2000)()
        remedied(
            lambda: list(harness_logs._json_log(log)),
            "exchange.harness_logs._json_log",
            logged(10),
        )
    zipped = tmp_path / "images.eval"

    def packed(pixels: int) -> Callable[[], None]:
        def write() -> None:
            about, output = {"item_id": "x", "regime": "json"}, {"completion": "left", "choices": []}
            sample = {"metadata": about, "output": output, "messages": ["i" * pixels]}
            with zipfile.ZipFile(zipped, "w") as archive:
                archive.writestr("samples/x.json", json.dumps(sample))

        return write

    with monkeypatch.context() as small_limits:
        small_limits.setattr(harness_logs, "MOST_SAMPLE_BYTES", 1000)
        packed(2000)()
        remedied(lambda: list(harness_logs._eval_log(zipped)), "exchange.harness_logs._eval_log", packed(10))
    broken = tmp_path / "log.eval"
    broken.write_bytes(b"no zip")
    remedied(
        lambda: list(harness_logs._eval_log(broken)),
        "exchange.harness_logs._eval_log",
        again=lambda: list(harness_logs._json_log(log)),
    )
