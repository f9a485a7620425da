"""The golden study as a user sees it: from records to the report, and what a second command then finds to do."""

from __future__ import annotations

import json
import re

import pytest

from tests.conftest import EXPERIMENT, Checkout, Finished
from tests.tables import TABLES
from traps_pipeline.benchmark.records import load_release
from traps_pipeline.scoring.score_rows import LEADERBOARD, METRICS
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.promise
ANSWERS = 3 * 2 * 48  # models x regimes x items of 12 scenarios in two datasets, two sides
VOTES = ANSWERS // 2 * 9  # three judges on a control's two tasks and on a void's one


def test_one_command_goes_from_records_to_the_leaderboard_and_the_report(small: Checkout, small_output: str) -> None:
    counts = Finished(0, small_output, "").counts()
    assert (counts["answers"], counts["votes"]) == (ANSWERS, VOTES)
    assert re.findall(r"asked \((\d+) ", small_output) == ["0", "0"]  # none of them was known
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
    assert again.err == ""  # no partition was materialized
    stages = {row["stage"]: row for row in json.loads(study.traps("status", EXPERIMENT, "--json").out)["stages"]}
    assert not [row for row in stages.values() if row["stale"] or row["missing"]]
    place, fresh = study.traps("status", EXPERIMENT).out.splitlines()
    assert place == f"workspace {study.workspace}"
    partitions = sum(row["fresh"] for row in stages.values())
    assert re.findall(r"\d+", fresh) == [str(partitions), str(len(stages))]
    expected = {"scene_specs": 4, "items": 4, "responses": 24, "verdicts": 24, "leaderboard": 1}
    assert {stage: stages[stage]["fresh"] for stage in expected} == expected
    plan = study.traps("plan", EXPERIMENT).out
    assert re.search(rf"^all +{ANSWERS} +{ANSWERS} +0 +{VOTES:,} +{VOTES:,} +0$", plan, re.MULTILINE), plan
