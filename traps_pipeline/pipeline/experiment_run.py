"""Run an experiment (`traps run`): preflight checks, the run, and a report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from traps_pipeline.base import progress
from traps_pipeline.base.extras import require_extra
from traps_pipeline.models.asking.backends import require_libraries
from traps_pipeline.models.money.spending import open_budget
from traps_pipeline.models.registry.entries import NETWORK, Entry
from traps_pipeline.models.registry.judges import JudgeEntry
from traps_pipeline.pipeline.experiment import Experiment
from traps_pipeline.pipeline.run_plan import RunPlan, RunReport, stages_until
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    from dagster import DagsterInstance

    from traps_pipeline.pipeline.runs import Runs

OpenRuns = Callable[["DagsterInstance", Workspace], AbstractContextManager["Runs"]]


def run_experiment(
    workspace: Workspace,
    experiment: Experiment,
    *,
    until: str | None,
    preflight: Callable[[str], None] | None,
    goes_on: Callable[[str], bool],
    look_at_machine: bool,
    open_runs: OpenRuns,
) -> RunReport:
    """Materialize missing or stale partitions, reporting to `progress.current()`.

    until: comma-separated stages; only these and their upstream are materialized. preflight: receives a line about each
    model and judge, which are tried first unless it is None. goes_on: see `require_sound`. open_runs: opens the
    executor of runs; called, like Dagster's history, only if there is something to materialize. Raises TrapsError if a
    run cannot begin.
    """
    plan = RunPlan(workspace, experiment.name, stages_until(until))
    plan.require_work(until)
    if plan.is_nothing_to_do():
        warnings = plan.failed_checks(blocking=False)
        return RunReport(plan.failed_checks() + warnings, warnings)
    from traps_pipeline.pipeline.machine import pending_entries, require_machine
    from traps_pipeline.pipeline.run import dagster_history, materialize_stale

    with dagster_history(workspace) as instance:
        entries = pending_entries(plan, plan.parts)
        for entry in entries:
            require_libraries(entry)
        if experiment.mechanism is not None and "hidden_states" in plan.parts:
            require_extra("local")
        if look_at_machine:
            require_machine(plan)
        if any(entry.prices for entry in entries):  # from the first line on
            with open_budget(workspace, entries) as budget:
                progress.current().money(budget.spent_usd, workspace.study.budget_usd)
        if preflight is not None:
            _preflight(workspace, experiment, entries, preflight, goes_on)
        with open_runs(instance, workspace) as runs:
            report = materialize_stale(instance, runs, plan)
    if not report.problems:
        plan.note_made()
        return report
    after = RunPlan(workspace, experiment.name, plan.parts)
    report.is_made = after.is_made()
    report.has_board = after.part(["leaderboard", "report_page"]).is_made()
    return report


def _preflight(
    workspace: Workspace,
    experiment: Experiment,
    entries: Sequence[Entry],
    say: Callable[[str], None],
    goes_on: Callable[[str], bool],
) -> None:
    """Try networked models and judges first. Raises TrapsError with all problems."""
    network = [entry for entry in entries if entry.backend == NETWORK]
    if not network:
        return
    judges = [entry for entry in network if isinstance(entry, JudgeEntry)]
    models = [entry for entry in network if entry not in judges]
    from traps_pipeline.checks.live_check import preflight, require_sound

    checks = preflight(workspace, models, judges, experiment.forms)
    for check in checks:
        if not check.problems:  # they are raised instead
            say(check.line)
    require_sound(checks, goes_on)
