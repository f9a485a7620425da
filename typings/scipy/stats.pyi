# What this project imports, since pyright would take minutes to infer it from the source: add what you need.
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

_Alternative = Literal["two-sided", "less", "greater"]
_NanPolicy = Literal["propagate", "omit", "raise"]

class _ConfidenceInterval(NamedTuple):
    low: float
    high: float

class _BinomTestResult:
    k: int
    n: int
    alternative: _Alternative
    statistic: float
    pvalue: float
    def proportion_ci(
        self, confidence_level: float = 0.95, method: Literal["exact", "wilson", "wilsoncc"] = "exact"
    ) -> _ConfidenceInterval: ...

class _BootstrapResult:
    confidence_interval: _ConfidenceInterval
    bootstrap_distribution: np.ndarray
    standard_error: float

class _SignificanceResult(NamedTuple):
    statistic: float
    pvalue: float

class _Normal:
    def cdf(self, x: ArrayLike, loc: ArrayLike = 0, scale: ArrayLike = 1) -> np.ndarray: ...
    def ppf(self, q: ArrayLike, loc: ArrayLike = 0, scale: ArrayLike = 1) -> np.ndarray: ...

norm: _Normal

def binomtest(k: int, n: int, p: float = 0.5, alternative: _Alternative = "two-sided") -> _BinomTestResult: ...
def bootstrap(
    data: Sequence[ArrayLike],
    statistic: Callable[..., object],
    *,
    n_resamples: int = 9999,
    batch: int | None = None,
    vectorized: bool | None = None,
    paired: bool = False,
    axis: int = 0,
    confidence_level: float = 0.95,
    alternative: _Alternative = "two-sided",
    method: Literal["percentile", "basic", "BCa"] = "BCa",
    bootstrap_result: _BootstrapResult | None = None,
    rng: np.random.Generator | int | None = None,
) -> _BootstrapResult: ...
def kendalltau(
    x: ArrayLike,
    y: ArrayLike,
    *,
    nan_policy: _NanPolicy = "propagate",
    method: Literal["auto", "asymptotic", "exact"] = "auto",
    variant: Literal["b", "c"] = "b",
    alternative: _Alternative = "two-sided",
) -> _SignificanceResult: ...
def rankdata(
    a: ArrayLike,
    method: Literal["average", "min", "max", "dense", "ordinal"] = "average",
    *,
    axis: int | None = None,
    nan_policy: _NanPolicy = "propagate",
) -> np.ndarray: ...
