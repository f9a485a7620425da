"""Runs on other hosts: `traps run EXPERIMENT --cluster` puts them in Dagster's queue, from where they start on Ray.

The head of the cluster runs Dagster's daemon (`traps ui`), which starts queued runs as Ray jobs and resumes those whose
host died. This module cuts what is to be made into ranges, submits them, and tells what they have done.
"""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import dagster as dg

from traps_pipeline.base import progress
from traps_pipeline.base.cores import CORES
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import missing
from traps_pipeline.base.partitions import Cell
from traps_pipeline.models.registry import LOCAL, get_model
from traps_pipeline.models.tables import RESPONSES
from traps_pipeline.orchestration.graph import Stage, the_graph
from traps_pipeline.orchestration.ranges import Range, cut, shared_out
from traps_pipeline.orchestration.runs import (
    Ran,
    Runs,
    broke_off,
    problems_of,
    range_of,
    range_tags,
    reason,
)
from traps_pipeline.orchestration.same_code import CODE_TAG, code_here
from traps_pipeline.orchestration.shared_history import unusable
from traps_pipeline.orchestration.step import TAKEN, TALLY
from traps_pipeline.orchestration.translation import asset_key
from traps_pipeline.storage.database import PATIENCE_S
from traps_pipeline.storage.workspace import RAY, VARIABLE, Workspace

if TYPE_CHECKING:
    from dagster._core.workspace.context import WorkspaceRequestContext

STUDY_TAG = "traps/study"
RUN_CPUS, RUN_GPUS = "TRAPS_RUN_CPUS", "TRAPS_RUN_GPUS"  # of runs that are launched in Dagster's pages
RESOURCES_TAG = "dagster-ray/config"  # dagster-ray's own name
AT_ONCE = 40  # runs; Ray keeps a process of some 85 MB for each on the head
POLL_S = 1.0
MONITOR_S, RESUMES = 15, 3
START_S = 24 * 3600  # a run may wait so long for a host; one that waits for nothing ends sooner (`lost_runs.py`)
IDLE_S = 60.0  # after so long a person is told that runs wait for a host
ALIVE_S = 120  # a daemon that has been silent for longer is dead
QUEUE = "QUEUED_RUN_COORDINATOR"
SAID = 300  # letters of the beginning and of the end of what a lost run said
OnInterrupt = Literal["leave", "cancel"]
_WAITING = (
    dg.DagsterRunStatus.QUEUED,
    dg.DagsterRunStatus.NOT_STARTED,
    dg.DagsterRunStatus.STARTING,
    dg.DagsterRunStatus.STARTED,
    dg.DagsterRunStatus.CANCELING,
)
_MADE, _FAILED = dg.DagsterEventType.ASSET_MATERIALIZATION, dg.DagsterEventType.STEP_FAILURE
_ENDED = {dg.DagsterEventType.RUN_FAILURE, dg.DagsterEventType.RUN_CANCELED, dg.DagsterEventType.ENGINE_EVENT}


def dagster_yaml(variable: str, place: str) -> dict[str, Any]:
    """The `dagster.yaml` of a study whose runs go to a cluster. variable: with the database's address; place: of the
    study, for runs that are launched in Dagster's pages, whose tags do not name it."""
    return {
        "telemetry": {"enabled": False},
        "nux": {"enabled": False},
        "storage": {
            "custom": {
                "module": "traps_pipeline.orchestration.shared_history",
                "class": "SharedHistory",
                "config": {"variable": variable},
            }
        },
        "run_launcher": {
            "module": "traps_pipeline.orchestration.ray_launcher",
            "class": "QuotingRayRunLauncher",
            "config": {"ray": {"address": os.environ[RAY], "num_cpus": 1, "runtime_env": _works_in(place)}},
        },
        "compute_logs": {
            "module": "traps_pipeline.orchestration.shared_logs",
            "class": "SharedLogs",
            "config": {"place": place},
        },
        "run_monitoring": {
            "enabled": True,
            "poll_interval_seconds": MONITOR_S,
            "max_resume_run_attempts": RESUMES,
            "start_timeout_seconds": START_S,
        },
        "concurrency": {"runs": {"max_concurrent_runs": AT_ONCE}},
    }


