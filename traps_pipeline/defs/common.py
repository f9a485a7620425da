"""What every asset shares: partitions, the workspace, and one way to tell Dagster that a partition is made.

Assets write their own tables and yield one `AssetMaterialization` a partition with a data version made from content
and the provenance that Dagster needs to call it fresh or stale, whichever way the run was started (`design.md`
section 3). Sources are observed on the way, so provenance never points at nothing.
"""

import json
import math
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import dagster as dg

from traps_pipeline import progress
from traps_pipeline.errors import TrapsError
from traps_pipeline.lineage import PARTITIONED_BY, SOURCES, Lineage, Node, keys_of, reread_sources
from traps_pipeline.models.registry import all_evaluations, all_extractions, all_steered
from traps_pipeline.partitions import CATEGORIES, DATASETS, PROBED_DATASETS
from traps_pipeline.progress import Tally
from traps_pipeline.storage.workspace import Workspace, write_text
from traps_pipeline.tables import TABLES, Table

if TYPE_CHECKING:
    import pandas as pd

# Partition mappings over one dimension, observable sources and backfill policies are in beta; the version is pinned.
warnings.filterwarnings("ignore", category=dg.BetaWarning)

CATEGORY = dg.StaticPartitionsDefinition(list(CATEGORIES))
DATASET = dg.StaticPartitionsDefinition(list(DATASETS))
EVALUATION = dg.StaticPartitionsDefinition([evaluation.key for evaluation in all_evaluations()])
CELL = dg.MultiPartitionsDefinition({"dataset": DATASET, "evaluation": EVALUATION})
# Inside local models: datasets and occlusion's answerable questions; model__prompt; model__directions__regime.
PROBED = dg.StaticPartitionsDefinition(list(PROBED_DATASETS))
EXTRACTION = dg.StaticPartitionsDefinition([extraction.key for extraction in all_extractions()])
STATES = dg.MultiPartitionsDefinition({"dataset": PROBED, "extraction": EXTRACTION})
STEERED = dg.StaticPartitionsDefinition(list(all_steered()))
STEERING_CELL = dg.MultiPartitionsDefinition({"dataset": DATASET, "steering": STEERED})
SOURCE_PARTITIONS = {"category": CATEGORY, "evaluation": EVALUATION, "extraction": EXTRACTION, "steered": STEERED}
SINGLE_RUN = dg.BackfillPolicy.single_run()
OWNERS = ["team:benchmark"]
Events = Iterator[dg.AssetMaterialization | dg.AssetCheckResult]

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
    return event_of(context.asset_key, key, version, provenance, metadata)


def event_of(
    asset: dg.AssetKey, key: str | None, version: str, provenance: Mapping[str, str], metadata: Mapping[str, Any]
) -> dg.AssetMaterialization:
    """`materialized`, for a step that makes several assets."""
    tags = {_VERSION_TAG: version, _USER_TAG: "true", **provenance}
    return dg.AssetMaterialization(asset, partition=key, metadata=metadata, tags=tags)


def provenance(context: dg.AssetExecutionContext, workspace: Workspace) -> dict[str, str]:
    """Tags that say which events of the parents are current. Taken before the tables are read.

    Raises TrapsError for a run of several stages (Dagster would skip those below a stage that hands on no output) and
    for a Dagster history that belongs to another study.
    """
    return provenance_of_each(context, workspace)[context.asset_key.to_user_string()]


