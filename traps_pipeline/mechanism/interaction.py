"""Tell whether states hold an interaction: that the event which is asked about is the hidden one.

Where a clip of two events hides exactly one, neither the clip nor the question tells alone, so that every raw input
that adds what they tell is at chance by design; the model's output is a rival that may tell. Over all eight items the
number of boards tells, with random weights too: that metric is the confound and claims nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from traps_pipeline.mechanism.baselines import output_or_note, probed_items, raw_features
from traps_pipeline.mechanism.control_rows import STATES, InteractionRow
from traps_pipeline.mechanism.gating import chosen_layers
from traps_pipeline.mechanism.mechanism_rows import PROBES
from traps_pipeline.mechanism.probes import auroc, auroc_interval, fit_probe, scenario_folds, share_interval
from traps_pipeline.mechanism.probing import each_layer
from traps_pipeline.mechanism.stored_states import StoredStates
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.protocol.cells import Extraction
from traps_pipeline.protocol.datasets import TWO_EVENTS
from traps_pipeline.protocol.regimes import PROBE_PROMPT
from traps_pipeline.protocol.two_events import lane_item
from traps_pipeline.scoring.bootstrap import scenario_weights
from traps_pipeline.storage.workspace import Workspace

DECIMALS = 9  # of a score: weights that are 0 but for rounding tie
HELD_OUT = ("scenarios", "families")


@dataclass(frozen=True, eq=False)
class LaneDesign:
    """Items of two events as arrays (n,): which event is hidden, and numbers of clip, scenario and family."""

    asked: np.ndarray
    other: np.ndarray
    clips: np.ndarray
    scenarios: np.ndarray
    families: np.ndarray

    @staticmethod
    def of(item_ids: Sequence[str]) -> LaneDesign:
        """Return the design of the items with these ids. Raises ValueError for an id of no lane."""
        items = [lane_item(item_id) for item_id in item_ids]
        hidden = (np.array([getattr(item, f"{name}_hidden") for item in items]) for name in ("asked", "other"))
        ids = [(f"{i.scenario_id}.{i.clip}", i.scenario_id, i.scenario_id.rpartition("-")[0]) for i in items]
        return LaneDesign(*hidden, *(pd.factorize(np.array(names))[0] for names in zip(*ids, strict=True)))


def interaction_rows(workspace: Workspace, entry: ModelEntry, extraction: Extraction) -> list[InteractionRow]:
    """Return INTERACTION rows of an extraction: of states at each layer, and of rivals."""
    settings, states = workspace.mechanism, StoredStates.of(workspace, extraction, [TWO_EVENTS])
    assert entry.media is not None, "local entries have media"
    design = LaneDesign.of([*states.items["item_id"]])
    resampling = (settings.probes.folds, settings.probes.resamples, settings.seed)
    raw = raw_features({TWO_EVENTS: probed_items(workspace, states, TWO_EVENTS)}, entry.media, workspace.resolve)
    pixels, words = raw["all frames"][TWO_EVENTS], raw["question words"][TWO_EVENTS]
    rivals = {"pixels": pixels, "words": words, "both added": np.hstack([pixels, words])}
    output = output_or_note("interaction", entry, states, states, [TWO_EVENTS])
    rivals |= {name: features[TWO_EVENTS] for name, features in ({"length": raw["length"]} | output).items()}
    chosen, joined = _chosen_layer(workspace, states), states.joined
    by_layer = each_layer(lambda n: lane_metrics(states.read(TWO_EVENTS, n), design, *resampling), states.n_layers)
    metrics = {(STATES, layer): of_layer for layer, of_layer in enumerate(by_layer)}
    metrics |= {(name, -1): lane_metrics(features, design, *resampling) for name, features in rivals.items()}
    return [
        InteractionRow(**joined, features=name, layer=layer, chosen=layer in (chosen, -1), held_out=held_out, **row)
        for (name, layer), by_held_out in metrics.items()
        for held_out, row in by_held_out.items()
    ]


def _chosen_layer(workspace: Workspace, states: StoredStates) -> int | None:
    """Return the layer that pairs of other datasets choose; None without their probes."""
    own = states.extraction
    probed = own if own.weights_seed is not None else Extraction(own.model, PROBE_PROMPT)
    if workspace.tables.state(PROBES, probed.partition) is None:
        return None
    return chosen_layers(workspace, StoredStates(workspace, probed, states.items), [TWO_EVENTS])[TWO_EVENTS]


def lane_metrics(
    features: np.ndarray, design: LaneDesign, folds: int, resamples: int, seed: int
) -> dict[str, dict[str, Any]]:
    """Return probe metrics of features (n, d), by what is held out of training."""
    one_hidden, result = design.asked != design.other, dict[str, dict[str, Any]]()
    of_one = design.scenarios[one_hidden]
    weights = scenario_weights(design.scenarios.max() + 1, resamples, seed)
    for name in HELD_OUT:
        groups = getattr(design, name)
        n_folds = min(folds, len(np.unique(groups)))
        if n_folds < 2:
            continue
        fold_of = scenario_folds(groups, n_folds, seed)
        scores = _unseen_scores(features, design.asked, fold_of, one_hidden)
        clip_scenarios, won = _within_clips(
            scores[one_hidden], design.asked[one_hidden], design.clips[one_hidden], of_one
        )
        counts = weights[:, clip_scenarios]
        draws = (counts @ won) / np.where(counts.any(axis=1), counts.sum(axis=1), np.nan)
        area = (design.asked[one_hidden], scores[one_hidden])
        auroc_low, auroc_high = auroc_interval(*area, of_one, weights)
        within_low, within_high = share_interval(draws, len(np.unique(clip_scenarios)))
        cells = [scores[(design.asked == a) & (design.other == o)].mean() for a, o in ((0, 0), (1, 0), (0, 1))]
        neither, asked, other = np.array(cells) / (scores.std() or 1.0)
        result[name] = {
            "auroc": float(auroc(*area)), "auroc_low": auroc_low, "auroc_high": auroc_high,
            "within": float(won.mean()), "within_low": within_low, "within_high": within_high,
            "confound": float(auroc(design.asked, _unseen_scores(features, design.asked, fold_of, fold_of >= 0))),
            "own_effect": float(asked - neither), "other_effect": float(other - neither),
            "same": _same_features(features[one_hidden], design.clips[one_hidden]),
            "n_clips": len(won), "n_scenarios": len(np.unique(design.scenarios)),
        }  # fmt: skip
    return result


def _unseen_scores(features: np.ndarray, label: np.ndarray, folds: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """Return scores (n,) of every item by probes fitted on the `fitted` items of other folds."""
    scores = np.empty(len(label))
    for fold in np.unique(folds):
        train = (folds != fold) & fitted
        scores[folds == fold] = fit_probe(features[train], label[train]).scores(features[folds == fold])
    return scores.round(DECIMALS)


def _same_features(features: np.ndarray, clips: np.ndarray) -> float:
    """Return the share of clips whose features are the same under both questions, but for rounding."""
    rounding = 1e-6 * np.abs(features).max()
    return float(np.mean([np.ptp(features[clips == clip], axis=0).max() <= rounding for clip in np.unique(clips)]))


def _within_clips(
    scores: np.ndarray, asked: np.ndarray, clips: np.ndarray, scenarios: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return each clip's scenario, and whether its hidden event's question is scored above the other one (ties .5)."""
    items = pd.DataFrame({"clip": clips, "scenario": scenarios, "asked": asked, "score": scores})
    sides = items.pivot(index=["clip", "scenario"], columns="asked", values="score").dropna()
    hidden, seen = (sides[side].to_numpy(float) for side in (True, False))
    return sides.index.get_level_values("scenario").to_numpy(int), (1 + np.sign(hidden - seen)) / 2
