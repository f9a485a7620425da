# What this project imports, since pyright would take minutes to infer it from the source: add what you need.
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import _Classifier

class LogisticRegression(_Classifier):
    coef_: np.ndarray
    intercept_: np.ndarray
    n_iter_: np.ndarray
    def __init__(
        self,
        *,
        C: float = 1.0,
        l1_ratio: float | None = 0.0,
        dual: bool = False,
        tol: float = 1e-4,
        fit_intercept: bool = True,
        intercept_scaling: float = 1,
        class_weight: dict[object, float] | Literal["balanced"] | None = None,
        random_state: int | np.random.RandomState | None = None,
        solver: str = "lbfgs",
        max_iter: int = 100,
        verbose: int = 0,
        warm_start: bool = False,
    ) -> None: ...
    def decision_function(self, X: ArrayLike) -> np.ndarray: ...
