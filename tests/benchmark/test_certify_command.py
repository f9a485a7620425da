"""`traps benchmark certify` on a folder: altered records fail by name and certificate, an untouched one passes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ROOT, Checkout, Finished
from traps_pipeline.base.paths import RELEASED

pytestmark = pytest.mark.slow

Record = dict[str, Any]


def lower_panel(record: Record) -> None:
    panel = record["void"]["panel"]
    panel["centre"][2] /= 2
    panel["half"][2] /= 2


def raise_panel(record: Record) -> None:
    panel = record["void"]["panel"]
    panel["centre"][2] *= 1.5
    panel["half"][2] *= 1.5


def change_answer(record: Record) -> None:
    record["ground_truth"] = next(label for label in record["labels"] if label != record["ground_truth"])


def close_the_gap(record: Record) -> None:
    assert record["params"]["gap_open"]
    record["params"]["gap_open"] = False


def widen_margin(record: Record) -> None:
    record["evidence"]["margin_m"] += 0.05


def cut_later(record: Record) -> None:
    record["void"]["cut_frame"] += 8


def start_the_twin_elsewhere(record: Record) -> None:
    record["twin"]["rollout"] += 1


ALTERED: dict[str, tuple[Callable[[Record], None], str]] = {
    "hidden_race-0001": (lower_panel, "hidden"),
    "domino_chain-0001": (close_the_gap, "physics"),
    "chain-0001": (raise_panel, "referents: something that the question names has 0 pixels"),
    "head_on-0001": (change_answer, "outcome"),
    "plinko-0001": (cut_later, "open"),
    "pachinko_waterfall-0001": (start_the_twin_elsewhere, "twin: the twin's trajectory begins"),
    "bounce-0001": (widen_margin, "outcome: margin_m is"),
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


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    folder = tmp_path_factory.mktemp("altered")
    for scenario_id, (alter, _) in ALTERED.items():
        copy_record(scenario_id, folder, alter)
    copy_record(UNTOUCHED, folder)
    return Checkout(ROOT, folder / "workspace").traps("benchmark", "certify", "--specs", folder)


@pytest.mark.parametrize("scenario_id", ALTERED)
def test_an_altered_record_is_named_with_the_certificate_it_loses(finished: Finished, scenario_id: str) -> None:
    assert finished.code == 1
    assert "Traceback" not in finished.err
    assert f"traps: {scenario_id}: {ALTERED[scenario_id][1]}" in finished.err, finished.err


def test_an_untouched_record_passes_beside_altered_ones(finished: Finished) -> None:
    assert f"traps: {UNTOUCHED}" not in finished.err
    assert "1 of 8 scenarios certified" in finished.out