def require_cluster(workspace: Workspace, instance: dg.DagsterInstance) -> None:
    """Raises TrapsError unless runs can be submitted from here: the study is one that other hosts see, Ray's address is
    known, and a daemon takes runs from the queue."""
    where = f"the host {socket.gethostname()} submits no runs of the study {workspace.study.name}: "
    if absent := missing("cluster", "ray", "dagster_ray", "dagster_postgres"):
        raise TrapsError(
            f"{where}runs on other hosts need {' and '.join(absent)} here and there: install the extra `cluster`, in a "
            "checkout `python -m pip install --no-deps --require-hashes -r requirements-cluster.lock`"
        )
    if not workspace.is_shared:
        raise TrapsError(
            f"{where}other hosts do not see {workspace.root}; a study for --cluster lies in an object store: "
            f"{VARIABLE}=s3://BUCKET/STUDY (docs/cluster.md)"
        )
    if not os.environ.get(RAY):
        raise TrapsError(
            f"{where}{RAY} is not set: export {RAY}=http://HEAD:8265, the address of Ray's head for the study"
        )
    beats = instance.get_daemon_heartbeats()
    last = beats[QUEUE].timestamp if QUEUE in beats else 0.0
    if time.time() - last > ALIVE_S:
        raise TrapsError(
            f"{where}nobody takes runs from its queue; run `traps ui` on the head, with the same variables, and then "
            "the same command again"
        )


