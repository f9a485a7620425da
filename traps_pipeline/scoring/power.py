"""How precise a study will be before it is run: the width of PECS's interval, and the difference that can be found.

The delta method on PECS = Acc x (AbsRec - FalseAbs) of each dataset, for answers that are drawn independently. An
answer that abstains is not correct, so the two shares of the controls exclude each other. The overall figure is the
mean over datasets. Runs ask the same scenarios again and are not counted. Two datasets of one taxonomy share their
clips: where answers to them go together, intervals are wider than this.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

Z_95, Z_80 = 1.959963984540054, 0.8416212335729143  # of a two-sided 5 % test, and of 80 % power


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
        return self.acc * max(0.0, self.abs_rec - self.false_abs)


@dataclass(frozen=True)
class Precision:
    """width: of the 95 % interval of PECS. difference: the smallest one between two models of unrelated answers that a
    test at 5 % finds in 80 % of studies; answers of the same items go together, which makes it smaller, and the
    correction for many comparisons makes it larger."""

    width: float
    difference: float


def precision(pairs: Sequence[int], shares: Shares | None = None) -> Precision:
    """The precision of the mean over datasets with these numbers of pairs (those without a pair left out). Raises
    ValueError where none has a pair."""
    counts = [n for n in pairs if n]
    if not counts:
        raise ValueError("no dataset has a pair")
    s = shares or Shares()
    j = s.abs_rec - s.false_abs
    of_a_pair = (
        j * j * s.acc * (1 - s.acc)
        + s.acc * s.acc * (s.abs_rec * (1 - s.abs_rec) + s.false_abs * (1 - s.false_abs))
        + 2 * j * s.acc * s.acc * s.false_abs  # correct and abstained exclude each other: their covariance is negative
    )
    error = sqrt(sum(of_a_pair / n for n in counts)) / len(counts)
    return Precision(2 * Z_95 * error, (Z_95 + Z_80) * sqrt(2) * error)
