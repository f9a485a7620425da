"""`traps benchmark certify` on a folder: altered records fail by name and certificate, an untouched one passes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ROOT, Checkout
from traps_pipeline.base.paths import RELEASED

pytestmark = pytest.mark.slow

Record = dict[str, Any]


def change_answer(record: Record) -> None:
    record["ground_truth"] = next(label for label in record["labels"] if label != record["ground_truth"])


def start_the_twin_elsewhere(record: Record) -> None:
    record["twin"]["rollout"] += 1


# tests/scenes/test_certificates.py has what each certificate finds.
ALTERED: dict[str, tuple[Callable[[Record], None], str]] = {
    "head_on-0001": (change_answer, "outcome"),
    "pachinko_waterfall-0001": (start_the_twin_elsewhere, "twin: the twin's trajectory begins"),
}
UNTOUCHED = "slide-0001"


def copy_record(scenario_id: str, folder: Path, alter: Callable[[Record], None] = lambda _: None) -> None:
    """One released record and its trajectory, altered, into a benchmark folder."""
    family = scenario_id.rpartition("-")[0]
    lines = (RELEASED / f"{family}.jsonl").read_text().splitlines()
    record = next(r for r in map(json.loads, lines) if r["scenario_id"] == scenario_id)
    alter(record)
    (folder / "released" / "trajectories").mkdir(parents=True, exist_ok=True)
    (folder / "released" / f"{family}.jsonl").write_text(json.dumps(record) + "\n")
    shutil.copy(RELEASED / "trajectories" / f"{scenario_id}.npz", folder / "released" / "trajectories")


def test_altered_records_are_named_with_the_certificate_that_they_lose_and_an_untouched_one_passes(
    tmp_path: Path,
) -> None:
    for scenario_id, (alter, _) in ALTERED.items():
        copy_record(scenario_id, tmp_path, alter)
    copy_record(UNTOUCHED, tmp_path)
    finished = Checkout(ROOT, tmp_path / "workspace").traps("benchmark", "certify", "--specs", tmp_path)
    assert finished.code == 1 and "Traceback" not in finished.err
    for scenario_id, (_, lost) in ALTERED.items():
        assert f"traps: {scenario_id}: {lost}" in finished.err, finished.err
    assert f"traps: {UNTOUCHED}" not in finished.err and "1 of 3 scenarios certified" in finished.out
