"""How precise a study will be before it is run: the width of PECS's interval, and the difference that can be found.

Studies of a model are drawn, with answers that are independent of each other, and each is resampled as `bootstrap`
does it. That holds at J = 0 as well, where PECS is clipped, and with few pairs. The overall figure is the mean over
datasets. Runs ask the same scenarios again and are not counted. Two datasets of one taxonomy share their clips: where
answers to them go together, intervals are wider than this.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np

from traps_pipeline.scoring.bootstrap import percentiles
from traps_pipeline.scoring.metrics import pecs_of

Z_95, Z_80 = 1.959963984540054, 0.8416212335729143  # of a two-sided 5 % test, and of 80 % power
STUDIES, RESAMPLES, SEED = 400, 400, 7  # 0.3 s; the width is off by less than 2 %


@dataclass(frozen=True)
class Shares:
    """What a model is assumed to be: the shares of controls answered rightly and abstained on, and of voids abstained
    on. Those of the default lie in the middle of the paper's models."""

    acc: float = 0.6
    abs_rec: float = 0.5
    false_abs: float = 0.1

    @property
    def pecs(self) -> float:
        """PECS of these shares."""
        return float(pecs_of(np.asarray(self.acc), np.asarray(self.abs_rec - self.false_abs)))


@dataclass(frozen=True)
class Precision:
    """width: of the 95 % interval of PECS. difference: the smallest one between two models of unrelated answers that a
    test at 5 % finds in 80 % of studies; answers of the same items go together, which makes it smaller, and the
    correction for many comparisons makes it larger. None where not even a difference of 1 is found so often."""

    width: float
    difference: float | None


def precision(pairs: Sequence[int], shares: Shares | None = None) -> Precision:
    """The precision of the mean over datasets with these numbers of pairs (those without a pair left out). Raises
    ValueError where none has a pair."""
    counts = [n for n in pairs if n]
    if not counts:
        raise ValueError("no dataset has a pair")
    s, rng = shares or Shares(), np.random.default_rng(SEED)
    controls = np.array([s.acc, s.false_abs, max(0.0, 1 - s.acc - s.false_abs)])
    found, drawn = np.zeros(STUDIES), np.zeros((STUDIES, RESAMPLES))
    for n in counts:
        control = rng.multinomial(n, controls, size=STUDIES) / n
        void = rng.binomial(n, s.abs_rec, size=STUDIES) / n
        found += _pecs(control, void) / len(counts)
        again = rng.multinomial(n, control[:, None], size=(STUDIES, RESAMPLES)) / n
        drawn += _pecs(again, rng.binomial(n, void[:, None], size=(STUDIES, RESAMPLES)) / n) / len(counts)
    low, high = percentiles(drawn).T
    difference = (Z_95 + Z_80) * sqrt(2) * float(found.std())
    return Precision(float(np.mean(high - low)), difference if difference <= 1 else None)


def _pecs(control: np.ndarray, void: np.ndarray) -> np.ndarray:
    """PECS of shares of controls (.., right, abstained, rest) and of voids abstained on (..)."""
    return pecs_of(control[..., 0], void - control[..., 1])
