"""Run the mechanistic stages; each reads tables and returns the rows of one."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.base import progress
from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.mechanism.directions import (
    Directions,
    Origin,
    direction_scenarios,
    extract_directions,
    load_directions,
    save_directions,
    vector_digest,
)
from traps_pipeline.mechanism.mechanism_rows import (
    DIRECTIONS,
    PROBE_ITEMS,
    DirectionRow,
    HiddenStatesRow,
    ProbeRow,
)
from traps_pipeline.mechanism.probe_items import other_clip
from traps_pipeline.mechanism.probing import (
    Confabulated,
    NothingConfabulated,
    ProbeRun,
    confabulated_scenarios,
)
from traps_pipeline.mechanism.probing_versions import mechanism_entry, states_folder
from traps_pipeline.mechanism.stored_states import StoredStates
from traps_pipeline.models.registry.entries import LOCAL, ModelEntry, get_model
from traps_pipeline.models.registry.prompts import states_prompt
from traps_pipeline.protocol.cells import Cell, Evaluation, Extraction, StatesCell
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.storage.media import MediaSpec
from traps_pipeline.storage.study import MechanismSettings
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    import pandas as pd

    from traps_pipeline.mechanism.hidden_states import Item
    from traps_pipeline.models.local.adapter import LocalModel


def examined_model(workspace: Workspace, model: str) -> ModelEntry:
    """Return a local model's entry with the media of the `mechanism` section. Raises TrapsError for another one."""
    entry, settings = get_model(model), workspace.mechanism
    if entry.backend != LOCAL:
        local = ", ".join(name for name in settings.models if get_model(name).backend == LOCAL) or "none of the study's"
        raise TrapsError(
            f"{model}: is asked through backend {entry.backend}, and only local models have hidden states to read; "
            f"local models: {local}"
        )
    if model not in settings.models:
        raise TrapsError(f"study.yaml: mechanism.models does not name {model}; add it with its layers")
    return mechanism_entry(entry, settings)


# --- hidden states ----------------------------------------------------------------------------------------------------


def extract_states(workspace: Workspace, cell: StatesCell) -> tuple[list[HiddenStatesRow], int]:
    """Extract a partition's missing states; return its rows, and how many are new."""
    from traps_pipeline.mechanism.hidden_states import extract, read_layer, read_record
    from traps_pipeline.models.local.adapter import load_local_model

    entry, settings = examined_model(workspace, cell.extraction.model), workspace.mechanism
    assert entry.media is not None, "local entries have media"
    items = workspace.tables.read(PROBE_ITEMS, {"dataset": cell.dataset}).to_dict("records")
    model = load_local_model(entry, inside=True, seed=cell.extraction.weights_seed)
    system = states_prompt(settings.system, cell.text)
    _check_layers(workspace, entry.id, model.n_layers)
    folder = states_folder(workspace, cell)
    asked_of = [
        probed_item(workspace, model, entry.media, {str(k): v for k, v in item.items()}, system) for item in items
    ]
    existing = workspace.store.below(folder)
    workspace.store.bring(existing)
    n_new = extract(model, asked_of, folder, pooling=settings.pooling, noun=f"items of {cell.key}")
    files = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    workspace.store.keep(files)
    workspace.store.remove({*existing} - {*files})
    record, (ids, _) = read_record(folder), read_layer(folder, 0)
    keys, devices = (dict(zip(ids["item_id"], ids[name], strict=True)) for name in ("key", "device"))
    source = {name: record[name] for name in ("checkpoint", "checkpoint_digest", "dtype", "quantisation", "pooling")}
    columns = ("item_id", "scenario_id", "side", "sub_scenario", "benchmark_version")
    rows = [
        HiddenStatesRow(
            **{name: item[name] for name in columns},
            **source,
            dataset=cell.dataset,
            model=cell.extraction.model,
            prompt=cell.extraction.prompt,
            states_key=keys[item["item_id"]],
            device=devices[item["item_id"]],
            folder=workspace.relative(folder),
            n_layers=record["n_layers"],
            width=record["d_model"],
        )
        for item in items
    ]
    return rows, n_new


