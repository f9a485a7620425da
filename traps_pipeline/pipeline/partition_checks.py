"""Evaluate the checks of a stage's partitions, for Dagster and a run's report."""

import json
from collections.abc import Collection, Iterator, Mapping
from typing import Any

import dagster as dg

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.money.budget import BudgetReached
from traps_pipeline.pipeline.graph import Graph, Node, Stage, name_of, the_graph
from traps_pipeline.pipeline.history import History
from traps_pipeline.pipeline.lineage import Lineage, failed_calls
from traps_pipeline.pipeline.metadata import visible_metadata
from traps_pipeline.pipeline.translation import asset_key
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.workspace import Workspace

CURRENT = "current"  # the check that every stage has
CURRENT_DOC = "The partition is complete, made from the current inputs, and no call of it failed."
REACHED = "a budget is reached"  # in a check's metadata
STILL = "still failing"  # in a check's metadata: set for a partition that the run did not touch
MAX_NAMED = 12  # unmade partitions named in an error


class StageChecks:
    """Evaluates the checks of one stage in one run.

    A failure is stored in the workspace until the partition passes, so that each later run and `traps status` report it
    even if this run dies before it reports to Dagster.

    The evaluations are not `AssetCheckResult`s: if a blocking one of those fails, Dagster fails the step and skips
    everything downstream, including stages that do not need this partition. `Lineage.blocked` blocks the ones that do.
    """

    def __init__(self, workspace: Workspace, history: History, graph: Graph, stage: Stage) -> None:
        self._workspace, self._history, self._graph, self._stage = workspace, history, graph, stage
        self._failing: dict[tuple[str, str | None], Mapping[str, Any]] = {}

    def of_parents(self, lineage: Lineage, key: str | None) -> Iterator[dg.AssetCheckEvaluation]:
        """Yield failed evaluations of parents whose content was altered, before anything is built from them."""
        for parent, keys in self._graph.parents(self._stage.name, key).items():
            if self._graph.source(parent) is None:
                for parent_key in keys:
                    if damage := lineage.damage(parent, parent_key):
                        yield from evaluations(self._history, parent, parent_key, {CURRENT: {"damaged": damage}})

    def test(self, key: str | None, output: StageOutput) -> Mapping[str, Mapping[str, Any]]:
        """Return by check what it finds wrong with a partition that was just written.

        Failures are stored before Dagster hears of the partition: a run that dies between the two makes it again.
        """
        stage, wrong = self._stage, dict[str, Any]()
        if stage.table is not None:
            damage = self._workspace.tables.damage(stage.table, stage.columns(key), thorough=True)
            wrong |= {"damaged": damage} if damage else {}
        if output.tally.errors:
            wrong["failed"] = failed_calls(output.tally.errors)
        failures: dict[str, Mapping[str, Any]] = {CURRENT: wrong}
        for check in stage.checks:
            problems = check.wrong(self._workspace, key, output)
            file = self._workspace.failed_check(stage.name, check.name, key)
            if problems:
                self._workspace.store.write({file: json.dumps(problems, default=str).encode()})
            else:
                self._workspace.store.remove([file])
            failures[check.name] = {"failing": json.loads(json.dumps(problems, default=str))} if problems else {}
        return failures

    def of_made(self, key: str | None, found: Mapping[str, Mapping[str, Any]]) -> Iterator[dg.AssetCheckEvaluation]:
        """Yield the evaluation of every check of a partition, after its event, from what `test` returned."""
        self._failing |= {(check, key): failure for check, failure in found.items() if failure}
        yield from evaluations(self._history, self._stage.name, key, found)

    def of_unmade(self, key: str | None, error: TrapsError) -> Iterator[dg.AssetCheckEvaluation]:
        """Yield the evaluation of a partition that could not be built."""
        yield from self.of_made(key, {CURRENT: {"not made": str(error), REACHED: isinstance(error, BudgetReached)}})

    def of_fresh(self, key: str | None) -> Iterator[dg.AssetCheckEvaluation]:
        """Yield passing evaluations of a fresh partition, which this run does not build.

        Dagster awaits an evaluation from the run, and would say that the check was skipped, or failed to execute.
        """
        failed = {*self._workspace.failed_checks(self._stage.name).get(key, [])}
        names = {CURRENT, *(check.name for check in self._stage.checks)} - failed
        yield from evaluations(self._history, self._stage.name, key, {name: {} for name in sorted(names)})

    def still_failing(self, lineage: Lineage, seen: Collection[str | None]) -> Iterator[dg.AssetCheckEvaluation]:
        """Yield again the failed evaluations of all keys; Dagster shows only the newest result."""
        name = self._stage.name
        failed = self._workspace.failed_checks(name)
        for key in self._graph.keys(name):
            if key not in seen:
                for check in failed.get(key, []):
                    self._failing[check, key] = {STILL: json.loads(self._workspace.failure(name, check, key))}
                state = lineage.state(name, key)
                if state is not None and state.failed:
                    self._failing[CURRENT, key] = {STILL: failed_calls(state.failed)}
        for (check, key), failure in self._failing.items():
            yield from evaluations(self._history, name, key, {check: failure})


