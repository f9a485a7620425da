"""Extract states of an untrained network of the same class, sizes and prompts.

A gate on them uses only the inputs, through features that no training chose.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from traps_pipeline.mechanism.hidden_states import item_states
from traps_pipeline.mechanism.stages import probed_item
from traps_pipeline.mechanism.stored_states import StoredStates
from traps_pipeline.models.local.adapter import load_local_model
from traps_pipeline.models.local.library import load_transformers
from traps_pipeline.models.local.model import LocalModel
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.models.registry.prompts import states_prompt
from traps_pipeline.storage.workspace import Workspace


def untrained_model(entry: ModelEntry, seed: int) -> LocalModel:
    """Return the entry's network with random, unquantised weights: a second model."""
    import torch

    trained_model = load_local_model(entry, inside=True)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = load_transformers().AutoModelForImageTextToText.from_config(
            trained_model.network.config, dtype=trained_model.network.dtype
        )
    return LocalModel(
        network.to(trained_model.inputs_device).eval().requires_grad_(False),
        trained_model.processor,
        trained_model.checkpoint,
        trained_model.params,
        trained_model.device,
    )


def untrained_states(
    workspace: Workspace, entry: ModelEntry, states: StoredStates, items: Mapping[str, pd.DataFrame]
) -> dict[str, np.ndarray]:
    """Return the untrained network's states (n, d) of its middle block, by dataset."""
    model = untrained_model(entry, workspace.mechanism.seed)
    system, layer = states_prompt(workspace.mechanism.system, states.extraction.prompt), (model.n_layers + 1) // 2
    assert entry.media is not None, "local entries have media"
    states_by_dataset: dict[str, np.ndarray] = {}
    parts: dict[str, list[np.ndarray]] = {}
    for dataset, rows in items.items():
        keys = states.dataset(dataset)["states_key"]
        for key, row in zip(keys, rows.to_dict("records"), strict=True):
            if key not in states_by_dataset:
                item_row = {str(name): value for name, value in row.items()}
                item = probed_item(workspace, model, entry.media, item_row, system)
                states_by_dataset[key] = item_states(model, item, item.prompt(), workspace.mechanism.pooling).raw[layer]
            parts.setdefault(dataset, []).append(states_by_dataset[key])
    return {dataset: np.stack(vectors) for dataset, vectors in parts.items()}