def probed_item(workspace: Workspace, model: LocalModel, spec: MediaSpec, row: Mapping[str, Any], system: str) -> Item:
    """Return the forward pass of a row of PROBE_ITEMS. Raises TrapsError if a pooling lacks the other clip."""
    from traps_pipeline.mechanism.hidden_states import clip_item
    from traps_pipeline.models.local.capture import OF_PAIRS

    other_prompt = other_clip(workspace, row) if workspace.mechanism.pooling in OF_PAIRS else None
    return clip_item(model, spec, row, workspace.resolve(row["clip"]), system, other_prompt)


def unsound_layers(workspace: Workspace, cell: StatesCell, n_layers: int) -> list[int]:
    """Return those of the first and last layer whose stored states contain non-finite numbers."""
    from traps_pipeline.mechanism.hidden_states import read_layer

    folder = workspace.bring_folder(states_folder(workspace, cell))
    return [layer for layer in (0, n_layers) if not np.isfinite(read_layer(folder, layer)[1]).all()]


def _check_layers(workspace: Workspace, model: str, n_layers: int) -> None:
    """Raise TrapsError, before a long extraction, for a layer that the model lacks."""
    layers = workspace.mechanism.models[model]
    for name, layer in (
        ("steering", layers.steering),
        ("centroid", layers.centroid),
        *(("sweep", n) for n in layers.sweep),
    ):
        if layer > n_layers:
            raise TrapsError(
                f"mechanism.models.{model}.{name}: layer {layer} is out of range, {model} has blocks 1 to {n_layers} "
                "(layer 0 is the embeddings); name one of these in the experiment and in study.yaml"
            )


# --- probes -----------------------------------------------------------------------------------------------------------


def probe_rows(workspace: Workspace, extraction: Extraction) -> list[ProbeRow]:
    """Return PROBES rows of an extraction."""
    examined_model(workspace, extraction.model)
    states, settings = StoredStates.of(workspace, extraction), workspace.mechanism
    is_random = extraction.weights_seed is not None  # which answers nothing
    confabulated = Confabulated({}) if is_random else confabulations(workspace, extraction.model)
    centroid, n_layers = settings.models[extraction.model].centroid, states.n_layers
    run = ProbeRun(states.items, states.read, n_layers, centroid, settings.probes, settings.seed, confabulated)
    tick = partial(progress.current().tick, "probes", f"layers of {extraction.key}")
    rows = run.rows(tick, comparable=is_random)
    return [ProbeRow(**row, model=extraction.model, prompt=extraction.prompt) for row in rows]


def confabulations(workspace: Workspace, model: str) -> Confabulated:
    """Return the scenarios whose void the model answered under standard in run 1, by dataset."""
    scenarios: dict[str, frozenset[str]] = {}
    problems: dict[str, str] = {}
    for dataset in DATASETS:
        cell = Cell(dataset, Evaluation(model, "standard", 1))
        if workspace.tables.state(VERDICTS, cell.partition) is None:
            problems[dataset] = f"there are no verdicts {cell.key}; run the model under standard first"
            continue
        try:
            scenarios[dataset] = confabulated_scenarios(workspace.tables.read(VERDICTS, cell.partition), dataset, model)
        except NothingConfabulated as error:
            problems[dataset] = str(error)
    return Confabulated(scenarios, problems)


# --- directions -------------------------------------------------------------------------------------------------------


def directions_file(workspace: Workspace, extraction: Extraction, dataset: str) -> Path:
    """Return the path of the file of a dataset's directions."""
    return workspace.root / "directions" / extraction.model / extraction.prompt / f"{dataset}.safetensors"


