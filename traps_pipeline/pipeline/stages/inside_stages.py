"""Declare the mechanism group's controls: baselines, gate, nulls, patching."""

from functools import partial
from typing import TYPE_CHECKING

from traps_pipeline.mechanism import control_rows as tables
from traps_pipeline.mechanism.mechanism_rows import STEERING_EFFECTS
from traps_pipeline.mechanism.probing_versions import patching_version, sentence_version
from traps_pipeline.models.registry.entries import ModelEntry, local_models
from traps_pipeline.pipeline.partitioning import EVERY, SAME
from traps_pipeline.pipeline.schemes import CELL, EXTRACTION, PROBED, by_extraction, these_keys, to_keys
from traps_pipeline.pipeline.stage import dep, source, stage
from traps_pipeline.pipeline.stages.evaluation_stages import responses, verdicts
from traps_pipeline.pipeline.stages.mechanism_stages import (
    ANSWERED_CELLS,
    GROUP,
    hidden_states,
    probe_items,
    probes,
    probing_settings,
    steering_effects,
    steers,
)
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.protocol.cells import Cell, Evaluation, Extraction, StatesCell
from traps_pipeline.protocol.datasets import DATASETS, PROBED_ARMS, TWO_EVENTS
from traps_pipeline.protocol.regimes import GUIDED, PROBE_PROMPT, PROMPTING
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    from traps_pipeline.mechanism.stored_states import StoredStates

_source = partial(source, group=GROUP, kinds=["yaml"], scheme=EXTRACTION)
_stage = partial(stage, group=GROUP, scheme=EXTRACTION, cost="machine")
_STATES = dep(hidden_states, by_extraction, need="some")
_ANSWERED_DATASETS = (*DATASETS, *PROBED_ARMS)
_GATED = these_keys(
    CELL, [Cell(d, Evaluation(m, r, 1)).key for d in _ANSWERED_DATASETS for m in local_models() for r in PROMPTING]
)


def _with_random(key: str) -> list[str]:
    """Return the extraction that is compared with states (of random weights, too) under its prompt."""
    extraction = Extraction.parse(key)
    return [Extraction(extraction.model, PROBE_PROMPT).key] if extraction.text == PROBE_PROMPT else []


_COMPARED = [
    _STATES,  # those of random weights are upstream of their probes
    dep(probes, to_keys(EXTRACTION, EXTRACTION, _with_random), need="some"),
    dep(probe_items, EVERY),
    probing_settings,
]


@_source()
def patching_settings(workspace: Workspace, key: str) -> str:
    """Return the version of patching's checkpoint, precision, prompt, pairs, sites."""
    return patching_version(workspace, Extraction.parse(key))


@_source()
def sentence_settings(workspace: Workspace, key: str) -> str:
    """Return the version of sentences' checkpoint, precision, prompt and texts."""
    return sentence_version(workspace, Extraction.parse(key))


def _model(workspace: Workspace, key: str) -> tuple[ModelEntry, Extraction]:
    from traps_pipeline.mechanism.stages import examined_model

    extraction = Extraction.parse(key)
    return examined_model(workspace, extraction.model), extraction


def _model_and_states(workspace: Workspace, key: str) -> "tuple[ModelEntry, StoredStates]":
    from traps_pipeline.mechanism.stored_states import StoredStates

    model, extraction = _model(workspace, key)
    return model, StoredStates.of(workspace, extraction)


def _is_trained(_: StudyPartitions, key: str) -> bool:
    return Extraction.parse(key).weights_seed is None


@_stage(
    tables.PROBE_BASELINES,  # on this machine, since the output margin needs the model's head
    code="4",
    parents=[_STATES, dep(probe_items, EVERY), dep(verdicts, ANSWERED_CELLS, need="none"), probing_settings],
    kinds=["parquet", "scikitlearn"],
    wants=lambda _, key: Extraction.parse(key).prompt == PROBE_PROMPT,
)
def probe_baselines(workspace: Workspace, key: str) -> StageOutput:
    """Return probes on raw inputs, the output margin and noise instead of states."""
    from traps_pipeline.mechanism.baselines import baseline_rows

    return StageOutput(baseline_rows(workspace, *_model_and_states(workspace, key)))


def _is_gated(partitions: StudyPartitions, key: str) -> bool:
    """Return whether the model is also evaluated, so that a gate has answers."""
    extraction = Extraction.parse(key)
    evaluations = {(e.model, e.regime) for e in partitions.evaluations}
    return extraction.prompt == PROBE_PROMPT and any((extraction.model, r) in evaluations for r in PROMPTING)


_gates = partial(
    _stage,
    code="4",
    parents=[*_COMPARED, dep(verdicts, _GATED, need="some")],
    wants=_is_gated,
)


