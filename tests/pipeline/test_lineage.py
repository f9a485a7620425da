"""A partition is stale when what it was made from is another now, is gone or is new, or when its formula changed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dagster as dg
import pytest
from dagster._core.storage.asset_check_execution_record import AssetCheckExecutionResolvedStatus

from tests.build.cells import row
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.pipeline.automation import report_outdated, sensors
from traps_pipeline.pipeline.graph import the_graph
from traps_pipeline.pipeline.history import History
from traps_pipeline.pipeline.lineage import OTHER_COLUMNS, Lineage, Status
from traps_pipeline.pipeline.partition_checks import CURRENT, evaluations
from traps_pipeline.pipeline.run_plan import RunPlan, StageStatus
from traps_pipeline.pipeline.schemes import CELL as CELLS
from traps_pipeline.pipeline.translation import partitions_of
from traps_pipeline.scoring.score_rows import METRICS
from traps_pipeline.storage import columns as shared
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.study import Asked, Study
from traps_pipeline.storage.tables import Table
from traps_pipeline.storage.workspace import Workspace

CELL = {"dataset": "chaotic", "model": "prior", "regime": "json", "run": 1}
NAME = "verdicts/chaotic|prior__json__run1"


def decide(workspace: Workspace, cell: dict[str, Any], *, abstained: bool) -> None:
    """Write a verdict of a cell, as made from what is there."""
    verdict = row(VERDICTS, **cell, item_id="chaotic:plinko-0001:void", abstained=abstained)
    inputs = Lineage(workspace).inputs("verdicts", "{dataset}|{model}__{regime}__run{run}".format(**cell))
    workspace.tables.write(VERDICTS, cell, [verdict], inputs, code=the_graph()["verdicts"].code)


def score(workspace: Workspace, code: str) -> None:
    """Write metrics, without rows, as made from what is there."""
    inputs = Lineage(workspace).inputs("metrics", "chaotic")
    assert NAME in inputs
    workspace.tables.write(METRICS, {"dataset": "chaotic"}, [], inputs, code=code)


def status(workspace: Workspace) -> Status:
    return Lineage(workspace).status("metrics", "chaotic")


def is_stale_by(workspace: Workspace, *names: str) -> bool:
    """Whether metrics are stale for one reason, which names these."""
    (reason,) = status(workspace).reasons
    return status(workspace).kind == "stale" and all(name in reason for name in names)


@dataclass(frozen=True, kw_only=True)
class OlderRow:
    """A row of metrics as an older version had it."""

    dataset: shared.Dataset


@pytest.fixture
def study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    """A study whose metrics are made from one cell."""
    monkeypatch.setenv("TRAPS_WORKSPACE", str(tmp_path / "study"))
    asked = Asked(models=["prior", "oracle"], regimes=["json"], runs=[1], datasets=["chaotic"])
    workspace = Workspace.create(tmp_path / "study", Study(scenarios=["plinko-0001"], experiments={"one": asked}))
    decide(workspace, CELL, abstained=True)
    score(workspace, the_graph()["metrics"].code)
    assert status(workspace) == Status("fresh")
    return workspace


def test_other_verdicts_make_metrics_stale_and_the_same_ones_do_not(study: Workspace) -> None:
    decide(study, CELL, abstained=True)
    assert status(study) == Status("fresh")
    decide(study, CELL, abstained=False)
    assert is_stale_by(study, NAME)


def test_a_cell_that_joins_makes_metrics_stale(study: Workspace) -> None:
    decide(study, CELL | {"model": "oracle"}, abstained=True)
    assert is_stale_by(study, NAME.replace("prior", "oracle"))


def test_a_table_that_is_gone_makes_metrics_stale(study: Workspace) -> None:
    decide(study, CELL, abstained=False)
    changed = status(study)
    study.tables.path(VERDICTS, CELL).unlink()
    assert is_stale_by(study, NAME) and status(study) != changed


def test_a_table_of_a_version_with_other_columns_is_to_be_made_again_and_not_told_as_lost(study: Workspace) -> None:
    study.tables.write(Table("metrics", OlderRow, ("dataset",), ("dataset",)), {"dataset": "chaotic"}, [], {})
    assert status(study) == Status("missing", (OTHER_COLUMNS,))
    (told,) = (one for one in RunPlan(study).statuses() if one.stage == "metrics")
    assert told.by_reason() == {OTHER_COLUMNS: ["chaotic"]}


def test_what_would_read_a_damaged_table_names_it_and_the_remedy_before(study: Workspace) -> None:
    study.tables.write(ITEMS, {"dataset": "chaotic"}, [], {}, code=the_graph()["items"].code)
    decide(study, CELL | {"model": "oracle"}, abstained=True)
    assert Lineage(study).blocked("metrics", "chaotic", current=False) == ""
    path = study.tables.path(VERDICTS, CELL)
    path.write_bytes(path.read_bytes()[:-20])
    told = Lineage(study).blocked("metrics", "chaotic", current=False)
    assert NAME in told and "verdicts" in told.replace(NAME, "").replace(str(path), "")  # what to make again
    assert str(path) in told


def test_a_damaged_table_waits_for_nothing_but_what_is_above_it(study: Workspace) -> None:
    study.tables.write(ITEMS, {"dataset": "chaotic"}, [], {}, code=the_graph()["items"].code)
    for model in ("prior", "oracle"):
        decide(study, CELL | {"model": model}, abstained=True)
    path = study.tables.path(METRICS, {"dataset": "chaotic"})
    path.write_bytes(path.read_bytes()[:-20])
    assert is_stale_by(study, str(path))
    assert not Lineage(study).waits("metrics", "chaotic")  # the sensor makes it anew
    path.unlink()
    cell = study.tables.path(VERDICTS, CELL)
    cell.write_bytes(cell.read_bytes()[:-20])
    assert Lineage(study).waits("metrics", "chaotic")


@pytest.mark.slow
def test_damage_and_a_loss_are_reported_again_after_a_restart_of_the_daemon(study: Workspace, tmp_path: Path) -> None:
    path, cell, graph = study.tables.path(VERDICTS, CELL), NAME.partition("/")[2], the_graph()
    with dg.DagsterInstance.local_temp(str(tmp_path)) as instance:
        instance.report_runless_asset_event(History(instance, graph).event(graph["verdicts"], cell, "1", {}, {}))
        path.write_bytes(path.read_bytes()[:-20])
        for last in (False, False, True):  # a new process has reported nothing yet
            if last:
                path.unlink()
            report_outdated(instance, RunPlan(study), reported := dict[str, str]())
            assert reported and str(tmp_path) not in str(reported)  # the page of the sensor shows its cursor
        key = dg.AssetCheckKey(dg.AssetKey("verdicts"), CURRENT)
        stored = instance.event_log_storage.get_asset_check_execution_history(key, limit=9)
    found = [each.event.dagster_event.asset_check_evaluation_data for each in stored]  # pyright: ignore
    assert [each.partition for each in found] == [None, None, cell]
    assert all(each.metadata["partition"].value == cell for each in found)
    told = [str(each.metadata["not current"].value) for each in found]
    assert [study.relative(path) in line for line in told] == [False, True, True]  # newest first
    assert not [line for line in told if str(tmp_path) in line]


@pytest.mark.slow
def test_a_stale_cell_is_told_in_one_line_until_it_is_made_again(study: Workspace, tmp_path: Path) -> None:
    graph, reported = the_graph(), dict[str, str]()
    key = dg.AssetCheckKey(dg.AssetKey("metrics"), CURRENT)
    with dg.DagsterInstance.local_temp(str(tmp_path)) as instance:
        instance.report_runless_asset_event(History(instance, graph).event(graph["metrics"], "chaotic", "1", {}, {}))
        decide(study, CELL, abstained=False)
        decide(study, CELL | {"model": "oracle"}, abstained=True)
        report_outdated(instance, RunPlan(study), reported)
        assert [*reported] == ["metrics/chaotic"] and len(reported["metrics/chaotic"].splitlines()) == 1
        assert "(and 1 more)" in reported["metrics/chaotic"]
        score(study, graph["metrics"].code)
        report_outdated(instance, RunPlan(study), reported)
        stored = instance.event_log_storage.get_asset_check_execution_history(key, limit=9)
    results = [each.event.dagster_event.asset_check_evaluation_data for each in stored]  # pyright: ignore
    assert [(each.partition, each.passed) for each in results] == [(None, True), ("chaotic", False)] and not reported


@pytest.mark.slow
def test_the_sensor_and_the_status_name_the_same_partitions(
    study: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DAGSTER_HOME", str(tmp_path / "history"))
    sensor = sensors()[0]

    def told() -> str:
        with dg.DagsterInstance.local_temp(str(tmp_path)) as instance:
            skipped = sensor(dg.build_sensor_context(instance))
        assert isinstance(skipped, dg.SkipReason)
        return str(skipped.skip_message)

    def outdated() -> list[str]:
        return [f"{status.stage}/{key}" for status in RunPlan(study).statuses() for key in status.stale]

    assert not outdated() and "metrics/chaotic" not in told()
    decide(study, CELL, abstained=False)  # the items are missing, so that nothing can be made of it
    assert outdated() == ["metrics/chaotic"] and "metrics/chaotic" in told()


@pytest.mark.slow
def test_a_loss_is_told_each_time_that_it_happens_and_taken_back_once_it_is_repaired(
    study: Workspace, tmp_path: Path
) -> None:
    graph, path, reported = the_graph(), study.tables.path(METRICS, {"dataset": "chaotic"}), dict[str, str]()
    with dg.DagsterInstance.local_temp(str(tmp_path)) as instance:
        instance.report_runless_asset_event(History(instance, graph).event(graph["metrics"], "chaotic", "1", {}, {}))
        for _ in range(2):
            path.unlink()
            for _ in range(2):
                report_outdated(instance, RunPlan(study), reported)
            score(study, graph["metrics"].code)
            report_outdated(instance, RunPlan(study), reported)
        key = dg.AssetCheckKey(dg.AssetKey("metrics"), CURRENT)
        stored = instance.event_log_storage.get_asset_check_execution_history(key, limit=9)
    passed = [each.event.dagster_event.asset_check_evaluation_data.passed for each in stored]  # pyright: ignore
    assert (passed, reported) == ([True, False, True, False], {})


def test_a_check_is_of_the_newest_event_of_its_partition(study: Workspace, tmp_path: Path) -> None:
    """Dagster's page of a check calls a partition missing whose evaluation names no event, or an older one."""
    key, cell = dg.AssetCheckKey(dg.AssetKey("verdicts"), CURRENT), "chaotic|prior__json__run1"
    with dg.DagsterInstance.local_temp(str(tmp_path)) as instance:
        history = History(instance, the_graph())

        def failed() -> list[str]:
            state = instance.event_log_storage.get_asset_check_state([(key, partitions_of(CELLS))])[key]
            subset = state.subsets.get(AssetCheckExecutionResolvedStatus.FAILED)
            return [] if subset is None else list(subset.subset_value.get_partition_keys())

        for _ in range(2):
            instance.report_runless_asset_event(history.event(the_graph()["verdicts"], cell, "1", {}, {}))
            assert failed() == []
        [evaluation] = evaluations(history, "verdicts", cell, {CURRENT: {"damaged": "it was altered"}})
        instance.report_runless_asset_event(evaluation)
        assert failed() == [cell]