class RayRuns(Runs):
    """Runs of a study in Dagster's queue. most: into which a group of stages is cut. gpus: of each run that loads a
    local model. cpus: of each run that works on as many as it is given."""

    def __init__(
        self,
        instance: dg.DagsterInstance,
        workspace: Workspace,
        most: int,
        gpus: float,
        on_interrupt: OnInterrupt,
        cpus: int = 1,
    ) -> None:
        self._instance, self._workspace, self._on_interrupt = instance, workspace, on_interrupt
        self._most, self._gpus, self._cpus = most, gpus, cpus
        self._idle_since, self._told_idle = float("inf"), False  # while all runs wait for a host
        self._stack, self._keys = ExitStack(), frozenset[str | None]()
        self._cursors: dict[str, str | None] = {}
        self._retries: dict[str, tuple[Sequence[Stage], Range, Mapping[str, str]]] = {}  # once, what broke off
        self._failures: dict[str, list[dg.DagsterEvent]] = {}  # steps of runs that failed

    def __enter__(self) -> RayRuns:
        """Wait for runs that were left."""
        ours = dg.RunsFilter(statuses=[*_WAITING], tags={STUDY_TAG: self._workspace.study.name})
        if left := [*self._instance.get_runs(ours)]:
            progress.current().note(f"{len(left)} runs of this study go on that were left; waiting for them first")
            progress.current().stage("runs that were left", sum(map(_partitions, left)))
            self._watch([run.run_id for run in left])
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @cached_property
    def _context(self) -> WorkspaceRequestContext:
        """With the code location in which runs are submitted: a process of its own, so where there is nothing to make
        it is not loaded."""
        from dagster._core.workspace.context import WorkspaceProcessContext
        from dagster._core.workspace.load_target import ModuleTarget

        target = ModuleTarget("traps_pipeline.definitions", None, None, None)
        context = self._stack.enter_context(
            WorkspaceProcessContext(self._instance, target, version=dg.__version__, code_server_log_level="ERROR")
        )
        return context.create_request_context()

    def ranges(self, stages: Sequence[Stage], keys: Sequence[str | None]) -> list[Range]:
        """Ranges for several hosts: so many that all have work, and so few that starting them costs little. What one
        model is asked stays together, so that it is loaded in few runs. Runs that share what they make may have the
        same range."""
        self._keys = frozenset(keys)
        scheme = stages[0].scheme if stages else None
        shared = [stage.shared for stage in stages if stage.shared is not None]
        if not shared:
            return cut(scheme, keys, self._most)
        seconds = {key: sum(one.seconds(self._workspace, key) for one in shared) / self._cpus for key in keys}
        return shared_out(scheme, keys, seconds, self._most)

    def make(self, stages: Sequence[Stage], ranges: Sequence[Range], tags: Mapping[str, str]) -> Iterator[Ran]:
        """See `Runs`."""
        if ranges:
            progress.current().stage(", ".join(stage.name for stage in stages), len(self._keys) * len(stages))
            self._retries = {self._submit(stages, one, tags): (stages, one, tags) for one in ranges}
            yield from self._watch([*self._retries])

    def _submit(self, stages: Sequence[Stage], of: Range, tags: Mapping[str, str]) -> str:
        from dagster._core.definitions.selector import JobSubsetSelector

        (location,) = self._context.code_locations
        (repository,) = location.get_repositories().values()
        selected = frozenset(asset_key(stage.name) for stage in stages)
        selector = JobSubsetSelector(location.name, repository.name, "__ASSET_JOB", None, selected)
        job = location.get_job(selector)
        plan = location.get_execution_plan(job, {}, None, None, instance=self._instance)
        place = str(self._workspace.place)
        keys = [key for key in keys_in(stages, of) if key in self._keys]
        own = own_tags(self._workspace.study.name, place, stages, keys, self._cpus, self._gpus)
        run = self._instance.create_run(
            job_name=job.name,
            run_id=None,
            run_config={},
            status=None,
            tags={**tags, **own, **range_tags(of, always=True)},
            root_run_id=None,
            parent_run_id=None,
            step_keys_to_execute=plan.execution_plan_snapshot.step_keys_to_execute,
            execution_plan_snapshot=plan.execution_plan_snapshot,
            job_snapshot=job.job_snapshot,
            parent_job_snapshot=job.parent_job_snapshot,
            asset_selection=selected,
            asset_check_selection=None,
            resolved_op_selection=None,
            op_selection=None,
            remote_job_origin=job.get_remote_origin(),
            job_code_origin=job.get_python_origin(),
            asset_graph=repository.asset_graph,
        )
        return self._instance.submit_run(run.run_id, self._context).run_id

    def _watch(self, run_ids: Sequence[str]) -> list[Ran]:
        """Tell what runs do until all have ended. While the database is away, for as long as runs themselves wait for
        it, they are not given up."""
        left, done, seen_at = [*run_ids], list[Ran](), time.monotonic()
        try:
            while left:
                try:
                    self._look_at(left, done)
                    seen_at = time.monotonic()
                except unusable():
                    if time.monotonic() - seen_at > PATIENCE_S:
                        raise
                if left:
                    time.sleep(POLL_S)
        except KeyboardInterrupt:
            self._interrupted(left)
            raise
        return done

    def _look_at(self, left: list[str], done: list[Ran]) -> None:
        """Tell what these runs have done since the last time. What came of those that have ended is added to `done`."""
        runs = {run.run_id: run for run in self._instance.get_runs(dg.RunsFilter(run_ids=left))}
        self._tell_waiting([*runs.values()])
        for run_id in [*left]:
            run = runs.get(run_id)
            self._tell(run_id)
            if run is not None and run_id in self._retries and broke_off(run, self._failures.get(run_id, [])):
                again = self._submit(*self._retries[run_id])
                del self._retries[run_id]
                left[left.index(run_id)] = again
                progress.current().note(f"run {run_id[:8]} broke off, and is made once more as run {again[:8]}")
            elif run is None or run.is_finished:
                done.append(self._ended(run_id, run, self._failures.get(run_id, [])))
                left.remove(run_id)

    def _tell_waiting(self, runs: Sequence[dg.DagsterRun]) -> None:
        """Say once that no run has begun for a while, since no host has what one takes: nothing else would."""
        waiting = [run for run in runs if run.status == dg.DagsterRunStatus.STARTING]
        if not waiting or any(run.status == dg.DagsterRunStatus.STARTED for run in runs):
            self._idle_since = float("inf")
            return
        self._idle_since = min(self._idle_since, time.monotonic())
        if time.monotonic() - self._idle_since > IDLE_S and not self._told_idle:
            self._told_idle = True
            takes = json.loads(waiting[0].tags.get(RESOURCES_TAG, "{}"))
            wanted = ", ".join(f"{name} {value}" for name, value in takes.items() if name != "runtime_env")
            progress.current().note(
                f"{len(waiting)} runs have waited {IDLE_S:.0f} s for a host that is free and has {wanted or 'a CPU'}; "
                "`ray status` on the head shows what there is"
            )

    def _tell(self, run_id: str) -> None:
        """Tell of partitions that a run has made since the last time, and remember steps that failed."""
        while True:
            found = self._instance.get_records_for_run(run_id, self._cursors.get(run_id), {_MADE, _FAILED}, limit=1000)
            self._cursors[run_id] = found.cursor
            for record in found.records:
                event = record.event_log_entry.get_dagster_event()
                if event.is_step_failure:
                    self._failures.setdefault(run_id, []).append(event)
                elif TALLY in (made := event.step_materialization_data.materialization).metadata:
                    tally = progress.Tally(**json.loads(str(made.metadata[TALLY].value)))
                    if TAKEN in made.metadata:
                        progress.current().helped(made.asset_key.path[-1], tally)
                    else:
                        progress.current().partition(made.asset_key.path[-1], made.partition or "", tally)
            if not found.has_more:
                return

    def _ended(self, run_id: str, run: dg.DagsterRun | None, failures: Sequence[dg.DagsterEvent]) -> Ran:
        name = f"run {run_id[:8]} of the study {self._workspace.study.name}"
        if run is None:
            return Ran([f"{name} is in Dagster's history no more"], over_budget=False)
        ran = problems_of(failures)
        if run.status == dg.DagsterRunStatus.SUCCESS:
            return Ran([], over_budget=False)
        if not ran.problems:
            why = _shortened(" ".join(self._last_word(run_id).split()))
            ran.problems.append(f"{name} ended as {run.status.value.lower()} ({why}); see its log in `traps ui`")
        return ran

    def _last_word(self, run_id: str) -> str:
        """Why a run ended whose steps do not say it: an error of those who were to start it, or what was told last."""
        logged = [entry.dagster_event for entry in self._instance.all_logs(run_id, of_type=_ENDED)]
        events = [event for event in logged if event is not None]
        for event in events[-2:]:  # that a run could not be started is told right before its end
            if event.is_engine_event and event.engine_event_data.error:
                return reason(event.engine_event_data.error)
        said = [event.message for event in events if not event.is_engine_event and event.message]
        return said[-1] if said else "no reason is known"

    def _interrupted(self, left: Sequence[str]) -> None:
        if self._on_interrupt == "leave":
            progress.current().note(
                f"{len(left)} runs go on without this command; the same command shows them again, and "
                "`--on-interrupt cancel` would have ended them"
            )
            return
        for run_id in left:
            self._instance.run_coordinator.cancel_run(run_id)
        progress.current().note(f"{len(left)} runs were told to end; what they asked and made is kept")


