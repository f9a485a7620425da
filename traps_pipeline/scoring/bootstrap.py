"""Resampled figures and their percentile intervals: a cluster bootstrap over scenarios (docs/scoring.md, "Intervals").

A scenario is one draw of the world: its pairs in both datasets of its taxonomy, in every run, model and regime, stay
together. All cells of a taxonomy share one weight matrix, so two entries' resamples are paired, and their difference is
a paired difference (`contrasts`).

Because PECS clips J at 0, the interval of PECS for a strategy without discrimination (J = 0 up to chance) lies slightly
above 0 and need not contain 0; to test whether J differs from 0, use J (`leaderboard.pooled_j`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
import pandas as pd

from traps_pipeline.base.partitions import DATASETS, taxonomy_of
from traps_pipeline.scoring.metrics import COUNTS, decision_counts, pecs_of

TAXONOMIES = ("occlusion", "chaotic")
ENTRY = ["model", "regime", "dataset"]
RESAMPLED = ("acc", "abs_rec", "false_abs", "j", "pecs")
INTERVAL_COLUMNS = [f"{figure}_ci_{end}" for figure in RESAMPLED for end in ("low", "high")]
RESAMPLES, SEED = 10_000, 20260101


@dataclass(frozen=True)
class Resampled:
    """The mean over runs of every figure in every resample.

    entries: (model, regime, dataset or `overall`) of each row; values: (entries, RESAMPLED, resamples) float64, NaN
    where a denominator is 0, and for an `overall` entry without a run that has all four datasets.
    """

    entries: list[tuple[str, str, str]]
    values: np.ndarray

    def figure(self, name: str) -> np.ndarray:
        """The resamples of one figure: (entries, resamples)."""
        return self.values[:, RESAMPLED.index(name)]


def resample(verdicts: pd.DataFrame, resamples: int = RESAMPLES, seed: int = SEED) -> Resampled:
    """Resamples of every (model, regime) on each of its datasets, and overall: the equal-weight mean over the four
    datasets, over the runs that have all four. Figures are computed per run, then averaged.

    Memory: one float32 weight matrix (resamples, scenarios) per taxonomy, one (resamples, 6 x cells) product of a
    single model and regime, and the result: 200 kB per entry and figure at 10,000 resamples over four datasets.
    """
    items = pd.concat(
        [verdicts[["model", "regime", "dataset", "run", "scenario_id"]], decision_counts(verdicts)], axis=1
    )
    items["taxonomy"] = items["dataset"].map(taxonomy_of)
    drawn = draw_scenarios(items, resamples, seed)
    entries, values = [], []
    for key, group in items.groupby(["model", "regime"], sort=True):
        model, regime = cast(tuple[str, str], key)
        draws = {cell: figures_of(sums) for cell, sums in run_sums(group, drawn).items()}
        for dataset, mean in means_over_runs(draws, resamples).items():
            entries.append((model, regime, dataset))
            values.append(mean)
    shape = (len(entries), len(RESAMPLED), resamples)
    return Resampled(entries, np.stack(values) if values else np.zeros(shape))


def intervals(resampled: Resampled, level: float = 0.95) -> pd.DataFrame:
    """Percentile intervals: columns ENTRY and INTERVAL_COLUMNS, one row per entry.

    A resample in which some denominator is 0 is dropped from that interval's percentiles; null where none is left.
    """
    bounds = percentiles(resampled.values, level).reshape(len(resampled.entries), len(INTERVAL_COLUMNS))
    table = pd.DataFrame(resampled.entries, columns=pd.Index(ENTRY))
    return pd.concat([table, pd.DataFrame(bounds, columns=pd.Index(INTERVAL_COLUMNS))], axis=1)


def percentiles(draws: np.ndarray, level: float = 0.95) -> np.ndarray:
    """The central interval over the last axis without NaN: (.., resamples) -> (.., 2); NaN where all values are NaN."""
    tails = [(1 - level) / 2, (1 + level) / 2]
    flat = draws.reshape(-1, draws.shape[-1])
    whole = ~np.isnan(flat).any(axis=1)
    bounds = np.full((len(flat), 2), np.nan)
    bounds[whole] = np.quantile(flat[whole], tails, axis=1).T
    for row in np.flatnonzero(~whole):
        valid = flat[row][~np.isnan(flat[row])]
        if len(valid):
            bounds[row] = np.quantile(valid, tails)
    return bounds.reshape(*draws.shape[:-1], 2)


def scenario_weights(scenarios: int, resamples: int, seed: int | list[int]) -> np.ndarray:
    """How often each scenario is drawn in each resample: (resamples, scenarios) float32, rows sum to `scenarios`."""
    if not scenarios:
        return np.zeros((resamples, 0), np.float32)
    rng = np.random.default_rng(seed)
    return rng.multinomial(scenarios, np.full(scenarios, 1 / scenarios), size=resamples).astype(np.float32)


Drawn = Mapping[str, tuple[pd.Index, np.ndarray]]  # by taxonomy: its scenarios, and how often each is drawn


def draw_scenarios(items: pd.DataFrame, resamples: int, seed: int) -> Drawn:
    """Scenarios of items (columns scenario_id, taxonomy) with their weights (`scenario_weights`)."""
    drawn = {}
    for k, taxonomy in enumerate(TAXONOMIES):
        ids = pd.Index(sorted(items.loc[items["taxonomy"] == taxonomy, "scenario_id"].unique()))
        drawn[taxonomy] = ids, scenario_weights(len(ids), resamples, [seed, k])
    return drawn


def with_observed(drawn: Drawn) -> Drawn:
    """The same draws after one that takes each scenario once, and so gives the figures themselves."""
    return {
        taxonomy: (ids, np.concatenate([np.ones((1, len(ids)), np.float32), weights]))
        for taxonomy, (ids, weights) in drawn.items()
    }


def resampled_sums(weights: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Sums of counts of every cell and resample: (cells, kinds, resamples).

    weights is (resamples, scenarios), counts is (scenarios, cells, kinds), such as the six of COUNTS. Sums of whole
    counts stay far below 2^24, so float32 products are exact; weighted counts are summed in float64.
    """
    scenarios, cells, kinds = counts.shape
    whole = np.array_equal(counts, np.rint(counts))
    products = counts.astype(np.float32 if whole else np.float64).reshape(scenarios, cells * kinds).T @ weights.T
    return products.reshape(cells, kinds, -1).astype(np.float64)


