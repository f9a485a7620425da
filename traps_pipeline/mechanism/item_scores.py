"""Compare states and output item by item: a void may be encoded, expressed or not.

Every score of states comes from a probe that was fitted without the item's scenario, at the layer chosen without the
item's dataset, relative to the probe's own mid threshold (half-way between the sides' means).
"""

from typing import Any

import numpy as np

from traps_pipeline.mechanism.baselines import MARGIN, output_or_note
from traps_pipeline.mechanism.control_rows import ItemScoreRow
from traps_pipeline.mechanism.gate import MID, OTHER_DATASETS, gate_answers, sources_of_gate
from traps_pipeline.mechanism.gating import chosen_layers, gate_items, gate_table, outcomes_of, read_states
from traps_pipeline.mechanism.stored_states import StoredStates
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.protocol.regimes import PROMPTING
from traps_pipeline.storage.workspace import Workspace


def item_score_rows(workspace: Workspace, entry: ModelEntry, states: StoredStates) -> list[ItemScoreRow]:
    """Return ITEM_SCORES of an extraction, a row per item of the pairs' datasets."""
    settings, table = workspace.mechanism, gate_table(states)
    datasets = [name for name in DATASETS if len(states.dataset(name))]
    layers = chosen_layers(workspace, states, datasets)
    outcomes = {regime: outcomes_of(workspace, entry.id, regime, states) for regime in PROMPTING}
    margins = output_or_note("item_scores", entry, states, states, datasets).get(MARGIN, {})
    probe_settings = {"folds": settings.probes.folds, "seed": settings.seed, "false_abs": settings.gate.false_abs}
    rows, joined = list[ItemScoreRow](), states.joined
    for dataset in datasets:
        features = read_states(states, [*dict.fromkeys(table["dataset"])], layers[dataset])
        scores = np.full(len(states.dataset(dataset)), np.nan)
        if sources_of_gate(OTHER_DATASETS, dataset, datasets):
            items = gate_items(table, features, shuffled=False, seed=settings.seed)
            decision = gate_answers(items, OTHER_DATASETS, dataset, **probe_settings)
            scores = decision.score - decision.threshold[MID]
        for place, item in enumerate(states.dataset(dataset).to_dict("records")):
            abstained: dict[str, Any] = {
                f"abstained_{regime}": _decision(outcome[dataset].abstained[place] if outcome else np.nan)
                for regime, outcome in outcomes.items()
            }
            rows.append(
                ItemScoreRow(
                    **joined,
                    **{name: item[name] for name in ("item_id", "dataset", "scenario_id", "side")},
                    layer=layers[dataset],
                    others=_number(scores[place]),
                    margin=float(margins[dataset][place, 0]) if margins else None,
                    **abstained,
                )
            )
    return rows


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _decision(value: float) -> bool | None:
    return bool(value) if np.isfinite(value) else None
