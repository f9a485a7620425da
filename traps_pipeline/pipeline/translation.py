"""Translate the graph into Dagster's asset keys, partitions and mappings."""

import os
import warnings
from functools import cache
from pathlib import Path

import dagster as dg

from traps_pipeline.pipeline.graph import Graph
from traps_pipeline.pipeline.partitioning import ByDimension, FixedKeys, KeyMapping, Pairs, Partitioning, SameKeys
from traps_pipeline.pipeline.schemes import study_here

# Partition mappings over one dimension, observable sources and backfill policies are in beta, partitioned checks in
# preview; the version is pinned.
for _category in (dg.BetaWarning, dg.PreviewWarning):
    warnings.filterwarnings("ignore", category=_category)


def asset_key(name: str) -> dg.AssetKey:
    """Return a stage's or source's asset key, prefixed if studies share one history."""
    return dg.AssetKey([*_prefix(), name])


@cache
def _prefix() -> tuple[str, ...]:
    dagster_home, workspace = os.environ.get("DAGSTER_HOME"), study_here()
    if workspace is not None and (workspace.is_shared or workspace.is_on_cluster):
        return (workspace.study.name,)  # several studies may share its database and its history
    if workspace is None or not dagster_home or Path(dagster_home).resolve() == workspace.dagster_home.resolve():
        return ()
    return (workspace.study.name,) if workspace.study.name else ()


@cache
def partitions_of(scheme: Partitioning) -> dg.PartitionsDefinition:
    """Return Dagster's partitions of a scheme; the same object for the same scheme."""
    parts = {name: dg.StaticPartitionsDefinition([*keys]) for name, keys in scheme.dimensions.items()}
    return next(iter(parts.values())) if len(parts) == 1 else dg.MultiPartitionsDefinition(parts)


def asset_deps(graph: Graph, name: str) -> list[dg.AssetDep]:
    """Return the Dagster dependencies of a stage."""
    deps = []
    for parent in graph.parents_of[name].values():
        is_partitioned = graph.declared[parent.name].scheme is not None
        mapping = _mapping(graph.mapping(name, parent.name)) if is_partitioned else None
        deps.append(dg.AssetDep(asset_key(parent.name), partition_mapping=mapping))
    return deps


def _mapping(mapping: KeyMapping) -> dg.PartitionMapping:
    match mapping:
        case SameKeys():
            return dg.IdentityPartitionMapping()
        case ByDimension():
            return dg.MultiToSingleDimensionPartitionMapping(mapping.name)
        case Pairs():
            return dg.StaticPartitionMapping({key: [*downstream] for key, downstream in mapping.below.items()})
        case FixedKeys():
            return dg.SpecificPartitionsPartitionMapping([*mapping.keys])
        case _:
            return dg.AllPartitionMapping()
