"""What a command says of its arguments, of an export or an import, and of the stages of a study lets it go on."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.build.entries import nobodys_own
from tests.conftest import EXPERIMENT, ROOT, Checkout
from tests.remedies.remedied import remedied
from traps_pipeline.exchange import harness_logs
from traps_pipeline.exchange.answer_exchange import AnswerContext, checked_answers, export_requests, import_answers
from traps_pipeline.exchange.provider_batch import FOLDER, export_batches
from traps_pipeline.pipeline.experiment import load_experiment
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
        "exchange.provider_batch.export_batches",
        again=lambda: export_batches({}, tmp_path / "third"),
    )
    remedied(
        lambda: export_batches({}, out), "exchange.provider_batch.export_batches", lambda: shutil.rmtree(out / FOLDER)
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
        "exchange.answer_exchange",
        again=lambda: import_answers(unasked_copy, asks, path, AnswerContext("prior")),
    )
    assert found.new == 1
    wrong = {"item": items[1], "regime": "json", "outcome": "error"}
    written(right, wrong)()
    found = remedied(
        lambda: import_answers(unasked_copy, asks, path, AnswerContext("prior")),
        "exchange.answer_exchange",
        written(right),
    )
    assert (found.new, found.known) == (0, 1)
    given = tmp_path / "by_key.jsonl"
    given.write_text(json.dumps({"key": "k", "outcome": "error"}) + "\n")
    remedied(
        lambda: checked_answers(given, {}), "exchange.answer_exchange.checked_answers", lambda: given.write_text("")
    )


def test_a_log_without_images_or_converted_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = tmp_path / "log.json"

    def logged(pixels: int) -> Callable[[], int]:
        sample = {"id": "x", "messages": ["i" * pixels]}
        return lambda: log.write_text(json.dumps({"samples": [], "images": sample}))

    with monkeypatch.context() as small_limits:
        small_limits.setattr(harness_logs, "MOST_LOG_BYTES", 1000)
        logged(2000)()
        remedied(lambda: list(harness_logs._json_log(log)), "exchange.harness_logs", logged(10))
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
        remedied(lambda: list(harness_logs._eval_log(zipped)), "exchange.harness_logs", packed(10))
    broken = tmp_path / "log.eval"
    broken.write_bytes(b"no zip")
    remedied(
        lambda: list(harness_logs._eval_log(broken)),
        "exchange.harness_logs",
        again=lambda: list(harness_logs._json_log(log)),
    )
