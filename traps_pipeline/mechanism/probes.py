"""Fit linear probes (docs/spec.md 7.2): l2 logistic regression, and AUROC.

With fewer rows than columns the minimiser lies in the span of the rows, so the exact solver takes Newton steps on the
Gram matrix. Its optimum equals scikit-learn's up to rounding and takes a fraction of the time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, cast

import numpy as np

from traps_pipeline.base.errors import TrapsError

_TOLERANCE, _MAX_STEPS = 1e-10, 200


@dataclass(frozen=True, eq=False)
class Split:
    """A dataset's items at a layer: states (n, d), labels void (n,) bool, scenario (n,) int."""

    states: np.ndarray
    void: np.ndarray
    scenario: np.ndarray

    def rows(self, chosen: np.ndarray) -> Split:
        """Return the split of the selected items; chosen is a mask or indices."""
        return Split(self.states[chosen], self.void[chosen], self.scenario[chosen])


@dataclass(frozen=True, eq=False)
class Probe:
    """A fitted linear probe: mean, scale, and weights (d,) that apply to standardised states."""

    mean: np.ndarray = field(repr=False)
    scale: np.ndarray = field(repr=False)
    weights: np.ndarray = field(repr=False)
    intercept: float

    def scores(self, states: np.ndarray) -> np.ndarray:
        """Return the log-odds of void, (n,), for states (n, d)."""
        slope = self.weights / self.scale
        return states @ slope + (self.intercept - self.mean @ slope)


class Scorer(Protocol):
    """A fitted scorer of states; the scores of voids are higher."""

    def scores(self, states: np.ndarray) -> np.ndarray:
        """Return scores (n,) of states (n, d)."""
        ...


Fit = Callable[[np.ndarray, np.ndarray], Scorer]  # states (n, d), void (n,) bool -> what scores other states

# --- fitting ----------------------------------------------------------------------------------------------------------