def own_tags(
    study: str, place: str, stages: Collection[Stage], keys: Iterable[str], cpus: int, gpus: float
) -> dict[str, str]:
    """What a run on another host must say of itself: its study, the code that submitted it, and what Ray sets aside.
    No secrets: tags can be read by everybody. keys: the partitions that it is to make."""
    takes: dict[str, Any] = {"num_cpus": cpus if any(stage.takes.each_gb for stage in stages) else 1}
    asks = RESPONSES.name in {stage.name for stage in stages} and any(map(_is_local, keys))
    if gpus and (asks or any(stage.cost == "machine" for stage in stages)):
        takes["num_gpus"] = gpus
    if memory := max(stage.takes.memory_gb + takes["num_cpus"] * stage.takes.each_gb for stage in stages):
        takes["memory"] = int(memory * 2**30)
    takes["runtime_env"] = _works_in(place, takes["num_cpus"])
    return {STUDY_TAG: study, CODE_TAG: code_here(), RESOURCES_TAG: json.dumps(takes)}


def keys_in(stages: Sequence[Stage], of: Range) -> Sequence[str]:
    """The partitions of a range; none where the stages have none."""
    scheme, (first, last) = stages[0].scheme if stages else None, of
    if scheme is None or first is None:
        return []
    return scheme.between(first, str(last))


def _partitions(run: dg.DagsterRun) -> int:
    """How many partitions a run is to make, those of all its stages."""
    graph = the_graph()
    selected = [graph[key.path[-1]] for key in run.asset_selection or ()]
    return sum(len(keys_in([stage], range_of(run.tags))) or 1 for stage in selected)


def _shortened(said: str) -> str:
    """The beginning, which names what failed, and the end, where a log has the cause."""
    return said if len(said) <= 2 * SAID else f"{said[:SAID]} ... {said[-SAID:]}"


def _works_in(place: str, cpus: int = 1) -> dict[str, Any]:
    return {"env_vars": {VARIABLE: place, CORES: str(cpus)}}


def _is_local(cell: str) -> bool:
    return get_model(Cell.parse(cell).evaluation.model).backend == LOCAL
