"""A leaderboard in the forms that others collect is accepted by their own readers, and holds the study's figures."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml

from tests.conftest import Checkout, copy_of
from tests.release.environments import run_in
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.scoring.score_rows import LEADERBOARD
from traps_pipeline.scoring.scores import score
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def written(small: Checkout, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    finished = small.traps("publish", "results", folder, "--dataset", "owner/traps", "--organization", "A lab")
    assert finished.code == 0 and finished.out.startswith("7 "), finished.err
    return folder


def test_every_form_holds_the_figures_of_the_leaderboard(written: Path, small: Checkout) -> None:
    tables = Workspace.open(small.workspace).tables
    board, n_items = tables.read_all(LEADERBOARD), len(tables.read_all(ITEMS))
    assert pq.read_table(written / "leaderboard.parquet").num_rows == len(board)
    for row in board.loc[board["dataset"] == "overall"].to_dict("records"):
        hub = yaml.safe_load((written / "eval_results" / f"{row['model']}.yaml").read_text())
        values = {entry["dataset"]["task_id"]: entry["value"] for entry in hub}
        assert values[f"traps_{row['regime']}"] == row["pecs"]
        (path,) = (written / "data" / "trapsbench" / "traps-pipeline" / row["model"]).iterdir()
        record = json.loads(path.read_text())
        scores = {one["evaluation_result_id"]: one["score_details"]["score"] for one in record["evaluation_results"]}
        assert {one["source_data"]["samples_number"] for one in record["evaluation_results"]} == {n_items}
        for name in ("pecs", "acc", "abs_rec", "false_abs", "j"):
            assert scores[f"trapsbench/{row['regime']}/{name}"] == row[name]


def test_results_of_a_held_out_set_count_the_items_that_it_asks(small: Checkout, tmp_path: Path) -> None:
    study, folder = copy_of(small, tmp_path), tmp_path / "results"
    tables = Workspace.open(study.workspace).tables
    verdicts = tables.read_all(VERDICTS)
    turn = verdicts["pair_id"].rank(method="dense") % 2
    asked = verdicts.loc[(verdicts["side"] == "void") == (turn == 1)]  # one item of each pair
    tables.write(LEADERBOARD, {}, score(asked).board, {})
    study.traps("publish", "results", folder, "--dataset", "owner/traps").ok()
    records = [json.loads(path.read_text()) for path in (folder / "data").rglob("*.json")]
    counts = {one["source_data"]["samples_number"] for record in records for one in record["evaluation_results"]}
    assert counts == {len({*asked["item_id"]})} == {len({*verdicts["item_id"]}) // 2}


def test_the_hubs_library_reads_the_results(written: Path) -> None:
    read = "import sys, yaml; from huggingface_hub import parse_eval_result_entries as parse; "
    read += "print([(e.dataset_id, e.task_id, e.value) for e in parse(yaml.safe_load(open(sys.argv[1])))])"
    printed = run_in("hub", "-c", read, written / "eval_results" / "oracle.yaml")
    assert printed.strip() == "[('owner/traps', 'traps_json', 1.0), ('owner/traps', 'traps_standard', 1.0)]"


def test_every_eval_ever_validates_the_records(written: Path) -> None:
    files = sorted(path.relative_to(written) for path in (written / "data").rglob("*.json"))
    printed = run_in("eval", "-m", "every_eval_ever", "validate", "--format", "json", *files, folder=written)
    found = json.loads(printed)
    assert [(one["valid"], one["errors"], one["warnings"]) for one in found] == [(True, [], [])] * 3
