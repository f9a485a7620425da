"""Walk the graph: make what is missing or stale, a Dagster run for each block of stages that share their partitions."""

from __future__ import annotations

import fcntl
import os
import re
import socket
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import dagster as dg

from traps_pipeline import progress
from traps_pipeline.errors import TrapsError
from traps_pipeline.files import remedy
from traps_pipeline.models.budget import BudgetReached
from traps_pipeline.models.traffic import remembering_stops
from traps_pipeline.orchestration.graph import name_of, the_graph
from traps_pipeline.orchestration.history import History
from traps_pipeline.orchestration.lineage import Lineage
from traps_pipeline.orchestration.schemes import Scheme
from traps_pipeline.orchestration.step import EXPERIMENT_TAG, MAKE_TAG, OUTDATED, STALE, to_make
from traps_pipeline.orchestration.wanted import Wanted
from traps_pipeline.storage.workspace import Workspace

PID_TAG, HOST_TAG = "traps/pid", "traps/host"
_RANGE = "dagster/asset_partition_range_start", "dagster/asset_partition_range_end"
_SENTENCES = (TrapsError.__name__, BudgetReached.__name__)  # errors whose message is for people
_INTERRUPTS = ("DagsterExecutionInterruptedError", "KeyboardInterrupt")
_QUIET = {"loggers": {"console": {"config": {"log_level": "CRITICAL"}}}}


@dataclass
class WalkResult:
    """What a walk did: problems in sentences, among them checks that do not pass; whether a budget ended it."""

    problems: list[str] = field(default_factory=list)
    over_budget: bool = False
    seconds: float = 0.0


