"""`traps status`: the fresh, stale and missing partitions of a study, with the reasons."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.pipeline.wanted import Wanted
from traps_pipeline.storage.workspace import Workspace


@dataclass(frozen=True)
class StageStatus:
    """The partitions of a stage: the number of fresh ones, the stale ones with reasons, the number of missing ones."""

    stage: str
    fresh: int
    stale: Mapping[str, tuple[str, ...]]
    missing: int


def stage_statuses(workspace: Workspace, lineage: Lineage, experiment: str | None) -> Iterator[StageStatus]:
    """The status of every stage, over the partitions that the study wants, or that one of its experiments wants."""
    wanted = Wanted(workspace, experiment)
    for stage in lineage.graph.stages:
        statuses = {key or stage.name: lineage.status(stage.name, key) for key in stage.wanted(wanted)}
        stale = {key: status.reasons for key, status in statuses.items() if status.kind == "stale"}
        kinds = Counter(status.kind for status in statuses.values())
        yield StageStatus(stage.name, kinds["fresh"], stale, kinds["missing"])
