"""Fit other probes for `traps_pipeline.inside.protocol`, and erase a concept."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from traps_pipeline.mechanism.probes import Fit, Probe, Scorer, standardiser


def mean_difference(states: np.ndarray, void: np.ndarray) -> Scorer:
    """Return the probe along the difference of the sides' standardised means.

    A score of 0 lies half-way between them.

    Examples
    --------
    >>> probe = inside.mean_difference(np.array([[0.0], [1.0]]), np.array([False, True]))
    >>> probe.scores(np.array([[0.5]])).tolist()
    [0.0]
    """
    mean, scale = standardiser(np.asarray(states, float))
    standard = (states - mean) / scale
    sides = standard[void].mean(axis=0), standard[~void].mean(axis=0)
    weights = sides[0] - sides[1]
    return Probe(mean, scale, weights, float(-(sides[0] + sides[1]) @ weights / 2))


def from_sklearn(make: Callable[[], Any]) -> Fit:
    """Return a function that fits what `make` returns, a new scikit-learn classifier.

    Scores are its decision function, or the log-odds of its probabilities.

    Examples
    --------
    >>> from sklearn.svm import LinearSVC
    >>> probe = inside.from_sklearn(LinearSVC)(np.array([[0.0], [1.0]]), np.array([False, True]))
    >>> (probe.scores(np.array([[-1.0], [2.0]])) > 0).tolist()
    [False, True]
    """

    def fit(states: np.ndarray, void: np.ndarray) -> Scorer:
        return _Estimator(make().fit(states, void))

    return fit


@dataclass(frozen=True, eq=False)
class _Estimator:
    fitted: Any

    def scores(self, states: np.ndarray) -> np.ndarray:
        if hasattr(self.fitted, "decision_function"):
            return np.asarray(self.fitted.decision_function(states), float)
        chance = np.clip(self.fitted.predict_proba(states)[:, 1], 1e-12, 1 - 1e-12)
        return np.log(chance / (1 - chance))


def erased(states: np.ndarray, void: np.ndarray) -> np.ndarray:
    """Return the states (n, d) changed so that no linear classifier finds the labels (n,).

    Least-squares concept erasure (LEACE, of Belrose et al. 2023) of these very states: the smallest change, in the
    metric of their own covariance, after which both sides have the same mean.

    Examples
    --------
    >>> states = np.array([[0.0, 5.0], [2.0, 5.0], [1.0, 7.0], [3.0, 7.0]])  # the first coordinate tells the sides
    >>> inside.erased(states, np.array([False, True, False, True])).round(6).tolist()
    [[1.0, 5.0], [1.0, 5.0], [2.0, 7.0], [2.0, 7.0]]
    """
    states = np.asarray(states, float)
    centred, label = states - states.mean(axis=0), void - np.mean(void)
    left_vectors, size, right_vectors = np.linalg.svd(centred, full_matrices=False)
    mask = size > size[0] * max(states.shape) * np.finfo(float).eps
    label_direction = left_vectors[:, mask].T @ label  # rows of `left` have unit covariance up to a factor
    label_direction /= np.linalg.norm(label_direction)
    return states - np.outer(
        centred @ ((label_direction / size[mask]) @ right_vectors[mask]),
        (label_direction * size[mask]) @ right_vectors[mask],
    )
