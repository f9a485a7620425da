"""`traps run`: walk the stages of an experiment through Dagster, making what is missing or stale, and no more."""

from __future__ import annotations

import fcntl
import os
import re
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import groupby, product
from typing import TYPE_CHECKING, Any

from traps_pipeline import progress
from traps_pipeline.benchmark.corrections import categories_of, load_scenarios
from traps_pipeline.errors import TrapsError
from traps_pipeline.experiment import Experiment
from traps_pipeline.lineage import INSIDE, PARTITIONED_BY, STAGES, STEERED, Lineage, Node, name_of, steps, upstream
from traps_pipeline.mechanism.settings import MechanismSettings
from traps_pipeline.models.budget import BudgetReached
from traps_pipeline.models.registry import all_evaluations
from traps_pipeline.models.traffic import remembering_stops
from traps_pipeline.partitions import (
    ANSWERABLE,
    CATEGORIES,
    DATASETS,
    PROBED_DATASETS,
    Cell,
    Extraction,
    StatesCell,
    SteeringCell,
    datasets_of_category,
)
from traps_pipeline.storage.workspace import VARIABLE, Workspace
from traps_pipeline.tables import SCENE_SPECS

if TYPE_CHECKING:
    import dagster as dg

SHOWN = 4  # unfinished partitions named in a problem
# Made from whatever is there of these; of nothing at all where the prefix is empty.
AGGREGATES = {
    "metrics": "verdicts/",
    "contrasts": "metrics/",
    "regime_tests": "metrics/",
    "leaderboard": "metrics/",
    "agreement": "votes/",
    "judge_bias": "votes/",
    "leave_one_out": "leaderboard",
    "confabulation": "",
    "probes": "hidden_states/",
    "directions": "hidden_states/",
    "cosines": "directions/",
    "steering": "directions/",
    "steering_effects": "steering_votes/",
    "steering_shares": "steering_votes/",
    "mechanism_report": "",
}
PID_TAG = "traps/pid"
_SENTENCES = (TrapsError.__name__, BudgetReached.__name__)  # errors whose message is for people
_INTERRUPTS = ("DagsterExecutionInterruptedError", "KeyboardInterrupt")
_QUIET = {"loggers": {"console": {"config": {"log_level": "CRITICAL"}}}}


def enter(workspace: Workspace) -> None:
    """Make every asset and Dagster itself use this workspace."""
    os.environ[VARIABLE] = str(workspace.root)
    os.environ["DAGSTER_HOME"] = str(workspace.dagster_home)


