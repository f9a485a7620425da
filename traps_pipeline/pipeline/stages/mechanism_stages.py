"""Declare mechanism: states, probes, directions, steering (docs/spec.md 7 and 8)."""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING

from traps_pipeline.base.progress import Tally
from traps_pipeline.base.wording import count_noun
from traps_pipeline.mechanism import probing_versions as versions
from traps_pipeline.mechanism.mechanism_rows import (
    COSINES,
    DIRECTIONS,
    HIDDEN_STATES,
    PROBE_ITEMS,
    PROBES,
    STEERING_EFFECTS,
    STEERING_FLUENCY,
    STEERING_SHARES,
    STEERING_VOTES,
    CosineRow,
    ProbeRow,
    SteeringEffectRow,
    SteeringShareRow,
)
from traps_pipeline.mechanism.mechanism_rows import STEERING as STEERING_TABLE
from traps_pipeline.models.registry.entries import local_models
from traps_pipeline.pipeline import schemes
from traps_pipeline.pipeline.graph import Check, RunResources
from traps_pipeline.pipeline.partitioning import EVERY
from traps_pipeline.pipeline.schemes import (
    CATEGORY,
    CELL,
    DATASET,
    EXTRACTION,
    PROBED,
    by_dataset,
    by_extraction,
    these_keys,
    to_keys,
)
from traps_pipeline.pipeline.stage import dep, source, stage
from traps_pipeline.pipeline.stages.benchmark_stages import items, scene_specs, videos
from traps_pipeline.pipeline.stages.evaluation_stages import judges, verdicts
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.protocol.cells import Cell, Evaluation, Extraction, StatesCell, SteeringCell
from traps_pipeline.protocol.datasets import ANSWERABLE, DATASETS, taxonomy_of_category
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    import pandas as pd

GROUP = "mechanism"
_stage, _source = partial(stage, group=GROUP), partial(source, group=GROUP, kinds=["yaml"])
# Cells of the local models' answers under Standard in run 1: their verdicts tell confabulated voids.
ANSWERED_CELLS = these_keys(CELL, [Cell(d, Evaluation(m, "standard", 1)).key for d in DATASETS for m in local_models()])
_OCCLUSION = to_keys(CATEGORY, PROBED, lambda key: [ANSWERABLE] if taxonomy_of_category(key) == "occlusion" else [])


@_source(scheme=EXTRACTION)
def extraction_settings(workspace: Workspace, key: str) -> str:
    """Return the version of checkpoint, precision and prompt of hidden states."""
    return versions.extraction_version(workspace, Extraction.parse(key))


@_source(scheme=EXTRACTION)
def probing_settings(workspace: Workspace, key: str) -> str:
    """Return the version of a model's settings of probes and directions."""
    return versions.probing_version(workspace, Extraction.parse(key))


@_source(scheme=schemes.STEERED)
def steering_settings(workspace: Workspace, key: str) -> str:
    """Return the version of the study's steering settings, the model and its prompt."""
    return versions.steering_version(workspace, key)


def steers(partitions: StudyPartitions, key: str | None) -> bool:
    """Return whether the study steers models: adds directions of a model's own to its hidden states."""
    return partitions.steers and (key is None or Extraction.parse(key).weights_seed is None)


@_stage(
    PROBE_ITEMS,
    code="3",
    parents=[
        dep(items, to_keys(DATASET, PROBED, lambda dataset: [dataset])),
        dep(scene_specs, _OCCLUSION),
        dep(videos, _OCCLUSION),
    ],
    scheme=PROBED,
)
def probe_items(workspace: Workspace, dataset: str) -> StageOutput:
    """Return the clips and questions for which hidden states are extracted.

    These are a dataset's items, and occlusion's void clips with an answerable question.
    """
    from traps_pipeline.mechanism.probe_items import probe_items as rows_of

    return StageOutput(rows_of(workspace, dataset))


def _unsound_layers(workspace: Workspace, key: str | None, output: StageOutput) -> list[int]:
    from traps_pipeline.mechanism.stages import unsound_layers

    return unsound_layers(workspace, StatesCell.parse(str(key)), output.rows(HIDDEN_STATES)[0].n_layers)


@_stage(
    HIDDEN_STATES,
    code="2",
    parents=[dep(probe_items, by_dataset), dep(extraction_settings, by_extraction)],
    scheme=schemes.STATES,
    kinds=["parquet", "pytorch"],
    cost="machine",
    lost=lambda workspace, key: (
        [] if versions.has_states(workspace, StatesCell.parse(key)) else ["its states are gone"]
    ),
    checks=[Check("states_finite", "Every number of the first and last layer is finite.", _unsound_layers)],
)
def hidden_states(workspace: Workspace, key: str) -> StageOutput:
    """Return a frozen local model's hidden states at every layer, one row per item."""
    from traps_pipeline.mechanism.stages import extract_states

    rows, new = extract_states(workspace, StatesCell.parse(key))
    return StageOutput(rows, Tally(asked=new), {"extracted": new})


def _outside_shares(workspace: Workspace, key: str | None, output: StageOutput) -> str:
    def is_wrong(row: ProbeRow) -> bool:
        numbers = (row.value, row.low, row.high)
        return any(f is not None and f == f and not -1e-9 <= f <= 1 + 1e-9 for f in numbers)

    n_wrong = sum(is_wrong(row) for row in output.rows(PROBES))
    return f"{count_noun(n_wrong, 'row')} with a share outside 0 to 1" if n_wrong else ""


