"""Every stage on its own, through Dagster's own command or its library, and the exit codes of the command."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import dagster as dg
import pytest
import yaml

from tests.conftest import EXPERIMENT, Checkout, Finished, forget_answers
from traps_pipeline.definitions import defs
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.pipeline.graph import the_graph
from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.pipeline.runs import HOST_TAG, PID_TAG, this_host
from traps_pipeline.pipeline.stage import SHARED_IN_RUN
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.protocol.cells import Cell
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
CELL = "occlusion|oracle__standard__run1"
RANGE = "occlusion|oracle__standard__run1...occlusion_ill_posed|oracle__json__run1"

# Partitions of a check by their state, as Dagster's page of the check counts them.
CHECKED = """
import json
import dagster as dg
from traps_pipeline.pipeline.schemes import CELL
from traps_pipeline.pipeline.translation import partitions_of
key = dg.AssetCheckKey(dg.AssetKey("votes"), "current")
with dg.DagsterInstance.get() as history:
    state = history.event_log_storage.get_asset_check_state([(key, partitions_of(CELL))])[key]
print(json.dumps({name.value: subset.size for name, subset in state.subsets.items() if subset.size}))
"""


# What Dagster's own resolver says of each partition of each asset.
RESOLVED = """
import json
import dagster as dg
from dagster._core.definitions.data_version import CachingStaleStatusResolver
from dagster._core.loader import LoadingContextForTest
from traps_pipeline.definitions import defs
graph = defs.resolve_asset_graph()
with dg.DagsterInstance.get() as history:
    resolver = CachingStaleStatusResolver(history, graph, LoadingContextForTest(history))
    nodes = list[tuple[dg.AssetKey, str | None]]()
    for key in graph.materializable_asset_keys:
        partitions = graph.get(key).partitions_def
        nodes += [(key, name) for name in (partitions.get_partition_keys() if partitions else [None])]
    states = {f"{key.path[-1]}/{partition}": resolver.get_status(key, partition).value for key, partition in nodes}
