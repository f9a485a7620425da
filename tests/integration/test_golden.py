"""The golden study as a user sees it: from records to the report, and what a second command then finds to do."""

from __future__ import annotations

import json
import re

import pytest

from tests.conftest import EXPERIMENT, Checkout
from tests.tables import TABLES
from traps_pipeline.benchmark.records import load_release
from traps_pipeline.scoring.score_rows import LEADERBOARD, METRICS
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.promise
ANSWERS = 3 * 2 * 48  # models x regimes x items of 12 scenarios in two datasets, two sides
VOTES = ANSWERS // 2 * 9  # three judges on a control's two tasks and on a void's one


def test_one_command_goes_from_records_to_the_leaderboard_and_the_report(small: Checkout, small_output: str) -> None:
    assert f"{ANSWERS} answers asked (0 from the ledger)\n{VOTES:,} votes asked (0 from the ledger)\n" in small_output
    reports = small.workspace / "reports"
    for kind, page in (("report", reports / "report.html"), ("explorer", reports / "index.html")):
        assert f"{kind} {page}" in small_output.splitlines()
        assert page.stat().st_size > 1000


def test_the_oracle_scores_one_and_nothing_is_missing(small: Checkout) -> None:
    tables = Workspace.open(small.workspace).tables
    board = tables.read(LEADERBOARD, {}).query("model == 'oracle'")
    assert len(board) == 2 * 5  # regimes x (four datasets and overall)
    assert (board[["acc", "abs_rec", "pecs", "pecs_ci_high"]] == 1.0).all().all()
    assert (board["pecs_ci_low"] < 0.95).all()
    assert (tables.read_all(METRICS)["n_missing"] == 0).all()


def test_every_table_that_was_made_knows_its_benchmark_version(small: Checkout) -> None:
    workspace, made = Workspace.open(small.workspace), 0
    for table in TABLES.values():
        rows = workspace.tables.read_all(table)
        made += not rows.empty
        assert set(rows.get("benchmark_version", ())) <= {load_release().version}, table.name
    assert made > 10


def test_a_second_run_does_nothing_and_status_and_plan_agree(study: Checkout) -> None:
    again = study.traps("run", EXPERIMENT).ok()
    assert again.counts() == {"answers": 0, "votes": 0, "frames": 0}
    assert "tables and figures" not in again.err  # no partition was materialized
    place, fresh = study.traps("status", EXPERIMENT).out.splitlines()
    assert place == f"workspace {study.workspace}"
    assert re.fullmatch(r"everything is fresh: \d+ partitions of \d+ stages", fresh)
    stages = {row["stage"]: row for row in json.loads(study.traps("status", EXPERIMENT, "--json").out)["stages"]}
    expected = {"scene_specs": 4, "items": 4, "responses": 24, "verdicts": 24, "leaderboard": 1}
    for stage, partitions in expected.items():
        assert stages[stage] == {"stage": stage, "fresh": partitions, "stale": {}, "missing": []}
    plan = study.traps("plan", EXPERIMENT).out
    assert re.search(rf"^all +{ANSWERS} +{ANSWERS} +0 +{VOTES:,} +{VOTES:,} +0$", plan, re.MULTILINE), plan
