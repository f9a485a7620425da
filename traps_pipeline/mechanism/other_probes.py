"""Probes besides the regression of the protocol: some by name, and any classifier of scikit-learn.

An experiment names them (`mechanism.probes.others`), and they stand in the table `probe_baselines` beside raw inputs;
in a notebook `traps_pipeline.inside.protocol` takes them, or any function of one's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from traps_pipeline.errors import TrapsError
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


NAMED: dict[str, Fit] = {"logistic": fit_probe, "mean difference": mean_difference}


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
            f"mechanism.probes.others: no probe {name!r:.60}; name one of {', '.join(NAMED)}, or a classifier of "
            "scikit-learn by its class, e.g. LinearSVC"
        )

    def make() -> Any:
        try:
            estimator = known[name]()
        except TypeError as error:
            raise TrapsError(
                f"mechanism.probes.others: {name} cannot be made without settings ({error}); name another classifier"
            ) from error
        if "random_state" in estimator.get_params():
            estimator.set_params(random_state=seed)
        return make_pipeline(StandardScaler(), estimator)

    make()
    return from_sklearn(make)
