"""Compute cosines of void directions, corrected for few pairs and shared controls.

A direction is a mean over pairs, so its noise makes its cosine with any other direction too small, and if two datasets
have the same controls, their common noise makes it too large. Products of *different* scenarios have neither: the
disattenuated cosine uses only them. The split half says how far other pairs give the same direction.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.directions import cosine_matrix
from traps_pipeline.mechanism.mechanism_rows import DIRECTIONS, CosineRow
from traps_pipeline.mechanism.nulls import nan_to_null
from traps_pipeline.mechanism.stages import direction_pairs, saved_directions
from traps_pipeline.mechanism.stored_states import StoredStates
from traps_pipeline.mechanism.transfer_paths import FAMILIES
from traps_pipeline.protocol.cells import Extraction
from traps_pipeline.protocol.datasets import taxonomy_of
from traps_pipeline.scoring.bootstrap import scenario_weights
from traps_pipeline.storage.workspace import Workspace

RESAMPLES, HALVINGS = 200, 50


@dataclass(frozen=True, eq=False)
class PairDifferences:
    """The state of the void minus that of the control, of each pair (n, d), and its scenario's number (n,)."""

    values: np.ndarray
    scenario: np.ndarray


def cross_product(first: PairDifferences, second: PairDifferences, weights: np.ndarray) -> np.ndarray:
    """Return the mean product of differences of two pairs of different scenarios, (draws,).

    It is an unbiased product of two mean differences.

    weights: (draws, scenarios), the count of each scenario.
    """
    products = first.values @ second.values.T
    is_other_scenario = (first.scenario[:, None] != second.scenario).astype(float)
    left_weights, right_weights = weights[:, first.scenario], weights[:, second.scenario]
    with np.errstate(invalid="ignore", divide="ignore"):
        return ((left_weights @ (products * is_other_scenario)) * right_weights).sum(axis=1) / (
            (left_weights @ is_other_scenario) * right_weights
        ).sum(axis=1)


def disattenuated(first: PairDifferences, second: PairDifferences, weights: np.ndarray) -> np.ndarray:
    """Return cosines corrected for noise, (draws,): above 1 at times, NaN for differences not longer than noise."""
    lengths = cross_product(first, first, weights) * cross_product(second, second, weights)
    is_defined = (lengths > 0) & (cross_product(first, first, weights) > 0)
    return np.where(
        is_defined, cross_product(first, second, weights) / np.sqrt(np.where(is_defined, lengths, 1)), np.nan
    )


def split_half(of: PairDifferences, seed: Sequence[int]) -> float:
    """Return the cosine of the directions of two halves of the pairs, averaged over random halvings."""
    products, n = of.values @ of.values.T, len(of.values)
    rng = np.random.default_rng([*seed])
    first = np.stack([rng.permutation(np.arange(n) < n // 2) for _ in range(HALVINGS)]).astype(float)
    second = 1 - first
    dot, first_norm, second_norm = (
        ((a @ products) * b).sum(axis=1) for a, b in ((first, second), (first, first), (second, second))
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        return float(np.mean(dot / np.sqrt(first_norm * second_norm)))


def cosine_rows(workspace: Workspace) -> list[CosineRow]:
    """Return COSINES of a model's void directions (dataset, VQA prompt) at one layer."""
    table = workspace.tables.read_all(DIRECTIONS, ["model", "prompt"])
    extractions = sorted({Extraction(str(m), str(p)) for m, p in zip(table["model"], table["prompt"], strict=True)})
    rows: list[CosineRow] = []
    for model in sorted({extraction.model for extraction in extractions}):
        rows += _model_rows(workspace, [candidate for candidate in extractions if candidate.model == model])
    if not rows:
        raise TrapsError("cosines: no directions yet; materialize directions first")
    return rows


def _model_rows(workspace: Workspace, extractions: Sequence[Extraction]) -> list[CosineRow]:
    rows_by_name = [
        (StoredStates.of(workspace, extraction), dataset, directions.void)
        for extraction in extractions
        for dataset, directions in saved_directions(workspace, extraction).items()
    ]
    pairs = [
        direction_pairs(workspace.mechanism, dataset, states.dataset(dataset)) for states, dataset, _ in rows_by_name
    ]
    ids = pd.Index(sorted({name for names, _, _ in pairs for name in names}))
    places = [ids.get_indexer(pd.Index(names)) for names, _, _ in pairs]
    taxonomies = {
        name: taxonomy_of(d) for (_, d, _), (names, _, _) in zip(rows_by_name, pairs, strict=True) for name in names
    }
    weights = _weights([taxonomies[name] for name in ids], workspace.mechanism.seed)
    rows: list[CosineRow] = []
    for layer in range(min(len(vectors) for _, _, vectors in rows_by_name)):
        cosines = cosine_matrix(np.stack([vectors[layer] for _, _, vectors in rows_by_name]))
        differences = []
        for (states, dataset, _), (_, voids, controls), place in zip(rows_by_name, pairs, places, strict=True):
            layer_states = np.asarray(states.read(dataset, layer), float)
            differences.append(PairDifferences(layer_states[voids] - layer_states[controls], place))
        halves = [split_half(of, [workspace.mechanism.seed, layer]) for of in differences]
        for i, (first, dataset, _) in enumerate(rows_by_name):
            for j, (second, other_dataset, _) in enumerate(rows_by_name):
                if np.isfinite(cosines[i, j]):
                    rows.append(
                        CosineRow(
                            model=first.extraction.model,
                            layer=layer,
                            prompt=first.extraction.prompt,
                            dataset=dataset,
                            other_prompt=second.extraction.prompt,
                            other_dataset=other_dataset,
                            cosine=float(cosines[i, j]),
                            **nan_to_null(
                                _figures(differences[i], differences[j], weights) | {"split_half": halves[i]}
                            ),
                        )
                    )
    return rows


def _figures(first: PairDifferences, second: PairDifferences, weights: np.ndarray) -> dict[str, float]:
    values = disattenuated(first, second, weights)
    low, high = (np.nan, np.nan)
    if np.isfinite(values[1:]).mean() > 0.5:
        low, high = np.nanquantile(values[1:], [0.025, 0.975])
    return {"disattenuated": float(values[0]), "low": float(low), "high": float(high)}


def _weights(taxonomies: Sequence[str], seed: int) -> np.ndarray:
    """Return scenario counts (1 + RESAMPLES, scenarios): ones, then draws by taxonomy."""
    weights, taxonomy_of = np.ones((1 + RESAMPLES, len(taxonomies))), np.array(taxonomies)
    for number, taxonomy in enumerate(FAMILIES):
        if n := int(np.count_nonzero(taxonomy_of == taxonomy)):
            weights[1:, taxonomy_of == taxonomy] = scenario_weights(n, RESAMPLES, [seed, number])
    return weights
