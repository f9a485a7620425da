"""Compute confidence intervals of scores by a Bayesian bootstrap over scenarios.

See docs/scoring.md, "Intervals", and docs/design/intervals.md. All cells of a taxonomy share one weight matrix over
scenarios. Every resample is computed twice: with one unseen scenario in each share that is the worst for the metric
(its lower end), and with one that is the best (its upper end).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import cast
from zlib import crc32

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from traps_pipeline.protocol.datasets import DATASETS, taxonomy_of
from traps_pipeline.protocol.metric_words import METRIC_WORDS
from traps_pipeline.scoring.metrics import COUNTS, decision_counts

TAXONOMIES = ("occlusion", "chaotic")
ENTRY = ["model", "regime", "dataset"]
RESAMPLED_METRICS = tuple(METRIC_WORDS)
INTERVAL_COLUMNS = [f"{metric}_ci_{end}" for metric in RESAMPLED_METRICS for end in ("low", "high")]
RESAMPLES, SEED = 10_000, 20260101
_GRAIN = 256  # weights are multiples of 1/256, so that float32 sums of them are exact on every machine
_LEVEL = 0.95
_IN_MEAN = 0.5**0.5  # of two taxonomies: their errors are independent, so squared distances add up


@dataclass(frozen=True)
class ResampledMetrics:
    """Every metric, averaged over runs: as observed, and both of its bounds in every resample.

    entries: (model, regime, dataset or `overall`) of each row; observed: (entries, RESAMPLED_METRICS) float64; values:
    (entries, 2, RESAMPLED_METRICS, resamples) float32, lower ends before upper ends. NaN where nothing is decided, and
    for an `overall` entry without a run that has all four datasets.
    """

    entries: list[tuple[str, str, str]]
    observed: np.ndarray
    values: np.ndarray

    def metric(self, name: str) -> np.ndarray:
        """Return the lower and upper bounds of one metric in each resample, (entries, 2, resamples)."""
        return self.values[:, :, RESAMPLED_METRICS.index(name)]


def resample(verdicts: pd.DataFrame, resamples: int = RESAMPLES, seed: int = SEED) -> ResampledMetrics:
    """Return the resampled metrics of every (model, regime) on each of its datasets, and overall.

    Overall is the equal-weight mean over the four datasets, over the runs that have all four. Metrics are computed per
    run, then averaged.

    Memory: one float32 weight matrix (resamples, scenarios) per taxonomy, one (resamples, 6 x cells) product of a
    single model and regime, and the result: 400 kB per entry and metric at 10,000 resamples over four datasets.
    """
    items = pd.concat(
        [verdicts[["model", "regime", "dataset", "run", "scenario_id"]], decision_counts(verdicts)], axis=1
    )
    items["taxonomy"] = items["dataset"].map(taxonomy_of)
    resampling = draw_scenarios(items, resamples, seed)
    groups = items.groupby(["model", "regime"], sort=True)
    entries, observed = list[tuple[str, str, str]](), list[np.ndarray]()
    n_entries = groups.ngroups * (len(DATASETS) + 1)  # at most
    # float32 takes half the memory, and half the time of quantiles.
    values = np.empty((n_entries, 2, len(RESAMPLED_METRICS), resamples), np.float32)
    with threadpool_limits(1):  # threads of products this small wait for each other, which takes as long again
        for key, group in groups:
            model, regime = cast(tuple[str, str], key)
            sums = run_sums(group, resampling, f"{model}|{regime}")
            for dataset, mean in means_over_runs(sums, metrics_of, resamples + 1).items():
                values[len(entries)] = mean[..., 1:]
                observed.append(mean[1, :, 0])
                entries.append((model, regime, dataset))
    metrics = np.array(observed).reshape(len(entries), len(RESAMPLED_METRICS))
    return ResampledMetrics(entries, metrics, values[: len(entries)])


def intervals(resampled: ResampledMetrics, level: float = _LEVEL) -> pd.DataFrame:
    """Return each entry's interval of this level in every metric, as a frame; null where nothing is decided."""
    ends = [
        interval(resampled.metric(name), resampled.observed[:, k], limits_of(name), level)
        for k, name in enumerate(RESAMPLED_METRICS)
    ]
    table = pd.DataFrame(resampled.entries, columns=pd.Index(ENTRY))
    bounds = np.concatenate(ends, axis=-1) if resampled.entries else np.zeros((0, len(INTERVAL_COLUMNS)))
    return pd.concat([table, pd.DataFrame(bounds, columns=pd.Index(INTERVAL_COLUMNS))], axis=1)


