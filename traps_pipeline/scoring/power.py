"""Predict the width of a study's PECS interval, and its detectable difference.

Simulated studies of a model have independent answers, and each is resampled as in `bootstrap`, with its unseen
scenarios. That holds at J = 0 as well, where PECS is clipped, and with few pairs. The overall metric is the mean over
datasets. Runs ask the same scenarios again and are not counted. Two datasets of one taxonomy share their clips: if
answers to them are correlated, intervals are wider than predicted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import comb
from statistics import NormalDist

import numpy as np

from traps_pipeline.protocol.datasets import DATASETS, taxonomy_of
from traps_pipeline.scoring.bootstrap import RESAMPLED_METRICS, TAXONOMIES, interval, limits_of, metrics_of
from traps_pipeline.scoring.contrasts import SEPARABLE_BELOW, least_p
from traps_pipeline.scoring.metrics import pecs_of

POWER, ROUNDS = 0.8, 2  # a better model has another variance, so its difference is found iteratively
STUDIES, RESAMPLES, SEED = 400, 400, 7  # 0.3 s; the width is off by less than 2 %


@dataclass(frozen=True)
class Shares:
    """The shares that a model is assumed to have; by default those amid the paper's models."""

    acc: float = 0.6
    abs_rec: float = 0.5
    false_abs: float = 0.1

    @property
    def pecs(self) -> float:
        """PECS from accuracy and the two shares of abstention."""
        return float(pecs_of(np.asarray(self.acc), np.asarray(self.abs_rec - self.false_abs)))


@dataclass(frozen=True)
class Precision:
    """The width of a study's intervals, and the differences between models that it detects.

    width: width of PECS's 95 % interval. difference: the smallest one between two models with independent answers that
    a test at 5 % detects in 80 % of studies; among_all: the same after Holm's correction over the pairs of all models,
    if it is tested first. Answers to the same items are correlated, which makes both smaller. None if not even a
    difference of 1 is detected so often.
    """

    width: float
    difference: float | None
    among_all: float | None


def precision(pairs: Mapping[str, int], shares: Shares | None = None, models: int = 2) -> Precision:
    """Return the precision of the mean over datasets, in a study of several models.

    pairs: the number of each dataset; datasets without a pair are left out. Raises ValueError if no dataset has a pair.
    """
    counts = [pairs.get(name, 0) for name in DATASETS if pairs.get(name, 0)]
    if not counts:
        raise ValueError("no dataset has a pair")
    shares = shares or Shares()
    observed, ends = studies = _studies(counts, shares, SEED)
    low, high = interval(ends, observed, limits_of("pecs")).T
    scenarios = sum(max(pairs.get(name, 0) for name in DATASETS if taxonomy_of(name) == t) for t in TAXONOMIES)
    detectable = {m: _detectable(counts, shares, studies, scenarios, m) for m in {1, max(1, comb(models, 2))}}
    return Precision(float(np.mean(high - low)), detectable[1], detectable[max(detectable)])


def _studies(counts: Sequence[int], shares: Shares, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Simulate studies: PECS (STUDIES,), and its ends (STUDIES, 2, RESAMPLES)."""
    rng, s = np.random.default_rng(seed), shares
    control, void = [s.acc, s.false_abs, max(0.0, 1 - s.acc - s.false_abs)], [s.abs_rec, 1 - s.abs_rec]
    observed, ends = np.zeros(STUDIES), np.zeros((STUDIES, 2, RESAMPLES))
    for n in counts:
        answers = rng.multinomial(n, np.outer(control, void).ravel(), size=STUDIES)
        gamma = rng.standard_gamma(answers[:, :, None], size=(STUDIES, 6, RESAMPLES))
        unseen_weights = rng.standard_exponential((3, RESAMPLES))
        observed += _pecs(answers[..., None], np.zeros((3, 1)), False)[:, 1, 0] / len(counts)
        ends += _pecs(gamma, unseen_weights, len(counts) > 1) / len(counts)
    return observed, ends


def _raise_shares(shares: Shares, by: float) -> Shares:
    """Return shares of a PECS higher by `by`: abstain on more voids, then raise Acc."""
    goal = shares.pecs + by
    abs_rec = min(1.0, shares.false_abs + goal / shares.acc) if shares.acc else 1.0
    j = abs_rec - shares.false_abs
    return Shares(
        min(1 - shares.false_abs, max(shares.acc, goal / j)) if j > 0 else shares.acc, abs_rec, shares.false_abs
    )


def _detectable(
    counts: Sequence[int], shares: Shares, studies: tuple[np.ndarray, np.ndarray], scenarios: int, comparisons: int
) -> float | None:
    """Return the smallest gain in PECS that 80 % of studies detect, or None.

    Tests are at 5 % divided by the number of comparisons; a difference is detected if its lower end is above 0.
    """
    if least_p(scenarios) * comparisons >= SEPARABLE_BELOW:
        return None
    smallest, (observed, ends) = 0.0, studies
    for seed in range(SEED + 1, SEED + 1 + ROUNDS):
        better, better_ends = _studies(counts, _raise_shares(shares, smallest), seed)
        difference, low = better - observed, better_ends[:, 0] - ends[:, 1]
        lower_half_width = np.quantile(low.mean(axis=1, keepdims=True) - low, 1 - SEPARABLE_BELOW / 2 / comparisons)
        smallest = float(
            difference.mean() - low.mean() + lower_half_width + NormalDist().inv_cdf(POWER) * difference.std()
        )
    return smallest if smallest <= 1 else None


def _pecs(answers: np.ndarray, unseen: np.ndarray, in_mean: bool) -> np.ndarray:
    """Return the ends of PECS, (studies, 2, draws).

    answers: weighted numbers of pairs (studies, 6, draws). The six kinds of pairs: control right, abstained or wrong,
    each with a void that was abstained on or not.
    """
    all_pairs = answers.sum(axis=1)
    yes = answers[:, :2].sum(axis=1), answers[:, 2:4].sum(axis=1), answers[:, ::2].sum(axis=1)
    sums = np.stack([part for n_yes in yes for part in (n_yes, all_pairs)], axis=1)
    unseen_draws = np.broadcast_to(unseen, (len(answers), *unseen.shape))
    return np.moveaxis(
        metrics_of(np.concatenate([sums, unseen_draws], axis=1), in_mean)[:, :, RESAMPLED_METRICS.index("pecs")], 0, 1
    )