print(json.dumps(states))
"""


def versions(study: Checkout) -> dict[str, str | None]:
    """Versions of all that is there, by partition, as the footers say."""
    workspace = Workspace.open(study.workspace)
    found, wanted = Lineage(workspace), StudyPartitions(workspace)
    return {f"{s.name}/{k}": found.version(s.name, k) for s in the_graph().stages for k in s.wanted(wanted)}


def materialize(study: Checkout, stages: str, *partition: str) -> Finished:
    return study.dagster("asset", "materialize", "-m", "traps_pipeline.definitions", "--select", stages, *partition)


def execute(study: Checkout, job: str) -> Finished:
    return study.dagster("job", "execute", "-m", "traps_pipeline.definitions", "-j", job)


@pytest.mark.promise
def test_a_range_of_cells_is_one_run_through_three_stages_and_makes_exactly_its_cells(study: Checkout) -> None:
    forget_answers(study)
    materialize(study, "responses,votes,verdicts", "--partition-range", RANGE).ok()
    for stage in ("responses", "votes", "verdicts"):
        assert len([*(study.workspace / "tables" / stage).rglob("*.parquet")]) == 2 * 2  # datasets x regimes
    assert len(study.ledger_rows("answers")) == 2 * 2 * 12
    assert json.loads(study.python("-c", CHECKED).ok().out.splitlines()[-1]) == {"SUCCEEDED": 4 * 3 * 2}
    materialize(study, "metrics", "--partition-range", "occlusion...occlusion_ill_posed").ok()


def test_one_command_makes_all_that_the_study_asks_and_fails_with_what_it_could_not(own_study: Checkout) -> None:
    before = versions(own_study)
    forget_answers(own_study)
    execute(own_study, "everything").ok()
    assert versions(own_study) == before
    question = {"ill_posed_question": "What does the triangle at the bottom weigh?"}
    own_study.correct("plinko-0002", **question)
    asked = len(own_study.ledger_rows("answers"))
    assert execute(own_study, "everything").code == 0  # a correction is one command
    assert len(own_study.ledger_rows("answers")) == asked + 3 * 2
    damaged = Workspace.open(own_study.workspace).tables.path(VERDICTS, Cell.parse(CELL).partition)
    (own_study.root / "scene_specs" / "released" / "plinko.jsonl").write_text("{}\n")
    damaged.unlink()
    finished = execute(own_study, "everything")
    assert finished.code == 1
    assert "plinko.jsonl:1" in finished.out + finished.err


def test_a_stopped_model_leaves_the_other_cells_made_and_the_reason_is_told(study: Checkout) -> None:
    forget_answers(study)
    # The study names a model that costs money, and has none: it may not be asked.
    study_file = study.workspace / "study.yaml"
    settings = yaml.safe_load(study_file.read_text())
    settings["experiments"]["small"]["models"].append("gemini-2.5-pro")
    study_file.write_text(yaml.safe_dump(settings))
    whole = "occlusion|oracle__standard__run1...occlusion|gemini-2.5-pro__json__run1"
    finished = materialize(study, "responses,votes,verdicts", "--partition-range", whole)
    assert finished.code == 1
    told, cell = (finished.out + finished.err).splitlines(), "occlusion|gemini-2.5-pro__standard__run1"
    assert any(f"responses/{cell}" in line and "`traps plan`" in line for line in told), told
    assert any(f"verdicts/{cell}" in line and f"responses/{cell}" in line for line in told), told
    for stage in ("responses", "votes", "verdicts"):
        made = {path.parts[-3] for path in (study.workspace / "tables" / stage).rglob("*.parquet")}
        assert made == {"oracle", "random-50", "prior"}


def test_a_copied_study_and_two_studies_in_one_history_do_each_other_no_harm(study: Checkout, tmp_path: Path) -> None:
    copy = Checkout(study.root, tmp_path / "copy")
    shutil.copytree(study.workspace, copy.workspace)
    assert copy.score(EXPERIMENT).counts() == {"answers": 0, "votes": 0, "frames": 0}
    other = Checkout(study.root, tmp_path / "other")
    (tmp_path / "other").mkdir()
    shutil.copytree(study.workspace / "clips", other.workspace / "clips")
    shared = f"DAGSTER_HOME={study.workspace / 'dagster'}"
    traps = ["env", shared, sys.executable, "-m", "traps_pipeline.cli"]
    other.run(*traps, "run", EXPERIMENT, "--until", "items").ok()
    assert len(Workspace.open(other.workspace).tables.read_all(ITEMS)) == 48
    again = study.score(EXPERIMENT)  # the first study finds its own history as it was
    assert (again.code, again.err) == (0, "")
    assert len(Workspace.open(study.workspace).tables.read_all(RESPONSES)) == 3 * 2 * 48


def test_a_run_that_lives_elsewhere_is_left_alone(study: Checkout, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DAGSTER_HOME", str(study.workspace / "dagster"))
    job = defs.resolve_job_def("report")
    with dagster_history(Workspace.open(study.workspace)) as history:
        for host in ("another machine", this_host()):
            run = history.create_run_for_job(job, tags={PID_TAG: "999999999", HOST_TAG: host})
            history.report_engine_event("begun", run)
            history.handle_run_event(run.run_id, dg.DagsterEvent(dg.DagsterEventType.RUN_START.value, job.name))
    study.traps("run", EXPERIMENT, "--until", "items").ok()
    with dagster_history(Workspace.open(study.workspace)) as history:
        runs = [run for run in history.get_runs() if run.tags.get(PID_TAG) == "999999999"]
    assert {run.tags[HOST_TAG]: run.status.value for run in runs} == {
        "another machine": "STARTED",
        this_host(): "FAILURE",
    }


def test_dagster_itself_calls_every_partition_of_a_new_study_fresh(small: Checkout) -> None:
    states: dict[str, str] = json.loads(small.python("-c", RESOLVED).ok().out)
    assert {name.partition("/")[0] for name in states} == {
        stage.name for stage in the_graph().stages if stage.wanted(StudyPartitions(Workspace.open(small.workspace)))
    }
    assert {name for name, state in states.items() if state != "FRESH"} == set()


@pytest.mark.promise
def test_a_failing_step_exits_with_one_and_names_the_file(own_study: Checkout) -> None:
    path = own_study.root / "scene_specs" / "released" / "domino_chain.jsonl"
    lines = path.read_text().splitlines()
    record = json.loads(lines[0])
    record["ground_truth"] = "perhaps"
    path.write_text("\n".join([json.dumps(record), *lines[1:]]) + "\n")
    finished = materialize(own_study, "scene_specs", "--partition", "dominoes")
    assert finished.code == 1
    assert f"{path.relative_to(own_study.root)}:1" in finished.out + finished.err


def test_the_code_location_validates_and_imports_nothing_heavy(study: Checkout) -> None:
    heavy = ("torch", "transformers", "litellm", "mujoco", "matplotlib", "cv2", "sklearn", "av", "pandas")
    code = f"import traps_pipeline.definitions, sys; print([m for m in {heavy} if m in sys.modules])"
    finished = study.run(sys.executable, "-c", code)
    assert finished.out.strip() == "[]", finished.err
    valid = study.dagster("definitions", "validate", "-m", "traps_pipeline.definitions").ok()
    assert "BetaWarning" not in valid.err


def test_a_run_keeps_nothing_in_memory_for_a_stage_that_does_not_follow(study: Checkout) -> None:
    shutil.rmtree(study.workspace / "tables" / "contrasts")
    assert study.traps("run", EXPERIMENT, "--until", "contrasts").code == 0
    assert (study.workspace / "tables" / "contrasts").exists() and not SHARED_IN_RUN
