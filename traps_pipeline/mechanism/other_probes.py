"""Alternative probes for `traps_pipeline.inside.protocol`, and the erasure of a concept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from traps_pipeline.mechanism.probes import Fit, Probe, Scorer, standardiser


def mean_difference(states: np.ndarray, void: np.ndarray) -> Scorer:
    """Return the probe whose weights are the difference of the sides' standardised means.

    A score of 0 lies half-way between them.
    """
    mean, scale = standardiser(np.asarray(states, float))
    standard = (states - mean) / scale
    sides = standard[void].mean(axis=0), standard[~void].mean(axis=0)
    weights = sides[0] - sides[1]
    return Probe(mean, scale, weights, float(-(sides[0] + sides[1]) @ weights / 2))


def from_sklearn(make: Callable[[], Any]) -> Fit:
    """Return a fit function for any scikit-learn classifier or pipeline; make: returns a new one.

    Scores are its decision function, or the log-odds of its probabilities.
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


@dataclass(frozen=True, eq=False)
class Eraser:
    """Least-squares concept erasure for one binary concept (LEACE, of Belrose et al. 2023).

    It is the smallest change of states, in the metric of their own covariance, after which both sides have the same
    mean. mean: (d,), of the fitted states. read, written: (d,), the component that is read from a state, and the one
    subtracted.
    """

    mean: np.ndarray
    read: np.ndarray
    written: np.ndarray

    @staticmethod
    def of(states: np.ndarray, void: np.ndarray) -> Eraser:
        """Return the eraser of the side of an item, fitted on states (n, d) and void (n,)."""
        states = np.asarray(states, float)
        mean, label = states.mean(axis=0), void - np.mean(void)
        left, size, right = np.linalg.svd(states - mean, full_matrices=False)
        mask = size > size[0] * max(states.shape) * np.finfo(float).eps
        towards = left[:, mask].T @ label  # rows of `left` have unit covariance up to a factor
        towards /= np.linalg.norm(towards)
        return Eraser(mean, (towards / size[mask]) @ right[mask], (towards * size[mask]) @ right[mask])

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """Return states (m, d) without the concept."""
        states = np.asarray(states, float)
        return states - np.outer((states - self.mean) @ self.read, self.written)


def erase_side(states: np.ndarray, void: np.ndarray) -> np.ndarray:
    """Return states (n, d) from which no linear classifier can tell the sides, by the `Eraser` of these very states."""
    return Eraser.of(states, void)(states)
