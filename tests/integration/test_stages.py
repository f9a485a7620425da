"""Every stage on its own, through Dagster's own command or its library, and the exit codes of the command."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest

from tests.conftest import EXPERIMENT, Checkout, Finished, forget_answers
from traps_pipeline.lineage import INSIDE, PARTITIONED_BY, STAGES, Lineage
from traps_pipeline.report.catalogue import PRINTED
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
CELL = "occlusion|oracle__standard__run1"
ONE_KEY = {"category": "dominoes", "dataset": "occlusion", "cell": CELL}
ONE_BY_ONE = """
import sys
import dagster as dg
from traps_pipeline.definitions import ASSETS, SOURCES
with dg.DagsterInstance.get() as history:
    for stage in sys.argv[1:]:
        dg.materialize([*SOURCES, *ASSETS], instance=history, selection=[stage])
"""
RANGE = "occlusion|oracle__standard__run1...occlusion_ill_posed|always-abstain__json__run1"


def materialize(study: Checkout, stage: str, *partition: str) -> Finished:
    return study.dagster("asset", "materialize", "-m", "traps_pipeline.definitions", "--select", stage, *partition)


def test_every_stage_is_rematerialized_alone_from_the_tables_that_are_there(study: Checkout) -> None:
    stages = [stage for stage in STAGES if stage not in INSIDE]  # those need a local model: tests/mechanism
    before = {stage: Lineage(Workspace.open(study.workspace)).version(stage, _key(stage)) for stage in stages}
    # What has partitions and one printed table by the command; a process for each of the others would take minutes.
    whole = [stage for stage in stages if _key(stage) is None and stage not in PRINTED]
    for stage in [*(stage for stage in stages if _key(stage)), "table_overall", ",".join(PRINTED)]:
        key = _key(stage)
        finished = materialize(study, stage, *(("--partition", key) if key else ()))
        assert finished.code == 0, (stage, finished.err[-3000:])
    one_by_one = study.run(sys.executable, "-c", ONE_BY_ONE, *whole)
    assert one_by_one.code == 0, one_by_one.err[-3000:]
    after = {stage: Lineage(Workspace.open(study.workspace)).version(stage, _key(stage)) for stage in stages}
    assert after == before  # rebuilt from the same inputs: the same content


def _key(stage: str) -> str | None:
    return ONE_KEY.get(PARTITIONED_BY.get(stage, ""))


def test_a_range_of_cells_is_one_run_and_makes_exactly_its_cells(study: Checkout) -> None:
    forget_answers(study)
    for stage in ("responses", "votes", "verdicts"):
        finished = materialize(study, stage, "--partition-range", RANGE)
        assert finished.code == 0, (stage, finished.err[-3000:])
        made = sorted((study.workspace / "tables" / stage).rglob("*.parquet"))
        assert len(made) == 2 * 2 * 3  # datasets x models x regimes
    assert len(study.ledger_rows("answers")) == 2 * 2 * 3 * 12


def test_an_unknown_partition_exits_with_one(study: Checkout) -> None:
    finished = materialize(study, "responses", "--partition", "occlusion|nobody__standard__run1")
    assert finished.code == 1
    assert "nobody__standard__run1" in finished.out + finished.err


def test_a_missing_upstream_exits_with_one_and_names_it(study: Checkout) -> None:
    forget_answers(study)
    finished = materialize(study, "votes", "--partition", CELL)
    assert finished.code == 1
    assert "materialize responses for this partition first" in finished.out + finished.err


def test_several_stages_in_one_run_are_refused_instead_of_skipped(study: Checkout) -> None:
    finished = materialize(study, "scene_specs,videos", "--partition", "dominoes")
    assert finished.code == 1
    assert "one stage a run, not scene_specs, videos" in finished.out + finished.err


def test_a_history_of_another_study_is_refused(study: Checkout, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    command = [sys.executable, "-m", "dagster", "asset", "materialize", "-m", "traps_pipeline.definitions"]
    other = f"DAGSTER_HOME={tmp_path / 'elsewhere'}"
    finished = study.run("env", other, *command, "--select", "items", "--partition", "occlusion")
    assert finished.code == 1
    assert "is not of the workspace" in finished.out + finished.err


def test_a_failing_step_exits_with_one_and_names_the_file(study: Checkout) -> None:
    path = study.root / "scene_specs" / "released" / "domino_chain.jsonl"
    lines = path.read_text().splitlines()
    record = json.loads(lines[3])
    record["ground_truth"] = "perhaps"
    path.write_text("\n".join([*lines[:3], json.dumps(record), *lines[4:]]) + "\n")
    finished = materialize(study, "scene_specs", "--partition", "dominoes")
    assert finished.code == 1
    assert f"{path}:4" in finished.out + finished.err


def test_a_table_that_was_deleted_is_made_again_from_the_ledger(study: Checkout) -> None:
    shutil.rmtree(study.workspace / "tables" / "responses")
    shutil.rmtree(study.workspace / "tables" / "verdicts")
    run = study.score(EXPERIMENT)
    assert run.code == 0, run.err
    assert run.counts() == {"answers": 0, "votes": 0, "frames": 0}


def test_the_code_location_validates_and_imports_nothing_heavy(study: Checkout) -> None:
    heavy = ("torch", "transformers", "litellm", "mujoco", "matplotlib", "cv2", "sklearn", "av")
    code = f"import traps_pipeline.definitions, sys; print([m for m in {heavy} if m in sys.modules])"
    finished = study.run(sys.executable, "-c", code)
    assert finished.out.strip() == "[]", finished.err
    valid = study.dagster("definitions", "validate", "-m", "traps_pipeline.definitions")
    assert valid.code == 0, valid.err
    assert "BetaWarning" not in valid.err


def test_help_loads_neither_dagster_nor_pandas(study: Checkout) -> None:
    code = (
        "import sys; from traps_pipeline.cli import build_parser; build_parser().format_help();"
        "print(sorted({'dagster', 'pandas', 'pydantic', 'numpy'} & set(sys.modules)))"
    )
    assert study.run(sys.executable, "-c", code).out.strip() == "[]"
