"""What the mechanistic stages depend on besides tables: versions of settings, prompts and precision, without torch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from traps_pipeline.digests import digest
from traps_pipeline.models.local.settings import Quantisation
from traps_pipeline.models.media import profile_digest
from traps_pipeline.models.prompts import system_prompt, vqa_prompt
from traps_pipeline.models.registry import ModelEntry, effective_params, get_model
from traps_pipeline.partitions import Extraction, StatesCell
from traps_pipeline.storage.workspace import Workspace

SAMPLING = ("do_sample", "temperature", "top_p", "max_new_tokens")


def quantisation_of(entry: ModelEntry) -> Quantisation:
    """The quantisation that a model is looked into with: of `mechanism:` of its entry, else that it answers with."""
    own = entry.mechanism.quantisation if entry.mechanism else None
    return own or entry.local_params().quantisation


def loaded_params(entry: ModelEntry) -> dict[str, Any]:
    """What decides a local model's states: its parameters without those of sampling, in the precision that it is looked
    into with."""
    params = {name: value for name, value in effective_params(entry, "standard").items() if name not in SAMPLING}
    return params | {"quantisation": quantisation_of(entry)}


def states_folder(workspace: Workspace, cell: StatesCell) -> Path:
    """Where the shards of a partition lie."""
    return workspace.root / "states" / cell.extraction.model / cell.extraction.prompt / cell.dataset


def states_are_there(workspace: Workspace, cell: StatesCell) -> bool:
    """Whether an extraction was finished there and not removed since."""
    return (states_folder(workspace, cell) / "ids.parquet").is_file()


def extraction_version(workspace: Workspace, extraction: Extraction) -> str:
    """Of what decides hidden states besides items: checkpoint and precision, frames, VQA prompt, pooling."""
    entry, settings = get_model(extraction.model), workspace.study.mechanism
    media = profile_digest(entry.media) if entry.media else None
    pooling = settings.pooling if settings else None
    return digest([loaded_params(entry), media, vqa_prompt(extraction.prompt), pooling])[:16]


def probing_version(workspace: Workspace, extraction: Extraction) -> str:
    """Of the study's settings of probes and directions of a model."""
    settings = workspace.study.mechanism
    if settings is None or extraction.model not in settings.models:
        return "none"
    steering = settings.steering
    pairs = [steering.well_posed_pairs, steering.ill_posed_pairs, steering.pairs] if steering else []
    layers = settings.models[extraction.model]
    return digest([settings.probes.model_dump(mode="json"), layers.centroid, pairs, settings.seed])[:16]


def steering_version(workspace: Workspace, run: str) -> str:
    """Of what decides steered answers besides items and directions: the study's settings, the model, the prompt."""
    model, _, regime = run.split("__")
    entry, settings = get_model(model), workspace.study.mechanism
    if settings is None or settings.steering is None or model not in settings.models:
        return "none"
    asked = settings.steering.model_dump(mode="json"), settings.models[model].model_dump(mode="json"), settings.seed
    media = profile_digest(entry.media) if entry.media else None
    return digest([*asked, loaded_params(entry), media, system_prompt(regime)])[:16]
