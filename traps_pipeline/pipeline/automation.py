"""Define Dagster jobs for parts of the study, and sensors that follow corrections.

A job materializes the missing or stale partitions of its stages that the study's experiments want. Dagster cannot run
assets of different partitions in one job, so a job whose stages have several is one op, which starts a run for each
block of stages that share their partitions and links them; `report` selects its assets. The sensors request
runs of what exists and is outdated, by the state of the tables (docs/design/staleness.md).
"""

import json
from collections.abc import Collection, Sequence
from functools import cache, partial
from typing import Any

import dagster as dg
from sqlalchemy.exc import IntegrityError

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.benchmark.corrections import corrected_scenarios, corrected_two_events
from traps_pipeline.benchmark.records import load_released, released_lines, two_events_lines
from traps_pipeline.judging.confabulation_protocol import load_protocol
from traps_pipeline.models.registry.entries import load_accounts, load_models
from traps_pipeline.models.registry.judges import load_judges, load_panel
from traps_pipeline.models.registry.prompts import load_prompt, system_prompt, vqa_prompt
from traps_pipeline.pipeline.assets import WorkspaceResource
from traps_pipeline.pipeline.graph import JOB_GROUPS, Stage, name_of, the_graph
from traps_pipeline.pipeline.history import History
from traps_pipeline.pipeline.machine import require_machine
from traps_pipeline.pipeline.metadata import errors_for_pages, page_text, visible_metadata
from traps_pipeline.pipeline.partition_checks import CURRENT
from traps_pipeline.pipeline.ranges import key_ranges
from traps_pipeline.pipeline.run import materialize_stale
from traps_pipeline.pipeline.run_plan import RunPlan
from traps_pipeline.pipeline.runs import LocalRuns, range_tags, report_canceling
from traps_pipeline.pipeline.schemes import study_here
from traps_pipeline.pipeline.step import MAKE_TAG, STALE_ONLY, STALE_OR_MISSING
from traps_pipeline.pipeline.translation import asset_key

DESCRIPTIONS = {
    "benchmark": "Scenarios, clips and items.",
    "evaluation": "Answers, votes and verdicts; asks what the ledger does not hold.",
    "scoring": "Metrics, contrasts, leaderboard; agreement, confabulation, people's labels.",
    "mechanism": "Hidden states, probes, directions and steering of local models.",
    "report": "Tables, figures and pages.",
}
EVERYTHING = "everything"
UNFINISHED = [
    dg.DagsterRunStatus.QUEUED,
    dg.DagsterRunStatus.NOT_STARTED,
    dg.DagsterRunStatus.STARTING,
    dg.DagsterRunStatus.STARTED,
]
INTERVAL_S = 30
MAX_REPORTS, MAX_NAMED = 500, 3  # evaluations of checks in one tick, partitions named in a sentence


def reread_sources() -> None:
    """Clear caches of specs, corrections, prompts, registries, so that edits count.

    The set of evaluations stays: partition keys are built from it when the code location is loaded.
    """
    registries = (load_models, load_accounts, load_judges, load_panel, load_protocol)
    benchmark = (load_released, released_lines, two_events_lines, corrected_scenarios, corrected_two_events)
    for reader in (*benchmark, load_prompt, system_prompt, vqa_prompt, *registries):
        reader.cache_clear()


def jobs() -> list[Any]:
    """Return a Dagster job for each part of the graph and one for all, once stages are declared."""
    stages = the_graph().stages
    parts = {name: [s for s in stages if s.group in groups] for name, groups in JOB_GROUPS.items()}
    everything_job = _job(EVERYTHING, "All that the study asks, from scenarios to the report.", stages)
    return [*(_job(name, DESCRIPTIONS[name], part) for name, part in parts.items() if part), everything_job]


def _job(name: str, doc: str, stages: Sequence[Stage]) -> Any:
    if all(stage.scheme is None for stage in stages):
        selection = dg.AssetSelection.assets(*(asset_key(stage.name) for stage in stages))
        return dg.define_asset_job(name, selection=selection, description=doc, tags={MAKE_TAG: STALE_OR_MISSING})

    @dg.op(name=f"make_{name}", description=doc)
    @errors_for_pages()
    def make(context: dg.OpExecutionContext, workspace: WorkspaceResource) -> None:
        reread_sources()
        plan = RunPlan(workspace.open(), stages=[stage.name for stage in stages])
        require_machine(plan)
        every_asset = context.repository_def.get_implicit_global_asset_job_def()
        runs = LocalRuns(context.instance, every_asset, parent=context.run, log=context.log.info)
        try:
            outcome = materialize_stale(context.instance, runs, plan)
        except KeyboardInterrupt:  # one of its runs was terminated
            report_canceling(context.instance, context.run_id)
            raise
        if runs.finished:
            context.add_output_metadata({"runs": dg.MetadataValue.table([dg.TableRecord(r) for r in runs.finished])})
        for warning in outcome.warnings:
            context.log.warning(warning)
        if problems := [problem for problem in outcome.problems if problem not in outcome.warnings]:
            raise TrapsError("\n".join(problems))

    @dg.job(name=name, description=doc)
    def job() -> None:
        make()

    return job


def _stages(costs: bool) -> list[Stage]:
    return [stage for stage in the_graph().stages if costs or not stage.cost]


_GONE = "its file is gone; materialize it again: nothing that the ledger holds is asked"