def shares_of(sums: np.ndarray) -> np.ndarray:
    """Acc, FalseAbs and AbsRec of sums of COUNTS: (.., 6, resamples) -> (.., 3, resamples); NaN where a denominator is
    0."""
    with np.errstate(invalid="ignore"):
        return sums[..., 0::2, :] / sums[..., 1::2, :]


def figures_of(sums: np.ndarray) -> np.ndarray:
    """RESAMPLED figures of sums of COUNTS: (.., 6, resamples) -> (.., RESAMPLED, resamples); NaN where a denominator
    is 0."""
    return figures_of_shares(shares_of(sums))


def figures_of_shares(shares: np.ndarray) -> np.ndarray:
    """RESAMPLED figures of Acc, FalseAbs and AbsRec: (.., 3, resamples) -> (.., RESAMPLED, resamples)."""
    acc, false_abs, abs_rec = np.moveaxis(shares, -2, 0)
    j = abs_rec - false_abs
    return np.stack([acc, abs_rec, false_abs, j, pecs_of(acc, j)], axis=-2)


def run_sums(group: pd.DataFrame, drawn: Drawn) -> dict[tuple[str, int], np.ndarray]:
    """(dataset, run) -> sums of COUNTS (6, resamples), for the items of one model and regime. A dataset (an arm) may
    have items of both taxonomies."""
    found: dict[tuple[str, int], np.ndarray] = {}
    for taxonomy, items in group.groupby("taxonomy", sort=True):
        scenarios, weights = drawn[str(taxonomy)]
        cells = items.groupby(["dataset", "run"], sort=True)
        counts = np.zeros((len(scenarios), cells.ngroups, len(COUNTS)))
        places = scenarios.get_indexer(pd.Index(items["scenario_id"])), cells.ngroup().to_numpy()
        np.add.at(counts, places, items[COUNTS].to_numpy())
        for cell, sums in zip(cells.size().index, resampled_sums(weights, counts), strict=True):
            key = cast(tuple[str, int], cell)
            found[key] = found[key] + sums if key in found else sums
    return found


def means_over_runs(draws: Mapping[tuple[str, int], np.ndarray], resamples: int) -> dict[str, np.ndarray]:
    """Dataset or `overall` -> mean over runs (RESAMPLED, resamples), from those of (dataset, run)."""
    runs = sorted({run for _, run in draws})
    means = {
        dataset: np.mean([draws[dataset, run] for run in runs if (dataset, run) in draws], axis=0)
        for dataset in DATASETS
        if any((dataset, run) in draws for run in runs)
    }
    whole = [draws[d, run] for run in runs if all((d, run) in draws for d in DATASETS) for d in DATASETS]
    return {**means, "overall": np.mean(whole, axis=0) if whole else np.full((len(RESAMPLED), resamples), np.nan)}
