"""`traps status`: what of a study is there, what is missing, what is stale and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from traps_pipeline.orchestration.lineage import Lineage
from traps_pipeline.orchestration.wanted import Wanted
from traps_pipeline.storage.workspace import Workspace


@dataclass(frozen=True)
class StageStatus:
    """How many partitions of a stage are fresh, which are stale and why, how many are missing."""

    stage: str
    fresh: int
    stale: Mapping[str, tuple[str, ...]]
    missing: int


def stage_statuses(workspace: Workspace, lineage: Lineage, experiment: str | None) -> Iterator[StageStatus]:
    """The state of every stage, of what the study wants, or one experiment of it."""
    wanted = Wanted(workspace, experiment)
    for stage in lineage.graph.stages:
        statuses = {key or stage.name: lineage.status(stage.name, key) for key in stage.wanted(wanted)}
        stale = {key: status.reasons for key, status in statuses.items() if status.kind == "stale"}
        kinds = Counter(status.kind for status in statuses.values())
        yield StageStatus(stage.name, kinds["fresh"], stale, kinds["missing"])