def raise_for_run(context: dg.AssetExecutionContext, graph: Graph, last: str) -> None:
    """Raise TrapsError, or BudgetReached, for all failures of this run that block something, up to a stage.

    An error in an upstream step would have made Dagster skip everything downstream, including what is sound.
    """
    upstream, failed = graph.above([last]), dict[tuple[str, Node], dg.AssetCheckEvaluation]()
    event_type = dg.DagsterEventType.ASSET_CHECK_EVALUATION
    for entry in context.instance.all_logs(context.run.run_id, of_type=event_type):
        event = entry.get_dagster_event().asset_check_evaluation_data
        node = (event.asset_key.path[-1], event.partition)
        if node[0] in upstream and STILL not in event.metadata and event.severity == dg.AssetCheckSeverity.ERROR:
            failed[event.check_name, node] = event
    messages_by_reason: dict[tuple[str, str], list[str]] = {}  # by stage and message: each reason is reported once
    for (check, node), event in failed.items():
        for line in _lines(check, node, event):
            messages_by_reason.setdefault((node[0], line.replace(name_of(node), "")), []).append(line)
    if messages_by_reason:
        lines = [
            f"{first} (and {len(repeats)} more)" if repeats else first
            for first, *repeats in messages_by_reason.values()
        ]
        suffix_lines = [f"... and {len(lines) - MAX_NAMED} more"] if len(lines) > MAX_NAMED else []
        is_budget_reached = any(e.metadata[REACHED].value for e in failed.values() if REACHED in e.metadata)
        raise (BudgetReached if is_budget_reached else TrapsError)("\n".join([*lines[:MAX_NAMED], *suffix_lines]))


def evaluations(
    history: History, stage: str, key: str | None, found: Mapping[str, Mapping[str, Any]]
) -> Iterator[dg.AssetCheckEvaluation]:
    """Yield the evaluation of each check of a partition, from the checks' failures."""
    target = history.check_target(stage, key)
    warning_checks = {check.name for check in the_graph()[stage].checks if not check.blocks}
    for check, failure in found.items():
        yield dg.AssetCheckEvaluation(
            asset_key=asset_key(stage),
            check_name=check,
            passed=not failure,
            severity=dg.AssetCheckSeverity.WARN if check in warning_checks else dg.AssetCheckSeverity.ERROR,
            partition=key,
            metadata=visible_metadata(failure),
            target_materialization_data=target,
        )


def _lines(check: str, node: Node, event: dg.AssetCheckEvaluation) -> Iterator[str]:
    """Yield the message of a failed check, one line at a time."""
    if event.passed:
        return
    for name, value in ((name, value.value) for name, value in event.metadata.items() if name != REACHED):
        if check != CURRENT:
            text = value if isinstance(value, str) else json.dumps(value)
            yield f"check {check} of {name_of(node)} does not pass: {text}"
        else:
            yield f"{name_of(node)}{' is not made' if name == 'not made' else ''}: {value}"
