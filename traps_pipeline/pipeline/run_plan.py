"""Plan a run: the wanted partitions, which of them are missing or stale and why, in the order of their making.

A command, a job, a sensor's tick and each Dagster run make one `RunPlan` and hand it on. `wanted` says which partitions
a study asks for, `lineage` whether one is fresh. Nothing here imports Dagster or opens its history, so `traps run` with
nothing to do ends before either.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from copy import copy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.progress import Tally
from traps_pipeline.base.suggestions import did_you_mean
from traps_pipeline.pipeline.graph import Stage, name_of, the_graph
from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.storage.workspace import Workspace

_NOTE = "last_run.json"
_HISTORY = Path("history", "runs", "index.db")  # all events of Dagster's SQLite storage, below its folder

Parts = Mapping[str, Sequence[str | None]]  # partitions by stage
Recorded = Callable[[str], Mapping[str | None, str | None]]  # a stage's versions in Dagster's history, by partition


@dataclass(frozen=True)
class StageStatus:
    """A stage's partitions (or itself, by its name): how many are fresh, which are stale (why) or missing."""

    stage: str
    fresh: int
    stale: Mapping[str, tuple[str, ...]]
    missing: Sequence[str]

    @property
    def to_make(self) -> int:
        """Number of partitions that are not fresh."""
        return len(self.stale) + len(self.missing)

    def by_reason(self) -> Mapping[str, list[str]]:
        """Return the partitions that are not fresh, by their reasons without the partition's own key."""
        groups = dict[str, list[str]]()
        for key, reasons in self.stale.items():
            general_reasons = [reason.replace(f"/{key} ", " ") for reason in reasons]
            groups.setdefault("; ".join(general_reasons), []).append(key)
        return groups | ({"not made yet": [*self.missing]} if self.missing else {})


@dataclass
class RunReport:
    """A run's problems in sentences, whether a budget ended it, and its tallies.

    warnings: those of them that block nothing. is_made: whether every table is made, so that the same command would do
    nothing; has_board: whether the leaderboard is.
    """

    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    is_made: bool = True
    has_board: bool = True
    over_budget: bool = False
    seconds: float = 0.0
    tallies: Mapping[str, Tally] = field(default_factory=dict)

    def tally(self, stage: str) -> Tally:
        """Return the counted work (calls, frames, rows) of one stage."""
        return self.tallies.get(stage, Tally())

    @property
    def frames(self) -> int:
        """The number of frames that the run rendered."""
        return sum(tally.frames for tally in self.tallies.values())


