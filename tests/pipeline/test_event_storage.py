"""Kept connections change what an event costs, and neither what is stored nor what a page sees."""

import threading
from pathlib import Path

import dagster as dg
import pytest
from dagster._core.storage.sqlite_storage import DagsterSqliteStorage

from traps_pipeline.base.paths import ASSETS, ROOT


@dg.asset
def answer() -> int:
    return 42


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "dagster.yaml").write_text((ASSETS / "dagster.yaml").read_text())
    monkeypatch.setenv("DAGSTER_HOME", str(tmp_path))
    return tmp_path


@pytest.mark.slow
def test_dagsters_own_storage_reads_every_event(home: Path) -> None:
    with dg.DagsterInstance.from_config(str(home)) as instance:
        run = dg.materialize([answer], instance=instance)
        ours = [entry.to_json() for entry in instance.all_logs(run.run_id)]
    theirs = DagsterSqliteStorage(str(home)).event_log_storage
    assert [entry.to_json() for entry in theirs.get_logs_for_run(run.run_id)] == ours
    assert theirs.get_latest_materialization_events([answer.key])[answer.key] is not None


@pytest.mark.promise
def test_each_commit_touches_the_file_that_a_page_watches(home: Path) -> None:
    touched = list[int]()

    @dg.op
    def look(context: dg.OpExecutionContext) -> None:
        for number in range(3):
            context.log.info(f"line {number}")
            touched.append((home / "history" / "runs" / f"{context.run_id}.db").stat().st_mtime_ns)

    with dg.DagsterInstance.from_config(str(home)) as instance:
        dg.GraphDefinition(name="job", node_defs=[look]).to_job().execute_in_process(instance=instance)
    assert touched == sorted(set(touched))


@pytest.mark.slow
def test_threads_that_write_at_once_lose_nothing(home: Path) -> None:
    keys = [dg.AssetKey(f"of_thread_{number}") for number in range(4)]
    with dg.DagsterInstance.from_config(str(home)) as instance:

        def report(key: dg.AssetKey) -> None:
            for version in range(20):
                instance.report_runless_asset_event(dg.AssetMaterialization(key, metadata={"version": version}))

        threads = [threading.Thread(target=report, args=[key]) for key in keys]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for key in keys:
            assert len(instance.fetch_materializations(key, limit=100).records) == 20


@pytest.mark.promise
def test_the_settings_of_a_checkout_need_no_study_and_send_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`dagster dev` reads them where DAGSTER_HOME is not set."""
    monkeypatch.delenv("DAGSTER_HOME", raising=False)
    (tmp_path / "dagster.yaml").write_text((ROOT / "dagster.yaml").read_text())
    with dg.DagsterInstance.from_config(str(tmp_path)) as instance:
        assert instance.get_runs() == [] and not instance.telemetry_enabled
