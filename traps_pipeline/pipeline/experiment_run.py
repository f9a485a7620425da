"""Run an experiment (`traps run`): preflight checks, the run, and a report."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from traps_pipeline.base import progress
from traps_pipeline.base.extras import require
from traps_pipeline.base.progress import Tally
from traps_pipeline.models.asking.backends import require_libraries
from traps_pipeline.models.registry.entries import LOCAL, NETWORK, Entry, get_model
from traps_pipeline.models.registry.judges import load_panel
from traps_pipeline.pipeline.experiment import Experiment
from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.pipeline.selection import (
    failed_checks,
    is_made,
    is_nothing_to_do,
    note_versions,
    require_work,
    stages_until,
)
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.protocol.cells import Cell
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    from dagster import DagsterInstance

    from traps_pipeline.pipeline.runs import Runs

OpenRuns = Callable[["DagsterInstance", Workspace], AbstractContextManager["Runs"]]


@dataclass
class RunReport:
    """A run's problems in sentences, whether a budget ended it, and its tallies.

    is_made: whether the same command would do nothing. has_board: whether the leaderboard is made.
    """

    problems: list[str] = field(default_factory=list)
    is_made: bool = True
    has_board: bool = True
    over_budget: bool = False
    seconds: float = 0.0
    tallies: Mapping[str, Tally] = field(default_factory=dict)

    def tally(self, stage: str) -> Tally:
        """Return the work of one stage."""
        return self.tallies.get(stage, Tally())

    @property
    def frames(self) -> int:
        """Number of rendered frames."""
        return sum(tally.frames for tally in self.tallies.values())


def run_experiment(
    workspace: Workspace,
    experiment: Experiment,
    *,
    until: str | None,
    preflight: Callable[[str], None] | None,
    look_at_machine: bool,
    open_runs: OpenRuns,
) -> RunReport:
    """Materialize missing or stale partitions, reporting to `progress.current()`.

    until: comma-separated stages; only these and their upstream are materialized. preflight: receives a line about each
    model and judge, which are tried first unless it is None. open_runs: opens the executor of runs; called, like
    Dagster's history, only if there is something to materialize. Raises TrapsError if a run cannot begin.
    """
    stages = stages_until(until)
    require_work(workspace, experiment.name, until)
    if is_nothing_to_do(workspace, stages, experiment.name):
        return RunReport(failed_checks(workspace, experiment.name))
    from traps_pipeline.pipeline.machine import require_machine, wanted_parts
    from traps_pipeline.pipeline.run import dagster_history, materialize_stale

    with dagster_history(workspace) as instance:
        participants = _pending_participants(workspace, experiment, stages)
        for entry in (*participants.models, *participants.judges):
            require_libraries(entry)
        if experiment.mechanism is not None and "hidden_states" in stages:
            require("local")
        if look_at_machine:
            require_machine(workspace, wanted_parts(workspace, stages, experiment.name))
        if preflight is not None:
            _preflight(workspace, participants, preflight)
        with open_runs(instance, workspace) as runs:
            result = materialize_stale(instance, runs, workspace, stages, experiment=experiment.name)
    problems = [*dict.fromkeys([*result.problems, *failed_checks(workspace, experiment.name)])]
    if not problems:
        note_versions(workspace, stages, experiment.name)
    made = not problems or is_made(workspace, stages, experiment.name)
    has_board = made or is_made(workspace, ["leaderboard", "report_page"], experiment.name)
    return RunReport(problems, made, has_board, result.over_budget, result.seconds, progress.current().totals)


@dataclass(frozen=True)
class _Participants:
    """Models and judges with answers missing, whose libraries or keys may be missing."""

    models: list[Entry]
    judges: list[Entry]


def _pending_participants(workspace: Workspace, experiment: Experiment, stages: Collection[str]) -> _Participants:
    """Return the models and judges whose answers are not all in the ledger."""
    lineage, cells = Lineage(workspace), StudyPartitions(workspace, experiment.name).cells

    def behind(stage: str) -> Iterator[str]:
        keys = cells if stage in stages else ()
        return (key for key in keys if lineage.status(stage, key).kind != "fresh")

    entries = {name: entry for name in experiment.models if (entry := get_model(name)).backend in (LOCAL, NETWORK)}
    panel = load_panel(workspace.study.panel) if "votes" in stages else ()
    judges: list[Entry] = [judge for judge in panel if judge.backend == NETWORK]
    # Whether a cell is behind is looked up for the sake of these alone.
    names = {Cell.parse(key).evaluation.model for key in behind("responses")} if entries else set[str]()
    models: list[Entry] = [entry for name, entry in entries.items() if name in names]
    return _Participants(models, judges if judges and any(behind("votes")) else [])


def _preflight(workspace: Workspace, participants: _Participants, say: Callable[[str], None]) -> None:
    """Try networked models and judges first. Raises TrapsError with all problems."""
    models = [entry for entry in participants.models if entry.backend == NETWORK]
    if not models and not participants.judges:
        return
    from traps_pipeline.checks.live_check import preflight, require_sound

    checks = preflight(workspace, models, participants.judges)
    for check in checks:
        if not check.problems:  # they are raised instead
            say(check.line)
    require_sound(checks)
