"""What every asset shares: partitions, the workspace, and one way to tell Dagster that a partition is made.

Assets write their own tables and yield one `AssetMaterialization` a partition with a data version made from content
and the provenance that Dagster needs to call it fresh or stale, whichever way the run was started (`design.md`
section 3). Sources are observed on the way, so provenance never points at nothing.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import dagster as dg

from traps_pipeline.errors import TrapsError
from traps_pipeline.lineage import PARTITIONED_BY, SOURCES, Lineage, Node, keys_of, reread_sources
from traps_pipeline.models.registry import all_evaluations
from traps_pipeline.partitions import CATEGORIES, DATASETS
from traps_pipeline.storage.workspace import Workspace, write_text
from traps_pipeline.tables import TABLES

# Partition mappings over one dimension, observable sources and backfill policies are in beta; the version is pinned.
warnings.filterwarnings("ignore", category=dg.BetaWarning)

CATEGORY = dg.StaticPartitionsDefinition(list(CATEGORIES))
DATASET = dg.StaticPartitionsDefinition(list(DATASETS))
EVALUATION = dg.StaticPartitionsDefinition([evaluation.key for evaluation in all_evaluations()])
CELL = dg.MultiPartitionsDefinition({"dataset": DATASET, "evaluation": EVALUATION})
SINGLE_RUN = dg.BackfillPolicy.single_run()
OWNERS = ["team:benchmark"]

_VERSION_TAG, _USER_TAG, _CODE_TAG = (
    "dagster/data_version",
    "dagster/data_version_is_user_provided",
    "dagster/code_version",
)
_INPUT_VERSION, _INPUT_POINTER = "dagster/input_data_version", "dagster/input_event_pointer"

by_dataset = dg.MultiToSingleDimensionPartitionMapping("dataset")
by_evaluation = dg.MultiToSingleDimensionPartitionMapping("evaluation")


def column_schema(table: str) -> dg.TableSchema:
    """A table's contract as Dagster shows it."""
    columns = [
        dg.TableColumn(c.name, c.type.rstrip("?"), c.doc, dg.TableColumnConstraints(nullable=c.nullable))
        for c in TABLES[table].columns
    ]
    return dg.TableSchema(columns=columns)


def table_metadata(table: str) -> dict[str, Any]:
    """Static metadata of an asset that is a table."""
    return {"dagster/column_schema": column_schema(table), "one row is": TABLES[table].row}


def keys(context: dg.AssetExecutionContext) -> list[str]:
    """The partition keys of this run."""
    return [str(key) for key in context.partition_keys]


def materialized(
    context: dg.AssetExecutionContext, key: str | None, version: str, provenance: Mapping[str, str], **metadata: Any
) -> dg.AssetMaterialization:
    """The event that makes a partition count as made, with its data version and what it was made from."""
    tags = {_VERSION_TAG: version, _USER_TAG: "true", **provenance}
    return dg.AssetMaterialization(context.asset_key, partition=key, metadata=metadata, tags=tags)


def provenance(context: dg.AssetExecutionContext, workspace: Workspace) -> dict[str, str]:
    """Tags that say which events of the parents are current. Taken before the tables are read.

    Raises TrapsError for a run of several stages (Dagster would skip those below a stage that hands on no output) and
    for a Dagster history that belongs to another study.
    """
    selected = set(context.run.asset_selection or context.job_def.asset_layer.executable_asset_keys)
    if len(selected) > 1:
        names = ", ".join(sorted(key.to_user_string() for key in selected))
        raise TrapsError(f"one stage a run, not {names}: `traps run EXPERIMENT` walks the stages in order")
    home = Path(os.environ.get("DAGSTER_HOME") or workspace.dagster_home)
    if home.resolve() != workspace.dagster_home.resolve():
        raise TrapsError(
            f"DAGSTER_HOME={home} is not of the workspace {workspace.root}: set it to {workspace.dagster_home}"
        )
    observe_sources(context.instance, workspace)
    tags = {_CODE_TAG: context.run_id}
    for parent in sorted(context.assets_def.asset_deps[context.asset_key]):
        name = parent.to_user_string()
        newest = _fetch(context.instance, name)(dg.AssetRecordsFilter(asset_key=parent), limit=1).records
        version = _recorded_version(newest[0]) if newest else None
        tags[f"{_INPUT_VERSION}/{name}"] = version or "none"
        tags[f"{_INPUT_POINTER}/{name}"] = str(newest[0].storage_id) if newest else "NULL"
    return tags


