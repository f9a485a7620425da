"""Build a stage's partitions in one Dagster run, and report them.

`run_step` is the whole protocol, in the only sound order. It records the inputs' versions before it reads anything. It
skips, with a reason, what cannot be built yet or would be built from something damaged. Each partition is written, read
back, checked and reported to Dagster as soon as it is done. The last step of a run raises for what is missing
(docs/design/staleness.md).
A partition of a range gets an `AssetMaterialization` with a data version of its own, since the versions of a
`MaterializeResult` hold for all partitions of a step (Dagster's issues 21072 and 34013). An asset without partitions
gets a `MaterializeResult`.
"""

import hashlib
import os
from collections.abc import Generator, Iterator, Mapping
from functools import cache
from typing import Any, cast

import dagster as dg
from dagster._core.definitions.source_asset import SYSTEM_METADATA_KEY_SOURCE_ASSET_OBSERVATION

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.redaction import redact_exception
from traps_pipeline.pipeline.graph import Stage, the_graph
from traps_pipeline.pipeline.history import History
from traps_pipeline.pipeline.lineage import write_report_state
from traps_pipeline.pipeline.machine import nothing_to_do_reason, parts_of_run, require_machine
from traps_pipeline.pipeline.making import PartitionMaker
from traps_pipeline.pipeline.metadata import page_text, partition_metadata, tally_metadata, visible_metadata
from traps_pipeline.pipeline.partition_checks import StageChecks, raise_for_run
from traps_pipeline.pipeline.run_plan import IN_PROGRESS, RunPlan
from traps_pipeline.pipeline.runs import report_canceling
from traps_pipeline.storage.parquet import StageOutput, State
from traps_pipeline.storage.workspace import Workspace

MAKE_TAG, EXPERIMENT_TAG = "traps/make", "traps/experiment"  # tags of runs: what to build, for which experiment
BACKFILL_TAG = "dagster/backfill"  # tag of a backfill's run: a run with nothing to do must not end the backfill
STALE_OR_MISSING, STALE_ONLY = "stale", "outdated"  # values of MAKE_TAG: the partitions to build
# In an event's metadata: nobody asks for the partition; another run has built it.
UNWANTED, TAKEN = "not wanted", "taken over"
RESUMED_ELSEWHERE = 5  # the exit code of a process whose run another process has resumed
Event = dg.AssetMaterialization | dg.AssetCheckEvaluation | dg.MaterializeResult | dg.Output
Events = Generator[Event, None, None]
_ATTEMPTS: dict[str, int] = {}  # by run: how often it had been resumed when this process started on it
_PLANS: dict[str, RunPlan] = {}  # by run: its snapshot of the study; only of the run in progress


def run_step(stage: Stage, context: dg.AssetExecutionContext, workspace: Workspace) -> Events:
    """Build this run's part of a stage; yield Dagster's events. Raises TrapsError for all failures at the run's end."""
    step = _Step(stage, context, workspace)
    yield from step.tell_unwanted()
    for key in step.to_make():
        yield from step.checks.of_parents(step.lineage, key)
        step.admit(key)
    made_result: dg.MaterializeResult | None = None
    for key, output in step.make():
        version = step.write(key, output)
        failures = step.checks.test(key, output)
        progress.current().partition(stage.name, key or "", output.tally, is_empty=not len(output.content))
        metadata = partition_metadata(workspace, stage, key, output)
        if stage.scheme is None:
            yield from step.checks.of_made(key, failures)
            metadata = visible_metadata(metadata)
            # Dagster's own provenance is older: it reads the inputs' versions before the step can report them.
            made_result = dg.MaterializeResult(
                metadata=metadata, data_version=dg.DataVersion(version), tags=step.provenance
            )
        else:
            yield step.history.event(stage, key, version, step.provenance, metadata)
            yield from step.checks.of_made(key, failures)
    step.lineage.renew(stage.name)
    yield from step.tell_taken()
    yield from step.tell_fresh()
    yield from step.tell_unmade()
    yield from step.hand_on(made_result)
    if not step.stages_below():
        raise_for_run(context, step.graph, stage.name)


