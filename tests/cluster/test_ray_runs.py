"""Runs on a cluster, as far as they need none: how work is cut, what a host refuses, what a person is told."""

from __future__ import annotations

import json
import os
import shlex
import socket
import threading
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import dagster as dg
import pytest
from dagster._daemon.monitoring.run_monitoring import RESUME_RUN_LOG_MESSAGE

from tests.build.errors import raises
from tests.postgres import Postgres
from traps_cluster.history import HISTORY, LOGS, dagster_yaml
from traps_cluster.node import code_here, require_same_code
from traps_cluster.ray_runs import RESOURCES_TAG, STUDY_TAG, RayRuns, own_tags
from traps_cluster.sensors import REQUEST_TAG, start_requested_runs, submit
from traps_pipeline.base.cores import cores
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.progress import Progress, use_progress
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.pipeline.graph import the_graph
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.pipeline.runs import is_broken_off, range_tags
from traps_pipeline.pipeline.schemes import DATASET
from traps_pipeline.pipeline.stages import benchmark_stages
from traps_pipeline.pipeline.step import RESUMED_ELSEWHERE, end_if_resumed
from traps_pipeline.pipeline.translation import asset_key
from traps_pipeline.storage.benchmark_tables import SCENE_SPECS, VIDEOS
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import RAY, Workspace


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path, Study(name="lab"))