def standardiser(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and population standard deviation of each column, (d,) each.

    As in scikit-learn's StandardScaler the deviation is 1 for a column that is constant up to rounding.
    """
    mean, variance = states.mean(axis=0), states.var(axis=0)
    rounding = len(states) * np.finfo(float).eps
    constant = variance <= rounding * variance + (rounding * mean) ** 2
    return mean, np.where(constant, 1.0, np.sqrt(variance))


def fit_probe(states: np.ndarray, void: np.ndarray) -> Probe:
    """Return the probe fitted on states (n, d), labels (n,). Raises TrapsError for one class."""
    _check_labels(void)
    states = np.asarray(states, float)
    mean, scale = standardiser(states)
    standard = (states - mean) / scale
    dual, intercept = solve_gram(standard @ standard.T, void)
    return Probe(mean, scale, standard.T @ dual, intercept)


def _check_labels(void: np.ndarray) -> None:
    n_void = int(np.count_nonzero(void))
    if not 0 < n_void < len(void):
        raise TrapsError(
            f"a probe needs void and control items, but {n_void} of {len(void)} items are void; extract more items"
        )


def solve_gram(gram: np.ndarray, void: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the dual (n,) and the intercept of logistic regression on a Gram matrix (n, n).

    The intercept is unpenalised. The coefficients of the columns are the rows' transpose times the dual.

    At the minimum the dual is label - probability and sums to 0. Newton's step solves (I + W gram) step + W
    intercept_step = residual of that condition, with W = p (1 - p), through I + sqrt(W) gram sqrt(W), whose eigenvalues
    are at least 1 (Rasmussen and Williams, algorithm 3.1); it is halved until the objective falls. A factorisation is
    used again while each step with it reduces the residual to a fifth or less, since W hardly changes near the minimum.
    Raises TrapsError for states that are not finite.
    """
    from scipy.special import expit

    if not np.isfinite(gram).all():
        raise _unfit(len(gram))
    label = np.asarray(void, float)
    odds = float(np.log(label.mean() / (1 - label.mean())))
    at = _Point(np.zeros(len(label)), odds, np.full(len(label), odds))
    newton, previous_loss = None, np.inf
    for _ in range(_MAX_STEPS):
        chance = expit(at.logits)
        missing = label - chance - at.dual
        max_residual = float(max(np.abs(missing).max(), abs(at.dual.sum()) / len(label)))
        if max_residual < _TOLERANCE:
            return at.dual, at.intercept
        if newton is None or max_residual > 0.2 * previous_loss:
            newton = _NewtonStep(gram, chance * (1 - chance))
        step, intercept_step = newton.solve(missing, at.dual.sum())
        at, previous_loss = (
            _descend(at, _Point(step, intercept_step, gram @ step + intercept_step), label),
            max_residual,
        )
    raise _unfit(len(label))


class _Point(NamedTuple):
    """A place in the search, or a step: dual (n,), intercept, and logits (n,), which follow from both."""

    dual: np.ndarray
    intercept: float
    logits: np.ndarray

    def objective(self, label: np.ndarray) -> float:
        loss = np.logaddexp(0, self.logits).sum() - label @ self.logits
        return float(0.5 * self.dual @ (self.logits - self.intercept) + loss)  # scikit-learn's, with C = 1


def _descend(at: _Point, step: _Point, label: np.ndarray) -> _Point:
    """Return the place after a step, halved until the objective falls."""
    value, size = at.objective(label), 1.0
    while True:
        candidate = _Point(
            at.dual + size * step.dual, at.intercept + size * step.intercept, at.logits + size * step.logits
        )
        if candidate.objective(label) <= value + 1e-12 * abs(value) or size < 1e-6:
            return candidate
        size /= 2


def _unfit(rows: int) -> TrapsError:
    return TrapsError(
        f"no probe can be fitted to these {rows} rows: the states are not finite, or too large for float64; extract "
        "them again"
    )


class _NewtonStep:
    """A factorisation of the Newton equations at weights (n,)."""

    def __init__(self, gram: np.ndarray, weight: np.ndarray) -> None:
        self._gram, self._root = gram, np.sqrt(weight)
        matrix = gram * self._root
        matrix *= self._root[:, None]
        matrix.flat[:: len(weight) + 1] += 1.0
        self._factor = np.linalg.cholesky(matrix).T  # unlike scipy's it lets other threads run; .T is Fortran's order
        self._by_intercept = self._inverse(weight)

    def _inverse(self, right: np.ndarray) -> np.ndarray:
        """Return (I + W gram)^-1 right."""
        from scipy.linalg import cho_solve

        scaled_product = self._root * (self._gram @ right)
        return right - self._root * cho_solve((self._factor, False), scaled_product, check_finite=False)

    def solve(self, missing: np.ndarray, dual_sum: float) -> tuple[np.ndarray, float]:
        """Return steps of dual and intercept, after which the dual sums to 0."""
        free = self._inverse(missing)
        intercept_step = float((free.sum() + dual_sum) / self._by_intercept.sum())
        return free - intercept_step * self._by_intercept, intercept_step


# --- scoring ----------------------------------------------------------------------------------------------------------


def auroc(void: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Return the AUROC of scores, (n,) -> () or (n, k) -> (k,), against labels (n,).

    Ties count half, by mean ranks (Mann and Whitney). NaN if one class has no item.
    """
    from scipy.stats import rankdata

    void = np.asarray(void, bool)
    n_void, n_control = np.count_nonzero(void), np.count_nonzero(~void)
    if not n_void or not n_control:
        return np.full(np.shape(scores)[1:], np.nan)
    ranks = cast(np.ndarray, rankdata(scores, axis=0))[void].sum(axis=0)
    return (ranks - n_void * (n_void + 1) / 2) / (n_void * n_control)


def auroc_interval(
    void: np.ndarray, scores: np.ndarray, scenario: np.ndarray, weights: np.ndarray, level: float = 0.95
) -> tuple[float, float]:
    """Return the AUROC's percentile interval over scenarios, with a minimum width.

    The probe is held fixed. If all resamples agree (a probe that separates 16 pairs), percentiles alone would claim
    certainty, so the exact binomial bound is the minimum: if a share s of n scenarios fails, none of them fails with
    probability (1 - s)^n; so with n scenarios of the scarcer side, an interval reaches down to at least ((1 - level) /
    2)^(1/n), which is .79 for 16, and up to at least 1 minus that.

    weights: (resamples, scenarios), how often each is drawn (`scoring.bootstrap.scenario_weights`); scenario: (n,), the
    column of `weights` for each item. A resample in which a class is empty is dropped.
    """
    void, areas = np.asarray(void, bool), auroc_draws(void, scores, scenario, weights)
    return share_interval(areas, min(len(np.unique(scenario[side])) for side in (void, ~void)), level)


def share_interval(draws: np.ndarray, scenarios: int, level: float = 0.95) -> tuple[float, float]:
    """Return the percentile interval of draws of a share of scenarios, with the minimum width of `auroc_interval`."""
    if np.isnan(draws).all():
        return np.nan, np.nan
    low, high = np.nanquantile(draws, [(1 - level) / 2, (1 + level) / 2])
    certain_share = ((1 - level) / 2) ** (1 / scenarios)
    return min(float(low), certain_share), max(float(high), 1 - certain_share)


def auroc_draws(void: np.ndarray, scores: np.ndarray, scenario: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the AUROC of each resample of `auroc_interval`, (resamples,); NaN without one of the classes."""
    void = np.asarray(void, bool)
    void_scores, control_scores = scores[void][:, None], scores[~void][None, :]
    win_weights = (void_scores > control_scores).astype(np.float32) + np.float32(0.5) * (void_scores == control_scores)
    times_void, times_control = weights[:, scenario[void]], weights[:, scenario[~void]]
    won_weight = ((times_void @ win_weights) * times_control).sum(axis=1, dtype=float)
    pairs = times_void.sum(axis=1, dtype=float) * times_control.sum(axis=1, dtype=float)
    return np.divide(won_weight, pairs, out=np.full(len(pairs), np.nan), where=pairs > 0)


# --- within a split ---------------------------------------------------------------------------------------------------


def scenario_folds(scenario: np.ndarray, folds: int, seed: int) -> np.ndarray:
    """Return the fold of each item, (n,) int; a scenario's items share one.

    Fold sizes differ by at most one scenario. Raises TrapsError if there are fewer scenarios than folds.
    """
    names = np.unique(scenario)
    if len(names) < folds:
        raise TrapsError(
            f"{folds} folds need {folds} scenarios, but there are {len(names)}; lower `folds` or extract more"
        )
    place = np.random.default_rng(seed).permutation(len(names)) % folds
    return place[np.searchsorted(names, scenario)]


def side_swapped_labels(void: np.ndarray, scenario: np.ndarray, shuffles: int, seed: int) -> np.ndarray:
    """Return labels (n, shuffles) in which random scenarios have swapped control and void.

    Each scenario is swapped with probability 0.5. A swap keeps every fold balanced, and any labels of a held-out fold
    are as likely as their complement, so that the expected AUROC is exactly 0.5. A free permutation, which unbalances
    the folds, would only approach 0.5.
    """
    names, place = np.unique(scenario, return_inverse=True)
    coins = np.random.default_rng(seed).integers(0, 2, (len(names), shuffles)).astype(bool)
    return np.asarray(void, bool)[:, None] ^ coins[place]


def within_split(split: Split, labels: np.ndarray, folds: np.ndarray) -> np.ndarray:
    """Return the cross-validated AUROC, averaged over folds, of each column of labels: (n, k) -> (k,).

    Standardiser and probe use only the training folds; all labellings share the Gram matrix of a fold.
    """
    areas = []
    for fold in np.unique(folds):
        train, test = folds != fold, folds == fold
        states = np.asarray(split.states[train], float)
        mean, scale = standardiser(states)
        train_states, test_states = (states - mean) / scale, (split.states[test] - mean) / scale
        gram = train_states @ train_states.T
        duals = np.column_stack([solve_gram(gram, column)[0] for column in labels[train].T])
        scores = test_states @ (train_states.T @ duals)
        areas.append([auroc(labels[test, k], scores[:, k]) for k in range(labels.shape[1])])
    return np.mean(areas, axis=0)


# --- nearest centroid -------------------------------------------------------------------------------------------------


def nearest_centroid(source: Split, states: np.ndarray) -> np.ndarray:
    """Return whether states (n, d) lie nearer to the void centroid, by cosine, (n,).

    Standardiser and centroids are the source's; with equal distances a state is assigned to control.
    """
    _check_labels(source.void)
    source_states = np.asarray(source.states, float)
    mean, scale = standardiser(source_states)
    standard = (source_states - mean) / scale
    centroids = np.stack([standard[~source.void].mean(axis=0), standard[source.void].mean(axis=0)])
    centroids /= np.maximum(np.linalg.norm(centroids, axis=1, keepdims=True), np.finfo(float).tiny)
    control, void = centroids @ ((states - mean) / scale).T  # an item's own length has no effect
    return void > control


# --- one layer of the transfer protocol -------------------------------------------------------------------------------


def transfer_scores(
    layer: Mapping[str, Split], pairs: Sequence[tuple[str, str]], fit: Fit = fit_probe
) -> dict[tuple[str, str], np.ndarray]:
    """Return scores (n_target,) of each (source, target) at a layer, a fit per source. No label of a target is read."""
    probes = {source: fit(layer[source].states, layer[source].void) for source in {s for s, _ in pairs}}
    return {(source, target): probes[source].scores(layer[target].states) for source, target in pairs}
