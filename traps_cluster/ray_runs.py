"""Request runs on other hosts (`traps run EXPERIMENT --cluster`).

The head of the cluster runs Dagster's daemon (`traps ui`), which creates the requested runs, starts them as Ray jobs
and resumes those whose host died. This module cuts the missing partitions into ranges, requests their runs with tags of
the study, the submitter's code and the resources for Ray, and reports their progress.
"""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import dagster as dg
from typing_extensions import override

from traps_cluster.node import CODE, REFUSED_TAG, code_here
from traps_cluster.postgres import PATIENCE_S
from traps_cluster.run_shares import cut_keys, shared_out
from traps_cluster.sensors import REQUEST_TAG, submit
from traps_pipeline.base import progress
from traps_pipeline.base.cores import CORES
from traps_pipeline.base.databases import database_error
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import find_missing
from traps_pipeline.base.wording import count_noun
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.registry.entries import LOCAL, get_model
from traps_pipeline.pipeline.graph import Stage, the_graph
from traps_pipeline.pipeline.metadata import tally_of
from traps_pipeline.pipeline.ranges import Range
from traps_pipeline.pipeline.runs import RunOutcome, Runs, failed_outcome, is_broken_off, keys_of, range_tags, reason
from traps_pipeline.pipeline.step import TAKEN, UNWANTED
from traps_pipeline.protocol.cells import Cell
from traps_pipeline.storage.workspace import RAY, VARIABLE, Workspace

STUDY_TAG = "traps/study"
RESOURCES_TAG = "dagster-ray/config"  # dagster-ray's own name
POLL_S = 1.0
IDLE_S = 60.0  # waiting time before the user is told that no run is at work
ALIVE_S = 120  # a daemon silent for longer is presumed dead
CREATED_S = 30.0  # when ending its runs, a command waits so long for the daemon to create the requested ones
DAEMONS = ("QUEUED_RUN_COORDINATOR", "SENSOR")
ENDS = 300  # characters of the beginning and of the end of a lost run's last message
_UNFINISHED = [status for status in dg.DagsterRunStatus if status.name not in ("SUCCESS", "FAILURE", "CANCELED")]
_WRITTEN, _FAILED = dg.DagsterEventType.ASSET_MATERIALIZATION, dg.DagsterEventType.STEP_FAILURE
_ENDED = {dg.DagsterEventType.RUN_FAILURE, dg.DagsterEventType.RUN_CANCELED, dg.DagsterEventType.ENGINE_EVENT}


def own_tags(
    workspace: Workspace, stages: Collection[Stage], keys: Iterable[str], cpus: int, gpus: float
) -> dict[str, str]:
    """Return the tags of a run on another host; they are public, so hold no secrets.

    keys: the partitions to build; cpus: of a run that can use several cores; gpus: of a run that loads a model.
    """
    takes: dict[str, Any] = {"num_cpus": cpus if any(stage.takes.each_gb for stage in stages) else 1}
    is_asking = RESPONSES.name in {stage.name for stage in stages}
    asks_local = is_asking and any(get_model(Cell.parse(key).evaluation.model).backend == LOCAL for key in keys)
    if gpus and (asks_local or any(stage.cost == "machine" for stage in stages)):
        takes["num_gpus"] = gpus
    memory_gb = [stage.takes.memory_gb + takes["num_cpus"] * stage.takes.each_gb for stage in stages]
    if memory := max(memory_gb, default=0.0):
        takes["memory"] = int(memory * 2**30)
    exported = {VARIABLE: str(workspace.place), RAY: os.environ.get(RAY, ""), CODE: code_here()}
    takes["runtime_env"] = {"env_vars": exported | {CORES: str(takes["num_cpus"])}}
    return {STUDY_TAG: workspace.study.name, RESOURCES_TAG: json.dumps(takes)}


def require_cluster(workspace: Workspace, instance: dg.DagsterInstance) -> None:
    """Raise TrapsError unless this host can request runs.

    Other hosts must see the study, Ray's address must be known, and a daemon must take runs from the queue.
    """
    where = f"the host {socket.gethostname()} submits no runs of the study {workspace.study.name}: "
    if absent := find_missing("cluster", "ray", "dagster_ray", "dagster_postgres"):
        raise TrapsError(
            f"{where}runs on other hosts need {' and '.join(absent)} here and there: install the extra `cluster`, in a "
            "checkout `python -m pip install --no-deps --require-hashes -r requirements-cluster.lock`"
        )
    if not workspace.study.database:
        raise TrapsError(
            f"{where}its ledger lies in {workspace.root}, where one host writes; a study for --cluster keeps it in "
            f"PostgreSQL, and its files in a folder that all hosts see or in an object store: {VARIABLE}="
            "s3://BUCKET/STUDY (docs/cluster.md)"
        )
    if not os.environ.get(RAY):
        raise TrapsError(
            f"{where}{RAY} is not set: export {RAY}=http://HEAD:8265, the address of Ray's head for the study"
        )
    beats = instance.get_daemon_heartbeats()
    oldest = min(beats[name].timestamp if name in beats else 0.0 for name in DAEMONS)
    if time.time() - oldest > ALIVE_S:
        raise TrapsError(
            f"{where}nobody takes runs from its queue; run `traps ui` on the head, with the same variables, and then "
            "the same command again"
        )