def _plan_of(run: dg.DagsterRun, workspace: Workspace) -> RunPlan:
    """Return the plan that this process carries out, or that a run's steps share; of a step if other hosts build, too.

    If another process builds a partition between two steps, the later step records its older version, so that the next
    run makes the result once more.
    """
    plan = None if workspace.is_shared else IN_PROGRESS.get() or _PLANS.get(run.run_id)
    if plan is None:
        _PLANS.clear()
        plan = _PLANS[run.run_id] = RunPlan(workspace, run.tags.get(EXPERIMENT_TAG))
    plan.lineage.read_in_full()  # a run builds nothing from an altered table
    return plan


class _Step:
    """The state and phases of `run_step`; methods are called in order of definition."""

    def __init__(self, stage: Stage, context: dg.AssetExecutionContext, workspace: Workspace) -> None:
        self.stage, self.context, self.workspace, self.graph = stage, context, workspace, the_graph()
        self.tags = context.run.tags
        if context.run.run_id not in _ATTEMPTS:
            _ATTEMPTS[context.run.run_id] = context.instance.count_resume_run_attempts(context.run.run_id)
        self.plan = _plan_of(context.run, workspace)
        require_machine(self.plan, parts_of_run(context, stage, self.plan))
        self.history, self.lineage = History(context.instance, self.graph), self.plan.lineage
        self.history.observe(self.lineage, [p for p in stage.parents if self.graph.source(p)])
        self.provenance = self.history.provenance(stage)
        self.checks = StageChecks(workspace, self.history, self.graph, stage)
        self._maker = PartitionMaker(workspace, stage, self.history)
        self._inputs: dict[str | None, Mapping[str, str]] = {}  # recorded before anything is read
        keys: list[str | None] = [None] if stage.scheme is None else [str(key) for key in context.partition_keys]
        wanted_keys = {*self.plan.parts[stage.name]}
        self._wanted, self._unwanted = [k for k in keys if k in wanted_keys], [k for k in keys if k not in wanted_keys]

    def tell_unwanted(self) -> Iterator[dg.AssetMaterialization]:
        """Report unwanted cells of the range as done, so that a backfill ends."""
        if MAKE_TAG in self.tags:
            return
        if self.stage.scheme and not self._wanted and BACKFILL_TAG not in self.tags:
            reason = nothing_to_do_reason(self._unwanted, self.tags, self.workspace)
            raise TrapsError(f"{self.stage.name}: nothing is made: {reason}")
        metadata = {UNWANTED: f"nothing is made: no experiment in {self.workspace.root / 'study.yaml'} asks for it"}
        for key in self._unwanted:
            yield self.history.event(self.stage, key, UNWANTED, self.provenance, metadata)

    def to_make(self) -> list[str | None]:
        """Return the wanted keys, or those among them that the run's tag selects."""
        if MAKE_TAG not in self.tags:
            return self._wanted
        recorded, existing = cache(self.history.recorded), self.tags[MAKE_TAG] == STALE_ONLY
        return [k for k in self._wanted if self.plan.is_pending(self.stage.name, k, recorded, existing=existing)]

    def admit(self, key: str | None) -> None:
        """Record the inputs of a partition that can be built, or the reason why it cannot."""
        if reason := self.lineage.blocked(self.stage.name, key, current=MAKE_TAG in self.tags):
            self._maker.unmade[key] = TrapsError(reason)
        else:
            self._inputs[key] = self.lineage.inputs(self.stage.name, key)

    def make(self) -> Iterator[tuple[str | None, StageOutput]]:
        """Build the admitted partitions."""
        if self._inputs:
            progress.current().stage(self.stage.name, len(self._inputs))
        return self._maker.make(self._inputs)

    def write(self, key: str | None, output: StageOutput) -> str:
        """Write a stage's output; return its data version."""
        stage, inputs, content = self.stage, self._inputs[key], output.content
        if stage.table is not None:
            rows, failed = cast(Any, content), output.tally.errors
            return self.workspace.tables.write(
                stage.table, stage.columns(key), rows, inputs, failed=failed, code=stage.code
            )
        files = cast(Mapping[str, bytes], content)
        self.workspace.store.write({self.workspace.reports / path: data for path, data in files.items()})
        version = hashlib.sha256(b"".join(files.values())).hexdigest()[:16]
        write_report_state(self.workspace, stage, State(version, dict(inputs), 0, 0, stage.code))
        return version

    def tell_taken(self) -> Iterator[dg.AssetMaterialization]:
        """Report partitions that other runs have built."""
        for key, (version, tally) in self._maker.taken.items():
            progress.current().partition(self.stage.name, key or "", tally)
            metadata = {TAKEN: "made by another run meanwhile", **tally_metadata(self.stage, tally)}
            yield self.history.event(self.stage, key, version, self.provenance, metadata)

    def tell_fresh(self) -> Iterator[dg.AssetCheckEvaluation]:
        """Report partitions of this run that need not be built."""
        for key in self._wanted:
            is_left = key not in self._inputs and key not in self._maker.unmade
            if is_left and self.lineage.status(self.stage.name, key).kind == "fresh":
                yield from self.checks.of_fresh(key)

    def tell_unmade(self) -> Iterator[dg.AssetCheckEvaluation]:
        """Report partitions that could not be built or fail a check, now or before."""
        reason_by_key = self._maker.unmade
        if reason_by_key:
            end_if_resumed(self.context.instance, self.context.run.run_id, _ATTEMPTS[self.context.run.run_id])
        for key, error in reason_by_key.items():
            yield from self.checks.of_unmade(key, error)
        yield from self.checks.still_failing(self.lineage, {*self._inputs, *reason_by_key} - self._maker.taken.keys())

    def hand_on(self, result: dg.MaterializeResult | None) -> Iterator[dg.Output | dg.MaterializeResult]:
        """Yield the result of an asset without partitions, or outputs that write no event.

        Dagster skips everything downstream of a step without outputs, and would write one event, with one version, for
        all partitions. Observable sources, which report their own versions too, carry this mark.
        """
        for name in self.context.op_def.output_dict:
            if name != "result":
                yield dg.Output(None, output_name=name)  # output of a check
        yield result or dg.MaterializeResult(metadata={SYSTEM_METADATA_KEY_SOURCE_ASSET_OBSERVATION: True})

    def stages_below(self) -> set[str]:
        """Return the stages of this run that are directly downstream of this one."""
        asset_keys = self.context.run.asset_selection or self.context.job_def.asset_layer.executable_asset_keys
        return self.graph.below(self.stage.name) & {key.path[-1] for key in asset_keys}


def guard_events(events: Events, context: dg.AssetExecutionContext) -> Events:
    """Yield the events of a step; log its progress, and keep keys out of stored tracebacks."""
    report = progress.current()
    try:
        with report.reporting_to(lambda line: context.log.info(page_text(line))):
            yield from events
            report.end_stage()
    except Exception as error:
        if (without_keys := redact_exception(error)) is error:
            raise
        raise without_keys from None
    except (KeyboardInterrupt, dg.DagsterExecutionInterruptedError):
        report_canceling(context.instance, context.run.run_id)
        raise


def end_if_resumed(instance: dg.DagsterInstance, run_id: str, attempts: int) -> None:
    """End this process if its run has been resumed elsewhere, its host presumed dead.

    Another process builds what this one could not, so this one must not report a failed run to Dagster.
    """
    if instance.count_resume_run_attempts(run_id) > attempts:
        os._exit(RESUMED_ELSEWHERE)
