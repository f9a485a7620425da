"""Report partitions and sources to Dagster, and read back versions and provenance."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import dagster as dg
from dagster._core.definitions.asset_checks.asset_check_evaluation import (
    AssetCheckEvaluationTargetMaterializationData as CheckTarget,
)

from traps_pipeline.pipeline.graph import Graph, Stage
from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.pipeline.metadata import visible_metadata
from traps_pipeline.pipeline.translation import asset_key

_VERSION, _USER, _CODE = "dagster/data_version", "dagster/data_version_is_user_provided", "dagster/code_version"
_INPUT_VERSION, _INPUT_POINTER = "dagster/input_data_version", "dagster/input_event_pointer"
_MATERIALIZATION = dg.DagsterEventType.ASSET_MATERIALIZATION
NEVER = "INITIAL"  # Dagster's word for the version of what was never made


class History:
    """Dagster's history of the assets of a graph."""

    def __init__(self, instance: dg.DagsterInstance, graph: Graph) -> None:
        self._instance, self._graph = instance, graph

    def event(
        self, stage: Stage, key: str | None, version: str, provenance: Mapping[str, str], metadata: Mapping[str, Any]
    ) -> dg.AssetMaterialization:
        """Return the materialization of a partition, with data version and provenance."""
        tags = {_VERSION: version, _USER: "true", _CODE: stage.code, **provenance}
        return dg.AssetMaterialization(
            asset_key(stage.name), partition=key, metadata=visible_metadata(metadata), tags=tags
        )

    def provenance(self, stage: Stage) -> dict[str, str]:
        """Return Dagster tags that name the parents' current events; call before reading inputs."""
        tags: dict[str, str] = {}
        for parent in stage.parents:
            key = asset_key(parent)
            name = key.to_user_string()
            records = self._fetch(parent)(dg.AssetRecordsFilter(asset_key=key), limit=1).records
            version = _version_of(records[0]) if records else None
            tags[f"{_INPUT_VERSION}/{name}"] = version or NEVER
            tags[f"{_INPUT_POINTER}/{name}"] = str(records[0].storage_id) if records else "NULL"
        return tags

    def recorded(self, name: str) -> dict[str | None, str | None]:
        """Return a stage's or source's data versions in Dagster's history, by partition."""
        node = self._graph.declared[name]
        if node.scheme is None:
            records = self._fetch(name)(dg.AssetRecordsFilter(asset_key=asset_key(name)), limit=1).records
            return {None: _version_of(records[0])} if records else {}
        # One query over the index of tags: ten thousand events take seconds to deserialize.
        kind = dg.DagsterEventType.ASSET_OBSERVATION if self._graph.source(name) else _MATERIALIZATION
        tags = self._instance.event_log_storage.get_latest_tags_by_partition(asset_key(name), kind, [_VERSION])
        return {key: key_tags[_VERSION] for key, key_tags in tags.items()}

    def check_target(self, name: str, key: str | None) -> CheckTarget | None:
        """Return the newest event of a partition, which a check's evaluation must name.

        Dagster's page of a check calls a partition missing whose last evaluation names no event, or an older one. The
        event of an asset without partitions follows its evaluations, in the same run.
        """
        if key is None:
            return None
        record_filter = dg.AssetRecordsFilter(asset_key=asset_key(name), asset_partitions=[key])
        records = self._instance.fetch_materializations(record_filter, limit=1).records
        return next(
            (CheckTarget(storage_id=r.storage_id, run_id=r.run_id, timestamp=r.timestamp) for r in records), None
        )

    def observe(self, lineage: Lineage, sources: Iterable[str] | None = None) -> None:
        """Report versions of sources (default: all) that Dagster lacks."""
        for name in self._graph.sources if sources is None else sources:
            now = {key: str(lineage.version(name, key)) for key in self._graph.keys(name)}
            slot = (Path(self._instance.root_directory), name)
            if _OBSERVED.get(slot) == now:
                continue
            recorded_versions = self.recorded(name)
            for key, version in now.items():
                if recorded_versions.get(key) != version:
                    tags = {_VERSION: version, _USER: "true"}
                    event = dg.AssetObservation(asset_key(name), partition=key, tags=tags)
                    self._instance.report_runless_asset_event(event)
            _OBSERVED[slot] = now

    def _fetch(self, name: str) -> Callable[..., dg.EventRecordsResult]:
        source = self._graph.source(name) is not None
        return self._instance.fetch_observations if source else self._instance.fetch_materializations


# Versions last reported by this process, by history and source: saves each of a run's many steps a query.
_OBSERVED: dict[tuple[Path, str], dict[str | None, str]] = {}


def _version_of(record: dg.EventLogRecord) -> str | None:
    event = record.asset_materialization or record.asset_observation
    return (event.tags or {}).get(_VERSION) if event else None