class RayRuns(Runs):
    """Runs of a study in Dagster's queue.

    most: maximum number of ranges per group of stages. gpus: of each run that loads a local model. cpus: of each run
    that can use several. on_interrupt: whether Ctrl-C is to `leave` or to `cancel` them.
    """

    def __init__(
        self,
        instance: dg.DagsterInstance,
        workspace: Workspace,
        most: int,
        gpus: float,
        on_interrupt: str,
        cpus: int = 1,
    ) -> None:
        self._instance, self._workspace, self._on_interrupt = instance, workspace, on_interrupt
        self._most, self._gpus, self._cpus = most, gpus, cpus
        self._idle_since, self._is_reported_idle = 0.0, False  # when a run was last seen at work
        self._submit, self._keys = partial(submit, instance, workspace.study.name), frozenset[str | None]()
        # Stages and tags by name, to request a run again if it breaks off.
        self._requests: dict[str, tuple[Sequence[str], Mapping[str, str]]] = {}
        # By run: how far its events were read, and its failed steps.
        self._cursors, self._failures = dict[str, str | None](), dict[str, list[dg.DagsterEvent]]()

    def wait_for_earlier(self) -> None:
        """Wait for runs of earlier commands."""
        filters = dg.RunsFilter(statuses=_UNFINISHED, tags={STUDY_TAG: self._workspace.study.name})
        if runs := [*self._instance.get_runs(filters)]:
            progress.current().note(f"waiting first for {count_noun(len(runs), 'run')} that an earlier command left")
            stages = [(the_graph()[key.path[-1]], run.tags) for run in runs for key in run.asset_selection or ()]
            progress.current().stage("runs that were left", sum(len(keys_of(*each)) or 1 for each in stages))
            self._watch([], [run.run_id for run in runs])

    def ranges(self, stages: Sequence[Stage], keys: Sequence[str | None]) -> list[Range]:
        """Cut keys into ranges: enough to keep hosts busy, few enough to start quickly.

        The calls of one model stay together, so that few runs load it. Runs that build partitions together may have the
        same range.
        """
        self._keys = frozenset(keys)
        scheme = stages[0].scheme if stages else None
        shared = [stage.shared for stage in stages if stage.shared is not None]
        if not shared:
            return cut_keys(scheme, keys, self._most)
        seconds = {key: sum(each.seconds(self._workspace, key) for each in shared) / self._cpus for key in keys}
        return shared_out(scheme, keys, seconds, self._most)

    @override
    def make(self, stages: Sequence[Stage], ranges: Sequence[Range], tags: Mapping[str, str]) -> Iterator[RunOutcome]:
        if not ranges:
            return
        names, requests = [stage.name for stage in stages], list[tuple[Sequence[str], Mapping[str, str]]]()
        progress.current().stage(", ".join(names), len(self._keys) * len(stages))
        for each in ranges:
            of_range = range_tags(each, always=True)
            keys = [key for stage in stages[:1] for key in keys_of(stage, of_range) if key in self._keys]
            own = own_tags(self._workspace, stages, keys, self._cpus, self._gpus)
            requests.append((names, {**tags, **own, **of_range}))
        self._requests = {self._submit(*request): request for request in requests}
        yield from self._watch([*self._requests], [])

    def _watch(self, requests: list[str], run_ids: list[str]) -> list[RunOutcome]:
        """Report the progress of requested and existing runs until all have ended.

        An unreachable database ends this only after runs themselves would give up on it.
        """
        done = list[RunOutcome]()
        seen_at = self._idle_since = time.monotonic()
        try:
            while requests or run_ids:
                time.sleep(POLL_S)
                try:
                    self._look_at(requests, run_ids, done)
                    seen_at = time.monotonic()
                except Exception as error:
                    if database_error(error) is None or time.monotonic() - seen_at > PATIENCE_S:
                        raise
        except KeyboardInterrupt:
            self._interrupted(requests, run_ids)
            raise
        return done

    def _look_at(self, requests: list[str], run_ids: list[str], done: list[RunOutcome]) -> None:
        """Report progress of runs; replace requests by runs, and add ended ones to `done`."""
        self._take_created(requests, run_ids)
        runs = {run.run_id: run for run in self._instance.get_runs(dg.RunsFilter(run_ids=run_ids))} if run_ids else {}
        self._report_waiting(runs.values())
        for run_id in [*run_ids]:
            run = runs.get(run_id)
            self._report(run_id)
            if run is not None and not run.is_finished:
                continue
            tags, failures = run.tags if run is not None else {}, self._failures.get(run_id, [])
            request = self._requests.get(tags.get(REQUEST_TAG, ""))
            if run is not None and request and REFUSED_TAG not in tags and is_broken_off(run, failures):
                requests.append(self._submit(*request))
                progress.current().note(f"run {run_id[:8]} broke off, and is made once more")
            else:
                done.append(self._ended(run_id, run, failures))
            run_ids.remove(run_id)  # last, since the database may be lost on the way

    def _take_created(self, requests: list[str], run_ids: list[str]) -> None:
        """Replace requests by the runs created from them."""
        for run in self._instance.get_runs(dg.RunsFilter(tags={REQUEST_TAG: requests})) if requests else ():
            requests.remove(run.tags[REQUEST_TAG])
            run_ids.append(run.run_id)

    def _report_waiting(self, runs: Iterable[dg.DagsterRun]) -> None:
        """Warn once if nothing begins: no host has the resources, or the daemon is idle."""
        if any(run.status == dg.DagsterRunStatus.STARTED for run in runs):
            self._idle_since = time.monotonic()
        elif time.monotonic() - self._idle_since > IDLE_S and not self._is_reported_idle:
            self._is_reported_idle = True
            progress.current().note(
                f"no run has begun for {IDLE_S:.0f} s: `ray status` on the head shows what runs take and what is free, "
                "and the ticks of start_requested_runs in `traps ui` whether Dagster's daemon creates them"
            )

    def _report(self, run_id: str) -> None:
        """Report a run's newly built partitions, and record its failed steps."""
        has_more = True
        while has_more:
            cursor, kinds = self._cursors.get(run_id), {_WRITTEN, _FAILED}
            page = self._instance.get_records_for_run(run_id, cursor, kinds, limit=1000)
            self._cursors[run_id], has_more = page.cursor, page.has_more
            for record in page.records:
                event = record.event_log_entry.get_dagster_event()
                if event.is_step_failure:
                    self._failures.setdefault(run_id, []).append(event)
                    continue
                result = event.step_materialization_data.materialization
                name, tally = result.asset_key.path[-1], tally_of(result.metadata)
                if TAKEN in result.metadata:
                    progress.current().helped(name, tally)
                elif UNWANTED not in result.metadata:
                    progress.current().partition(name, result.partition or "", tally)

    def _ended(self, run_id: str, run: dg.DagsterRun | None, failures: Sequence[dg.DagsterEvent]) -> RunOutcome:
        name = f"run {run_id[:8]} of the study {self._workspace.study.name}"
        if run is None:
            return RunOutcome([f"{name} is in Dagster's history no more"], over_budget=False)
        outcome = failed_outcome([] if run.status == dg.DagsterRunStatus.SUCCESS else failures)
        if run.status != dg.DagsterRunStatus.SUCCESS and not outcome.problems:
            message = " ".join(self._last_message(run_id).split())
            # The beginning names what failed, and at its end a log has the cause.
            reason = message if len(message) <= 2 * ENDS else f"{message[:ENDS]} ... {message[-ENDS:]}"
            ended = f"{name} ended as {run.status.value.lower()} ({reason}); see its log in `traps ui`"
            outcome.problems.append(message if REFUSED_TAG in run.tags else ended)
        return outcome

    def _last_message(self, run_id: str) -> str:
        """Return the launcher's error or last event's message, if no step says why."""
        logged = [entry.dagster_event for entry in self._instance.all_logs(run_id, of_type=_ENDED)]
        events = [event for event in logged if event is not None]
        # A failed start is recorded right before the run's end.
        errors = [event.engine_event_data.error for event in events[-2:] if event.is_engine_event]
        messages = [event.message for event in events if not event.is_engine_event and event.message]
        return next(map(reason, filter(None, errors)), (messages or ["no reason is known"])[-1])

    def _interrupted(self, requests: list[str], run_ids: list[str]) -> None:
        if self._on_interrupt == "leave":
            progress.current().note(
                f"left running: {count_noun(len(requests) + len(run_ids), 'run')}; the same command shows the progress "
                "again, and `--on-interrupt cancel` would end such runs"
            )
            return
        until = time.monotonic() + CREATED_S
        while requests and time.monotonic() < until:
            self._take_created(requests, run_ids)
            time.sleep(POLL_S)
        for run_id in run_ids:
            self._instance.run_coordinator.cancel_run(run_id)
        progress.current().note(f"told {count_noun(len(run_ids), 'run')} to end; finished work is kept")