class RunPlan:
    """The partitions of a study, or of one experiment, that a run makes, from one snapshot of the workspace.

    stages: their names; all by default.
    """

    def __init__(
        self, workspace: Workspace, experiment: str | None = None, stages: Collection[str] | None = None
    ) -> None:
        self.workspace, self.experiment, self.lineage = workspace, experiment, Lineage(workspace)
        self.graph = self.lineage.graph
        self.partitions = self.lineage.partitions.of(experiment)
        # The wanted partitions, in the order of the graph.
        self.parts: Parts = {
            stage.name: stage.wanted(self.partitions)
            for stage in self.graph.stages
            if stages is None or stage.name in stages
        }

    def part(self, stages: Iterable[str]) -> RunPlan:
        """Return the plan of some of its stages, with the same snapshot."""
        plan, names = copy(self), {*stages}
        plan.parts = {name: keys for name, keys in self.parts.items() if name in names}
        return plan

    def blocks(self) -> list[list[Stage]]:
        """Return the stages that want anything, in order, in groups that one Dagster run can materialize."""
        return self.graph.blocks([name for name, keys in self.parts.items() if keys])

    def statuses(self) -> Iterator[StageStatus]:
        """Yield the status of each stage, in order."""
        for name, keys in self.parts.items():
            statuses = {key or name: self.lineage.status(name, key) for key in keys}
            # A table of other columns is no lost one: it is told with its reason.
            stale_reasons = {key: status.reasons for key, status in statuses.items() if status.reasons}
            missing = [key for key, status in statuses.items() if status.kind == "missing" and not status.reasons]
            yield StageStatus(name, len(statuses) - len(stale_reasons) - len(missing), stale_reasons, missing)

    def is_pending(self, name: str, key: str | None, recorded: Recorded, *, existing: bool = False) -> bool:
        """Return whether a partition is missing, stale, or unknown to Dagster.

        A crash between a table and its event leaves a table that Dagster does not know, which is built once more.
        existing: only a partition that exists, is outdated, and waits for nothing upstream: it would be built twice.
        """
        status = self.lineage.status(name, key)
        if existing:
            return status.kind == "stale" and bool(status.outdated) and not self.lineage.waits(name, key)
        return status.kind != "fresh" or recorded(name).get(key) != self.lineage.version(name, key)

    def pending(
        self, block: Iterable[Stage], recorded: Recorded, *, existing: bool = False
    ) -> tuple[list[Stage], list[str | None]]:
        """Return the block's pending stages, their dependents in it, and the pending keys, in order."""
        pending: dict[str, set[str | None]] = {}
        for stage in block:
            name, keys = stage.name, self.parts[stage.name]
            pending_keys = {key for key in keys if self.is_pending(name, key, recorded, existing=existing)}
            if pending_keys or self.graph.parents_of[name].keys() & pending.keys():
                pending[name] = pending_keys
        keys = {key for pending_keys in pending.values() for key in pending_keys}
        stages = [self.graph[name] for name in pending]
        return stages, [key for key in self.graph.keys(stages[0].name) if key in keys] if stages else []

    def renew(self, stages: Iterable[Stage]) -> None:
        """Look up anew the stages that were built since, and all stages downstream of them."""
        if self.workspace.is_shared:  # other hosts build beside this one
            self.lineage = Lineage(self.workspace)
        for stage in stages:
            self.lineage.renew(stage.name)

    @contextmanager
    def in_progress(self) -> Iterator[None]:
        """Give this plan, within the block, to the steps that this process executes."""
        before = IN_PROGRESS.set(self)
        try:
            yield
        finally:
            IN_PROGRESS.reset(before)

    def require_work(self, until: str | None) -> None:
        """Raise TrapsError if an experiment wants nothing of the named stages (or of any)."""
        if not self.partitions.cells and not self.partitions.states:
            raise TrapsError(
                f"experiment {self.experiment} asks nothing: none of its scenarios belongs to its datasets, or no "
                "model has its runs; change `scenarios`, `datasets` or `runs`"
            )
        if empty := [name for name in until.split(",") if not self.parts[name]] if until else []:
            raise TrapsError(
                f"--until {', '.join(empty)}: experiment {self.experiment} wants nothing of it; name another stage"
            )

    def failed_checks(self, *, blocking: bool = True) -> list[str]:
        """Return failed checks of wanted partitions, from any run; those that block something, or the others."""
        failing, problems = {stage for _, stage, _, _ in failing_checks(self.workspace)}, list[str]()
        for stage in (stage for stage in self.graph.stages if stage.name in failing):
            checks = self.workspace.failed_checks(stage.name)
            blocks = {check.name: check.blocks for check in stage.checks}
            for key in stage.wanted(self.partitions):
                for check in (name for name in checks.get(key, ()) if blocks.get(name, True) == blocking):
                    details = self.workspace.failure(stage.name, check, key)
                    details = details[1:-1] if details[:1] == details[-1:] == '"' else details
                    problems.append(f"check {check} of {name_of((stage.name, key))} does not pass: {details}")
        return problems

    # --- nothing to do ------------------------------------------------------------------------------------------------

    def note_made(self) -> None:
        """Record versions and the history's state after a run without problems."""
        if (history := _history_state(self.workspace)) is None:
            return
        nodes = [(name, key) for name, keys in self.parts.items() for key in keys]
        versions = {name_of(node): self.lineage.version(*node) for node in nodes}
        previous_note = _read_note(self.workspace)
        if previous_note.get("history") == history:  # keep versions of other stages or experiments
            versions = previous_note["versions"] | versions
        note = json.dumps({"history": history, "versions": versions})
        self.workspace.store.write({self.workspace.dagster_home / _NOTE: note.encode()})

    def is_nothing_to_do(self) -> bool:
        """Return whether all wanted partitions are fresh and recorded, history unchanged."""
        note = _read_note(self.workspace)
        if not note or note.get("history") != _history_state(self.workspace):
            return False
        return self.is_made(note["versions"])

    def is_made(self, noted: Mapping[str, Any] | None = None) -> bool:
        """Return whether all wanted partitions are fresh, and of the noted versions if these are given."""
        return all(
            (noted is None or noted.get(name_of((name, key))) == self.lineage.version(name, key) is not None)
            and self.lineage.status(name, key).kind == "fresh"
            for name, keys in self.parts.items()
            for key in keys
        )


IN_PROGRESS = ContextVar[RunPlan | None]("IN_PROGRESS", default=None)  # the plan whose runs this process executes


def stages_until(until: str | None) -> set[str] | None:
    """Return the stages of `until` (comma-separated) and their upstream; None for all. Raises TrapsError."""
    if until is None:
        return None
    graph = the_graph()
    stage_names = [stage.name for stage in graph.stages]
    if unknown := [name for name in until.split(",") if name not in stage_names]:
        suggestion = did_you_mean(unknown[0], stage_names) or f"; choose from {', '.join(stage_names)}"
        raise TrapsError(f"--until {', '.join(unknown)}: no such stage{suggestion}")
    return graph.above(until.split(","))


def failing_checks(workspace: Workspace) -> Iterator[tuple[str, str, str, str]]:
    """Yield each failed check: its name, stage, partition and message."""
    for file in workspace.store.below(workspace.root / "checks", "*/*/*.json"):
        stage, check = file.parts[-3:-1]
        yield check, stage, file.stem, workspace.store.here(file).read_text(encoding="utf-8")[:200]


def _read_note(workspace: Workspace) -> dict[str, Any]:
    path = workspace.dagster_home / _NOTE
    try:
        note = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return note if isinstance(note, dict) and isinstance(note.get("versions"), dict) else {}


def _history_state(workspace: Workspace) -> list[Any] | None:
    """Return path, sizes and times of Dagster's history; None if it is no local file."""
    dagster_home = Path(os.environ.get("DAGSTER_HOME") or workspace.dagster_home)
    index = dagster_home / _HISTORY
    if workspace.is_shared or not index.is_file():
        return None
    states = [path.stat() for path in (index, index.with_name(index.name + "-wal")) if path.exists()]
    return [str(dagster_home.resolve()), *([state.st_size, state.st_mtime_ns] for state in states if state.st_size)]
