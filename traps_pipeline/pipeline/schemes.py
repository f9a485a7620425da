"""Partition the study that `TRAPS_WORKSPACE` names."""

from collections.abc import Callable, Iterable
from functools import cache

from traps_pipeline.pipeline.partitioning import ByDimension, FixedKeys, Pairs, Partitioning
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.protocol.cells import Cell, Extraction, StatesCell, SteeringCell
from traps_pipeline.storage.workspace import Workspace


def study_here() -> Workspace | None:
    """Return the workspace that the environment names; None if it does not exist yet."""
    place = Workspace.default_place()
    return Workspace.open(place) if Workspace.is_there(place) else None


_PARTITIONS = StudyPartitions(study_here())


# Groups of assets that the study does not use: Dagster does not show them, and nothing materializes them.
LEFT_OUT = frozenset(
    group for group, used in (("mechanism", _PARTITIONS.has_mechanism), ("arms", bool(_PARTITIONS.arms))) if not used
)

CATEGORY = Partitioning(
    {"category": _PARTITIONS.categories}, lambda key: {"category": key}, lambda study: study.categories
)
DATASET = Partitioning({"dataset": _PARTITIONS.datasets}, lambda key: {"dataset": key}, lambda study: study.datasets)
EVALUATION = Partitioning(
    {"evaluation": [e.key for e in _PARTITIONS.evaluations]},
    lambda key: {},
    lambda study: [e.key for e in study.evaluations],
)
CELL = Partitioning(
    {**DATASET.dimensions, **EVALUATION.dimensions},
    cache(lambda key: Cell.parse(key).partition),
    lambda study: study.cells,
)
# Inside local models: datasets and occlusion's answerable questions; model__prompt; model__directions__regime.
PROBED = Partitioning({"dataset": _PARTITIONS.probed}, lambda key: {"dataset": key}, lambda study: study.probed)
EXTRACTION = Partitioning(
    {"extraction": [e.key for e in _PARTITIONS.extractions]},
    cache(lambda key: Extraction.parse(key).partition),
    lambda study: [e.key for e in study.extractions],
)
STATES = Partitioning(
    {**PROBED.dimensions, **EXTRACTION.dimensions},
    cache(lambda key: StatesCell.parse(key).partition),
    lambda study: study.states,
)
STEERED = Partitioning({"steering": _PARTITIONS.steered}, lambda key: {}, lambda study: study.steered)
STEERING = Partitioning(
    {**DATASET.dimensions, **STEERED.dimensions},
    cache(lambda key: SteeringCell.parse(key).partition),
    lambda study: study.steering,
)

by_dataset = ByDimension("dataset")
by_evaluation = ByDimension("evaluation")
by_extraction = ByDimension("extraction")
by_steering = ByDimension("steering")


def to_keys(above: Partitioning, below: Partitioning, mapping: Callable[[str], Iterable[str]]) -> Pairs:
    """Return the mapping of each upstream partition to the downstream keys that the study has."""
    pairs = {key: sorted(below.known & {*mapping(key)}) for key in sorted(above.known)}
    return Pairs({key: keys for key, keys in pairs.items() if keys})


def these_keys(above: Partitioning, keys: Iterable[str]) -> FixedKeys:
    """Return the mapping of every partition to those of these upstream keys that the study has."""
    return FixedKeys([key for key in keys if key in above.known])