def limits_of(metric: str) -> tuple[float, float]:
    """Return the minimum and maximum of a score: [-1, 1] for J, [0, 1] for most others."""
    return (METRIC_WORDS[metric].lowest if metric in METRIC_WORDS else 0.0), 1.0


def interval(
    ends: np.ndarray, observed: np.ndarray | float, limits: tuple[float, float], level: float = _LEVEL
) -> np.ndarray:
    """Return the interval of bounds in resamples, (.., 2, resamples) -> (.., 2).

    Every interval of a score comes from here. It contains `observed` (..) and lies within the limits; a NaN among the
    resamples is left out, and the interval is NaN where all are.
    """
    low = np.fmin(quantile(ends[..., 0, :], (1 - level) / 2), observed)
    high = np.fmax(quantile(ends[..., 1, :], (1 + level) / 2), observed)
    is_undefined = np.all(np.isnan(ends), axis=(-2, -1), keepdims=True)[..., 0]
    return np.where(is_undefined, np.nan, np.clip(np.stack([low, high], axis=-1), *limits))


def with_interval(name: str, ends: np.ndarray, limits: tuple[float, float]) -> dict[str, float]:
    """Return score and interval as columns; ends: bounds (2, 1 + resamples), the observed one first."""
    low, high = interval(ends[:, 1:], ends[1, 0], limits)
    return {name: float(ends[1, 0]), f"{name}_ci_low": float(low), f"{name}_ci_high": float(high)}


