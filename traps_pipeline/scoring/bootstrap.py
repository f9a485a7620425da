"""Percentile intervals of PECS by a cluster bootstrap over scenarios (benchmark.md section 5).

A scenario is one draw of the world: its pairs in both datasets of its taxonomy, in every run, model and regime, stay
together. One weight matrix a taxonomy serves all cells, so two cells' resamples are paired.

Because PECS clips J at 0, its interval for a strategy without discrimination (J = 0 but for chance) lies slightly above
0 and need not contain it; whether J differs from 0 is a question for J (`leaderboard.pooled_j`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import numpy as np
import pandas as pd

from traps_pipeline.partitions import DATASETS, taxonomy_of
from traps_pipeline.scoring.metrics import COUNTS, decision_counts, pecs_of

TAXONOMIES = ("occlusion", "chaotic")
INTERVAL_COLUMNS = ["model", "regime", "dataset", "pecs_ci_low", "pecs_ci_high"]


def pecs_intervals(
    verdicts: pd.DataFrame, resamples: int = 10_000, seed: int = 20260101, level: float = 0.95
) -> pd.DataFrame:
    """Intervals of the mean PECS over runs: one row a (model, regime) and dataset present, and one for `overall`.

    PECS is computed per run, then averaged. `overall` is the equal-weight mean over the four datasets, over the runs
    that have all four; null where there is no such run. A resample in which some denominator is 0 is dropped from that
    interval's percentiles. Memory: one float32 weight matrix (resamples, scenarios) a taxonomy, and one
    (resamples, 6 x cells) product of a single model and regime.
    """
    items = pd.concat(
        [verdicts[["model", "regime", "dataset", "run", "scenario_id"]], decision_counts(verdicts)], axis=1
    )
    items["taxonomy"] = items["dataset"].map(taxonomy_of)
    scenarios = {t: pd.Index(sorted(items.loc[items["taxonomy"] == t, "scenario_id"].unique())) for t in TAXONOMIES}
    weights = {t: scenario_weights(len(ids), resamples, [seed, k]) for k, (t, ids) in enumerate(scenarios.items())}
    rows = []
    for key, group in items.groupby(["model", "regime"], sort=True):
        model, regime = cast(tuple[str, str], key)
        draws = _run_draws(group, scenarios, weights)
        for dataset, mean in _means_over_runs(draws).items():
            rows.append((model, regime, dataset, *_percentiles(mean, level)))
    return pd.DataFrame(rows, columns=pd.Index(INTERVAL_COLUMNS))


def scenario_weights(scenarios: int, resamples: int, seed: int | list[int]) -> np.ndarray:
    """How often each scenario is drawn in each resample: (resamples, scenarios) float32, rows sum to `scenarios`."""
    if not scenarios:
        return np.zeros((resamples, 0), np.float32)
    rng = np.random.default_rng(seed)
    return rng.multinomial(scenarios, np.full(scenarios, 1 / scenarios), size=resamples).astype(np.float32)


def resampled_pecs(weights: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """PECS of every resample and cell: (resamples, cells); NaN where a denominator is 0.

    weights is (resamples, scenarios), counts is (scenarios, cells, 6) in the order of COUNTS. Sums of counts stay far
    below 2^24, so float32 products are exact.
    """
    scenarios, cells, _ = counts.shape
    sums = (
        (weights @ counts.astype(np.float32).reshape(scenarios, -1)).reshape(-1, cells, len(COUNTS)).astype(np.float64)
    )
    with np.errstate(invalid="ignore"):
        shares = sums[..., 0::2] / sums[..., 1::2]
    acc, false_abs, abs_rec = np.moveaxis(shares, -1, 0)
    return pecs_of(acc, abs_rec - false_abs)


def _run_draws(
    group: pd.DataFrame, scenarios: Mapping[str, pd.Index], weights: Mapping[str, np.ndarray]
) -> dict[tuple[str, int], np.ndarray]:
    """(dataset, run) -> resampled PECS (resamples,), for one model and regime."""
    draws = {}
    for taxonomy, items in group.groupby("taxonomy", sort=True):
        cells = items.groupby(["dataset", "run"], sort=True)
        counts = np.zeros((len(scenarios[str(taxonomy)]), cells.ngroups, len(COUNTS)))
        places = scenarios[str(taxonomy)].get_indexer(pd.Index(items["scenario_id"])), cells.ngroup().to_numpy()
        np.add.at(counts, places, items[COUNTS].to_numpy())
        pecs = resampled_pecs(weights[str(taxonomy)], counts)
        draws.update(zip(cells.size().index, pecs.T, strict=True))
    return cast(dict[tuple[str, int], np.ndarray], draws)


def _means_over_runs(draws: Mapping[tuple[str, int], np.ndarray]) -> dict[str, np.ndarray | None]:
    """Dataset or `overall` -> resampled mean over runs (resamples,)."""
    runs = sorted({run for _, run in draws})
    means: dict[str, np.ndarray | None] = {
        dataset: np.mean([draws[dataset, run] for run in runs if (dataset, run) in draws], axis=0)
        for dataset in DATASETS
        if any((dataset, run) in draws for run in runs)
    }
    complete = [run for run in runs if all((dataset, run) in draws for dataset in DATASETS)]
    whole = [draws[dataset, run] for run in complete for dataset in DATASETS]
    return {**means, "overall": np.mean(whole, axis=0) if whole else None}


def _percentiles(draws: np.ndarray | None, level: float) -> tuple[float, float]:
    valid = draws[~np.isnan(draws)] if draws is not None else np.empty(0)
    if not len(valid):
        return np.nan, np.nan
    low, high = np.quantile(valid, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)
