"""Materialize missing or stale partitions, one Dagster run per block of stages."""

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import dagster as dg
import yaml

from traps_pipeline.base import progress
from traps_pipeline.base.databases import database_error, is_damaged, reason_and_remedy
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import remedy, write_text
from traps_pipeline.base.paths import require_history_path
from traps_pipeline.models.asking.traffic import remembering_stops
from traps_pipeline.pipeline.history import History
from traps_pipeline.pipeline.run_plan import RunPlan, RunReport
from traps_pipeline.pipeline.runs import HOST_TAG, PID_TAG, Runs, this_host
from traps_pipeline.pipeline.step import EXPERIMENT_TAG, MAKE_TAG, STALE_OR_MISSING
from traps_pipeline.storage.several_hosts import several_hosts
from traps_pipeline.storage.workspace import Workspace


@contextmanager
def dagster_history(workspace: Workspace) -> Iterator[dg.DagsterInstance]:
    """Open the workspace's Dagster history, locked: concurrent openings corrupt it.

    Runs whose process was killed are marked as failed, since a queue would count them forever. A lost history begins
    anew, and so does an unreadable one, which is kept beside it: the tables are authoritative. Raises TrapsError if the
    history cannot be read or written.
    """
    dagster_home = Path(os.environ.get("DAGSTER_HOME") or workspace.dagster_home)
    require_history_path(dagster_home)
    try:
        workspace.locks.mkdir(parents=True, exist_ok=True)
        with (workspace.locks / "dagster.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            instance = _open_history(workspace, dagster_home)
        with instance:
            for run in instance.get_runs(dg.RunsFilter(statuses=[dg.DagsterRunStatus.STARTED])):
                is_this_host = run.tags.get(HOST_TAG) == this_host()
                if is_this_host and PID_TAG in run.tags and not _is_alive(int(run.tags[PID_TAG])):
                    instance.report_run_failed(run, "its process was killed; what it had asked and made is kept")
            yield instance
    except BrokenPipeError:
        raise  # the reader of the output has gone
    except Exception as error:
        cause = database_error(error)
        if isinstance(error, OSError):
            reason, hint = error.strerror or "its file cannot be used", remedy(error)
        elif cause is not None:
            reason, hint, _ = reason_and_remedy(cause)
        else:
            raise
        raise TrapsError(
            f"{getattr(error, 'filename', None) or dagster_home}: Dagster's history cannot be read or written "
            f"({reason}); {hint} and run the same command again: tables are whole, no answer is lost"
        ) from error


def _open_history(workspace: Workspace, home: Path) -> dg.DagsterInstance:
    from sqlalchemy.exc import DatabaseError, OperationalError

    for is_retry in (False, True):
        if workspace.is_on_cluster and home == workspace.dagster_home:
            settings = several_hosts().dagster_yaml(workspace)
            write_text(home / "dagster.yaml", yaml.safe_dump(settings, sort_keys=False))
        workspace.copy_dagster_yaml(home)
        try:
            instance = _instance(home, is_captured=workspace.is_on_cluster)
            instance.get_runs_count()
            instance.all_asset_keys()  # read the other file
        except OperationalError:
            raise  # a full disk or another process's lock: the history is intact
        except DatabaseError as error:
            if is_retry or not is_damaged(error):
                raise
            backup = home / f"broken-{time.strftime('%Y%m%dT%H%M%S')}"
            for name in ("history", "schedules", "storage"):
                if (home / name).exists():
                    backup.mkdir(exist_ok=True)
                    (home / name).rename(backup / name)
            progress.current().note(
                f"{home}: Dagster's history was damaged; it lies in {backup.name}, a new one begins"
            )
        else:
            return instance
    raise AssertionError("unreachable: the second try returns or raises")


def _instance(home: Path, *, is_captured: bool) -> dg.DagsterInstance:
    """Open a folder's instance; is_captured: keep steps' output, as other hosts must."""
    if is_captured:
        return dg.DagsterInstance.from_config(str(home))
    no_logs = {"module": "dagster._core.storage.noop_compute_log_manager", "class": "NoOpComputeLogManager"}
    return dg.DagsterInstance.local_temp(str(home), overrides={"compute_logs": no_logs})


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def materialize_stale(instance: dg.DagsterInstance, runs: Runs, plan: RunPlan) -> RunReport:
    """Materialize what is missing or stale; problems include earlier failed checks. KeyboardInterrupt propagates."""
    report, started_at, history = RunReport(), time.monotonic(), History(instance, plan.graph)
    tags = {MAKE_TAG: STALE_OR_MISSING} | ({EXPERIMENT_TAG: plan.experiment} if plan.experiment else {})
    with remembering_stops(), plan.in_progress():
        for block in plan.blocks():
            pending, keys = plan.pending(block, cache(history.recorded))
            for range_outcome in runs.make(pending, runs.ranges(pending, keys), tags):
                report.problems += range_outcome.problems
                report.over_budget |= range_outcome.over_budget
            plan.renew(pending)
    report.warnings = plan.failed_checks(blocking=False)
    report.problems = [*dict.fromkeys([*report.problems, *plan.failed_checks(), *report.warnings])]
    report.seconds, report.tallies = time.monotonic() - started_at, progress.current().totals
    return report