def difference(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the bounds of left - right, (.., 2, resamples), from those of both."""
    return left - right[..., ::-1, :]


def quantile(draws: np.ndarray, q: float) -> np.ndarray:
    """Return a quantile of values over the last axis, (.., n) -> (..), ignoring NaN.

    Equals `np.nanquantile`, which partitions each row several times; one sort takes a fifth of that.
    """
    n = np.count_nonzero(~np.isnan(draws), axis=-1, keepdims=True)
    last, ordered = np.maximum(n - 1, 0), np.sort(draws, axis=-1)  # NaN behind all others
    place = q * last
    lower = place.astype(int)
    low, high = (np.take_along_axis(ordered, np.minimum(k, last), axis=-1) for k in (lower, lower + 1))
    return (low + (high - low) * (place - lower).astype(draws.dtype))[..., 0].astype(float)


def scenario_weights(scenarios: int, resamples: int, seed: int | list[int]) -> np.ndarray:
    """Return counts of each scenario by resample, (resamples, scenarios) float32.

    Each row sums to the number of scenarios.
    """
    if not scenarios:
        return np.zeros((resamples, 0), np.float32)
    rng = np.random.default_rng(seed)
    return rng.multinomial(scenarios, np.full(scenarios, 1 / scenarios), size=resamples).astype(np.float32)


@dataclass(frozen=True)
class Resampling:
    """The weight of each scenario in every resample.

    The first draw takes each scenario once and no unseen one, and so gives the metrics themselves. scenarios: by
    taxonomy its scenarios (n,) and their weights (1 + resamples, n) float32: exponential with mean 1, positive.
    """

    scenarios: Mapping[str, tuple[pd.Index, np.ndarray]]
    resamples: int
    seed: int

    def unseen(self, named: str, decisions: int) -> np.ndarray:
        """Return the bootstrap weights of a scenario met for the first time, (decisions, 1 + resamples) float64.

        They are the same for the same name, and independent for two names.
        """
        rng = np.random.default_rng([self.seed, len(TAXONOMIES), crc32(named.encode())])
        return np.concatenate([np.zeros((decisions, 1)), rng.standard_exponential((decisions, self.resamples))], axis=1)


def draw_scenarios(items: pd.DataFrame, resamples: int, seed: int) -> Resampling:
    """Return random weights of the scenarios of items (columns scenario_id, taxonomy)."""
    scenario_weights_of = {}
    for k, taxonomy in enumerate(TAXONOMIES):
        ids = pd.Index(sorted(items.loc[items["taxonomy"] == taxonomy, "scenario_id"].unique()))
        weights = np.random.default_rng([seed, k]).standard_exponential((resamples, len(ids)), np.float32)
        weights = np.ceil(weights * _GRAIN) / _GRAIN
        scenario_weights_of[taxonomy] = ids, np.concatenate([np.ones((1, len(ids)), np.float32), weights])
    return Resampling(scenario_weights_of, resamples, seed)


def resampled_sums(weights: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return weighted sums of counts, (cells, kinds, resamples).

    weights is (resamples, scenarios), counts is (scenarios, cells, kinds), such as the six of COUNTS. Sums of integer
    counts stay below 2^16, so float32 products are exact; weighted counts are summed in float64.
    """
    scenarios, cells, kinds = counts.shape
    are_integers = np.array_equal(counts, np.rint(counts))
    products = counts.astype(np.float32 if are_integers else np.float64).reshape(scenarios, cells * kinds).T @ weights.T
    return products.reshape(cells, kinds, len(weights)).astype(np.float64)


def with_unseen(sums: np.ndarray, scenarios: np.ndarray, unseen: np.ndarray) -> np.ndarray:
    """Return sums extended by the contribution of a scenario that the sample lacks.

    (.., 2 x decisions, draws) -> (.., 3 x decisions, draws).

    The sums count how often each decision was yes and was made. The unseen scenario makes it as often as an average
    scenario that has it. scenarios: their number, (.., decisions); unseen: weights of `Resampling.unseen`.
    """
    size = sums[..., 1::2, 0] / np.maximum(scenarios, 1)
    return np.concatenate([sums, size[..., None] * unseen], axis=-2)


def shares_of(sums: np.ndarray, in_mean: bool = False) -> np.ndarray:
    """Return the lower and upper bounds of shares, from sums of `with_unseen`.

    Of COUNTS these are Acc, FalseAbs and AbsRec: (.., 3 x decisions, resamples) -> (2, .., decisions, resamples); NaN
    where a denominator is 0. in_mean: whether the shares enter a mean over datasets or arms, where the unseen scenarios
    weigh less (_IN_MEAN).
    """
    decisions = sums.shape[-2] // 3
    yes, n_decided = sums[..., 0 : 2 * decisions : 2, :], sums[..., 1 : 2 * decisions : 2, :]
    unseen_weights = sums[..., 2 * decisions :, :] * (_IN_MEAN if in_mean else 1.0)
    with np.errstate(invalid="ignore"):
        return np.stack([yes, yes + unseen_weights]) / (n_decided + unseen_weights)


def ends_of_shares(counts: pd.DataFrame, resampling: Resampling, named: str) -> np.ndarray:
    """Return the lower and upper bounds of shares in each resample, (2, decisions, 1 + resamples).

    counts: by scenario, how often each decision was yes and was made, in turn. named: as in `run_sums`.
    """
    decided = counts.iloc[:, 1::2].gt(0).sum().to_numpy()
    parts = [
        resampled_sums(weights, counts.reindex(scenarios, fill_value=0).to_numpy(float)[:, None])[0]
        for scenarios, weights in resampling.scenarios.values()
    ]
    return shares_of(with_unseen(np.sum(parts, axis=0), decided, resampling.unseen(named, len(decided))))


def metrics_of(sums: np.ndarray, in_mean: bool = False) -> np.ndarray:
    """Return scores from sums, (.., 9, resamples) -> (2, .., RESAMPLED_METRICS, resamples).

    The sums are those of COUNTS with an unseen scenario. in_mean: as in `shares_of`.
    """
    return metrics_of_shares(shares_of(sums, in_mean))


def metrics_of_shares(shares: np.ndarray) -> np.ndarray:
    """Return scores, (2, .., 3, resamples) -> (2, .., RESAMPLED_METRICS, resamples).

    The three are the ends of Acc, FalseAbs and AbsRec.
    """
    acc, false_abs, abs_rec = np.moveaxis(shares, -2, 0)
    return np.stack([metric.ends(acc, false_abs, abs_rec) for metric in METRIC_WORDS.values()], axis=-2)


def run_sums(group: pd.DataFrame, resampling: Resampling, named: str) -> dict[tuple[str, int], np.ndarray]:
    """Return the sums of COUNTS and an unseen scenario, (9, 1 + resamples), by dataset and run.

    group: the items of one model and regime. A dataset (an arm) may have items of both taxonomies. named: identifies
    the items' unseen scenarios.
    """
    totals: dict[tuple[str, int], np.ndarray] = {}
    n_with_decision: dict[tuple[str, int], np.ndarray] = {}
    values = group[COUNTS].to_numpy()
    items_of: dict[str, list[tuple[int, tuple[str, int], str]]] = {}  # plain lists: groups are small, and many
    columns = (group[name].tolist() for name in ("taxonomy", "dataset", "run", "scenario_id"))
    for row, (taxonomy, dataset, run, scenario) in enumerate(zip(*columns, strict=True)):
        items_of.setdefault(taxonomy, []).append((row, (dataset, run), scenario))
    for taxonomy, items in sorted(items_of.items()):
        scenarios, weights = resampling.scenarios[taxonomy]
        cells = sorted({cell for _, cell, _ in items})
        place, column = ({name: k for k, name in enumerate(names)} for names in (scenarios, cells))
        counts = np.zeros((len(scenarios), len(cells), len(COUNTS)))
        places = [place[scenario] for *_, scenario in items], [column[cell] for _, cell, _ in items]
        np.add.at(counts, places, values[[row for row, *_ in items]])
        having_any = (counts[..., 1::2] > 0).sum(axis=0)
        for key, sums, n in zip(cells, resampled_sums(weights, counts), having_any, strict=True):
            totals[key] = totals.get(key, 0) + sums
            n_with_decision[key] = n_with_decision.get(key, 0) + n
    unseen_weights = {
        dataset: resampling.unseen(f"{named}|{dataset}", len(COUNTS) // 2) for dataset in {name for name, _ in totals}
    }
    return {key: with_unseen(sums, n_with_decision[key], unseen_weights[key[0]]) for key, sums in totals.items()}


def means_over_runs(
    sums: Mapping[tuple[str, int], np.ndarray], compute: Callable[[np.ndarray, bool], np.ndarray], draws: int
) -> dict[str, np.ndarray]:
    """Return the mean over runs (2, RESAMPLED_METRICS, draws) by dataset, `overall` included.

    sums: the `run_sums` of (dataset, run). compute: the function (`metrics_of`) that computes metrics from them.
    """
    runs = sorted({run for _, run in sums})
    means = {
        dataset: _mean([compute(sums[dataset, run], False) for run in runs if (dataset, run) in sums])
        for dataset in DATASETS
        if any((dataset, run) in sums for run in runs)
    }
    complete_runs = [sums[d, run] for run in runs if all((d, run) in sums for d in DATASETS) for d in DATASETS]
    undefined = np.full((2, len(RESAMPLED_METRICS), draws), np.nan)
    return {**means, "overall": _mean([compute(own, True) for own in complete_runs]) if complete_runs else undefined}


def _mean(values: Sequence[np.ndarray]) -> np.ndarray:
    """Return the elementwise mean; that of one array is the array, of which a megabyte need not be copied twice."""
    return values[0] if len(values) == 1 else np.mean(values, axis=0)
