"""Select the partitions that a run must materialize, from tables' footers alone.

Nothing here imports Dagster or opens its history, so `traps run` with nothing to do ends before either.
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.suggestions import did_you_mean
from traps_pipeline.pipeline.graph import name_of, the_graph
from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.pipeline.study_status import failing_checks
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.storage.workspace import Workspace

_NOTE = "last_run.json"
_HISTORY = Path("history", "runs", "index.db")  # all events of Dagster's SQLite storage, below its folder


def stages_until(until: str | None) -> set[str]:
    """Return all stages, or those of `until` (comma-separated) and their upstream.

    Raises TrapsError for an unknown stage.
    """
    graph = the_graph()
    if until is None:
        return {stage.name for stage in graph.stages}
    stage_names = [stage.name for stage in graph.stages]
    if unknown := [name for name in until.split(",") if name not in stage_names]:
        suggestion = did_you_mean(unknown[0], stage_names) or f"; choose from {', '.join(stage_names)}"
        raise TrapsError(f"--until {', '.join(unknown)}: no such stage{suggestion}")
    return graph.above(until.split(","))


def require_work(workspace: Workspace, experiment: str, until: str | None) -> None:
    """Raise TrapsError if an experiment wants nothing of the named stages (or of any)."""
    partitions, graph = StudyPartitions(workspace, experiment), the_graph()
    if not partitions.cells and not partitions.states:
        raise TrapsError(
            f"experiment {experiment} asks nothing: none of its scenarios belongs to its datasets, or no model has its "
            "runs; change `scenarios`, `datasets` or `runs`"
        )
    if empty := [name for name in until.split(",") if not graph[name].wanted(partitions)] if until else []:
        raise TrapsError(f"--until {', '.join(empty)}: experiment {experiment} wants nothing of it; name another stage")


def failed_checks(workspace: Workspace, experiment: str | None) -> list[str]:
    """Return failed checks of wanted partitions, from this or any earlier run."""
    failing: dict[tuple[str, str], list[str]] = {}
    for check, stage_name, partition, _ in failing_checks(workspace):
        failing.setdefault((stage_name, partition), []).append(check)
    partitions, problems = StudyPartitions(workspace, experiment), []
    for stage in the_graph().stages if failing else ():
        for key in stage.wanted(partitions):
            for check in sorted(failing.get((stage.name, key or stage.name), ())):
                details = workspace.failure(stage.name, check, key)
                problems.append(f"check {check} of {name_of((stage.name, key))} does not pass: {_unquote(details)}")
    return problems


def _unquote(details: str) -> str:
    return details[1:-1] if details[:1] == details[-1:] == '"' else details


# --- nothing to do ----------------------------------------------------------------------------------------------------


def note_versions(workspace: Workspace, stages: Collection[str], experiment: str | None) -> None:
    """Record versions and the history's state after a run without problems."""
    if (history := _history_state(workspace)) is None:
        return
    lineage, partitions = Lineage(workspace), StudyPartitions(workspace, experiment)
    graph = lineage.graph
    versions = {
        name_of((name, key)): lineage.version(name, key)
        for name in sorted(stages)
        for key in graph[name].wanted(partitions)
    }
    previous_note = _read_note(workspace)
    if previous_note.get("history") == history:  # keep versions of other stages or experiments
        versions = previous_note["versions"] | versions
    note = json.dumps({"history": history, "versions": versions})
    workspace.store.write({workspace.dagster_home / _NOTE: note.encode()})


def is_nothing_to_do(workspace: Workspace, stages: Collection[str], experiment: str | None) -> bool:
    """Return whether all wanted partitions are fresh and recorded, history unchanged."""
    note = _read_note(workspace)
    if not note or note.get("history") != _history_state(workspace):
        return False
    return is_made(workspace, stages, experiment, note["versions"])


def is_made(
    workspace: Workspace, stages: Collection[str], experiment: str | None, noted: Mapping[str, Any] | None = None
) -> bool:
    """Return whether all wanted partitions are fresh, and of the noted versions if these are given."""
    lineage, partitions = Lineage(workspace), StudyPartitions(workspace, experiment)
    return all(
        lineage.status(name, key).kind == "fresh"
        and (noted is None or noted.get(name_of((name, key))) == lineage.version(name, key) is not None)
        for name in stages
        for key in lineage.graph[name].wanted(partitions)
    )


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
