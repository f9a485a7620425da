"""Version settings, prompts and precision of mechanistic stages, without torch."""

from pathlib import Path
from typing import Any

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.mechanism_rows import DIRECTIONS
from traps_pipeline.mechanism.transfer_paths import CURVES
from traps_pipeline.models.local.capture import OF_PAIRS
from traps_pipeline.models.registry.entries import ModelEntry, effective_params, get_model
from traps_pipeline.models.registry.prompts import states_prompt, system_prompt
from traps_pipeline.protocol.cells import Extraction, StatesCell
from traps_pipeline.storage.benchmark_tables import VIDEOS
from traps_pipeline.storage.media import profile_digest
from traps_pipeline.storage.study import MechanismSettings
from traps_pipeline.storage.workspace import Workspace

SAMPLING = ("do_sample", "temperature", "top_p", "max_new_tokens")


def loaded_params(entry: ModelEntry) -> dict[str, Any]:
    """Return a local model's parameters that its states depend on, without sampling."""
    local_params, omitted_names = entry.inside_params(), (*SAMPLING, "nf4_skip")
    params = {name: value for name, value in effective_params(entry, "standard").items() if name not in omitted_names}
    nf4_skip = {"nf4_skip": [*local_params.nf4_skip]} if local_params.nf4_skip else {}
    return params | {"quantisation": local_params.quantisation} | nf4_skip


def mechanism_entry(entry: ModelEntry, settings: MechanismSettings) -> ModelEntry:
    """Return a model's entry with the media settings of the study's `mechanism`."""
    media = settings.models[entry.id].media
    return entry if media is None else entry.model_copy(update={"media": media})


def joined_models(entry: ModelEntry, settings: MechanismSettings) -> str | None:
    """Return in words the two models that a row joins (one of states, one of answers); None for one.

    They are two if the entry is looked into in another precision than it answers in, or on other frames.
    """
    states, answers = mechanism_entry(entry, settings).media, entry.media
    inside, asked = entry.inside_params(), entry.local_params()
    if (inside, states) == (asked, answers):
        return None
    sides = (("states", inside, states), ("answers", asked, answers))
    return "; ".join(
        f"{name}: {params.dtype if params.quantisation == 'none' else params.quantisation}, "
        + (f"{media.uniform} frames" if media.uniform else f"{media.fps:g} frames a second")
        for name, params, media in sides
        if media
    )


def states_folder(workspace: Workspace, cell: StatesCell) -> Path:
    """Return the path of the folder of a partition's shards."""
    return workspace.root / "states" / cell.extraction.model / cell.extraction.prompt / cell.dataset


def has_states(workspace: Workspace, cell: StatesCell) -> bool:
    """Return whether an extraction is finished and all of its files still exist."""
    from traps_pipeline.storage.parquet import read_sealed

    folder = states_folder(workspace, cell)
    try:
        shards = set(read_sealed(workspace.store.here(folder / "ids.parquet"))["shard"].to_pylist())
    except (OSError, ValueError, KeyError, TrapsError):
        return False
    files = {folder / f"{shard}{ending}" for shard in shards for ending in (".safetensors", ".parquet")}
    return workspace.store.sizes(files).keys() == files


def has_directions(workspace: Workspace, extraction: Extraction) -> bool:
    """Return whether all files in the directions table of an extraction exist."""
    paths = {workspace.root / path for path in workspace.tables.read(DIRECTIONS, extraction.partition)["path"]}
    files = paths | {path.with_suffix(".json") for path in paths}
    return workspace.store.sizes(files).keys() == files


def extraction_version(workspace: Workspace, extraction: Extraction) -> str:
    """Return the digest of checkpoint, precision, frames, VQA prompt and pooling."""
    entry, settings = get_model(extraction.model), workspace.study.mechanism
    if settings is not None and entry.id in settings.models:
        entry = mechanism_entry(entry, settings)
    media = profile_digest(entry.media) if entry.media else None
    pooling = settings.pooling if settings else None
    system = states_prompt(settings.system if settings else "vqa", extraction.text)
    made_of = [loaded_params(entry), media, system, pooling]
    if extraction.weights_seed is not None:
        made_of.append(extraction.weights_seed)
    if pooling in OF_PAIRS:  # an item's states depend on the other clip of its scenario, which is not in its own table
        made_of.append(sorted(workspace.tables.read_all(VIDEOS, ["file_sha256"])["file_sha256"]))
    return digest(made_of)[:16]


def probing_version(workspace: Workspace, extraction: Extraction) -> str:
    """Return the digest of the study's settings for a model's probes and directions."""
    settings = workspace.study.mechanism
    if settings is None or extraction.model not in settings.models:
        return "none"
    steering = settings.steering
    pairs: list[Any] = [steering.well_posed_pairs, steering.ill_posed_pairs, steering.pairs] if steering else []
    if steering and steering.nulls:
        pairs.append(steering.nulls.model_dump(mode="json"))
    layers = settings.models[extraction.model]
    gate = settings.gate.model_dump(mode="json")
    return digest([settings.probes.model_dump(mode="json"), layers.centroid, pairs, settings.seed, CURVES, gate])[:16]


def sentence_version(workspace: Workspace, extraction: Extraction) -> str:
    """Return the digest of states' inputs, sentences and prompt, without items."""
    settings = workspace.study.mechanism
    if settings is None or extraction.model not in settings.models:
        return "none"
    prompt = system_prompt(extraction.text)
    return digest([extraction_version(workspace, extraction), list(settings.sentences), prompt])[:16]


def patching_version(workspace: Workspace, extraction: Extraction) -> str:
    """Return the digest of states' inputs, pairs, sites and seed, without items."""
    settings = workspace.study.mechanism
    if settings is None or settings.patching is None or extraction.model not in settings.models:
        return "none"
    inputs = settings.patching.model_dump(mode="json"), settings.seed
    return digest([extraction_version(workspace, extraction), *inputs])[:16]


def steering_version(workspace: Workspace, run: str) -> str:
    """Return the digest of the study's settings, model and prompt of steered answers."""
    model, _, regime = run.split("__")
    entry, settings = get_model(model), workspace.study.mechanism
    if settings is None or settings.steering is None or model not in settings.models:
        return "none"
    entry = mechanism_entry(entry, settings)
    inputs = settings.steering.model_dump(mode="json"), settings.models[model].model_dump(mode="json"), settings.seed
    media = profile_digest(entry.media) if entry.media else None
    return digest([*inputs, loaded_params(entry), media, system_prompt(regime)])[:16]
