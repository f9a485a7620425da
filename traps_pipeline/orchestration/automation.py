"""Jobs that make a part of the study by one command or click, and sensors that follow corrections.

A job makes what is missing or stale of its stages for everything that the study's experiments ask, one Dagster run for
each block of stages that share their partitions. The sensors launch such a job for what is there and outdated. They
look at the state of the tables, not at events, so a correction that was made while they were off is followed, too.
"""

from collections.abc import Collection

import dagster as dg

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.benchmark.corrections import folded
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.judging.confabulation import load_protocol
from traps_pipeline.models.judges import load_judges, load_panel
from traps_pipeline.models.prompts import prompt, system_prompt, vqa_prompt
from traps_pipeline.models.registry import load_accounts, load_models
from traps_pipeline.orchestration.graph import Node, Stage, name_of, the_graph
from traps_pipeline.orchestration.history import History
from traps_pipeline.orchestration.lineage import Lineage
from traps_pipeline.orchestration.machine import require_machine, wanted_parts
from traps_pipeline.orchestration.run import failed_checks, walk
from traps_pipeline.orchestration.runs import RunsHere
from traps_pipeline.orchestration.stage import WorkspaceResource
from traps_pipeline.orchestration.step import CURRENT
from traps_pipeline.orchestration.wanted import Wanted
from traps_pipeline.storage.workspace import Workspace

PURPOSES = {
    "benchmark": ("Scenarios, clips and items.", ("benchmark",)),
    "evaluation": ("Answers, votes and verdicts; asks what the ledger does not hold.", ("evaluation",)),
    "scoring": (
        "Metrics, contrasts, leaderboard; agreement, confabulation, people's labels.",
        ("scoring", "judging", "people"),
    ),
    "mechanism": ("Hidden states, probes, directions and steering of local models.", ("mechanism",)),
    "report": ("Tables, figures and pages.", ("report", "tables", "figures", "published")),
}
EVERYTHING = "everything"
FREE, PAID = "follow_free", "follow_paid"
UNFINISHED = [
    dg.DagsterRunStatus.QUEUED,
    dg.DagsterRunStatus.NOT_STARTED,
    dg.DagsterRunStatus.STARTING,
    dg.DagsterRunStatus.STARTED,
]
INTERVAL_S = 30


def reread_sources() -> None:
    """Forget what was read of specs, corrections, prompts and registries: a server that lives long sees edits then.

    Which evaluations there are stays: partition keys are made from them when the code location is loaded.
    """
    registries = (load_models, load_accounts, load_judges, load_panel, load_protocol)
    for cached in (load_released, folded, prompt, system_prompt, vqa_prompt, *registries):
        cached.cache_clear()


def _job(
    name: str, doc: str, groups: Collection[str] | None, *, costs: bool = True, existing: bool = False
) -> dg.JobDefinition:
    """A job of one step that walks a part of the graph; the step fails with all that is not made."""

    @dg.op(name=f"make_{name}", description=doc)
    def make(context: dg.OpExecutionContext, workspace: WorkspaceResource) -> None:
        reread_sources()
        stages = [stage.name for stage in _stages(costs) if groups is None or stage.spec.group_name in groups]
        opened = workspace.open()
        if not existing:
            require_machine(opened, wanted_parts(opened, stages))
        every_asset = context.repository_def.get_implicit_global_asset_job_def()
        outcome = walk(context.instance, RunsHere(context.instance, every_asset), opened, stages, existing=existing)
        checks = [] if existing else failed_checks(opened, None)
        if problems := [*dict.fromkeys([*outcome.problems, *checks])]:
            raise TrapsError("\n".join(problems))

    @dg.job(name=name, description=doc)
    def job() -> None:
        make()

    return job


def _stages(costs: bool) -> list[Stage]:
    return [stage for stage in the_graph().stages if costs or not stage.cost]


follow_free = _job(
    FREE, "What a correction made outdated, as far as it costs nothing.", None, costs=False, existing=True
)
follow_paid = _job(PAID, "What a correction made outdated, calls and local models too.", None, existing=True)
JOBS = [
    *(_job(name, doc, groups) for name, (doc, groups) in PURPOSES.items()),
    _job(EVERYTHING, "All that the study asks, from scenarios to the report.", None),
    follow_free,
    follow_paid,
]


def outdated(workspace: Workspace, lineage: Lineage, *, costs: bool) -> dict[Node, int]:
    """Partitions that a correction made outdated and that can be made anew now, and when each was made."""
    wanted, found = Wanted(workspace), dict[Node, int]()
    for stage in _stages(costs):
        for key in stage.wanted(wanted):
            if lineage.status(stage.name, key).outdated and not lineage.waits(stage.name, key):
                found[stage.name, key] = lineage.made_at(stage.name, key)
    return found


def _tell(instance: dg.DagsterInstance, workspace: Workspace, lineage: Lineage, reported: set[str]) -> None:
    """Report what Dagster does not see by itself: altered tables, and unpartitioned ones that are not current."""
    for stage in the_graph().stages:
        for key in stage.wanted(Wanted(workspace)):
            wrong = [lineage.damage(stage.name, key)] if lineage.damage(stage.name, key) else []
            if stage.scheme is None:
                wrong = [*lineage.status(stage.name, key).outdated]
            text = f"{name_of((stage.name, key))}: {'; '.join(wrong)}"
            if wrong and text not in reported:
                reported.add(text)
                instance.report_runless_asset_event(
                    dg.AssetCheckEvaluation(
                        asset_key=stage.spec.key,
                        check_name=CURRENT,
                        passed=False,
                        partition=key,
                        metadata={"not current": "; ".join(wrong)},
                    )
                )


def _sensor(name: str, job: dg.JobDefinition, doc: str, *, costs: bool) -> dg.SensorDefinition:
    reported: set[str] = set()

    @dg.sensor(
        name=name,
        job=job,
        minimum_interval_seconds=INTERVAL_S,
        default_status=dg.DefaultSensorStatus.STOPPED if costs else dg.DefaultSensorStatus.RUNNING,
        description=doc,
    )
    def follow(context: dg.SensorEvaluationContext, workspace: WorkspaceResource) -> dg.SkipReason | dg.RunRequest:
        reread_sources()
        opened = workspace.open()
        lineage = Lineage(opened)
        History(context.instance, the_graph()).observe(lineage)
        _tell(context.instance, opened, lineage, reported)
        if context.instance.get_runs_count(dg.RunsFilter(statuses=UNFINISHED)):
            return dg.SkipReason("runs are under way")
        found = outdated(opened, lineage, costs=costs)
        if not found:
            return dg.SkipReason("nothing that is there is outdated")
        # What is outdated and stays so, with the same inputs, is tried once: it fails for a reason of its own.
        key = digest([[name_of(node), made, lineage.inputs(*node)] for node, made in found.items()])[:32]
        return dg.RunRequest(run_key=key, tags={"outdated": ", ".join(name_of(node) for node in [*found][:8])})

    return follow


SENSORS = [
    _sensor(
        "follow_corrections",
        follow_free,
        "Observes specs, corrections, prompts and registries; makes anew what an edit made outdated, unless that costs "
        "money or a local model's time. Makes nothing that is merely missing.",
        costs=False,
    ),
    _sensor(
        "follow_corrections_paid",
        follow_paid,
        "Off by default. The same for stages that cost money or a local model's time, within the study's budget.",
        costs=True,
    ),
]