def test_no_study_is_no_error_of_the_sensors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRAPS_WORKSPACE", str(tmp_path / "none"))
    with dg.DagsterInstance.local_temp(str(tmp_path)) as instance:
        for sensor in sensors():
            skipped = sensor(dg.build_sensor_context(instance))
            assert isinstance(skipped, dg.SkipReason) and "`traps init`" in str(skipped.skip_message)


def test_another_formula_makes_metrics_stale(study: Workspace) -> None:
    score(study, "c0de")
    assert is_stale_by(study, the_graph()["metrics"].code, "c0de")


def test_partitions_that_lost_their_own_parent_are_one_line_of_the_status():
    stale = {key: (f"responses/{key} is gone", "judges changed") for key in ("occlusion|a__json__run1", "chaotic|b")}
    assert StageStatus("votes", 0, stale, []).by_reason() == {"responses is gone; judges changed": [*stale]}


def test_a_snapshot_sees_what_was_built_since_when_it_is_renewed(study):
    seen = Lineage(study)
    assert seen.status("metrics", "chaotic").kind == "fresh"
    decide(study, CELL, abstained=False)
    assert seen.status("metrics", "chaotic").kind == "fresh"
    seen.renew("metrics")  # which looks at nothing upstream
    assert seen.status("metrics", "chaotic").kind == "fresh"
    seen.renew("verdicts")
    assert seen.status("metrics", "chaotic") == Status("stale", (f"{NAME} changed",))
