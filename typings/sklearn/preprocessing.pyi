# What this project imports, since pyright would take minutes to infer it from the source: add what you need.
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator

class StandardScaler(BaseEstimator):
    mean_: np.ndarray
    scale_: np.ndarray
    var_: np.ndarray
    def __init__(self, *, copy: bool = True, with_mean: bool = True, with_std: bool = True) -> None: ...
    def fit(self, X: ArrayLike, y: None = None, sample_weight: ArrayLike | None = None) -> Self: ...
    def transform(self, X: ArrayLike, copy: bool | None = None) -> np.ndarray: ...
    def fit_transform(self, X: ArrayLike, y: None = None) -> np.ndarray: ...
