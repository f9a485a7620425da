"""Execute Dagster runs, one after another here or on the hosts of a cluster."""

import os
import re
import signal
import socket
import threading
import uuid
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dagster as dg
from sqlalchemy.exc import SQLAlchemyError
from typing_extensions import override

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.money.budget import BudgetReached
from traps_pipeline.pipeline import history_files  # noqa: F401 - its listeners
from traps_pipeline.pipeline.graph import Stage
from traps_pipeline.pipeline.ranges import Range, key_ranges
from traps_pipeline.pipeline.translation import asset_key

PID_TAG, HOST_TAG = "traps/pid", "traps/host"
# Tags of the runs that a job starts; the job's own run has the second one, too, so that the pages list them together.
# With Dagster's tag of a parent, its pages would call them re-executions.
JOB_TAG, JOB_RUN_TAG = "traps/job", "traps/job_run"
_RANGE = "dagster/asset_partition_range_start", "dagster/asset_partition_range_end"
_SENTENCES = (TrapsError.__name__, BudgetReached.__name__)  # messages for people
_INTERRUPTS = ("DagsterExecutionInterruptedError", "KeyboardInterrupt")
_LOOK_S = 1.0  # between two looks whether a run was terminated in Dagster's pages
_stopped_here = set[str]()  # runs that a signal to this process stops already
_QUIET = {"loggers": {"console": {"config": {"log_level": "CRITICAL"}}}}


@dataclass
class RunOutcome:
    """The outcome of a Dagster run: its problems, one sentence each, and whether a budget was reached."""

    problems: list[str]
    over_budget: bool


class Runs(ABC):
    """An executor of runs of stages that share their partitions."""

    @abstractmethod
    def ranges(self, stages: Sequence[Stage], keys: Sequence[str | None]) -> Sequence[Range]:
        """Return a range of keys per run; ranges may repeat, and hold unwanted keys."""

    @abstractmethod
    def make(self, stages: Sequence[Stage], ranges: Sequence[Range], tags: Mapping[str, str]) -> Iterable[RunOutcome]:
        """Materialize the stages in these ranges; KeyboardInterrupt propagates."""