def observe_sources(instance: dg.DagsterInstance, workspace: Workspace) -> list[Node]:
    """Tell Dagster the versions of all sources that it does not know yet; returns those that changed."""
    lineage, changed = Lineage(workspace), list[Node]()
    for source in SOURCES:
        recorded = recorded_versions(instance, source)
        for key in keys_of(source):
            version = str(lineage.version(source, key))
            if recorded.get(key) != version:
                tags = {_VERSION_TAG: version, _USER_TAG: "true"}
                instance.report_runless_asset_event(dg.AssetObservation(source, partition=key, tags=tags))
                changed.append((source, key))
    return changed


def recorded_versions(instance: dg.DagsterInstance, name: str) -> dict[str | None, str | None]:
    """The data version that Dagster knows of each partition of a stage or source."""
    versions: dict[str | None, str | None] = {}
    cursor = None
    while True:
        page = _fetch(instance, name)(dg.AssetRecordsFilter(asset_key=dg.AssetKey(name)), limit=1000, cursor=cursor)
        for record in page.records:  # newest first
            event = record.asset_materialization or record.asset_observation
            if event is not None:
                versions.setdefault(event.partition, _recorded_version(record))
        if not page.has_more or len(versions) >= len(keys_of(name)):
            return versions
        cursor = page.cursor


def _fetch(instance: dg.DagsterInstance, name: str) -> Callable[..., dg.EventRecordsResult]:
    return instance.fetch_observations if name in SOURCES else instance.fetch_materializations


def _recorded_version(record: dg.EventLogRecord) -> str | None:
    event = record.asset_materialization or record.asset_observation
    return (event.tags or {}).get(_VERSION_TAG) if event else None


def source_asset(name: str, group: str, description: str, kinds: Sequence[str]) -> dg.SourceAsset | dg.AssetsDefinition:
    """An observable source asset whose data version, by partition where it has any, is made from its content."""
    kind = PARTITIONED_BY.get(name)
    partitions = CATEGORY if kind == "category" else EVALUATION if kind == "evaluation" else None
    tags = {f"dagster/kind/{kind}": "" for kind in kinds}

    def observe() -> dg.DataVersion | dg.DataVersionsByPartition:
        lineage = Lineage(Workspace.open())
        if partitions is None:
            return dg.DataVersion(str(lineage.version(name, None)))
        return dg.DataVersionsByPartition({str(key): str(lineage.version(name, key)) for key in keys_of(name)})

    decorate = dg.observable_source_asset(
        name=name, partitions_def=partitions, group_name=group, description=description, tags=tags
    )
    return decorate(observe)


@dg.sensor(
    minimum_interval_seconds=30,
    default_status=dg.DefaultSensorStatus.RUNNING,
    description="Looks at specs, corrections, prompts and registries, so that what an edit touched shows as stale.",
)
def watch_sources(context: dg.SensorEvaluationContext) -> dg.SkipReason:
    """Observes the sources every 30 s while the daemon runs; launches nothing."""
    reread_sources()
    changed = observe_sources(context.instance, Workspace.open())
    return dg.SkipReason(f"{len(changed)} source partitions changed" if changed else "no source changed")


def check(name: str, asset: str, description: str) -> dg.AssetCheckSpec:
    """Spec of a check that the asset itself evaluates while it has its rows in hand."""
    return dg.AssetCheckSpec(name, asset=asset, description=description)


class Checks:
    """The checks of one run, evaluated partition by partition before the partition counts as made.

    A failure is kept in the workspace until its partition passes, so that every later run and `traps status` tell, even
    if this run dies before it reports to Dagster.
    """

    def __init__(self, context: dg.AssetExecutionContext, workspace: Workspace) -> None:
        self._context, self._workspace = context, workspace
        self._stage = context.asset_key.to_user_string()
        self._failing: dict[str, dict[str, Any]] = {}

    def record(self, name: str, key: str | None, problems: Any) -> None:
        """A check of a partition; `problems` is empty where it passes."""
        failing = self._failing.setdefault(name, {})
        file = self._workspace.failed_check(self._stage, name, key)
        if problems:
            failing[str(key)] = problems
            write_text(file, json.dumps(problems, default=str))
        else:
            file.unlink(missing_ok=True)

    def results(self) -> Iterator[dg.AssetCheckResult]:
        """What Dagster is told: one result a check, with the failing partitions."""
        for name, failing in self._failing.items():
            yield dg.AssetCheckResult(
                check_name=name, asset_key=self._context.asset_key, passed=not failing, metadata={"failing": failing}
            )


Events = Iterator[dg.AssetMaterialization | dg.AssetCheckResult]
