"""How stages are partitioned, in Dagster's words: the keys are those of the study that `TRAPS_WORKSPACE` names."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import dagster as dg

from traps_pipeline.base.partitions import Cell, Extraction, StatesCell, SteeringCell
from traps_pipeline.orchestration.wanted import Wanted
from traps_pipeline.storage.workspace import Workspace

# Partition mappings over one dimension, observable sources and backfill policies are in beta, partitioned checks in
# preview; the version is pinned.
for _category in (dg.BetaWarning, dg.PreviewWarning):
    warnings.filterwarnings("ignore", category=_category)


@dataclass(frozen=True)
class Scheme:
    """One way of partitioning. columns: the values of a table's partition columns for a key; wanted: a study's keys."""

    definition: dg.PartitionsDefinition
    columns: Callable[[str], Mapping[str, Any]]
    wanted: Callable[[Wanted], Sequence[str]]

    @cached_property
    def keys(self) -> frozenset[str]:
        """Every key. (Dagster makes an object of each key of two dimensions, every time that it is asked.)"""
        if isinstance(self.definition, dg.MultiPartitionsDefinition):
            dimensions = (one.partitions_def.get_partition_keys() for one in self.definition.partitions_defs)
            return frozenset(map("|".join, product(*dimensions)))
        return frozenset(map(str, self.definition.get_partition_keys()))


def study_here() -> Workspace | None:
    """The workspace that the environment names; None where there is none yet."""
    place = Workspace.default_place()
    return Workspace.open(place) if Workspace.is_there(place) else None


_HERE = Wanted(study_here())


def _static(keys: Iterable[str]) -> dg.StaticPartitionsDefinition:
    return dg.StaticPartitionsDefinition([*keys])


def _multi(**dimensions: dg.PartitionsDefinition) -> dg.MultiPartitionsDefinition:
    return dg.MultiPartitionsDefinition(dimensions)


# Groups of assets that the study has no use for: Dagster does not show them, and nothing is made of them.
LEFT_OUT = frozenset(
    group for group, used in (("mechanism", _HERE.looks_inside), ("arms", bool(_HERE.arms))) if not used
)

CATEGORY = Scheme(_static(_HERE.categories), lambda key: {"category": key}, lambda wanted: wanted.categories)
DATASET = Scheme(_static(_HERE.datasets), lambda key: {"dataset": key}, lambda wanted: wanted.datasets)
EVALUATION = Scheme(
    _static(e.key for e in _HERE.evaluations), lambda key: {}, lambda wanted: [e.key for e in wanted.evaluations]
)
CELL = Scheme(
    _multi(dataset=DATASET.definition, evaluation=EVALUATION.definition),
    lambda key: Cell.parse(key).partition,
    lambda wanted: wanted.cells,
)
# Inside local models: datasets and occlusion's answerable questions; model__prompt; model__directions__regime.
PROBED = Scheme(_static(_HERE.probed), lambda key: {"dataset": key}, lambda wanted: wanted.probed)
EXTRACTION = Scheme(
    _static(e.key for e in _HERE.extractions),
    lambda key: Extraction.parse(key).partition,
    lambda wanted: [e.key for e in wanted.extractions],
)
STATES = Scheme(
    _multi(dataset=PROBED.definition, extraction=EXTRACTION.definition),
    lambda key: StatesCell.parse(key).partition,
    lambda wanted: wanted.states,
)
STEERED = Scheme(_static(_HERE.steered), lambda key: {}, lambda wanted: wanted.steered)
STEERING = Scheme(
    _multi(dataset=DATASET.definition, steering=STEERED.definition),
    lambda key: SteeringCell.parse(key).partition,
    lambda wanted: wanted.steering,
)

by_dataset = dg.MultiToSingleDimensionPartitionMapping("dataset")
by_evaluation = dg.MultiToSingleDimensionPartitionMapping("evaluation")
by_extraction = dg.MultiToSingleDimensionPartitionMapping("extraction")
by_steering = dg.MultiToSingleDimensionPartitionMapping("steering")


def to_keys(above: Scheme, below: Scheme, mapping: Callable[[str], Iterable[str]]) -> dg.StaticPartitionMapping:
    """What partitions below are made from each above, of the keys that the study has."""
    pairs = {key: sorted(below.keys & {*mapping(key)}) for key in sorted(above.keys)}
    return dg.StaticPartitionMapping({key: found for key, found in pairs.items() if found})


def these_keys(above: Scheme, keys: Iterable[str]) -> dg.SpecificPartitionsPartitionMapping:
    """Of all partitions above these, as far as the study has them."""
    return dg.SpecificPartitionsPartitionMapping([key for key in keys if key in above.keys])
