"""Contrast-consistent search (Burns et al. 2023): a probe that is fitted without labels, on states of a statement and
of its negation.

A question about a clip has no negation, so the model is shown the question twice, once followed by the statement that
the video settles it and once by the statement that it does not (`STATEMENTS`). The probe gives each a probability, and
is fitted such that the two add up to one and are not both a half. Which of its two ends means void it cannot know: that
one bit is taken from the labels of the items that it is fitted on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.mechanism_rows import PROBE_ITEMS
from traps_pipeline.mechanism.probes import Scorer, auroc, standardiser
from traps_pipeline.mechanism.stages import examined_model
from traps_pipeline.mechanism.stored import StoredStates
from traps_pipeline.models.prompts import states_prompt
from traps_pipeline.protocol.cells import Extraction
from traps_pipeline.storage.workspace import Workspace

STATEMENTS = (
    "Statement: the video shows what answers this question.",
    "Statement: the video does not show what answers this question.",
)
STARTS = 10  # random starts; the one with the smallest loss is taken
PENALTY = 0.01  # weight of half the mean squared coefficient; without it many probes have a loss of 0


def contrast_states(
    workspace: Workspace, extraction: Extraction, layer: int, datasets: Sequence[str]
) -> dict[str, np.ndarray]:
    """By dataset, (n, 2 d) float32 in the order of the study's hidden states: the states of each item's last token
    behind the question with the statement, and with its negation. Two passes an item, which are not kept.

    Raises TrapsError for a dataset without hidden states, and for a layer that the model lacks.
    """
    from traps_pipeline.mechanism.hidden_states import clip_item
    from traps_pipeline.models.local.adapter import load_local_model

    entry, own = examined_model(workspace, extraction.model), StoredStates.of(workspace, extraction)
    assert entry.media is not None, "local entries have media"
    model, system = load_local_model(entry, inside=True), states_prompt(workspace.mechanism.system, extraction.prompt)
    if not 0 <= layer <= model.n_layers:
        raise TrapsError(f"{entry.id}: no layer {layer}; it has 0 (embeddings) to {model.n_layers}")

    def both(item: dict[str, Any]) -> np.ndarray:
        times = workspace.resolve(item["times_clip"]) if isinstance(item["times_clip"], str) else None
        asked = [item | {"question": f"{item['question']} {statement}"} for statement in STATEMENTS]
        assert entry.media is not None
        parts = [
            clip_item(model, entry.media, row, workspace.resolve(item["clip"]), system, times).prompt() for row in asked
        ]
        with model.remembering_clips():
            return np.concatenate([model.forward_states(part).raw[layer] for part in parts])

    made = {}
    for dataset in datasets:
        rows = workspace.tables.read(PROBE_ITEMS, {"dataset": dataset}).set_index("item_id", drop=False)
        order = own.dataset(dataset)["item_id"]
        if order.empty:
            raise TrapsError(f"no hidden states of {dataset}; materialize hidden_states for it first")
        made[dataset] = np.stack([both({str(k): v for k, v in rows.loc[item].items()}) for item in order])
    return made


def ccs(states: np.ndarray, void: np.ndarray) -> Scorer:
    """The probe of contrast-consistent search. states: (n, 2 d) of `contrast_states`; void (n,) decides only which end
    means void. Each half is standardised by itself, so that what the words of the statement alone do is taken out."""
    from scipy.optimize import minimize

    states = np.asarray(states, float)
    if states.ndim != 2 or states.shape[1] % 2:
        raise TrapsError(f"states {states.shape} are not pairs; contrast-consistent search takes `inside.contrast`")
    mean, scale = standardiser(states)
    yes, no = np.split((states - mean) / scale, 2, axis=1)
    rng, width = np.random.default_rng(0), yes.shape[1]
    starts = [np.append(rng.normal(size=width) / np.sqrt(width), 0.0) for _ in range(STARTS)]
    found = [minimize(_loss, start, (yes, no), jac=True, method="L-BFGS-B") for start in starts]
    best = min(found, key=lambda one: float(one.fun)).x
    probe = ContrastProbe(mean, scale, best[:-1])
    return probe if auroc(void, probe.scores(states)) >= 0.5 else ContrastProbe(mean, scale, -best[:-1])


@dataclass(frozen=True, eq=False)
class ContrastProbe:
    """mean, scale: (2 d,), of the source. weights: (d,)."""

    mean: np.ndarray
    scale: np.ndarray
    weights: np.ndarray

    def scores(self, states: np.ndarray) -> np.ndarray:
        """Half the log-odds of the negation less those of the statement, (n,), for states (n, 2 d)."""
        yes, no = np.split((states - self.mean) / self.scale, 2, axis=1)
        return (no - yes) @ self.weights / 2


def _loss(values: np.ndarray, yes: np.ndarray, no: np.ndarray) -> tuple[float, np.ndarray]:
    """Consistency, (p + q - 1)^2, and confidence, min(p, q)^2, of the probabilities of a statement and of its negation,
    mean over items, with the penalty; and its gradient. values: weights and intercept, (d + 1,)."""
    weights, intercept = values[:-1], values[-1]
    p, q = (1 / (1 + np.exp(-np.clip(side @ weights + intercept, -40, 40))) for side in (yes, no))
    off, low = p + q - 1, np.minimum(p, q)
    by_p = (2 * off + 2 * low * (p <= q)) * p * (1 - p) / len(p)
    by_q = (2 * off + 2 * low * (p > q)) * q * (1 - q) / len(q)
    loss = float((off**2 + low**2).mean() + PENALTY * (weights**2).mean() / 2)
    slope = yes.T @ by_p + no.T @ by_q + PENALTY * weights / len(weights)
    return loss, np.append(slope, by_p.sum() + by_q.sum())