def provenance_of_each(context: dg.AssetExecutionContext, workspace: Workspace) -> dict[str, dict[str, str]]:
    """`provenance` of every asset that this step makes, by name."""
    selected = set(context.run.asset_selection or context.job_def.asset_layer.executable_asset_keys)
    if not selected <= set(context.assets_def.keys):
        names = ", ".join(sorted(key.to_user_string() for key in selected))
        raise TrapsError(f"one stage a run, not {names}: `traps run EXPERIMENT` walks the stages in order")
    home = Path(os.environ.get("DAGSTER_HOME") or workspace.dagster_home)
    if home.resolve() != workspace.dagster_home.resolve():
        raise TrapsError(
            f"DAGSTER_HOME={home} is not of the workspace {workspace.root}: set it to {workspace.dagster_home}"
        )
    _observe_changed_sources(context.instance, workspace)

    @cache
    def newest(parent: dg.AssetKey) -> dict[str, str]:
        name = parent.to_user_string()
        found = _fetch(context.instance, name)(dg.AssetRecordsFilter(asset_key=parent), limit=1).records
        version = _recorded_version(found[0]) if found else None
        pointer = str(found[0].storage_id) if found else "NULL"
        return {f"{_INPUT_VERSION}/{name}": version or "none", f"{_INPUT_POINTER}/{name}": pointer}

    return {
        key.to_user_string(): {_CODE_TAG: context.run_id}
        | {name: value for parent in sorted(parents) for name, value in newest(parent).items()}
        for key, parents in context.assets_def.asset_deps.items()
        if key in selected
    }


_OBSERVED: dict[Path, list[str]] = {}  # workspace to the versions of its sources when this process last observed them


def _observe_changed_sources(instance: dg.DagsterInstance, workspace: Workspace) -> None:
    """`observe_sources`, unless nothing changed since this process did so: a `traps run` makes many Dagster runs."""
    lineage = Lineage(workspace)
    versions = [str(lineage.version(source, key)) for source in SOURCES for key in keys_of(source)]
    if _OBSERVED.get(workspace.root) != versions:
        observe_sources(instance, workspace)
        _OBSERVED[workspace.root] = versions


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
    partitions = SOURCE_PARTITIONS.get(PARTITIONED_BY.get(name, ""))
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


def table_asset(
    table: Table,
    group: str,
    doc: str,
    deps: Sequence[dg.AssetsDefinition | dg.SourceAsset],
    make: "Callable[[Workspace], pd.DataFrame]",
    metadata: "Callable[[pd.DataFrame], Mapping[str, Any]] | None" = None,
    checked: "tuple[dg.AssetCheckSpec, Callable[[pd.DataFrame], str]] | None" = None,
) -> dg.AssetsDefinition:
    """An unpartitioned table that is made of whatever is there of its inputs.

    metadata adds to what Dagster shows (default: the first rows); checked is a check and what is wrong with the rows,
    empty where it passes.
    """

    @dg.asset(
        name=table.name,
        description=doc,
        deps=deps,
        group_name=group,
        kinds={"parquet"},
        owners=OWNERS,
        metadata=table_metadata(table.name),
        output_required=False,
        check_specs=[checked[0]] if checked else None,
    )
    def make_table(context: dg.AssetExecutionContext) -> Events:
        workspace = Workspace.open()
        tags, inputs = provenance(context, workspace), Lineage(workspace).inputs(table.name, None)
        checks = Checks(context, workspace)
        frame = make(workspace)
        if checked:
            checks.record(checked[0].name, None, checked[1](frame))
        version = workspace.tables.write(table, {}, frame, inputs)
        progress.current().partition(table.name, "", Tally())
        shown = dict(metadata(frame)) if metadata else {table.name: rows_shown(frame)}
        yield materialized(context, None, version, tags, **{"dagster/row_count": len(frame)}, **shown)
        yield from checks.results()

    return make_table


def rows_shown(frame: "pd.DataFrame", rows: int = 60) -> dg.MarkdownMetadataValue | str:
    """The first rows as Dagster shows them. For figures and ids alone: nothing that a model wrote."""
    if frame.empty:
        return "not run"
    head = frame.head(rows)
    lines = [[str(name) for name in head.columns], ["---"] * len(head.columns)]
    lines += [[_shown(value) for value in row] for row in head.itertuples(index=False)]
    return dg.MetadataValue.md("\n".join("| " + " | ".join(line) + " |" for line in lines))


def _shown(value: object) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.4g}"
    return "" if value is None else str(value).replace("|", "\\|")


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