def direction_rows(workspace: Workspace, extraction: Extraction) -> list[DirectionRow]:
    """Compute and save directions of every dataset with states; return their rows."""
    examined_model(workspace, extraction.model)
    states = StoredStates.of(workspace, extraction)
    rows: list[DirectionRow] = []
    for dataset in DATASETS:
        if not states.dataset(dataset).empty:
            rows += _dataset_directions(workspace, states, dataset)
    if not rows:
        raise TrapsError(
            f"directions {extraction.key}: no hidden states of any dataset; materialize hidden_states first"
        )
    return rows


def direction_pairs(
    settings: MechanismSettings, dataset: str, items: pd.DataFrame
) -> tuple[list[str], list[int], list[int]]:
    """Return a direction's scenarios, and rows of their voids and controls. Raises TrapsError without steering."""
    steering = settings.steering
    if steering is None:
        raise TrapsError(
            "study.yaml: mechanism.steering is null, so the number of pairs for a direction is not known; set it there "
            "and in the experiment"
        )
    selection = direction_scenarios(sorted(set(items["scenario_id"])), steering.direction_pairs(dataset), settings.seed)
    place = {
        (name, side): row for row, (name, side) in enumerate(zip(items["scenario_id"], items["side"], strict=True))
    }
    voids, controls = ([place[name, side] for name in selection] for side in ("void", "control"))
    return selection, voids, controls


def _dataset_directions(workspace: Workspace, states: StoredStates, dataset: str) -> list[DirectionRow]:
    settings, items = workspace.mechanism, states.dataset(dataset)
    steering = settings.steering
    scenarios, *sides = direction_pairs(settings, dataset, items)
    assert steering is not None, "direction_pairs refuses a study that steers nothing"
    layers = [states.read(dataset, layer) for layer in range(states.n_layers)]
    voids, controls = (np.stack([layer_states[rows] for layer_states in layers]) for rows in sides)
    seed = [settings.seed, DATASETS.index(dataset)]
    nulls = steering.nulls
    kinds, draws = (nulls.kinds, nulls.draws) if nulls else ((), 1)
    directions = extract_directions(voids, controls, seed, kinds, draws)
    path = directions_file(workspace, states.extraction, dataset)
    scenario_items = items.loc[items["scenario_id"].isin(scenarios)]
    first = scenario_items.iloc[0]
    origin = Origin(
        **states.extraction.partition,
        **{name: str(first[name]) for name in ("checkpoint", "checkpoint_digest", "dtype", "quantisation", "pooling")},
        dataset=dataset,
        seed=settings.seed,
        scenarios=tuple(scenarios),
        states_digest=digest(sorted(scenario_items["states_key"])),
    )
    save_directions(path, directions, origin)
    workspace.store.keep([path, path.with_suffix(".json")])
    return [
        DirectionRow(
            model=states.extraction.model,
            prompt=states.extraction.prompt,
            dataset=dataset,
            kind=kind,
            draw=draw,
            layer=layer,
            n_pairs=len(scenarios),
            norm=float(directions.gaps[layer]),
            cosine=float(vectors[layer] @ directions.void[layer]),
            residual_norm=float(directions.residual_norms[layer]),
            width=voids.shape[2],
            path=workspace.relative(path),
            direction_digest=vector_digest(vectors[layer]),
            pooling=origin.pooling,
        )
        for kind, kind_vectors in directions.vectors.items()
        for draw, vectors in enumerate(kind_vectors)
        for layer in range(states.n_layers)
    ]


def saved_directions(workspace: Workspace, extraction: Extraction) -> dict[str, Directions]:
    """Return the saved directions by dataset. Raises TrapsError if a file and the table differ."""
    table = workspace.tables.read(DIRECTIONS, extraction.partition)
    result = {}
    for path in sorted(set(table["path"])):
        workspace.bring([path, str(Path(path).with_suffix(".json"))])
        directions, description = load_directions(workspace.root / path)
        rows = table.loc[(table["path"] == path) & (table["kind"] == "void")].sort_values("layer")
        if [vector_digest(vector) for vector in directions.void] != list(rows["direction_digest"]):
            raise TrapsError(
                f"{path}: differs from the directions in the table; delete it, then `traps run` makes it again"
            )
        result[description["dataset"]] = directions
    return result