@pytest.fixture
def remote(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    """A study whose runs go to a cluster, with the variables that its hosts export."""
    monkeypatch.setenv(RAY, "http://head:8265")
    monkeypatch.setenv("LAB_DATABASE", "postgresql://user:secret@host/db")
    for exported in (HISTORY, LOGS):
        monkeypatch.setenv(exported, "")  # and as it was after the test
    monkeypatch.delenv("DAGSTER_HOME", raising=False)
    return Workspace(tmp_path, Study(name="lab", database="LAB_DATABASE"), "s3://lab/study")


def test_what_a_stage_takes_is_what_ray_sets_aside_and_what_the_run_uses(
    remote: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    works = {
        "TRAPS_WORKSPACE": "s3://lab/study", "TRAPS_RAY": "http://head:8265", "TRAPS_CODE": code_here(),
        "TRAPS_CORES": "4",
    }  # fmt: skip

    def taken(stage: str, keys: Sequence[str] = (), gpus: float = 0.0) -> dict[str, Any]:
        tags = own_tags(remote, [the_graph()[stage]], keys, 4, gpus)
        assert tags[STUDY_TAG] == "lab"
        return json.loads(tags[RESOURCES_TAG])

    one = {"num_cpus": 1, "runtime_env": {"env_vars": works | {"TRAPS_CORES": "1"}}}
    assert taken(benchmark_stages.VIDEOS.name) == {
        "num_cpus": 4, "memory": int(2.2 * 2**30), "runtime_env": {"env_vars": works}
    }  # fmt: skip
    assert taken(benchmark_stages.ITEMS.name, gpus=1.0) == one
    reference, local = "occlusion|oracle__standard__run1", "occlusion|pocket__standard__run1"
    assert taken(RESPONSES.name, [reference], gpus=1.0) == one
    assert taken(RESPONSES.name, [reference, local], gpus=1.0) == one | {"num_gpus": 1.0}
    assert taken(RESPONSES.name, [local]) == one
    here = len(os.sched_getaffinity(0))
    for given, used in (("1", 1), ("100000", here), ("", here)):
        monkeypatch.setenv("TRAPS_CORES", given)
        assert cores() == used


class Shown(Progress):
    """Keep the stages that are told."""

    def __init__(self) -> None:
        super().__init__()
        self.stages = list[tuple[str, int]]()

    def stage(self, name: str, partitions: int) -> None:
        """See `Progress`."""
        self.stages.append((name, partitions))


def test_a_host_with_other_code_refuses_a_run_and_names_both() -> None:
    require_same_code(code_here(), "lab")
    require_same_code("", "lab")  # a run of this host's own
    theirs = json.loads(code_here())
    theirs |= {"files of assets": "0123", "numpy": "1.0", "numba": "9"}
    del theirs["mujoco"]  # which it does not have: what only one of them has is not compared
    names = (socket.gethostname(), "lab", "files of assets", "0123", f"numpy {version('numpy')}", " 1.0 ")
    with raises(TrapsError, "traps_cluster.node.require_same_code", *names) as refused:
        require_same_code(json.dumps(theirs), "lab")
    assert not [name for name in ("numba", "mujoco") if name in str(refused.value)]


def test_dagsters_settings_hold_no_address_of_the_database(remote: Workspace) -> None:
    settings = dagster_yaml(remote)
    assert "secret" not in str(settings) and settings["concurrency"]["runs"]["max_concurrent_runs"] == 40
    assert settings["run_launcher"]["config"]["ray"] == {"address": "http://head:8265", "num_cpus": 1}
    assert settings["storage"] == {"postgres": {"postgres_url": {"env": "TRAPS_HISTORY"}}}
    assert os.environ["TRAPS_HISTORY"] == "postgresql+psycopg2://user:secret@host/db"


@pytest.mark.slow
def test_the_command_line_of_a_run_survives_a_shell() -> None:
    launcher = pytest.importorskip("traps_cluster.launcher", reason="the extra `cluster` is not installed")
    run = """{"config_yaml": "'variable: X'", "a": 1}"""
    command = launcher.node_command(f"/venv/bin/dagster api execute_run '{run}'", "r1")
    node = ["python", "-P", "-m", "traps_cluster.node", "r1"]
    assert shlex.split(command) == [*node, "api", "execute_run", run]


@pytest.mark.slow
def test_a_run_that_dagsters_pages_launch_takes_and_says_what_one_of_the_command_line_does(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    launcher = pytest.importorskip("traps_cluster.launcher", reason="the extra `cluster` is not installed")
    monkeypatch.setenv("TRAPS_WORKSPACE", str(Workspace.create(tmp_path / "study", Study(name="lab")).root))
    monkeypatch.setenv("TRAPS_RUN_CPUS", "4")
    monkeypatch.setenv("TRAPS_RUN_GPUS", "1")

    def takes(stage: str, key: str) -> dict[str, Any]:
        selected = frozenset({asset_key(stage)})
        run = dg.DagsterRun("a job", asset_selection=selected, tags={"dagster/partition": key})
        tags = launcher.tags_of_page_run(run)
        assert tags[STUDY_TAG] == "lab"
        return json.loads(tags[RESOURCES_TAG])

    rendering, asking = (
        takes(benchmark_stages.VIDEOS.name, "dominoes"),
        takes(RESPONSES.name, "chaotic|pocket__standard__run1"),
    )
    assert (rendering["num_cpus"], rendering.get("num_gpus")) == (4, None) and rendering["memory"]
    assert (asking["num_cpus"], asking["num_gpus"]) == (1, 1.0)
    of_one_op = json.loads(launcher.tags_of_page_run(dg.DagsterRun("everything"))[RESOURCES_TAG])
    assert of_one_op["num_cpus"] == 1 and of_one_op["runtime_env"]["env_vars"]["TRAPS_CODE"] == code_here()


def test_a_run_that_is_asked_for_is_created_once_for_its_own_study(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRAPS_WORKSPACE", str(Workspace.create(tmp_path / "study", Study(name="lab")).root))
    stages = [SCENE_SPECS.name, VIDEOS.name]
    with dg.DagsterInstance.ephemeral() as instance:
        submit(instance, "another", stages, {})
        name = submit(instance, "lab", stages, {"traps/make": "stale", **range_tags(("dominoes", "plinko"))})
        with dg.build_sensor_context(instance) as context:
            first = start_requested_runs(context)
        assert isinstance(first, dg.SensorResult)
        with dg.build_sensor_context(instance, cursor=first.cursor) as context:
            second = start_requested_runs(context)
    assert isinstance(second, dg.SensorResult)
    (request,) = first.run_requests or []
    assert request.run_key == request.tags[REQUEST_TAG] == name
    assert request.asset_selection == [asset_key(stage) for stage in stages]
    assert request.tags["dagster/asset_partition_range_end"] == "plinko" and request.tags["traps/make"] == "stale"
    assert second.run_requests == []


@pytest.mark.slow
def test_a_command_that_watches_runs_outlives_a_database_that_is_stopped_and_started(
    remote: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("dagster_postgres", reason="the extra `cluster` is not installed")
    with Postgres.running() as server:
        monkeypatch.setenv("LAB_DATABASE", server.address())
        with dagster_history(remote) as instance:
            run = instance.create_run_for_job(_nothing)
            watching = RayRuns(instance, remote, 1, 0.0, "leave")
            ended = list[Any]()
            thread = threading.Thread(target=lambda: ended.extend(watching._watch([], [run.run_id])))
            thread.start()
            server.stop()
            time.sleep(3)
            assert thread.is_alive()
            server.start()
            instance.report_run_failed(run, "it was ended")
            thread.join(300)
    (problem,) = (problem for ran in ended for problem in ran.problems)
    assert all(name in problem for name in (run.run_id[:8], "lab", "(it was ended)", "`traps ui`"))


@pytest.mark.slow
@pytest.mark.parametrize("times", [1, 2])
def test_a_run_that_breaks_off_is_made_once_more_and_then_told(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch, times: int
) -> None:
    with dg.DagsterInstance.ephemeral() as instance:
        watching, submitted = RayRuns(instance, workspace, 1, 0.0, "leave"), list[str]()

        def create(*_: object) -> str:  # what Dagster's daemon and a node do
            name = f"request-{len(submitted)}"
            submitted.append(name)
            if len(submitted) <= times:
                run = instance.create_run_for_job(_nothing, tags={REQUEST_TAG: name})
                instance.report_run_failed(run, "its host is gone")
            else:
                _nothing.execute_in_process(instance=instance, tags={REQUEST_TAG: name})
            return name

        monkeypatch.setattr(watching, "_submit", create)
        told = [problem for ran in watching.make([], [(None, None)], {}) for problem in ran.problems]
    assert len(submitted) == 2
    assert len(told) == times - 1 and all("(its host is gone)" in one for one in told)


@pytest.mark.parametrize("error", [TrapsError("the budget is reached"), ConnectionError("the server is gone")])
def test_a_run_that_says_why_it_failed_did_not_break_off(error: Exception) -> None:
    @dg.op
    def fails() -> None:
        raise error

    @dg.op
    def waits() -> None:
        raise TrapsError("responses are not made")

    @dg.job
    def failing() -> None:
        fails()
        waits()

    with dg.DagsterInstance.ephemeral() as instance:
        result = failing.execute_in_process(instance=instance, raise_on_error=False)
        run = instance.get_run_by_id(result.run_id)
        assert run is not None
        failures = [event for event in result.all_events if event.is_step_failure]
        assert is_broken_off(run, failures) == isinstance(error, ConnectionError)


@pytest.mark.slow
def test_a_process_whose_run_was_resumed_elsewhere_ends_without_a_word(tmp_path: Path) -> None:
    with dg.DagsterInstance.local_temp(str(tmp_path)) as instance:
        run = instance.create_run_for_job(_nothing)
        end_if_resumed(instance, run.run_id, 0)  # goes on: nobody has resumed it
        instance.report_engine_event(RESUME_RUN_LOG_MESSAGE, run)
        end_if_resumed(instance, run.run_id, 1)  # is the one that goes on with it
        pid = os.fork()
        if pid == 0:
            end_if_resumed(instance, run.run_id, 0)
            os._exit(0)
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == RESUMED_ELSEWHERE


@dg.op
def _nothing_op() -> None: ...


@dg.job
def _nothing() -> None:
    _nothing_op()


@pytest.mark.promise
@pytest.mark.parametrize("on_interrupt", ["leave", "cancel"])
def test_an_interrupted_command_leaves_its_runs_or_ends_them_and_the_next_one_counts_what_was_left(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch, on_interrupt: Any
) -> None:
    shown = Shown()
    stages = [the_graph()[name] for name in (RESPONSES.name, "votes")]
    selected = frozenset(asset_key(stage.name) for stage in stages)
    cells = range_tags(("occlusion|oracle__standard__run1", "chaotic|oracle__standard__run1"))
    with dg.DagsterInstance.ephemeral() as instance, use_progress(shown):
        run = dg.DagsterRun("a job", asset_selection=selected, tags={**cells, STUDY_TAG: "lab"})
        instance.add_run(run)
        ended = list[str]()
        monkeypatch.setattr(type(instance.run_coordinator), "cancel_run", lambda _, run_id: ended.append(run_id))
        asking = RayRuns(instance, workspace, 1, 0.0, on_interrupt)

        def interrupt(*_: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr(asking, "_look_at", interrupt)
        with pytest.raises(KeyboardInterrupt):
            asking._watch([], [run.run_id])
        assert ended == ([run.run_id] if on_interrupt == "cancel" else [])
        instance.report_run_failed(run, "it was ended")
        instance.add_run(dg.DagsterRun("a job", asset_selection=selected, tags={**cells, STUDY_TAG: "another"}))
        again = dg.DagsterRun("a job", asset_selection=selected, tags={**cells, STUDY_TAG: "lab"})
        instance.add_run(again)
        next_one = RayRuns(instance, workspace, 1, 0.0, on_interrupt)
        monkeypatch.setattr(next_one, "_watch", lambda _, run_ids: watched.extend(run_ids))
        watched = list[str]()
        next_one.wait_for_earlier()
        assert watched == [again.run_id]
    datasets = [*DATASET.keys]
    between = abs(datasets.index("occlusion") - datasets.index("chaotic")) + 1
    assert [partitions for _, partitions in shown.stages] == [2 * between]
