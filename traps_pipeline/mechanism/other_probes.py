"""Probes besides the regression of the protocol: some by name, and any classifier of scikit-learn.

An experiment names them (`mechanism.probes.others`), and they stand in the table `probe_baselines` beside raw inputs;
in a notebook `traps_pipeline.inside.protocol` takes the same names, or any function of one's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.contrast import ccs
from traps_pipeline.mechanism.probes import Fit, Probe, Scorer, fit_probe, standardiser


def mean_difference(states: np.ndarray, void: np.ndarray) -> Scorer:
    """The probe whose weights are the difference of the sides' standardised means; 0 lies half-way between them."""
    mean, scale = standardiser(np.asarray(states, float))
    standard = (states - mean) / scale
    sides = standard[void].mean(axis=0), standard[~void].mean(axis=0)
    weights = sides[0] - sides[1]
    return Probe(mean, scale, weights, float(-(sides[0] + sides[1]) @ weights / 2))


def from_sklearn(make: Callable[[], Any]) -> Fit:
    """A probe of any scikit-learn classifier or pipeline; make: returns a new one. Scores are its decision function, or
    the log-odds of its probabilities."""

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
    """Least-squares concept erasure for one binary concept (LEACE, of Belrose et al. 2023): the smallest change of
    states, in the metric of their own covariance, after which both sides have the same mean.

    mean: (d,), of the states that it was fitted on. read, written: (d,), what of a state is taken out, and along what.
    """

    mean: np.ndarray
    read: np.ndarray
    written: np.ndarray

    @staticmethod
    def of(states: np.ndarray, void: np.ndarray) -> Eraser:
        """The erasure of which side an item is on, from states (n, d) and void (n,)."""
        states = np.asarray(states, float)
        mean, label = states.mean(axis=0), void - np.mean(void)
        left, size, right = np.linalg.svd(states - mean, full_matrices=False)
        kept = size > size[0] * max(states.shape) * np.finfo(float).eps
        towards = left[:, kept].T @ label  # rows of `left` have unit covariance up to a factor
        towards /= np.linalg.norm(towards)
        return Eraser(mean, (towards / size[kept]) @ right[kept], (towards * size[kept]) @ right[kept])

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """States (m, d) without the concept."""
        states = np.asarray(states, float)
        return states - np.outer((states - self.mean) @ self.read, self.written)


def erased(states: np.ndarray, void: np.ndarray) -> np.ndarray:
    """States (n, d) from which no linear classifier can tell the sides, by the `Eraser` of these very states."""
    return Eraser.of(states, void)(states)


def erased_probe(states: np.ndarray, void: np.ndarray) -> Scorer:
    """The regression of the protocol on states from which its source's sides were erased: what is left for it on a
    target was not linear in the source. It finds nothing to fit, so its figures are .5 but for what is written off as
    rounding (`_LEFT`); anything else would be a fault of the erasure."""
    eraser = Eraser.of(states, void)
    return _Erased(eraser, fit_probe(eraser(states), void))


@dataclass(frozen=True, eq=False)
class _Erased:
    eraser: Eraser
    probe: Scorer

    def scores(self, states: np.ndarray) -> np.ndarray:
        return np.round(self.probe.scores(self.eraser(states)), _LEFT)


_LEFT = 5  # digits of log-odds; what is smaller is rounding of float32 states
# By name: what an experiment and a notebook can ask for. CCS takes pairs of states (`contrast`).
NAMED: dict[str, Fit] = {"logistic": fit_probe, "mean difference": mean_difference, "CCS": ccs, "erased": erased_probe}
OF_PAIRS = ("CCS",)


def fit_named(name: str, seed: int) -> Fit:
    """A probe of NAMED, or a classifier of scikit-learn by its class name on standardised states, with its own settings
    and, where it draws, this seed. Nothing else can be named. Raises TrapsError for a name that is neither."""
    if name in NAMED:
        return NAMED[name]
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler
    from sklearn.utils import all_estimators

    known = dict(all_estimators(type_filter="classifier"))
    if name not in known:
        raise TrapsError(
            f"no probe {name!r:.60}; name one of {', '.join(NAMED)}, or a classifier of scikit-learn by its class, "
            "e.g. LinearSVC"
        )

    def make() -> Any:
        try:
            estimator = known[name]()
        except TypeError as error:
            raise TrapsError(
                f"probe {name} cannot be made without settings ({error}); name another classifier"
            ) from error
        if "random_state" in estimator.get_params():
            estimator.set_params(random_state=seed)
        return make_pipeline(StandardScaler(), estimator)

    make()
    return from_sklearn(make)