class LocalRuns(Runs):
    """Executes runs of the job of all assets in this process; parent: the run that starts them."""

    def __init__(
        self,
        instance: dg.DagsterInstance,
        job: dg.JobDefinition,
        *,
        parent: dg.DagsterRun | None = None,
        log: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._instance, self._job, self._parent, self._log = instance, job, parent, log
        self._tags = {PID_TAG: str(os.getpid()), HOST_TAG: this_host()}
        if parent:
            instance.add_run_tags(parent.run_id, {JOB_RUN_TAG: parent.run_id})
            self._tags |= {JOB_TAG: parent.job_name, JOB_RUN_TAG: parent.run_id}
        self.finished: list[dict[str, str]] = []

    def ranges(self, stages: Sequence[Stage], keys: Sequence[str | None]) -> Sequence[Range]:
        """Return the fewest ranges of keys that contain exactly these keys."""
        return [*key_ranges(stages[0].scheme if stages else None, keys)]

    @override
    def make(self, stages: Sequence[Stage], ranges: Sequence[Range], tags: Mapping[str, str]) -> Iterator[RunOutcome]:
        for number, keys in enumerate(ranges, start=1):
            run_id, names = str(uuid.uuid4()), ", ".join(stage.name for stage in stages)
            self._stop_if_terminated()
            words = "" if keys[0] is None else keys[0] if keys[0] == keys[1] else f"{keys[0]} to {keys[1]}"
            self._log(f"run {run_id} ({number} of {len(ranges)}): {names} {words}")
            outcome = self._execute(stages, keys, tags, run_id)
            result = "; ".join(outcome.problems) or "made"
            self._log(f"run {run_id}: {result}")
            self.finished.append({"run": run_id, "assets": names, "partitions": words, "result": result})
            self._stop_if_terminated(run_id)  # a library may have swallowed the signal
            yield outcome

    def _stop_if_terminated(self, *run_ids: str) -> None:
        if any(map(self._is_terminated, (*run_ids, *([self._parent.run_id] if self._parent else [])))):
            raise KeyboardInterrupt

    def _is_terminated(self, run_id: str) -> bool:
        run = self._instance.get_run_by_id(run_id)
        return run is not None and run.status in (dg.DagsterRunStatus.CANCELING, dg.DagsterRunStatus.CANCELED)

    @contextmanager
    def _following(self, run_id: str) -> Iterator[None]:
        """Interrupt this process if the run is terminated in Dagster's pages.

        Dagster's launcher started no process for it, so that "Terminate" can only mark it as canceling. A parent that
        Dagster has launched gets a signal from it.
        """
        is_over = threading.Event()

        def look() -> None:
            while not is_over.wait(_LOOK_S):
                with suppress(SQLAlchemyError):  # a busy history is looked at again
                    if run_id not in _stopped_here and self._is_terminated(run_id):
                        # To the main thread itself: it may wait in a call that a signal to another one does not end.
                        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
                        return

        thread = threading.Thread(target=look, daemon=True)
        thread.start()
        try:
            yield
        finally:
            is_over.set()
            thread.join()

    def _execute(self, stages: Sequence[Stage], keys: Range, tags: Mapping[str, str], run_id: str) -> RunOutcome:
        key = keys[0] if keys[0] == keys[1] else None
        try:
            with self._following(run_id):
                result = self._job.execute_in_process(
                    instance=self._instance,
                    asset_selection=[asset_key(stage.name) for stage in stages],
                    partition_key=key,
                    tags={**self._tags, **tags, **range_tags(keys)},
                    raise_on_error=False,
                    run_config=_QUIET,
                    run_id=run_id,
                )
        except dg.DagsterExecutionInterruptedError:
            raise KeyboardInterrupt from None
        failures = [event for event in result.all_events if event.is_step_failure]
        if any(error.cls_name in _INTERRUPTS for event in failures for error in _causes(event)):
            raise KeyboardInterrupt
        outcome = failed_outcome(failures)
        if not result.success and not outcome.problems:
            names = ", ".join(stage.name for stage in stages)
            outcome.problems.append(f"{names} {key or ''}: the run failed; see its log in Dagster")
        return outcome


def report_canceling(instance: dg.DagsterInstance, run_id: str) -> None:
    """Tell Dagster that a signal stops a run of this process, which it would call a failure otherwise."""
    _stopped_here.add(run_id)
    run = instance.get_run_by_id(run_id)
    if run is not None and run.status == dg.DagsterRunStatus.STARTED:
        instance.report_run_canceling(run, "Stopped by a signal.")


def range_tags(keys: Range, *, always: bool = False) -> dict[str, str]:
    """Return the Dagster tags of a range of keys; a single key has none unless `always`."""
    first, last = keys
    if first is None or (first == last and not always):
        return {}
    return {_RANGE[0]: str(first), _RANGE[1]: str(last)}


def keys_of(stage: Stage, tags: Mapping[str, str]) -> Sequence[str]:
    """Return the partition keys of a stage that a run's tags name."""
    first, last = (tags.get(name, tags.get("dagster/partition", "")) for name in _RANGE)
    return stage.scheme.between(first, last) if stage.scheme and first else []


def this_host() -> str:
    """Return a text for the scope in which process ids are unique: host and PID namespace."""
    namespace = Path("/proc/self/ns/pid")
    return f"{socket.gethostname()} {namespace.readlink() if namespace.exists() else ''}".strip()


def failed_outcome(failures: Sequence[dg.DagsterEvent]) -> RunOutcome:
    """Return the outcome of a run with these failed steps: their messages, and whether a budget was reached."""
    problems = [line for event in failures for line in reason(event.step_failure_data.error).splitlines()]
    over = any(error.cls_name == BudgetReached.__name__ for event in failures for error in _causes(event))
    return RunOutcome(problems, over)


def is_broken_off(run: dg.DagsterRun, failures: Sequence[dg.DagsterEvent]) -> bool:
    """Return whether a run failed without a reason, as when host or network fails."""
    named = [{error.cls_name for error in _causes(event)} for event in failures]
    is_interrupted = any(names & {*_INTERRUPTS} for names in named)
    unnamed = not failures or any(not names & {*_SENTENCES} for names in named)
    return run.status == dg.DagsterRunStatus.FAILURE and unnamed and not is_interrupted


def _causes(event: dg.DagsterEvent) -> list[Any]:
    """Return the error of a failed step and its causes, outermost first."""
    return _chain(event.step_failure_data.error)


def _chain(error: Any) -> list[Any]:
    chain = []
    while error is not None:
        chain.append(error)
        error = error.cause
    return chain


def reason(error: Any) -> str:
    """Return the message of a Dagster error: our own sentence, else its innermost cause."""
    chain = _chain(error)
    readable = [link for link in chain if link.cls_name in _SENTENCES]
    if not readable:
        return chain[-1].message.strip() if chain else "the step failed"
    return re.sub(rf"^\S*\b{readable[0].cls_name}: ", "", readable[0].message.strip())