@_gates(tables.GATE)
def gate(workspace: Workspace, key: str) -> StageOutput:
    """Return scores before and after a gate, which turns answers into abstentions.

    The gate is a probe on the model's states, compared with gates on raw inputs, on the output margin and with shuffled
    labels.
    """
    from traps_pipeline.mechanism.gating import gate_rows

    return StageOutput(gate_rows(workspace, *_model_and_states(workspace, key)))


@_stage(
    tables.LENS,
    parents=[_STATES, probing_settings],
    wants=_is_trained,
)
def lens(workspace: Workspace, key: str) -> StageOutput:
    """Return the output margin of stored states at every layer (final norm and head)."""
    from traps_pipeline.mechanism.lens import lens_rows

    return StageOutput(lens_rows(workspace, *_model_and_states(workspace, key)))


@_stage(tables.LEADS, code="2", parents=_COMPARED, wants=lambda _, key: Extraction.parse(key).prompt == PROBE_PROMPT)
def leads(workspace: Workspace, key: str) -> StageOutput:
    """Return how well states and rivals order each dataset's sides, in the model and its controls."""
    from traps_pipeline.mechanism.leads import lead_rows

    return StageOutput(lead_rows(workspace, *_model_and_states(workspace, key)))


def _with_two_events(key: str) -> list[str]:
    """Return the extraction of two events whose layer an extraction's probes choose."""
    extraction = Extraction.parse(key)
    return [Extraction(extraction.model, GUIDED).key if extraction.prompt == PROBE_PROMPT else key]


@_stage(
    tables.INTERACTION,
    code="2",
    parents=[
        _STATES,
        dep(probes, to_keys(EXTRACTION, EXTRACTION, _with_two_events), need="some"),
        dep(probe_items, these_keys(PROBED, [TWO_EVENTS])),
        probing_settings,
    ],
    wants=lambda study, key: StatesCell(TWO_EVENTS, Extraction.parse(key)).key in study.states,
)
def interaction(workspace: Workspace, key: str) -> StageOutput:
    """Return how well states of two events tell, within a clip, that the asked event is hidden."""
    from traps_pipeline.mechanism.interaction import interaction_rows

    return StageOutput(interaction_rows(workspace, *_model(workspace, key)))


@_stage(
    tables.ITEM_SCORES,
    code="3",
    parents=[_STATES, dep(probes, SAME), dep(verdicts, _GATED, need="none"), probing_settings],
    wants=_is_gated,
)
def item_scores(workspace: Workspace, key: str) -> StageOutput:
    """Return items' scores from states and output, with verdicts; probes are held-out."""
    from traps_pipeline.mechanism.item_scores import item_score_rows

    return StageOutput(item_score_rows(workspace, *_model_and_states(workspace, key)))


def _has_sentences(partitions: StudyPartitions, key: str) -> bool:
    extraction = Extraction.parse(key)
    evaluations = {(e.model, e.regime) for e in partitions.evaluations}
    return partitions.has_sentences and (extraction.model, extraction.prompt) in evaluations


@_stage(
    tables.SENTENCES,
    code="2",
    parents=[dep(probe_items, EVERY, need="some"), dep(responses, _GATED, need="some"), sentence_settings],
    wants=_has_sentences,
)
def sentences(workspace: Workspace, key: str) -> StageOutput:
    """Return log-likelihoods of whole abstentions, and own answers, after every item."""
    from traps_pipeline.mechanism.sentences import sentence_rows

    return StageOutput(sentence_rows(workspace, *_model(workspace, key)))


@_stage(
    tables.PATCHING,
    parents=[dep(probe_items, EVERY, need="some"), patching_settings],
    wants=lambda study, key: study.patched_prompt == Extraction.parse(key).prompt,
    kinds=["parquet", "pytorch"],
)
def patching(workspace: Workspace, key: str) -> StageOutput:
    """Return indirect effects of exchanged states by layer and group, beside nulls."""
    from traps_pipeline.mechanism.patching_stage import patching_rows

    return StageOutput(patching_rows(workspace, *_model(workspace, key)))


_of_effects = partial(stage, code="2", group=GROUP, parents=[steering_effects], wants=steers)


@_of_effects(tables.STEERING_NULLS)
def steering_nulls(workspace: Workspace, _: None) -> list[tables.SteeringNullRow]:
    """Return each void direction's effect on its dataset among orthogonal nulls."""
    from traps_pipeline.mechanism.nulls import null_rows

    return null_rows(workspace.tables.read(STEERING_EFFECTS, {}))


@_of_effects(tables.STEERING_PECS)
def steering_pecs(workspace: Workspace, _: None) -> list[tables.SteeringPecsRow]:
    """Return the steered model's PECS by sign policy, and share of degenerate answers."""
    from traps_pipeline.mechanism.nulls import pecs_rows

    return pecs_rows(workspace.tables.read(STEERING_EFFECTS, {}))