@contextmanager
def dagster_history(workspace: Workspace) -> Iterator[dg.DagsterInstance]:
    """Dagster's history of this workspace, opened by one process at a time (a first opening by two corrupts it).

    Runs whose process was killed are marked as failed: a queue would count them for ever. A history that is gone begins
    anew, and so does one that is no history any more, which is kept beside it: what counts stands in the tables.
    Raises TrapsError when the history cannot be read or written.
    """
    from sqlalchemy.exc import DBAPIError

    home = Path(os.environ.get("DAGSTER_HOME") or workspace.dagster_home)
    try:
        workspace.locks.mkdir(parents=True, exist_ok=True)
        with (workspace.locks / "dagster.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            instance = _opened(workspace, home)
        with instance:
            for run in instance.get_runs(dg.RunsFilter(statuses=[dg.DagsterRunStatus.STARTED])):
                here = run.tags.get(HOST_TAG) == this_host()
                if here and PID_TAG in run.tags and not _alive(int(run.tags[PID_TAG])):
                    instance.report_run_failed(run, "its process was killed; what it had asked and made is kept")
            yield instance
    except BrokenPipeError:
        raise  # of what is printed to
    except (DBAPIError, OSError) as error:
        what = remedy(error) if isinstance(error, OSError) else "free some space, or move that folder away"
        raise TrapsError(
            f"{home}: Dagster's history cannot be read or written ({' '.join(str(error).split())[:300]}); {what} and "
            "run the same command again: tables are whole, no answer is lost"
        ) from error


def _opened(workspace: Workspace, home: Path) -> dg.DagsterInstance:
    from sqlalchemy.exc import DatabaseError, OperationalError

    for again in (False, True):
        workspace.copy_dagster_yaml(home)
        try:
            instance = dg.DagsterInstance.from_config(str(home))
            instance.get_runs_count()
            instance.all_asset_keys()  # of the other file
        except OperationalError:
            raise  # a full disk or another's lock: it is whole
        except DatabaseError as error:
            if again or ("not a database" not in str(error) and "malformed" not in str(error)):
                raise
            kept = home / f"broken-{time.strftime('%Y%m%dT%H%M%S')}"
            for name in ("history", "schedules", "storage"):
                if (home / name).exists():
                    kept.mkdir(exist_ok=True)
                    (home / name).rename(kept / name)
            progress.current().note(f"{home}: Dagster's history was damaged; it lies in {kept.name}, a new one begins")
        else:
            return instance
    raise AssertionError("unreachable: the second try returns or raises")


def this_host() -> str:
    """Where process numbers mean what they mean here: the machine and its namespace of processes."""
    namespace = Path("/proc/self/ns/pid")
    return f"{socket.gethostname()} {namespace.readlink() if namespace.exists() else ''}".strip()


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def walk(
    instance: dg.DagsterInstance,
    job: dg.JobDefinition,
    workspace: Workspace,
    stages: Collection[str],
    *,
    experiment: str | None = None,
    existing: bool = False,
) -> WalkResult:
    """Make what is missing or stale of these stages, block by block, in runs of the job of all assets.

    experiment: only what that one of the study's wants; existing: only what is there already and outdated.
    KeyboardInterrupt passes through.
    """
    outcome, began, graph = WalkResult(), time.monotonic(), the_graph()
    history, wanted = History(instance, graph), Wanted(workspace, experiment)
    tags = {MAKE_TAG: OUTDATED if existing else STALE} | ({EXPERIMENT_TAG: experiment} if experiment else {})
    with remembering_stops():
        for block in graph.blocks([name for name in stages if graph[name].wanted(wanted)]):
            lineage = Lineage(workspace)
            todo: dict[str, list[str | None]] = {}
            for stage in block:
                known = history.recorded(stage.name)
                every = stage.wanted(wanted)
                keys = [k for k in every if to_make(lineage, known, stage.name, k, existing=existing)]
                keys = [k for k in keys if not (existing and lineage.waits(stage.name, k))]
                if keys or graph.parents_of[stage.name].keys() & todo.keys():
                    todo[stage.name] = keys
            keys = [key for key in graph.keys(block[0].name) if any(key in of for of in todo.values())]
            for first, last in batches(block[0].scheme, keys):
                ranged = {_RANGE[0]: str(first), _RANGE[1]: str(last)} if first != last else {}
                problems, over_budget = _execute(
                    instance, job, [*todo], first if first == last else None, tags | ranged
                )
                outcome.problems += problems
                outcome.over_budget |= over_budget
    outcome.problems = [*dict.fromkeys(outcome.problems)]
    outcome.seconds = time.monotonic() - began
    return outcome


def stages_until(until: str | None) -> set[str]:
    """All stages; with `until` (names with commas between), these and what they are made from. Raises TrapsError."""
    graph = the_graph()
    if until is None:
        return {stage.name for stage in graph.stages}
    known = [stage.name for stage in graph.stages]
    if unknown := [name for name in until.split(",") if name not in known]:
        raise TrapsError(f"--until {', '.join(unknown)}: no such stage; choose from {', '.join(known)}")
    return graph.above(until.split(","))


def failed_checks(workspace: Workspace, experiment: str | None) -> list[str]:
    """Checks of what is wanted that do not pass, whichever run made it."""
    wanted, problems = Wanted(workspace, experiment), []
    for stage in the_graph().stages:
        for key in stage.wanted(wanted):
            for check in workspace.failed_checks(stage.name, key):
                details = workspace.failure(stage.name, check, key)
                problems.append(f"check {check} of {name_of((stage.name, key))} does not pass: {_unquoted(details)}")
    return problems


def _unquoted(details: str) -> str:
    return details[1:-1] if details[:1] == details[-1:] == '"' else details


def batches(scheme: Scheme | None, keys: Sequence[str | None]) -> Iterator[tuple[str | None, str | None]]:
    """Ranges (first key, last key) that together are exactly the keys: one run each. Of two dimensions a range is a
    rectangle of neighbours."""
    if scheme is None or not keys:
        yield from ((key, key) for key in keys)
        return
    if not isinstance(scheme.definition, dg.MultiPartitionsDefinition):
        every = [str(key) for key in scheme.definition.get_partition_keys()]
        yield from ((every[first], every[last]) for first, last in _spans([every.index(str(key)) for key in keys]))
        return
    rows, columns = ([str(k) for k in d.partitions_def.get_partition_keys()] for d in scheme.definition.partitions_defs)
    places = {key: number for number, key in enumerate(columns)}
    by_row: dict[int, list[int]] = {}
    for key in keys:
        row, _, column = str(key).partition("|")
        by_row.setdefault(rows.index(row), []).append(places[column])
    spans = sorted((span, row) for row, numbers in by_row.items() for span in _spans(numbers))
    for span, group in groupby(spans, key=lambda pair: pair[0]):
        for first, last in _spans([row for _, row in group]):
            yield f"{rows[first]}|{columns[span[0]]}", f"{rows[last]}|{columns[span[1]]}"


def _spans(numbers: Sequence[int]) -> list[tuple[int, int]]:
    """Maximal runs of neighbouring numbers, as (first, last)."""
    spans: list[tuple[int, int]] = []
    for number in sorted(numbers):
        if spans and spans[-1][1] == number - 1:
            spans[-1] = spans[-1][0], number
        else:
            spans.append((number, number))
    return spans


def _execute(
    instance: dg.DagsterInstance, job: dg.JobDefinition, stages: Sequence[str], key: str | None, tags: Mapping[str, str]
) -> tuple[list[str], bool]:
    """One Dagster run of some assets; what went wrong in it, a sentence each, and whether a budget was reached."""
    graph = the_graph()
    try:
        result = job.execute_in_process(
            instance=instance,
            asset_selection=[graph[name].spec.key for name in stages],
            partition_key=key,
            tags={PID_TAG: str(os.getpid()), HOST_TAG: this_host(), **tags},
            raise_on_error=False,
            run_config=_QUIET,
        )
    except dg.DagsterExecutionInterruptedError:
        raise KeyboardInterrupt from None
    failures = [event for event in result.all_events if event.is_step_failure]
    if any(error.cls_name in _INTERRUPTS for event in failures for error in _chain(event)):
        raise KeyboardInterrupt
    problems = [line for event in failures for line in _reason(event).splitlines()]
    if not result.success and not problems:
        problems.append(f"{', '.join(stages)} {key or ''}: the run failed; see its log in Dagster")
    return problems, any(error.cls_name == BudgetReached.__name__ for event in failures for error in _chain(event))


def _chain(event: dg.DagsterEvent) -> list[Any]:
    """The error of a failed step and its causes, outermost first."""
    chain, error = [], event.step_failure_data.error
    while error is not None:
        chain.append(error)
        error = error.cause
    return chain


def _reason(event: dg.DagsterEvent) -> str:
    """The error of a failed step: our own sentences where there are some, else the innermost exception."""
    chain = _chain(event)
    readable = [error for error in chain if error.cls_name in _SENTENCES]
    if not readable:
        return chain[-1].message.strip() if chain else "the step failed"
    return re.sub(rf"^\S*\b{readable[0].cls_name}: ", "", readable[0].message.strip())
