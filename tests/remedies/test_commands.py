"""What errors of an export and of a harness's log say to do lets them go on."""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path

import pytest

from tests.conftest import SMALL, Checkout
from tests.remedies.remedied import remedied
from traps_pipeline.exchange import harness_logs
from traps_pipeline.exchange.answer_exchange import export_requests
from traps_pipeline.exchange.harness_logs import log_reader
from traps_pipeline.exchange.provider_batch import FOLDER, export_batches
from traps_pipeline.pipeline.experiment import load_experiment
from traps_pipeline.storage.workspace import Workspace


def test_an_export_goes_to_another_folder_or_to_one_that_was_deleted(unasked: Checkout, tmp_path: Path) -> None:
    workspace = Workspace.open(unasked.workspace)
    few = {"models": ["prior"], "regimes": ["json"], "datasets": ["chaotic"]}
    asks, out, by = load_experiment(str(SMALL)).model_copy(update=few), tmp_path / "out", "exchange.answer_exchange"
    assert export_requests(workspace, asks, out) > 0

    def exported(folder: Path = out) -> int:
        return export_requests(workspace, asks, folder)

    remedied(exported, f"{by}.export_requests", again=lambda: exported(tmp_path / "other"))
    remedied(exported, f"{by}.export_requests", lambda: shutil.rmtree(out))
    (out / FOLDER).mkdir(exist_ok=True)
    (out / FOLDER / "batch.jsonl").write_text("{}")
    by = "exchange.provider_batch.export_batches"
    remedied(lambda: export_batches({}, out), by, lambda: shutil.rmtree(out / FOLDER))


@pytest.mark.parametrize("ending", ["json", "eval"])
def test_a_log_without_images_is_read(ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(harness_logs, "MAX_LOG_BYTES", 1000)
    monkeypatch.setattr(harness_logs, "MAX_SAMPLE_BYTES", 1000)
    log = tmp_path / f"log.{ending}"

    def write(pixels: int) -> None:
        about, output = {"item_id": "x", "regime": "json"}, {"completion": "left", "choices": []}
        sample = {"metadata": about, "output": output, "messages": ["i" * pixels]}
        if ending == "json":
            log.write_text(json.dumps({"samples": [sample]}))
            return
        with zipfile.ZipFile(log, "w") as archive:
            archive.writestr("samples/x.json", json.dumps(sample))

    write(2000)
    reader = log_reader(log)
    assert reader is not None
    (answer,) = remedied(lambda: list(reader(log)), "exchange.harness_logs", lambda: write(10))
    assert answer.item == "x"
