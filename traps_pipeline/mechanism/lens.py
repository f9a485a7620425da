"""Compute the output margin by layer: a logit lens on stored states.

Without any pass, the stored states go through the model's own final norm and head. At the last layer the result is the
output margin itself. The curve shows at which layer a prompt decides whether a void is answered.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from traps_pipeline.base import progress
from traps_pipeline.mechanism.baselines import NoMargin, margin_tokens
from traps_pipeline.mechanism.control_rows import LensRow
from traps_pipeline.mechanism.margin import first_token_margins
from traps_pipeline.mechanism.probes import auroc, auroc_interval
from traps_pipeline.mechanism.stored_states import StoredStates
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.scoring.bootstrap import scenario_weights
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    from traps_pipeline.models.local.adapter import LocalModel


def lens_rows(workspace: Workspace, entry: ModelEntry, states: StoredStates) -> list[LensRow]:
    """Return LENS rows of an extraction: every dataset of pairs at every layer.

    There are none if states are means over tokens, or if no token of the vocabulary begins an abstention; a note says
    so.
    """
    try:
        model, tokens = margin_tokens(entry, states)
    except NoMargin as error:
        progress.current().note(f"lens: no margin ({error})")
        return []
    settings, rows = workspace.mechanism, list[LensRow]()
    for dataset in [name for name in DATASETS if len(states.dataset(name))]:
        items = states.dataset(dataset)
        void, scenario = (items["side"] == "void").to_numpy(), pd.factorize(items["scenario_id"])[0]
        weights = scenario_weights(scenario.max() + 1, settings.probes.resamples, settings.seed)
        for layer in range(states.n_layers):
            margins = layer_margins(model, states.read(dataset, layer), tokens)
            low, high = auroc_interval(void, margins, scenario, weights)
            rows.append(
                LensRow(
                    **states.extraction.partition,
                    dataset=dataset,
                    layer=layer,
                    voids=float(margins[void].mean()),
                    controls=float(margins[~void].mean()),
                    auroc=float(auroc(void, margins)),
                    low=low,
                    high=high,
                    n_voids=int(void.sum()),
                    n_controls=int((~void).sum()),
                )
            )
    return rows


def layer_margins(model: LocalModel, states: Any, tokens: list[int]) -> np.ndarray:
    """Return the output margins (n,) of block outputs (n, d), computed by the final norm and the head."""
    import torch

    with torch.inference_mode():
        raw = torch.as_tensor(np.asarray(states)).to(model.inputs_device, model.network.dtype)
        return first_token_margins(model, model.norm(raw), tokens).double().numpy()
