"""Compute fresh, stale (with reasons) and missing partitions (`traps status`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.storage.workspace import Workspace


@dataclass(frozen=True)
class StageStatus:
    """A stage's partitions: fresh (their number), stale (with reasons), missing.

    A stage without partitions has one, of its own name.
    """

    stage: str
    fresh: int
    stale: Mapping[str, tuple[str, ...]]
    missing: Sequence[str]

    def by_reason(self) -> Mapping[str, list[str]]:
        """Return the partitions that are not fresh, by their reasons.

        A reason leaves out the partition's own key, so that many partitions share it.
        """
        groups = dict[str, list[str]]()
        for key, reasons in self.stale.items():
            general_reasons = [reason.replace(f"/{key} ", " ") for reason in reasons]
            groups.setdefault("; ".join(general_reasons), []).append(key)
        return groups | ({"not made yet": [*self.missing]} if self.missing else {})


def stage_statuses(workspace: Workspace, lineage: Lineage, experiment: str | None) -> Iterator[StageStatus]:
    """Yield each stage's status over the partitions that a study or experiment wants."""
    partitions = StudyPartitions(workspace, experiment)
    for stage in lineage.graph.stages:
        statuses = {key or stage.name: lineage.status(stage.name, key) for key in stage.wanted(partitions)}
        # A table of other columns is no lost one: it is told with its reason.
        stale_reasons = {key: status.reasons for key, status in statuses.items() if status.reasons}
        missing = [key for key, status in statuses.items() if status.kind == "missing" and not status.reasons]
        yield StageStatus(stage.name, len(statuses) - len(stale_reasons) - len(missing), stale_reasons, missing)


def failing_checks(workspace: Workspace) -> Iterator[tuple[str, str, str, str]]:
    """Yield each failed check: its name, stage, partition and message."""
    for file in workspace.store.below(workspace.root / "checks", "*/*/*.json"):
        stage, check = file.parts[-3:-1]
        yield check, stage, file.stem, workspace.store.here(file).read_text(encoding="utf-8")[:200]
