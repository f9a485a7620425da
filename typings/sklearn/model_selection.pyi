# What this project imports, since pyright would take minutes to infer it from the source: add what you need.
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator

class _Splits:
    def split(
        self, X: ArrayLike, y: ArrayLike | None = None, groups: ArrayLike | None = None
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]: ...

class GroupKFold(_Splits):
    def __init__(
        self, n_splits: int = 5, *, shuffle: bool = False, random_state: int | np.random.RandomState | None = None
    ) -> None: ...

class StratifiedKFold(_Splits):
    def __init__(
        self, n_splits: int = 5, *, shuffle: bool = False, random_state: int | np.random.RandomState | None = None
    ) -> None: ...

class PredefinedSplit(_Splits):
    def __init__(self, test_fold: ArrayLike) -> None: ...

def cross_val_predict(
    estimator: BaseEstimator,
    X: ArrayLike,
    y: ArrayLike | None = None,
    *,
    groups: ArrayLike | None = None,
    cv: _Splits | int | None = None,
    n_jobs: int | None = None,
    method: str = "predict",
) -> np.ndarray: ...
def cross_val_score(
    estimator: BaseEstimator,
    X: ArrayLike,
    y: ArrayLike | None = None,
    *,
    groups: ArrayLike | None = None,
    scoring: str | None = None,
    cv: _Splits | int | None = None,
    n_jobs: int | None = None,
) -> np.ndarray: ...