def report_outdated(instance: dg.DagsterInstance, plan: RunPlan, reported: dict[str, str]) -> None:
    """Fail the check `current` for altered, lost or stale partitions, and pass it once they are well.

    reported: the failures that were reported and last, by partition; at most MAX_REPORTS change at once.
    """
    history, changes = History(instance, plan.graph), list[tuple[str, str | None, str]]()
    for stage, keys in plan.parts.items():
        recorded_versions = history.recorded(stage)
        for key in keys:
            status = plan.lineage.status(stage, key)
            reasons = [*status.outdated]
            if status.kind == "missing":
                reasons = (reasons or [_GONE]) if key in recorded_versions else []
            rest = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
            wrong = page_text(reasons[0] + rest) if reasons else ""  # the pages show it, and the sensor's cursor
            if wrong != reported.get(name_of((stage, key)), ""):
                changes.append((stage, key, wrong))
    for stage, key, wrong in changes[:MAX_REPORTS]:  # a tick has a minute, and the next one goes on
        name = name_of((stage, key))
        reported[name] = wrong
        _report(instance, stage, key, wrong)
        if not wrong:
            reported.pop(name)


def _report(instance: dg.DagsterInstance, stage: str, key: str | None, wrong: str) -> None:
    """Evaluate the check `current` of a partition outside of any run: it passes if nothing is wrong."""
    evaluation = partial(
        dg.AssetCheckEvaluation,
        asset_key=asset_key(stage),
        check_name=CURRENT,
        passed=not wrong,
        metadata=visible_metadata({**({"not current": wrong} if wrong else {}), "partition": key or "all"}),
        target_materialization_data=History(instance, the_graph()).check_target(stage, key),
    )
    try:
        instance.report_runless_asset_event(evaluation(partition=key))
    except IntegrityError:  # Dagster stores one evaluation without a run for each partition; the next is of the asset
        instance.report_runless_asset_event(evaluation(partition=None))


def _requests(instance: dg.DagsterInstance, plan: RunPlan) -> list[dg.RunRequest]:
    """Return runs that rebuild outdated partitions, as far as possible now; dependents follow at a later tick."""
    requests, recorded = list[dg.RunRequest](), cache(History(instance, plan.graph).recorded)
    for block in plan.blocks():
        stages, keys = plan.pending(block, recorded, existing=True)
        nodes = [(stage.name, key) for stage in stages for key in keys]
        # Try each outdated partition once per set of inputs: if it stays outdated, it fails for its own reasons.
        states = [[name_of(node), plan.lineage.made_at(*node), plan.lineage.inputs(*node)] for node in nodes]
        for batch in key_ranges(block[0].scheme, keys):
            requests.append(
                dg.RunRequest(
                    digest([*batch, states])[:32],
                    partition_key=batch[0] if batch[0] == batch[1] else None,
                    tags={MAKE_TAG: STALE_ONLY, "outdated": ", ".join(map(name_of, nodes[:8])), **range_tags(batch)},
                    asset_selection=[asset_key(stage.name) for stage in stages],
                )
            )
    return requests


def _sensor(name: str, doc: str, *, costs: bool) -> dg.SensorDefinition:
    @dg.sensor(
        name=name,
        asset_selection=dg.AssetSelection.assets(*(asset_key(stage.name) for stage in _stages(costs))),
        minimum_interval_seconds=INTERVAL_S,
        default_status=dg.DefaultSensorStatus.STOPPED if costs else dg.DefaultSensorStatus.RUNNING,
        description=doc,
    )
    @errors_for_pages()
    def follow(context: dg.SensorEvaluationContext) -> dg.SkipReason | list[dg.RunRequest]:
        reread_sources()
        study_workspace = study_here()
        if study_workspace is None:
            return dg.SkipReason("there is no study; make one with `traps init`, then press Reload definitions")
        plan = RunPlan(study_workspace)
        History(context.instance, plan.graph).observe(plan.lineage)
        if context.instance.get_runs_count(dg.RunsFilter(statuses=UNFINISHED)):
            return dg.SkipReason("runs are under way")  # they may be mending what would be reported
        reported: dict[str, str] = json.loads(context.cursor or "{}")
        report_outdated(context.instance, plan, reported)
        context.update_cursor(json.dumps(reported))
        plan = plan.part(stage.name for stage in _stages(costs))
        return _requests(context.instance, plan) or dg.SkipReason(_nothing_to_request(reported))

    return follow


def _nothing_to_request(reported: Collection[str]) -> str:
    """Say why no run is requested, as `traps status` would."""
    if not reported:
        return "no partition that was made is outdated"
    rest = f" and {len(reported) - MAX_NAMED} more" if len(reported) > MAX_NAMED else ""
    names = ", ".join([*reported][:MAX_NAMED]) + rest
    return f"outdated, but not made without you: {names}; the check `{CURRENT}` fails for each, a job makes it again"


def sensors() -> list[dg.SensorDefinition]:
    """Return the sensors that follow corrections, once stages are declared."""
    return [
        _sensor(
            "follow_corrections",
            "Observes specs, corrections, prompts and registries; makes anew what an edit made outdated, unless that "
            "costs money or a local model's time. Makes nothing that is merely missing.",
            costs=False,
        ),
        _sensor(
            "follow_corrections_paid",
            "Off by default. The same for stages that cost money or a local model's time, within the study's budget.",
            costs=True,
        ),
    ]