@_stage(
    PROBES,
    code="4",
    parents=[
        dep(hidden_states, by_extraction, need="some"),
        dep(verdicts, ANSWERED_CELLS, need="none"),
        probing_settings,
    ],
    scheme=EXTRACTION,
    kinds=["parquet", "scikitlearn"],
    takes=RunResources(memory_gb=1.0, each_gb=0.5),
    wants=lambda study, key: Extraction.parse(key).prompt in study.probed_prompts,
    checks=[Check("shares_are_shares", "Every number and interval lies in [0, 1].", _outside_shares)],
)
def probes(workspace: Workspace, key: str) -> StageOutput:
    """Return probes by layer: transfer, Cf->Cf, within, label-shuffled, centroids."""
    from traps_pipeline.mechanism.stages import probe_rows

    return StageOutput(probe_rows(workspace, Extraction.parse(key)))


@_stage(
    DIRECTIONS,
    code="3",
    parents=[dep(hidden_states, by_extraction, need="some"), probing_settings],
    scheme=EXTRACTION,
    wants=steers,
    lost=lambda workspace, key: (
        [] if versions.has_directions(workspace, Extraction.parse(key)) else ["its directions are gone"]
    ),
)
def directions(workspace: Workspace, key: str) -> StageOutput:
    """Return files of each dataset's void direction at every layer, and of its nulls."""
    from traps_pipeline.mechanism.stages import direction_rows

    return StageOutput(direction_rows(workspace, Extraction.parse(key)))


@_stage(COSINES, code="2", parents=[dep(directions, need="some"), dep(hidden_states, need="some")], wants=steers)
def cosines(workspace: Workspace, _: None) -> list[CosineRow]:
    """Return cosines, with reliability, of a model's void directions at one layer."""
    from traps_pipeline.mechanism.cosines import cosine_rows

    return cosine_rows(workspace)


@_stage(
    STEERING_TABLE,
    code="5",
    parents=[dep(items, by_dataset), dep(directions, EVERY, need="some"), dep(steering_settings, schemes.by_steering)],
    scheme=schemes.STEERING,
    kinds=["parquet", "pytorch"],
    cost="machine",
    side_by_side=True,
)
def steering(workspace: Workspace, keys: Sequence[str]) -> Iterator[tuple[str | None, StageOutput]]:
    """Yield answers of a model that is steered along every path into a dataset. Answers in the ledger are reused."""
    from traps_pipeline.mechanism.stages import examined_model, saved_directions
    from traps_pipeline.mechanism.steering import collect_steered

    for key in keys:
        cell = SteeringCell.parse(key)
        entry = examined_model(workspace, cell.evaluation.model)
        along = {cell.directions: saved_directions(workspace, Extraction(entry.id, cell.directions))}
        for finished_cell, output in collect_steered(workspace, entry, [cell], along):
            yield finished_cell.key, output


@_stage(
    STEERING_VOTES,
    code="5",
    parents=[dep(items, by_dataset), steering, judges],
    scheme=schemes.STEERING,
    cost="money",
    side_by_side=True,
)
def steering_votes(workspace: Workspace, keys: Sequence[str]) -> Iterator[tuple[str | None, StageOutput]]:
    """Yield the panel's votes on steered answers: abstention, and correct controls."""
    from traps_pipeline.mechanism.steering import collect_steering_votes

    for finished_cell, output in collect_steering_votes(workspace, [SteeringCell.parse(key) for key in keys]):
        yield finished_cell.key, output


@_stage(
    STEERING_FLUENCY,
    parents=[dep(items, by_dataset), steering],
    scheme=schemes.STEERING,
    kinds=["parquet", "pytorch"],
    cost="machine",
)
def steering_fluency(workspace: Workspace, key: str) -> StageOutput:
    """Return how likely the unsteered model finds each steered answer."""
    from traps_pipeline.mechanism.fluency import fluency_rows
    from traps_pipeline.mechanism.stages import examined_model

    cell = SteeringCell.parse(key)
    return StageOutput(fluency_rows(workspace, examined_model(workspace, cell.evaluation.model), cell))


def _answers_and_votes(workspace: Workspace) -> "tuple[pd.DataFrame, pd.DataFrame]":
    """Return the steered answers, and the votes on them."""
    from traps_pipeline.mechanism.shares import VOTE_COLUMNS

    return workspace.tables.read_all(STEERING_TABLE), workspace.tables.read_all(STEERING_VOTES, VOTE_COLUMNS)


_STEERING_PARENTS = (dep(steering, need="some"), dep(steering_votes, need="some"))


@_stage(STEERING_EFFECTS, code="4", parents=(*_STEERING_PARENTS, dep(steering_fluency, need="some")), wants=steers)
def steering_effects(workspace: Workspace, _: None) -> list[SteeringEffectRow]:
    """Return abstention by path, kind of direction, layer, strength and side."""
    from traps_pipeline.mechanism.shares import effect_rows

    return effect_rows(*_answers_and_votes(workspace), workspace.tables.read_all(STEERING_FLUENCY))


@_stage(STEERING_SHARES, code="5", parents=_STEERING_PARENTS, wants=steers)
def steering_shares(workspace: Workspace, _: None) -> list[SteeringShareRow]:
    """Return abstention over the paths of a set, with intervals by scenario."""
    from traps_pipeline.mechanism.shares import share_rows

    return share_rows(*_answers_and_votes(workspace))