@contextmanager
def dagster_history(workspace: Workspace) -> Iterator[dg.DagsterInstance]:
    """Dagster's history of this workspace, opened by one process at a time (a first opening by two corrupts it).

    Runs whose process was killed are marked as failed: a queue would count them for ever. Raises TrapsError when the
    history cannot be read or written.
    """
    import dagster as dg
    from sqlalchemy.exc import DBAPIError

    enter(workspace)
    try:
        workspace.locks.mkdir(parents=True, exist_ok=True)
        with (workspace.locks / "dagster.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            instance = dg.DagsterInstance.get()
        with instance:
            for run in instance.get_runs(dg.RunsFilter(statuses=[dg.DagsterRunStatus.STARTED])):
                if PID_TAG in run.tags and not _alive(int(run.tags[PID_TAG])):
                    instance.report_run_failed(run, "its process was killed; what it had asked and made is kept")
            yield instance
    except (DBAPIError, OSError) as error:
        raise TrapsError(
            f"{workspace.dagster_home}: Dagster's history cannot be read or written ({error}); free some space and run "
            "the same command again: tables are whole, no answer is lost"
        ) from error


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def wanted_keys(workspace: Workspace, experiment: Experiment, stage: str) -> list[str | None]:
    """Partition keys of a stage that an experiment needs, in key order."""
    scenarios = load_scenarios(workspace.study)
    present = categories_of(scenarios)
    match PARTITIONED_BY.get(stage):
        case "category":
            made = [c for c in CATEGORIES if workspace.tables.state(SCENE_SPECS, {"category": c}) is not None]
            return [c for c in CATEGORIES if c in present or c in made]
        case "dataset":
            return [d for d in DATASETS if d in _datasets(experiment, present)]
        case "cell":
            return [cell.key for cell in experiment.cells() if cell.dataset in _datasets(experiment, present)]
        case None if stage not in INSIDE:
            return [None]
    return _inside(experiment.mechanism, stage, _datasets(experiment, present))


def _inside(asked: MechanismSettings | None, stage: str, datasets: Sequence[str]) -> list[str | None]:
    """Partition keys of a mechanistic stage; none for an experiment that asks nothing inside models.

    Probes are of the standard VQA prompt, the guided one serves directions (`benchmark.md` section 7).
    """
    steering = asked.steering if asked else None
    if asked is None or (steering is None and stage in ("directions", "cosines", *STEERED)):
        return []
    probed = [d for d in PROBED_DATASETS if d in datasets or (d == ANSWERABLE and "occlusion" in datasets)]
    extractions = [Extraction(model, prompt) for model in asked.models for prompt in asked.prompts]
    match PARTITIONED_BY.get(stage):
        case "probed":
            return [*probed]
        case "states":
            cells = [StatesCell(d, e) for e in extractions for d in probed]
            return [c.key for c in cells if c.dataset != ANSWERABLE or c.extraction.prompt == "standard"]
        case "extraction":
            return [e.key for e in extractions if stage != "probes" or e.prompt == "standard"]
        case "steering":
            assert steering is not None, "checked above"
            runs = product(asked.models, steering.direction_regimes, steering.inference_regimes)
            return [SteeringCell.make(d, *run).key for run in runs for d in datasets]
    return [None]


def _datasets(experiment: Experiment, categories: Sequence[str]) -> list[str]:
    there = {dataset for category in categories for dataset in datasets_of_category(category)}
    return [dataset for dataset in experiment.datasets if dataset in there]


@dataclass
class Outcome:
    """What a run did: problems by partition, and checks that did not pass; whether a budget ended it."""

    problems: list[str] = field(default_factory=list)
    over_budget: bool = False
    failed: set[Node] = field(default_factory=set)
    seconds: float = 0.0


def run_experiment(workspace: Workspace, experiment: Experiment, until: str | None = None) -> Outcome:
    """Materialize whatever of the experiment is missing or stale, stage by stage, up to `until`. KeyboardInterrupt
    passes through. Raises TrapsError for a stage that is none."""
    from traps_pipeline.definitions import observe_sources

    if until is not None and until not in STAGES:
        raise TrapsError(f"--until {until}: no such stage; choose from {', '.join(STAGES)}")
    wanted = STAGES if until is None else STAGES[: STAGES.index(until) + 1]
    outcome, began = Outcome(), time.monotonic()
    with dagster_history(workspace) as instance, remembering_stops():
        observe_sources(instance, workspace)
        for name, stages in steps(wanted):
            _run_step(instance, workspace, experiment, name, stages, outcome)
    outcome.problems = [*dict.fromkeys(outcome.problems), *failed_checks(workspace, experiment)]
    outcome.seconds = time.monotonic() - began
    return outcome


def failed_checks(workspace: Workspace, experiment: Experiment) -> list[str]:
    """Checks of the experiment's partitions that do not pass, whichever run made them."""
    problems = []
    for stage in STAGES:
        for key in wanted_keys(workspace, experiment, stage):
            for check in workspace.failed_checks(stage, key):
                details = workspace.failed_check(stage, check, key).read_text(encoding="utf-8")
                problems.append(f"check {check} of {name_of((stage, key))} does not pass: {details}")
    return problems


def _run_step(
    instance: dg.DagsterInstance,
    workspace: Workspace,
    experiment: Experiment,
    name: str,
    stages: Sequence[str],
    outcome: Outcome,
) -> None:
    """Make what is not fresh of a stage, or of several unpartitioned ones that are one run."""
    lineage = Lineage(workspace)
    todo = [node for stage in stages for node in _not_fresh(instance, workspace, experiment, lineage, stage)]
    blocked = {node for node in todo if _blocked(lineage, *node, outcome.failed)}
    outcome.failed |= blocked
    todo = [node for node in todo if node not in blocked]
    if not todo:
        return
    progress.current().stage(name, len(todo))
    made = list(dict.fromkeys(stage for stage, _ in todo))
    for batch in batches(made[0], [key for _, key in todo]) if len(stages) == 1 else [(None, None)]:
        problems, over_budget = _materialize(instance, made, batch)
        outcome.problems += problems
        outcome.over_budget |= over_budget
    after = Lineage(workspace)
    statuses = {node: after.status(*node) for node in todo}
    unfinished = [node for node, status in statuses.items() if status.kind == "missing" or status.outdated]
    outcome.failed.update(unfinished)
    if unfinished:
        shown = ", ".join(name_of(node) for node in unfinished[:SHOWN]) + (", ..." if len(unfinished) > SHOWN else "")
        outcome.problems.append(f"{len(unfinished)} of {len(todo)} partitions of {name} are not done: {shown}")
    outcome.problems += [
        f"{name_of(node)}: {status.failed} calls failed" for node, status in statuses.items() if status.failed
    ]


def _not_fresh(
    instance: dg.DagsterInstance, workspace: Workspace, experiment: Experiment, lineage: Lineage, stage: str
) -> list[Node]:
    """Wanted partitions of a stage that are missing, stale, or unknown to Dagster: a crash between a table and its
    event leaves such a table; it is materialized once more."""
    from traps_pipeline.definitions import recorded_versions

    recorded = recorded_versions(instance, stage)
    return [
        (stage, key)
        for key in wanted_keys(workspace, experiment, stage)
        if lineage.status(stage, key).kind != "fresh" or recorded.get(key) != lineage.version(stage, key)
    ]


def _blocked(lineage: Lineage, stage: str, key: str | None, failed: set[Node]) -> bool:
    """Whether a failure above leaves nothing sound to make a partition from."""
    if stage in AGGREGATES:
        scored = [name for name in lineage.inputs(stage, key) if name.startswith(AGGREGATES[stage])]
        return bool(failed) and not scored
    return bool(failed & set(upstream(stage, key)))


def batches(stage: str, keys: Sequence[str | None]) -> Iterator[tuple[str | None, str | None]]:
    """Ranges (first key, last key) that together are exactly the keys: one run each. A range of cells is a rectangle of
    neighbouring datasets and evaluations; other stages take one partition a run."""
    if PARTITIONED_BY.get(stage) != "cell":
        yield from ((key, key) for key in keys)
        return
    order = {evaluation: number for number, evaluation in enumerate(all_evaluations())}
    by_dataset: dict[int, list[int]] = {}
    for key in keys:
        cell = Cell.parse(str(key))
        by_dataset.setdefault(DATASETS.index(cell.dataset), []).append(order[cell.evaluation])
    spans = sorted((span, dataset) for dataset, numbers in by_dataset.items() for span in _spans(numbers))
    for span, group in groupby(spans, key=lambda pair: pair[0]):
        for first, last in _spans([dataset for _, dataset in group]):
            evaluations = all_evaluations()
            yield Cell(DATASETS[first], evaluations[span[0]]).key, Cell(DATASETS[last], evaluations[span[1]]).key


def _spans(numbers: Sequence[int]) -> list[tuple[int, int]]:
    """Maximal runs of neighbouring numbers, as (first, last)."""
    spans: list[tuple[int, int]] = []
    for number in sorted(numbers):
        if spans and spans[-1][1] == number - 1:
            spans[-1] = (spans[-1][0], number)
        else:
            spans.append((number, number))
    return spans


def _materialize(
    instance: dg.DagsterInstance, stages: Sequence[str], batch: tuple[str | None, str | None]
) -> tuple[list[str], bool]:
    """One Dagster run; what went wrong in it, one sentence each, and whether a budget was reached."""
    import dagster as dg

    from traps_pipeline.definitions import ASSETS, SOURCES, inputs_current

    first, last = batch
    ranged = PARTITIONED_BY.get(stages[0]) == "cell"
    tags = {"dagster/asset_partition_range_start": str(first), "dagster/asset_partition_range_end": str(last)}
    try:
        result = dg.materialize(
            [*SOURCES, *ASSETS, inputs_current],
            selection=dg.AssetSelection.assets(*stages),
            instance=instance,
            partition_key=None if ranged else first,
            tags={PID_TAG: str(os.getpid())} | (tags if ranged else {}),
            raise_on_error=False,
            run_config=_QUIET,
        )
    except dg.DagsterExecutionInterruptedError:
        raise KeyboardInterrupt from None
    failures = [event for event in result.all_events if event.is_step_failure]
    if any(error.cls_name in _INTERRUPTS for event in failures for error in _chain(event)):
        raise KeyboardInterrupt
    problems = [_reason(event) for event in failures]
    if not result.success and not problems:
        problems.append(f"{', '.join(stages)} {first or ''}: the run failed; see its log in Dagster")
    over_budget = any(error.cls_name == BudgetReached.__name__ for event in failures for error in _chain(event))
    return problems, over_budget


def _chain(event: dg.DagsterEvent) -> list[Any]:
    """The error of a failed step and its causes, outermost first."""
    chain, error = [], event.step_failure_data.error
    while error is not None:
        chain.append(error)
        error = error.cause
    return chain


def _reason(event: dg.DagsterEvent) -> str:
    """The error of a failed step: our own sentence where there is one, else the innermost exception."""
    chain = _chain(event)
    told = [error for error in chain if error.cls_name in _SENTENCES]
    if not told:
        return chain[-1].message.strip() if chain else "the step failed"
    return re.sub(rf"^\S*\b{told[0].cls_name}: ", "", told[0].message.strip())
